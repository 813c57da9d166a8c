//! Frames of many sizes, contexts and horizons of many lengths: both networks train on them and predict.

use std::path::Path;

use candle_core::{Device, Tensor};
use foreframe_core::nn::ConditioningTensors;
use foreframe_core::registry;
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData};
use foreframe_train::training::{TrainConfig, TrainingOutcome};

use crate::training::train;

/// Width and height in pixels, context and horizon in frames.
const SHAPES: [[usize; 4]; 5] = [
    [32, 32, 1, 1],
    [32, 48, 3, 50],
    [64, 32, 20, 2],
    [256, 32, 2, 3],
    [36, 256, 5, 1],
];

/// Episodes of a wave that drifts to the right.
fn waves(width: usize, height: usize, frames: usize) -> Dataset {
    let level = |frame: usize, at: usize| {
        let (row, column) = (at / width, at % width);
        let phase = (column as f32 - frame as f32) / 5.0 + row as f32 / 9.0;
        (128.0 + 100.0 * phase.sin()) as u8
    };
    let episode = |index: usize| EpisodeData {
        pixels: (0..frames)
            .flat_map(|frame| (0..width * height).map(move |at| level(frame + index, at)))
            .collect(),
        timestamps_s: (0..frames).map(|frame| frame as f64 * 0.2).collect(),
        ..EpisodeData::default()
    };
    let info = DatasetInfo {
        name: "waves".to_owned(),
        frame_width_px: width as u32,
        frame_height_px: height as u32,
        frame_period_s: 0.2,
        ..DatasetInfo::default()
    };
    Dataset::from_episodes(info, (0..10).map(episode).collect()).unwrap()
}

fn trains_and_predicts(preset: &str, [width, height, context, horizon]: [usize; 4]) {
    let settings = [
        "name=sized".to_owned(),
        format!("model.context={context}"),
        format!("model.horizon={horizon}"),
        "data.windows=8".to_owned(),
        "data.validation_windows=2".to_owned(),
        "pretrain.steps=0".to_owned(),
        "sequence.steps=2".to_owned(),
        "sequence.batch_size=2".to_owned(),
    ];
    let small: &[&str] = match preset {
        "static-flow" => &[
            "model.flow={ channels = 4, stem_channels = 4, enlarged_channels = 2, fine_channels = 4 }",
            "data.mirror=off",
        ],
        _ => &["model.features=6", "model.hidden=6"],
    };
    let settings: Vec<String> = settings
        .into_iter()
        .chain(small.iter().map(|&setting| setting.to_owned()))
        .collect();
    let config = TrainConfig::layered(preset, None, &settings).unwrap();
    let (dataset, dir) = (
        waves(width, height, context + horizon + 6),
        tempfile::tempdir().unwrap(),
    );
    let outcome = train(&config, &dataset, dir.path()).unwrap();
    let TrainingOutcome::Finished { model_dir, .. } = outcome else {
        panic!("{outcome:?}")
    };
    let model = registry::load(&model_dir).unwrap().network;
    let frames = Tensor::full(0.5f32, (1, context, width * height), &Device::Cpu).unwrap();
    let predicted = model.predict_frames(&frames, &ConditioningTensors::none()).unwrap();
    assert_eq!(predicted.dims(), [1, horizon, width * height]);
    let values = predicted.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert!(
        values.iter().all(|value| value.is_finite()),
        "{preset} {width}×{height}"
    );
}

#[test]
fn the_dense_network_takes_any_size_and_window() {
    for shape in SHAPES {
        trains_and_predicts("static", shape);
    }
}

#[test]
fn the_flow_network_takes_any_size_and_window() {
    for shape in SHAPES {
        trains_and_predicts("static-flow", shape);
    }
}

#[test]
fn no_accepted_value_makes_a_prediction_nan() {
    for name in ["moving-flow", "donkeycar", "moving"] {
        let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("models").join(name);
        let model = registry::load(&directory).unwrap().network;
        let spec = model.spec();
        let filled = |value: f32, shape: &[usize]| Tensor::full(value, shape, &Device::Cpu).unwrap();
        let frames = filled(0.5, &[1, spec.context, spec.pixels()]);
        for value in [1e13, 1e30, -1e30] {
            let conditioning = ConditioningTensors {
                actions: spec
                    .action_inputs()
                    .map(|count| filled(value, &[1, spec.horizon, count])),
                state: spec.state_inputs().map(|count| filled(value, &[1, count])),
                ..ConditioningTensors::none()
            };
            let predicted = model.predict_frames(&frames, &conditioning).unwrap();
            let predicted: Vec<f32> = predicted.flatten_all().unwrap().to_vec1().unwrap();
            assert!(predicted.iter().all(|value| value.is_finite()), "{name}, {value}");
        }
    }
}
