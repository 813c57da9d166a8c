//! Whether a model can run on a data set, checked before anything is computed.

use super::EvaluationError;
use super::config::ScoredSplit;
use super::windows::window_shape;
use crate::frame_marks::{self, FramesOfTraining};
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::{Manifest, Model};
use foreframe_core::types::Seed;
use foreframe_data::dataset::{Dataset, DatasetInfo, Window};

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

/// Errors: `TrainedOn` and `TrainedOnFrames` if the model was trained on this data set, or on frames of these windows of it, so that it
/// cannot be tested on all of it; those of [`Dataset::pixels`].
pub(super) fn check_untrained(loaded: &Model, dataset: &Dataset, windows: &[Window]) -> Result<(), EvaluationError> {
    let (model, info) = (&loaded.manifest, dataset.info());
    let (name, title) = (model.name.clone(), info.name.clone());
    if model.dataset.includes(&info.content_hash) {
        return Err(EvaluationError::TrainedOn {
            model: name,
            dataset: title,
        });
    }
    match frames_of_training(loaded, dataset, windows)? {
        Some(frames) if frames.were_trained_on() => Err(EvaluationError::TrainedOnFrames {
            model: name,
            dataset: title,
            frames,
        }),
        _ => Ok(()),
    }
}

/// How many frames of these windows the training had. Not asked of a data set that the model was trained on, which is split. Not known
/// of a model of an earlier program. Errors: those of [`Dataset::pixels`].
pub(super) fn frames_of_training(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
) -> Result<Option<FramesOfTraining>, EvaluationError> {
    let trained = &loaded.manifest.dataset;
    if trained.frame_marks.is_empty() || trained.includes(&dataset.info().content_hash) {
        return Ok(None);
    }
    // The training had the frames as they are stored.
    let as_stored = (dataset.brightness() != 1.0).then(|| dataset.clone().with_brightness(1.0));
    let length = window_shape(loaded.spec()).frames();
    let marks = frame_marks::of_windows(as_stored.as_ref().unwrap_or(dataset), windows, length)?;
    Ok(Some(FramesOfTraining::count(&marks, &trained.frame_marks)))
}

/// Whether the scores may be written into the model's manifest: those on its own data set, and those that replace none of another data
/// set. Errors: `OtherScores`.
#[doc(hidden)]
pub fn check_saving(loaded: &Model, dataset: &Dataset, split: ScoredSplit) -> Result<(), EvaluationError> {
    let (model, info) = (&loaded.manifest, dataset.info());
    if model.dataset.includes(&info.content_hash) {
        return Ok(());
    }
    let split = split.of(loaded, dataset);
    let names = split.splits().iter().map(|&part| split.set_name(dataset, part));
    let is_of_another = |name: &&str| {
        let saved = model.metrics.get(*name);
        saved.is_some_and(|scores| scores["dataset_content_hash"] != info.content_hash.as_str())
    };
    match { names }.find(is_of_another) {
        Some(set) => Err(EvaluationError::OtherScores {
            model: model.name.clone(),
            set,
            dataset: info.name.clone(),
        }),
        None => Ok(()),
    }
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
