//! Small models with random weights, for tests.

use std::sync::Arc;

use crate::nn::{
    Architecture, ChannelScale, Conditioning, DenseSpec, FlowLayers, FlowSpec, ModelSpec, Network, Parameters,
};
use crate::registry::Model;
use crate::types::Seed;

/// A small model with random weights.
pub(crate) fn test_model() -> Model {
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
pub(crate) fn test_flow_model() -> Model {
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
pub(crate) fn test_depth_model() -> Model {
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
pub(crate) fn test_speed_model() -> Model {
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
fn loaded(spec: ModelSpec) -> Model {
    let parameters = Parameters::initialize(&spec, Seed(1)).unwrap();
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
