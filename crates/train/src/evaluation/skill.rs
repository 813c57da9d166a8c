//! The headline: the share of the strongest baseline's error that the model removes.

use serde::{Deserialize, Serialize};

use super::bootstrap::{Bootstrap, Interval, TrialSums};
use super::method::Method;
use super::metrics::{StepCurve, WindowScores};

/// skill = 1 − MSE / MSE of the strongest baseline: 1 is perfect, 0 is no better than that baseline, below 0 is worse.
/// The strongest baseline is chosen at each step ahead, and again in each resample.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Skill {
    /// At each step ahead, and their mean.
    pub skill: StepCurve,
    /// 95 % bootstrap interval at each step; empty with fewer than two trials or blocks of time.
    pub per_step_interval: Vec<Interval>,
    /// 95 % bootstrap interval of the mean; absent with fewer than two trials or blocks of time.
    pub mean_interval: Option<Interval>,
    /// The strongest baseline at each step.
    pub best_baseline: Vec<Method>,
    /// The baseline with the least mean MSE over all steps.
    pub best_mean_baseline: Method,
    /// 1 − mean MSE / mean MSE of that one baseline.
    pub against_best_mean: f64,
}

/// The skill of the model over these windows, whose rows are these methods: the model, the baselines and perhaps the codec.
pub(super) fn skill(methods: &[Method], windows: &[WindowScores], bootstrap: &Bootstrap) -> Skill {
    skill_against(Method::is_baseline, methods, windows, bootstrap)
}

/// The same against only those of the baselines that count.
pub(super) fn skill_against(
    counts: impl Fn(Method) -> bool,
    methods: &[Method],
    windows: &[WindowScores],
    bootstrap: &Bootstrap,
) -> Skill {
    let numbered = methods.iter().copied().enumerate();
    let (places, baselines): (Vec<usize>, Vec<Method>) = numbered
        .filter(|&(_, method)| method.is_baseline() && counts(method))
        .unzip();
    // The first row is the model's.
    let places: Vec<usize> = [0].into_iter().chain(places).collect();
    let rows = places.len();
    let errors_by_row = |window: &WindowScores| -> Vec<f64> {
        let rows = places.iter().filter_map(|&place| window.frames.get(place));
        rows.flat_map(|steps| steps.iter().map(|score| score.mse)).collect()
    };
    let trial_of: Vec<usize> = windows.iter().map(|window| window.group).collect();
    let trials = TrialSums::group(&trial_of, windows.iter().map(errors_by_row));
    let means = trials.means();
    let mut intervals = trials
        .intervals(bootstrap, |means| {
            let per_step = skills(&baselines, means);
            let mean = StepCurve::new(per_step.clone()).mean;
            per_step.into_iter().chain([mean]).collect()
        })
        .unwrap_or_default();
    let mean_interval = intervals.pop();
    let steps = means.len() / rows;
    let mean_errors: Vec<f64> = means
        .chunks(steps.max(1))
        .map(|steps| steps.iter().sum::<f64>() / steps.len() as f64)
        .collect();
    let (best_mean_baseline, least) = best(&baselines, &mean_errors, 0);
    Skill {
        skill: StepCurve::new(skills(&baselines, &means)),
        per_step_interval: intervals,
        mean_interval,
        best_baseline: (0..steps).map(|step| best(&baselines, &means, step).0).collect(),
        best_mean_baseline,
        against_best_mean: mean_errors.first().map_or(0.0, |&model| share_removed(model, least)),
    }
}

/// The strongest baseline at a step and its error. `means` holds the model's steps, then those of each baseline.
fn best(baselines: &[Method], means: &[f64], step: usize) -> (Method, f64) {
    let steps = means.len() / (1 + baselines.len());
    let mut best = (Method::CopyLast, f64::INFINITY);
    for (row, &method) in baselines.iter().enumerate() {
        let error = means[(1 + row) * steps + step];
        if error < best.1 {
            best = (method, error);
        }
    }
    best
}

fn skills(baselines: &[Method], means: &[f64]) -> Vec<f64> {
    let steps = means.len() / (1 + baselines.len());
    (0..steps)
        .map(|step| share_removed(means[step], best(baselines, means, step).1))
        .collect()
}

/// Where a baseline makes no error at all, there is none to remove.
fn share_removed(model: f64, baseline: f64) -> f64 {
    if baseline > 0.0 { 1.0 - model / baseline } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::metrics::FrameScore;
    use foreframe_core::types::Seed;

    const BOOTSTRAP: Bootstrap = Bootstrap {
        samples: 200,
        seed: Seed(5),
    };

    const BASELINES: i32 = 11;

    /// Two steps; every baseline errs by 0.1 · (1 + its row), times the trial's difficulty.
    fn windows(model: impl Fn(f64) -> f64) -> Vec<WindowScores> {
        (0..30)
            .map(|i| {
                let difficulty = 1.0 + (i % 7) as f64;
                let errors = [model(difficulty)]
                    .into_iter()
                    .chain((1..=BASELINES).map(|row| 0.1 * f64::from(row) * difficulty));
                WindowScores {
                    episode: i / 3,
                    first_frame: i,
                    group: i / 3,
                    frames: errors
                        .map(|mse| {
                            vec![
                                FrameScore {
                                    mse,
                                    ..FrameScore::default()
                                };
                                2
                            ]
                        })
                        .collect(),
                    model_space_mse: vec![0.0; 2],
                    reconstruction_mse: vec![0.0; 2],
                }
            })
            .collect()
    }

    #[test]
    fn a_perfect_model_has_skill_1() {
        let skill = skill(&Method::ALL, &windows(|_| 0.0), &BOOTSTRAP);
        assert_eq!(skill.skill, StepCurve::new(vec![1.0; 2]));
        assert_eq!(skill.mean_interval, Some(Interval { low: 1.0, high: 1.0 }));
        assert_eq!(skill.best_baseline, [Method::CopyLast; 2]);
    }

    #[test]
    fn a_model_that_copies_the_last_frame_has_none() {
        let same = skill(&Method::ALL, &windows(|difficulty| 0.1 * difficulty), &BOOTSTRAP);
        assert!(same.skill.mean.abs() < 1e-12 && same.against_best_mean.abs() < 1e-12);
        let worse = skill(&Method::ALL, &windows(|difficulty| 0.2 * difficulty), &BOOTSTRAP);
        assert!(worse.skill.mean < 0.0);
    }

    #[test]
    fn only_baselines_that_count_are_compared_each_with_its_own_row() {
        let windows = windows(|difficulty| 0.1 * difficulty);
        // Row 7 errs by 0.7, row 9 by 0.9.
        let [kept, weaker] = [Method::ALL[7], Method::ALL[9]];
        let few = skill_against(
            |method| method == kept || method == weaker,
            &Method::ALL,
            &windows,
            &BOOTSTRAP,
        );
        assert_eq!((few.best_mean_baseline, &*few.best_baseline), (kept, &[kept; 2][..]));
        assert!((few.skill.mean - (1.0 - 0.1 / 0.7)).abs() < 1e-12, "{few:?}");
        assert!(few.skill.mean >= skill(&Method::ALL, &windows, &BOOTSTRAP).skill.mean);
    }

    #[test]
    fn the_interval_holds_the_estimate() {
        let skill = skill(
            &Method::ALL,
            &windows(|difficulty| 0.02 * difficulty * difficulty),
            &BOOTSTRAP,
        );
        let interval = skill.mean_interval.unwrap();
        assert!(interval.low < skill.skill.mean && skill.skill.mean < interval.high);
        assert_eq!(skill.per_step_interval.len(), 2);
    }
}
