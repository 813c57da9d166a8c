//! Movers: networks that learn where they are and will be, and the scenario in which they cross.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use candle_core::{Device, Tensor};
use foreframe_core::nn::{ConditioningTensors, FlowPrediction};
use foreframe_core::registry::{self, StoredWeights};
use foreframe_core::types::Seed;
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData, Lacking};
use foreframe_sim::{RoomSet, Scenario, World, WorldConfig, arena};
use foreframe_train::training::{TrainConfig, TrainError, Training, TrainingOutcome, run};

use crate::fixtures::moving_squares;
use crate::sim::{small, whole_trial};

const SIDE: u32 = 16;

fn config(settings: &[&str]) -> TrainConfig {
    let small = [
        "name=squares",
        // With some seeds, 400 steps do not suffice to find all of what is coming.
        "seed=2",
        "data.validation_windows=4",
        "sequence.steps=400",
        "sequence.batch_size=8",
        "sequence.learning_rate=0.004",
        "sequence.movers_weight=0.5",
        "model.context=3",
        "model.horizon=2",
        "model.conditioning=action",
        "model.flow={ channels = 12, stem_channels = 8, enlarged_channels = 4, fine_channels = 6, frames_read = 3, \
         depth = true, movers = true }",
        "run.validate_every_steps=400",
        "run.checkpoint_every_steps=400",
        "run.warmup_steps=10",
    ];
    let settings: Vec<String> = small
        .iter()
        .chain(settings)
        .map(|&setting| setting.to_owned())
        .collect();
    TrainConfig::layered("rooms", None, &settings).unwrap()
}

pub(crate) fn train(
    config: &TrainConfig,
    dataset: &Dataset,
    run_dir: &Path,
    start: Option<&StoredWeights>,
) -> Result<TrainingOutcome, TrainError> {
    let training = Training {
        config,
        dataset,
        run_dir,
        command: "foreframe train",
        start,
    };
    run(&training, &mut |_| {}, &AtomicBool::new(false))
}

/// What the model of a run predicts for the first window of an episode.
fn predicted(run_dir: &Path, dataset: &Dataset, episode: usize) -> FlowPrediction {
    let model = registry::load(&run_dir.join("model")).unwrap();
    let spec = model.spec();
    let first = dataset.episodes()[episode].frames().start;
    let pixels: Vec<f32> = (first..first + spec.context)
        .flat_map(|frame| spec.preprocess.forward(&dataset.frame(frame).unwrap()))
        .collect();
    let last = first + spec.context - 1;
    let actions: Vec<f32> = (last..last + spec.horizon)
        .flat_map(|frame| dataset.action(frame).to_vec())
        .collect();
    let conditioning = ConditioningTensors {
        actions: Tensor::from_vec(actions, (1, spec.horizon, 1), &Device::Cpu).ok(),
        ..ConditioningTensors::none()
    };
    let frames = Tensor::from_vec(pixels, (1, spec.context, spec.pixels()), &Device::Cpu).unwrap();
    let predicted = model.network.predict_flow(&frames, &conditioning, spec.horizon);
    predicted.unwrap().unwrap()
}

#[test]
fn a_network_learns_where_movers_are_and_will_be() {
    let (dataset, dir) = (moving_squares(20, SIDE, 0.2), tempfile::tempdir().unwrap());
    let run_dir = dir.path().join("run");
    train(&config(&[]), &dataset, &run_dir, None).unwrap();
    let movers = predicted(&run_dir, &dataset, 4).movers.unwrap();
    assert_eq!(movers.dims(), [1, 3, (SIDE * SIDE) as usize]);
    let logits = movers.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let first = dataset.episodes()[4].frames().start;
    for (step, logits) in logits.chunks_exact((SIDE * SIDE) as usize).enumerate() {
        let mask = dataset.mask(first + 2 + step).unwrap().unwrap();
        let found = logits.iter().zip(mask.iter()).filter(|(logit, _)| **logit > 0.0);
        let right = found.clone().filter(|(_, robot)| **robot != 0).count();
        // The square has 16 of the 256 pixels.
        assert!(right >= 12 && found.count() <= 20, "step {step}: {right}");
    }

    // From a model without movers, only what finds them starts anew.
    let plain = dir.path().join("plain");
    let settings = ["sequence.steps=4", "model.flow={ movers = false }"];
    train(&config(&settings), &dataset, &plain, None).unwrap();
    assert!(predicted(&plain, &dataset, 4).movers.is_none());
    let weights = registry::load_weights(&plain.join("model")).unwrap();
    let more = dir.path().join("more");
    train(&config(&["sequence.steps=4"]), &dataset, &more, Some(&weights)).unwrap();
    assert!(predicted(&more, &dataset, 4).movers.is_some());
    // To a model without movers, what finds them is left out.
    let weights = registry::load_weights(&more.join("model")).unwrap();
    let fewer = dir.path().join("fewer");
    train(&config(&settings), &dataset, &fewer, Some(&weights)).unwrap();
    assert!(predicted(&fewer, &dataset, 4).movers.is_none());
}

#[test]
fn movers_cannot_be_learned_without_masks_weight_or_depth() {
    let dir = tempfile::tempdir().unwrap();
    let masked = moving_squares(20, SIDE, 0.2);
    let episodes = masked.episodes().iter().map(|episode| EpisodeData {
        timestamps_s: episode.frames().map(|frame| masked.timestamp_s(frame)).collect(),
        pixels: episode
            .frames()
            .flat_map(|frame| masked.pixels(frame).unwrap().into_owned())
            .collect(),
        actions: episode
            .frames()
            .flat_map(|frame| masked.action(frame).to_vec())
            .collect(),
        states: episode
            .frames()
            .flat_map(|frame| masked.state(frame).to_vec())
            .collect(),
        ..EpisodeData::default()
    });
    let info = DatasetInfo {
        content_hash: String::new(),
        ..masked.info().clone()
    };
    let plain = Dataset::from_episodes(info, episodes.collect()).unwrap();
    let error = train(&config(&[]), &plain, &dir.path().join("a"), None)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("data set \"squares\" has no masks of movers")
            && error.contains("set model.flow.movers to false"),
        "{error}"
    );
    let unweighted = config(&["sequence.movers_weight=0"]);
    let error = train(&unweighted, &masked, &dir.path().join("b"), None)
        .unwrap_err()
        .to_string();
    assert!(error.contains("sequence.movers_weight is 0"), "{error}");
    let flat = config(&["model.flow={ depth = false, movers = true }"]);
    let error = train(&flat, &masked, &dir.path().join("c"), None)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("flow.movers is true, but flow.depth is false"),
        "{error}"
    );
}

#[test]
fn joined_data_sets_keep_their_masks_if_all_have_them() {
    let (first, second) = (moving_squares(4, SIDE, 0.2), moving_squares(6, SIDE, 0.2));
    let joined = Dataset::join(vec![(first.clone(), 1.0), (second.clone(), 1.0)], Lacking::Refused).unwrap();
    assert!(joined.info().has_masks);
    let offset = first.info().frame_count;
    for frame in [0, 7, second.info().frame_count - 1] {
        assert_eq!(joined.mask(offset + frame).unwrap(), second.mask(frame).unwrap());
        assert_eq!(joined.pixels(offset + frame).unwrap(), second.pixels(frame).unwrap());
    }
    assert_eq!(joined.mask(offset - 1).unwrap(), first.mask(offset - 1).unwrap());
}

#[test]
fn robots_cross_the_way_ahead_to_and_fro() {
    let config = WorldConfig {
        rooms: Some(RoomSet::Varied),
        max_duration_s: 12.0,
        ..small()
    };
    let (mut crossing, mut changed_sides) = (0, 0);
    for trial in 0..9 {
        let (seen, world) = whole_trial(Scenario::Crossing, Seed(3), trial, &config);
        assert!(
            seen == whole_trial(Scenario::Crossing, Seed(3), trial, &config).0,
            "trial {trial}"
        );
        let crowd = &world.parameters().crowd;
        assert_eq!(crowd.len(), [1, 4, 8][trial as usize % 3]);
        let observer = world.parameters().observer;
        let (sin, cos) = observer.heading_rad.sin_cos();
        let left = |place: [f32; 2]| cos * (place[1] - observer.y_m) - sin * (place[0] - observer.x_m);
        let mut replay = World::from_parameters(world.parameters().clone(), &config).unwrap();
        let mut sides: Vec<Vec<bool>> = vec![Vec::new(); crowd.len()];
        for _ in 0..50 {
            for (sides, pose) in sides.iter_mut().zip(&replay.other_robot_poses()[1..]) {
                sides.push(left(arena::position(*pose)) > 0.0);
            }
            replay.step(&crate::sim::action(0.0, 0.0)).unwrap();
        }
        for (route, sides) in crowd.iter().zip(sides) {
            if route.crossing.is_some() {
                crossing += 1;
                changed_sides += usize::from(sides.iter().any(|&is_left| is_left != sides[0]));
            }
        }
    }
    assert!(
        crossing > 25 && 3 * changed_sides > crossing,
        "{changed_sides} of {crossing}"
    );
}
