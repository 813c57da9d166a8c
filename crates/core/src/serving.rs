//! Predictions for many clients. One thread owns the models and computes in batches. [`Predictor`] is the handle to it,
//! [`batch`] chooses which waiting tasks are computed together, [`predict`] is the computation on the caller's own thread,
//! and [`session`] is the state that a stream of frames keeps between frames.

mod catalog;
mod compute;
mod conditioning;
mod error;
mod input;
mod local;
mod meter;
mod past_errors;
mod prediction;
mod predictor;
mod queue;
mod ranges;
mod task;
mod worker;

pub mod batch;
pub mod session;

pub use conditioning::{ConditioningInput, FieldNames, OBSERVATION_FIELDS, RawConditioning, STEP_FIELDS};
pub use error::{InputError, ServingError};
pub use input::PredictionInput;
pub use local::{Session, compute_task, predict};
pub use prediction::{Prediction, Rollout, Timing};
pub use predictor::{Predictor, PredictorConfig};
pub use session::{SessionSnapshot, SessionState};
pub use task::{Features, Task, check_size};

#[cfg(test)]
use std::sync::Arc;

#[cfg(test)]
use crate::registry::Model;

/// A small model with random weights.
#[cfg(test)]
pub fn test_model() -> Model {
    use crate::nn::{Architecture, ChannelScale, Conditioning, DenseSpec, ModelSpec};
    let channel = |name: &str| ChannelScale {
        name: name.to_owned(),
        unit: String::new(),
        mean: 0.0,
        std: 1.0,
    };
    let spec = ModelSpec {
        frame_width_px: 6,
        frame_height_px: 4,
        context: 3,
        horizon: 2,
        architecture: Architecture::Dense(DenseSpec {
            features: 5,
            hidden: 4,
            ..DenseSpec::default()
        }),
        conditioning: Conditioning::StateAction,
        actions: vec![channel("a")],
        states: vec![channel("s")],
        ..ModelSpec::default()
    };
    loaded(spec)
}

/// As [`test_model`], with the flow network, on frames of 8×4 px.
#[cfg(test)]
pub fn test_flow_model() -> Model {
    use crate::nn::{Architecture, FlowLayers, FlowSpec, ModelSpec};
    loaded(ModelSpec {
        architecture: Architecture::Flow(FlowSpec {
            layers: FlowLayers {
                channels: 8,
                stem_channels: 6,
                enlarged_channels: 3,
                fine_channels: 5,
                scene_hidden: 8,
                ..FlowLayers::default()
            },
            camera: None,
        }),
        frame_width_px: 8,
        ..test_model().network.spec().clone()
    })
}

/// As [`test_flow_model`], in the form that estimates depth, with a pose.
#[cfg(test)]
pub fn test_depth_model() -> Model {
    use crate::nn::{Architecture, ChannelScale, ModelSpec};
    let mut spec: ModelSpec = test_flow_model().network.spec().clone();
    if let Architecture::Flow(flow) = &mut spec.architecture {
        flow.layers.depth = true;
    }
    let channel = |name: &str| ChannelScale {
        name: name.to_owned(),
        ..spec.states[0].clone()
    };
    spec.states = ["x", "y", "heading_cos", "heading_sin"].map(channel).to_vec();
    loaded(spec)
}

/// As [`test_depth_model`], with speeds as actions.
#[cfg(test)]
pub fn test_speed_model() -> Model {
    use crate::nn::{ChannelScale, ModelSpec};
    let mut spec: ModelSpec = test_depth_model().network.spec().clone();
    let channel = |(name, unit): (&str, &str)| ChannelScale {
        name: name.to_owned(),
        unit: unit.to_owned(),
        ..spec.states[0].clone()
    };
    spec.actions = [("linear", "m/s"), ("angular", "rad/s")].map(channel).to_vec();
    loaded(spec)
}

/// A model of that specification with fresh weights.
#[cfg(test)]
fn loaded(spec: crate::nn::ModelSpec) -> Model {
    use crate::nn::{Network, Parameters};
    let parameters = Parameters::initialize(&spec, crate::types::Seed(1)).unwrap();
    let manifest = serde_json::json!({
        "name": "test", "version": 1, "spec": spec, "weights_sha256": "00",
        "dataset": {"name": "none", "content_hash": "", "scenario": null, "windows": 1, "split_seed": 0},
        "seed": 1, "command": "", "training": {}, "metrics": {}, "parameters": 1, "multiply_adds_per_frame": 1,
        "program": {"version": "0", "git_commit": null},
    });
    Model {
        manifest: Arc::new(serde_json::from_value(manifest).unwrap()),
        network: Network::detached(spec, &parameters).unwrap(),
    }
}
