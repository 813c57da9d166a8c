//! Does the action matter? The same weights with true, shuffled, held and zeroed actions, and twins: models of the same
//! training budget that lack the action, the state or both.

use rand::Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::EvaluationError;
use super::bootstrap::{Bootstrap, Interval, TrialSums};
use super::inference::{ActionSource, Inference};
use super::metrics::StepCurve;
use super::progress::{EvaluationContext, EvaluationStage, Pass};
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Model;
use foreframe_core::types::Seed;
use foreframe_data::dataset::Window;

/// One row of the action table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// The actions that were carried out.
    True,
    /// The actions of another window.
    Shuffled,
    /// At every step the action that led to the last frame seen.
    Held,
    /// Zero in every component.
    Zeroed,
    /// A model with the state but without the action, trained with the same budget.
    TwinWithoutAction,
    /// A model with the action but without the state, trained with the same budget.
    TwinWithoutState,
    /// A model without conditioning, trained with the same budget.
    UnconditionedTwin,
}

impl Variant {
    /// The row's name in words.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::True => "true actions",
            Self::Shuffled => "shuffled actions",
            Self::Held => "held actions",
            Self::Zeroed => "zeroed actions",
            Self::TwinWithoutAction => "twin without the action",
            Self::TwinWithoutState => "twin without the state",
            Self::UnconditionedTwin => "unconditioned twin",
        }
    }

    /// Whether it is another model, which lacks the action.
    fn is_twin_without_action(self) -> bool {
        matches!(self, Self::TwinWithoutAction | Self::UnconditionedTwin)
    }
}

/// Which row of the table a twin is, by what it lacks. Errors: `Twin` where it takes other windows than the model, has
/// seen other data, or lacks neither the action nor the state.
pub(super) fn twin_variant(loaded: &Model, twin: &Model) -> Result<Variant, EvaluationError> {
    let (spec, other) = (loaded.spec(), twin.spec());
    let refused = |found: String, wanted: String| EvaluationError::Twin {
        twin: twin.manifest.name.clone(),
        found,
        model: loaded.manifest.name.clone(),
        wanted,
    };
    let window = |spec: &ModelSpec| format!("{} context frames and {} to predict", spec.context, spec.horizon);
    if window(spec) != window(other) {
        return Err(refused(window(other), window(spec)));
    }
    let data = |loaded: &Model| format!("training data \"{}\"", loaded.manifest.dataset.name);
    if loaded.manifest.dataset.content_hash != twin.manifest.dataset.content_hash {
        return Err(refused(data(twin), format!("the same {}", data(loaded))));
    }
    let inputs = |spec: &ModelSpec| (spec.action_inputs().is_some(), spec.state_inputs().is_some());
    match (inputs(spec), inputs(other)) {
        (_, (false, false)) => Ok(Variant::UnconditionedTwin),
        ((_, true), (false, true)) => Ok(Variant::TwinWithoutAction),
        ((_, true), (true, false)) => Ok(Variant::TwinWithoutState),
        ((_, takes_state), _) => {
            let wanted = if takes_state {
                "conditioning \"none\", \"state\" or \"action\""
            } else {
                "conditioning \"none\""
            };
            let found = format!("conditioning \"{}\"", other.conditioning);
            Err(refused(found, wanted.to_owned()))
        }
    }
}

/// Scores of one variant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActionRow {
    /// Which actions the model got.
    pub variant: Variant,
    /// Mean squared error per pixel.
    pub mse: StepCurve,
    /// 95 % bootstrap interval of the mean MSE, over trials or blocks of time; absent with fewer than two.
    pub interval: Option<Interval>,
    /// 1 − MSE(true) / MSE(this): the share of this error that the true actions remove.
    pub reduction: f64,
    /// Its 95 % interval, both resampled together.
    pub reduction_interval: Option<Interval>,
}

/// The table, and the finding from it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActionTable {
    /// True actions first.
    pub rows: Vec<ActionRow>,
    /// Whether true actions beat all other actions and a twin without the action, with intervals that do not overlap.
    pub conditioning_works: bool,
    /// The finding in a sentence.
    pub finding: String,
}

/// A variant's mean squared errors, `[window][step]`.
pub(super) type VariantErrors = (Variant, Vec<Vec<f64>>);

/// For each of `count` windows another one whose actions it gets: a single cycle through all (Sattolo 1986), so none
/// keeps its own. With a single window there is no other.
fn shuffle(count: usize, seed: Seed) -> Vec<usize> {
    let mut rng = seed.derive("shuffled actions", 0).rng();
    let mut donors: Vec<usize> = (0..count).collect();
    for last in (1..count).rev() {
        donors.swap(last, rng.random_range(0..last));
    }
    donors
}

/// Errors of each variant, per window and step. Errors: those of the network, `NotFinite`.
pub(super) fn compare(
    evaluation: &EvaluationContext,
    windows: &[Window],
) -> Result<Vec<VariantErrors>, EvaluationError> {
    let (Inference { loaded, dataset }, config) = (evaluation.inference, evaluation.config);
    let donors = shuffle(windows.len(), config.seed).into_iter();
    let donors = donors.map(|donor| windows[donor]);
    let own = [Variant::True, Variant::Shuffled, Variant::Held, Variant::Zeroed];
    let mut variants = own.map(|variant| (variant, loaded)).to_vec();
    for twin in &config.twins {
        variants.push((twin_variant(loaded, twin)?, twin));
    }
    let pairs: Vec<(Window, Window)> = windows.iter().copied().zip(donors).collect();
    let count = variants.len();
    let mut all = Vec::new();
    for (number, (variant, model)) in variants.into_iter().enumerate() {
        let inference = Inference { loaded: model, dataset };
        let window_values = model.spec().horizon * model.spec().pixels();
        let pass = Pass {
            number,
            count,
            ..evaluation.pass(EvaluationStage::Actions)
        };
        let errors = evaluation.in_divided_batches(pass, &pairs, |batch| {
            let (batch, donors): (Vec<Window>, Vec<Window>) = batch.iter().copied().unzip();
            let source = match variant {
                Variant::Shuffled => ActionSource::OfWindows(&donors),
                Variant::Held => ActionSource::Held,
                Variant::Zeroed => ActionSource::Zero,
                _ => ActionSource::Recorded,
            };
            let predicted = inference.predict(&batch, source)?.frames;
            let predicted = predicted.par_chunks_exact(window_values).zip(&batch);
            let found = predicted.map(|(frames, &window)| inference.step_errors(window, frames));
            found.collect::<Result<Vec<_>, EvaluationError>>()
        })?;
        all.push((variant, errors));
    }
    Ok(all)
}

/// The table of these errors per variant, window and step; the true actions come first.
pub(super) fn table(errors: &[VariantErrors], trial_of: &[usize], bootstrap: &Bootstrap) -> ActionTable {
    let of_window = |window: usize| -> Vec<f64> {
        let mean = |(_, windows): &VariantErrors| StepCurve::new(windows[window].clone()).mean;
        errors.iter().map(mean).collect()
    };
    let trials = TrialSums::group(trial_of, (0..trial_of.len()).map(of_window));
    let reduction = |means: &[f64], row: usize| {
        if means[row] > 0.0 {
            1.0 - means[0] / means[row]
        } else {
            0.0
        }
    };
    let intervals = trials.intervals(bootstrap, |means| {
        let reductions = (0..means.len()).map(|row| reduction(means, row));
        means.iter().copied().chain(reductions).collect()
    });
    let means = trials.means();
    let row = |(row, (variant, windows)): (usize, &VariantErrors)| {
        let steps = windows.first().map_or(0, Vec::len);
        ActionRow {
            variant: *variant,
            mse: StepCurve::mean_over(windows, steps, |window, step| window[step]),
            interval: intervals.as_ref().map(|all| all[row]),
            reduction: reduction(&means, row),
            reduction_interval: intervals.as_ref().map(|all| all[errors.len() + row]),
        }
    };
    let rows: Vec<ActionRow> = errors.iter().enumerate().map(row).collect();
    let (conditioning_works, finding) = judge(&rows);
    ActionTable {
        rows,
        conditioning_works,
        finding,
    }
}

/// Conditioning works only where true actions beat all others and a twin without the action, with intervals apart. A twin
/// without the state says nothing about the action.
fn judge(rows: &[ActionRow]) -> (bool, String) {
    let Some((truth, others)) = rows.split_first() else {
        return (false, "Nothing was compared.".to_owned());
    };
    let is_beaten = |row: &&ActionRow| match (&truth.interval, &row.interval) {
        (Some(truth), Some(other)) => truth.is_below(other),
        _ => false,
    };
    let others = others.iter().filter(|row| row.variant != Variant::TwinWithoutState);
    let (beaten, unbeaten): (Vec<&ActionRow>, Vec<&ActionRow>) = others.partition(is_beaten);
    let labels = |rows: &[&ActionRow]| comma_separated(&rows.iter().map(|row| row.variant.label()).collect::<Vec<_>>());
    if !unbeaten.is_empty() {
        let finding = format!(
            "Conditioning is not shown to work: the interval of true actions does not lie below that of {}.",
            labels(&unbeaten)
        );
        return (false, finding);
    }
    let beaten_labels = labels(&beaten);
    if !beaten.iter().any(|row| row.variant.is_twin_without_action()) {
        let finding = format!(
            "Conditioning is not shown to work yet: true actions beat {beaten_labels} with intervals apart, but no twin without the action was compared."
        );
        return (false, finding);
    }
    let least = beaten.iter().map(|row| row.reduction).fold(f64::INFINITY, f64::min);
    let finding = format!(
        "Conditioning works: true actions beat {beaten_labels} with intervals apart, by at least {:.0} % of the MSE.",
        100.0 * least
    );
    (true, finding)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn shuffling_permutes_and_no_window_keeps_its_own(count in 2usize..300, seed in any::<u64>()) {
            let donors = shuffle(count, Seed(seed));
            prop_assert!(donors.iter().enumerate().all(|(window, &donor)| window != donor));
            let mut sorted = donors;
            sorted.sort_unstable();
            prop_assert_eq!(sorted, (0..count).collect::<Vec<_>>());
        }
    }

    fn table_of(levels: &[(Variant, f64)]) -> ActionTable {
        let trial_of: Vec<usize> = (0..60).map(|i| i / 3).collect();
        let noisy = |level: f64| -> Vec<Vec<f64>> {
            trial_of
                .iter()
                .map(|&trial| vec![level * (1.0 + 0.1 * (trial as f64).sin()); 2])
                .collect()
        };
        let errors: Vec<_> = levels.iter().map(|&(variant, level)| (variant, noisy(level))).collect();
        let bootstrap = Bootstrap {
            samples: 200,
            seed: Seed(1),
        };
        table(&errors, &trial_of, &bootstrap)
    }

    #[test]
    fn conditioning_works_only_where_all_others_are_beaten() {
        let all = [
            (Variant::True, 1.0),
            (Variant::Shuffled, 2.0),
            (Variant::Zeroed, 1.5),
            (Variant::UnconditionedTwin, 1.4),
        ];
        let good = table_of(&all);
        assert!(good.conditioning_works, "{}", good.finding);
        assert!((good.rows[1].reduction - 0.5).abs() < 1e-9);
        assert!(!table_of(&all[..3]).conditioning_works);
        let close = table_of(&[all[0], all[1], (Variant::Zeroed, 1.01), all[3]]);
        assert!(
            !close.conditioning_works && close.finding.contains("zeroed"),
            "{}",
            close.finding
        );
    }
}
