//! Shared fixtures: a small data set in memory, and a model with random weights.

use std::collections::BTreeSet;
use std::path::Path;

use foreframe_core::files::sha256_hex;
use foreframe_core::nn::{Architecture, ChannelScale, Conditioning, DenseSpec, ModelSpec, Parameters};
use foreframe_core::registry::{self, DatasetStamp, Manifest, Model, ProgramStamp};
use foreframe_core::types::{Channel, Seed};
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData};

/// Frames per episode.
const FRAMES: u32 = 14;

/// Episodes in which a dark square moves over a brightness ramp; the action is its speed in pixels per frame.
pub(crate) fn moving_squares(episodes: usize, side: u32, period_s: f64) -> Dataset {
    let data = (0..episodes).map(|episode| {
        let speed = (episode % 3) as u32;
        let inside = |frame: u32, i: u32| (i / side) / 4 == 1 && (i % side + side - (speed * frame) % side) % side < 4;
        let pixel = |frame: u32, i: u32| {
            if inside(frame, i) {
                20
            } else {
                (120 + 4 * (i % side)) as u8
            }
        };
        let each = |value: &dyn Fn(u32, u32) -> u8| -> Vec<u8> {
            (0..FRAMES)
                .flat_map(|frame| (0..side * side).map(move |i| value(frame, i)))
                .collect()
        };
        EpisodeData {
            pixels: each(&pixel),
            masks: Some(each(&|frame, i| u8::from(inside(frame, i)))),
            actions: vec![speed as f32; FRAMES as usize],
            states: vec![0.5; FRAMES as usize],
            timestamps_s: (0..FRAMES).map(|frame| f64::from(frame) * period_s).collect(),
            ..EpisodeData::default()
        }
    });
    let info = DatasetInfo {
        name: "squares".to_owned(),
        frame_width_px: side,
        frame_height_px: side,
        frame_period_s: period_s,
        action_channels: vec![Channel::new("speed", "px/frame")],
        state_channels: vec![Channel::new("phase", "")],
        ..DatasetInfo::default()
    };
    Dataset::from_episodes(info, data.collect()).unwrap()
}

/// A small dense network for the moving squares.
pub(crate) fn squares_spec(side: u32) -> ModelSpec {
    let channel = |name: &str, unit: &str| ChannelScale {
        name: name.parse().unwrap(),
        unit: unit.to_owned(),
        mean: 1.0,
        std: 0.8,
    };
    ModelSpec {
        frame_width_px: side,
        frame_height_px: side,
        architecture: Architecture::Dense(DenseSpec {
            features: 8,
            hidden: 12,
            ..DenseSpec::default()
        }),
        conditioning: Conditioning::StateAction,
        actions: vec![channel("speed", "px/frame")],
        states: vec![channel("phase", "")],
        ..ModelSpec::default()
    }
}

/// Names a data set as that of a training, with the split seed 7.
pub(crate) fn stamp(dataset: &Dataset) -> DatasetStamp {
    DatasetStamp {
        parts: Vec::new(),
        name: dataset.info().name.clone(),
        content_hash: dataset.info().content_hash.clone(),
        scenario: None,
        windows: 0,
        split_seed: Seed(7),
        frame_marks: Vec::new(),
    }
}

/// The marks that a training on these frames keeps, if they are few.
pub(crate) fn frame_marks(dataset: &Dataset, frames: impl IntoIterator<Item = usize>) -> Vec<u64> {
    let mark = |frame: usize| u64::from_str_radix(&sha256_hex(&dataset.pixels(frame).unwrap())[..12], 16).unwrap();
    let marks: BTreeSet<u64> = frames.into_iter().map(mark).collect();
    assert!(marks.len() <= 512);
    marks.into_iter().collect()
}

/// A model with random weights, published in `model_dir` and loaded from there.
pub(crate) fn model(model_dir: &Path, name: &str, spec: ModelSpec, trained_on: DatasetStamp) -> Model {
    let parameters = Parameters::initialize(&spec, Seed(1)).unwrap();
    let manifest = Manifest {
        name: name.parse().unwrap(),
        version: 1,
        weights_sha256: String::new(),
        dataset: trained_on,
        seed: Seed(1),
        command: "a test".to_owned(),
        training: serde_json::json!({}),
        metrics: serde_json::json!({}),
        calibration: None,
        parameters: spec.parameter_count(),
        multiply_adds_per_frame: spec.multiply_adds_per_frame(),
        program: ProgramStamp::current(),
        spec,
    };
    registry::publish(model_dir, &parameters, &manifest).unwrap();
    registry::load(model_dir).unwrap()
}
