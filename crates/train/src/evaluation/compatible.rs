//! Whether a model can run on a data set, checked before anything is computed.

use super::EvaluationError;
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Model;
use foreframe_core::types::{ModelName, Seed};
use foreframe_data::dataset::{Dataset, DatasetInfo};

/// Frame periods count as equal if they differ by less than this share.
const PERIOD_TOLERANCE: f64 = 0.01;

/// Errors: `FrameSize`, `FramePeriod`, `Channels` where the model cannot run on the data set.
pub fn check(loaded: &Model, dataset: &Dataset) -> Result<(), EvaluationError> {
    let (spec, info) = (loaded.spec(), dataset.info());
    let model = || loaded.manifest.name.clone();
    if (info.frame_width_px, info.frame_height_px) != (spec.frame_width_px, spec.frame_height_px) {
        return Err(EvaluationError::FrameSize {
            dataset: info.name.clone(),
            width: info.frame_width_px,
            height: info.frame_height_px,
            model: model(),
            wanted_width: spec.frame_width_px,
            wanted_height: spec.frame_height_px,
        });
    }
    if (info.frame_period_s - spec.frame_period_s).abs() > PERIOD_TOLERANCE * spec.frame_period_s {
        return Err(EvaluationError::FramePeriod {
            dataset: info.name.clone(),
            period_s: info.frame_period_s,
            model: model(),
            wanted_s: spec.frame_period_s,
        });
    }
    check_channels(info, spec, &model())
}

fn check_channels(info: &DatasetInfo, spec: &ModelSpec, model: &ModelName) -> Result<(), EvaluationError> {
    let uses = [
        ("action", spec.action_inputs(), &spec.actions, &info.action_channels),
        ("state", spec.state_inputs(), &spec.states, &info.state_channels),
    ];
    for (kind, used, wanted, found) in uses {
        if used.is_none() {
            continue;
        }
        let (wanted, found) = (comma_separated(wanted), comma_separated(found));
        if wanted != found {
            return Err(EvaluationError::Channels {
                dataset: info.name.clone(),
                kind,
                found,
                model: model.clone(),
                wanted,
            });
        }
    }
    Ok(())
}

/// Errors: `TrainedOn` if the model was trained on this data set, so that it cannot be tested on all of it.
pub fn check_untrained(loaded: &Model, dataset: &Dataset) -> Result<(), EvaluationError> {
    if loaded.manifest.dataset.content_hash == dataset.info().content_hash {
        return Err(EvaluationError::TrainedOn {
            model: loaded.manifest.name.clone(),
            dataset: dataset.info().name.clone(),
        });
    }
    Ok(())
}

/// The seed of the split to test with: that of the model's training, unless another is asked for.
/// Errors: `SplitSeed` where that would test on training data.
pub fn split_seed(loaded: &Model, dataset: &Dataset, asked: Option<Seed>) -> Result<Seed, EvaluationError> {
    let trained = &loaded.manifest.dataset;
    let seed = asked.unwrap_or(trained.split_seed);
    if seed != trained.split_seed && trained.content_hash == dataset.info().content_hash {
        return Err(EvaluationError::SplitSeed {
            model: loaded.manifest.name.clone(),
            trained: trained.split_seed.0,
            given: seed.0,
        });
    }
    Ok(seed)
}
