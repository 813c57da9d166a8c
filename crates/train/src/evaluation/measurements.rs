//! What an evaluation measures of each window of a set, from which all of the set's scores follow.

use super::EvaluationError;
use super::actions::{self, VariantErrors};
use super::baselines::Baselines;
use super::bootstrap::is_recording;
use super::compatible::has_actions_of;
use super::forecast::{Forecast, forecasts};
use super::metrics::{WindowScores, add_benchmark};
use super::pixel_class::{self, ClassSums};
use super::plans;
use super::progress::EvaluationContext;
use super::ranking;
use super::report::SetScores;
use super::score::score;
use super::skill::skill_against;
use super::surroundings::{self, SurroundingsMeasurements};
use super::uncertainty;
use super::visibility;
use foreframe_data::dataset::Window;

/// What was measured of the windows of a set; in a part, of its share of them.
pub(super) struct Measurements {
    scores: Vec<WindowScores>,
    /// `None` for a model that takes no actions.
    actions: Option<ActionMeasurements>,
    surroundings: Option<SurroundingsMeasurements>,
    visibility: Vec<Option<ClassSums>>,
    /// `None` for a model without calibration.
    forecasts: Option<Vec<Forecast>>,
}

struct ActionMeasurements {
    errors: Vec<VariantErrors>,
    /// The share of the plans that each context identifies.
    plans: Vec<Option<f64>>,
    /// For each moment of a recording, how many plans are as good as the driven one.
    ranking: Vec<Vec<usize>>,
}

impl Measurements {
    /// Runs the model and the baselines. Errors: those of the network and the simulator, `NotFinite`, `Cancelled`, `Io`.
    pub(super) fn of(
        evaluation: &EvaluationContext,
        windows: &[Window],
        baselines: &Baselines,
    ) -> Result<Self, EvaluationError> {
        let loaded = evaluation.inference.loaded;
        let actions = || {
            Ok::<_, EvaluationError>(ActionMeasurements {
                errors: actions::compare(evaluation, windows)?,
                plans: plans::identify(evaluation, windows)?,
                ranking: ranking::rank(evaluation, windows)?,
            })
        };
        let calibration = loaded.manifest.calibration.as_ref();
        Ok(Self {
            scores: score(evaluation, windows, baselines)?,
            actions: has_actions_of(loaded.spec(), evaluation.inference.dataset)
                .then(actions)
                .transpose()?,
            surroundings: surroundings::measure(evaluation, windows)?,
            visibility: visibility::measure(evaluation, windows, baselines)?,
            forecasts: calibration
                .map(|calibration| forecasts(evaluation, windows, calibration))
                .transpose()?,
        })
    }

    /// The scores of all windows; also their novelty, if the model is calibrated.
    pub(super) fn scores(
        self,
        evaluation: &EvaluationContext,
        windows: &[Window],
        baselines: &Baselines,
    ) -> (SetScores, Vec<f64>) {
        let (inference, bootstrap) = (evaluation.inference, evaluation.config.bootstrap());
        let is_recording = is_recording(inference.dataset);
        let mut scores = SetScores::new(baselines.methods(), &self.scores, &bootstrap, is_recording);
        let trained_on = &inference.loaded.manifest.dataset;
        if !trained_on.includes(&inference.dataset.info().content_hash) {
            let knows_nothing = |method| !baselines.knows_dataset(method);
            let skill = skill_against(knows_nothing, baselines.methods(), &self.scores, &bootstrap);
            scores.skill_against_unfitted = Some(skill);
        }
        if baselines.are_of_benchmark() {
            add_benchmark(&mut scores.methods, &self.scores, inference.spec().pixels());
        }
        if let Some(found) = &self.actions {
            let group_of: Vec<usize> = self.scores.iter().map(|window| window.group).collect();
            scores.actions = Some(actions::table(&found.errors, &group_of, &bootstrap));
            scores.plans = Some(plans::outcome(evaluation, windows, &found.plans));
            scores.ranking = ranking::rates(evaluation, windows, &group_of, &found.ranking, &bootstrap);
        }
        scores.surroundings = self.surroundings.map(SurroundingsMeasurements::scores);
        scores.visibility = pixel_class::scores(baselines.methods(), self.visibility);
        let mut novelty = Vec::new();
        if let (Some(calibration), Some(found)) = (&inference.loaded.manifest.calibration, &self.forecasts) {
            let (measured, found) = uncertainty::scores(calibration, found);
            scores.uncertainty = Some(measured);
            novelty = found;
        }
        (scores, novelty)
    }
}
