//! Whether a model can run on a data set, checked before anything is computed.

use super::EvaluationError;
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::{Manifest, Model};
use foreframe_core::types::Seed;
use foreframe_data::dataset::{Dataset, DatasetInfo};

/// Frame periods count as equal if they differ by less than this share.
const PERIOD_TOLERANCE: f64 = 0.01;

/// Errors: `Mismatch` where the model cannot run on the data set.
pub(super) fn check(loaded: &Model, dataset: &Dataset) -> Result<(), EvaluationError> {
    check_fit(&loaded.manifest, dataset.info())
}

/// The same by their descriptions alone. Errors: `Mismatch`.
pub fn check_fit(model: &Manifest, info: &DatasetInfo) -> Result<(), EvaluationError> {
    let spec = &model.spec;
    let mismatch = |found: String, wanted: String| {
        Err(EvaluationError::Mismatch {
            dataset: info.name.clone(),
            found,
            model: model.name.clone(),
            wanted,
        })
    };
    let (found, wanted) = (
        format!("{}×{}", info.frame_width_px, info.frame_height_px),
        format!("{}×{}", spec.frame_width_px, spec.frame_height_px),
    );
    if found != wanted {
        return mismatch(format!("frames of {found} px"), format!("takes {wanted}"));
    }
    let (found, wanted) = (info.frame_period_s, spec.frame_period_s);
    if (found - wanted).abs() > PERIOD_TOLERANCE * wanted {
        return mismatch(
            format!("a frame every {found} s"),
            format!("predicts one every {wanted} s"),
        );
    }
    let uses = [
        ("action", spec.action_inputs(), &spec.actions, &info.action_channels),
        ("state", spec.state_inputs(), &spec.states, &info.state_channels),
    ];
    for (kind, used, wanted, found) in uses {
        let (wanted, found) = (comma_separated(wanted), comma_separated(found));
        if used.is_some() && wanted != found && !spec.sees_speeds() {
            return mismatch(format!("the {kind} [{found}]"), format!("takes [{wanted}]"));
        }
    }
    Ok(())
}

/// Whether the data set's states are those that the model takes.
pub(super) fn has_states_of(spec: &ModelSpec, dataset: &Dataset) -> bool {
    spec.state_inputs().is_some() && comma_separated(&spec.states) == comma_separated(&dataset.info().state_channels)
}

/// Errors: `Mismatch` where the model cannot run on the data set, or could only without the states and actions that it takes.
pub(super) fn check_inputs(loaded: &Model, dataset: &Dataset) -> Result<(), EvaluationError> {
    check(loaded, dataset)?;
    let (spec, info) = (loaded.spec(), dataset.info());
    let lacks_actions = spec.action_inputs().is_some() && !has_actions_of(spec, dataset);
    let lacks_states = spec.state_inputs().is_some() && !has_states_of(spec, dataset);
    if !(lacks_actions || lacks_states) {
        return Ok(());
    }
    let channels = [
        comma_separated(&info.action_channels),
        comma_separated(&info.state_channels),
    ];
    Err(EvaluationError::Mismatch {
        dataset: info.name.clone(),
        found: format!("the actions [{}] and the states [{}]", channels[0], channels[1]),
        model: loaded.manifest.name.clone(),
        wanted: format!(
            "takes [{}] and [{}]",
            comma_separated(&spec.actions),
            comma_separated(&spec.states)
        ),
    })
}

/// Whether the data set's actions are those that the model takes.
pub(super) fn has_actions_of(spec: &ModelSpec, dataset: &Dataset) -> bool {
    spec.action_inputs().is_some() && comma_separated(&spec.actions) == comma_separated(&dataset.info().action_channels)
}

/// Errors: `TrainedOn` if the model was trained on this data set, so that it cannot be tested on all of it.
pub(super) fn check_untrained(loaded: &Model, dataset: &Dataset) -> Result<(), EvaluationError> {
    if loaded.manifest.dataset.includes(&dataset.info().content_hash) {
        return Err(EvaluationError::TrainedOn {
            model: loaded.manifest.name.clone(),
            dataset: dataset.info().name.clone(),
        });
    }
    Ok(())
}

/// The seed of the split to test with: that of the model's training, unless another is asked for.
/// Errors: `SplitSeed` where that would test on training data.
pub(super) fn split_seed(loaded: &Model, dataset: &Dataset, asked: Option<Seed>) -> Result<Seed, EvaluationError> {
    let trained = &loaded.manifest.dataset;
    let seed = asked.unwrap_or(trained.split_seed);
    if seed != trained.split_seed && trained.includes(&dataset.info().content_hash) {
        return Err(EvaluationError::SplitSeed {
            model: loaded.manifest.name.clone(),
            trained: trained.split_seed.0,
            given: seed.0,
        });
    }
    Ok(seed)
}
