//! The headline: how much of the best trivial baseline's error the model takes away.

use serde::{Deserialize, Serialize};

use super::baselines::Method;
use super::bootstrap::{Bootstrap, Interval, TrialSums};
use super::metrics::{StepCurve, WindowScores};

/// skill = 1 − MSE / MSE(best trivial baseline): 1 is perfect, 0 is no better than the best of them, and below 0 is worse.
/// The best baseline is chosen anew at each step ahead (and in each resample), so the model meets the hardest there is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Skill {
    /// At each step ahead, and their mean.
    pub skill: StepCurve,
    /// 95 % bootstrap interval at each step; empty with fewer than two trials.
    pub per_step_interval: Vec<Interval>,
    /// 95 % bootstrap interval of the mean; absent with fewer than two trials.
    pub mean_interval: Option<Interval>,
    /// The best trivial baseline at each step.
    pub best_baseline: Vec<Method>,
}

/// The skill of the model over these windows.
#[must_use]
pub fn skill(windows: &[WindowScores], bootstrap: &Bootstrap) -> Skill {
    let trial_of: Vec<usize> = windows.iter().map(|window| window.episode).collect();
    let trials = TrialSums::group(&trial_of, windows.iter().map(errors_by_row));
    let means = trials.means();
    let mut intervals = trials
        .intervals(bootstrap, |means| {
            let per_step = skills(means);
            let mean = StepCurve::new(per_step.clone()).mean;
            per_step.into_iter().chain([mean]).collect()
        })
        .unwrap_or_default();
    let mean_interval = intervals.pop();
    Skill {
        skill: StepCurve::new(skills(&means)),
        per_step_interval: intervals,
        mean_interval,
        best_baseline: (0..step_count(&means)).map(|step| best(&means, step).0).collect(),
    }
}

/// The rows that skill compares: the model, then the baselines.
const ROWS: usize = 1 + Method::BASELINES.len();

fn errors_by_row(window: &WindowScores) -> Vec<f64> {
    let rows = window.frames.iter().take(ROWS);
    rows.flat_map(|steps| steps.iter().map(|score| score.mse)).collect()
}

fn step_count(means: &[f64]) -> usize {
    means.len() / ROWS
}

fn best(means: &[f64], step: usize) -> (Method, f64) {
    let mut best = (Method::CopyLast, f64::INFINITY);
    for (row, method) in Method::BASELINES.into_iter().enumerate() {
        let error = means[(1 + row) * step_count(means) + step];
        if error < best.1 {
            best = (method, error);
        }
    }
    best
}

fn skills(means: &[f64]) -> Vec<f64> {
    (0..step_count(means))
        .map(|step| {
            let (model, baseline) = (means[step], best(means, step).1);
            // Where a baseline makes no error at all there is none to take away.
            if baseline > 0.0 { 1.0 - model / baseline } else { 0.0 }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::metrics::FrameScore;
    use crate::types::Seed;

    const BOOTSTRAP: Bootstrap = Bootstrap {
        samples: 200,
        seed: Seed(5),
    };

    /// Two steps; every baseline errs by 0.1 · (1 + its row), times the trial's difficulty.
    fn windows(model: impl Fn(f64) -> f64) -> Vec<WindowScores> {
        (0..30)
            .map(|i| {
                let difficulty = 1.0 + (i % 7) as f64;
                let errors = [model(difficulty)]
                    .into_iter()
                    .chain((1..7).map(|row| 0.1 * f64::from(row) * difficulty));
                WindowScores {
                    episode: i / 3,
                    first_frame: i,
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
        let skill = skill(&windows(|_| 0.0), &BOOTSTRAP);
        assert_eq!(skill.skill, StepCurve::new(vec![1.0; 2]));
        assert_eq!(skill.mean_interval, Some(Interval { low: 1.0, high: 1.0 }));
        assert_eq!(skill.best_baseline, [Method::CopyLast; 2]);
    }

    #[test]
    fn a_model_that_copies_the_last_frame_has_none() {
        assert!(
            skill(&windows(|difficulty| 0.1 * difficulty), &BOOTSTRAP)
                .skill
                .mean
                .abs()
                < 1e-12
        );
        assert!(skill(&windows(|difficulty| 0.2 * difficulty), &BOOTSTRAP).skill.mean < 0.0);
    }

    #[test]
    fn the_interval_holds_the_estimate() {
        let skill = skill(&windows(|difficulty| 0.02 * difficulty * difficulty), &BOOTSTRAP);
        let interval = skill.mean_interval.unwrap();
        assert!(interval.low < skill.skill.mean && skill.skill.mean < interval.high);
        assert_eq!(skill.per_step_interval.len(), 2);
    }
}
