//! Evaluations in parts: the same report as without, whatever is missing.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use foreframe_core::nn::Conditioning;
use foreframe_core::registry::{self, Model};
use foreframe_core::types::Seed;
use foreframe_data::dataset::{CollectConfig, Dataset, collect};
use foreframe_sim::{RoomSet, Scenario, WorldConfig};
use foreframe_train::evaluation::{self, EvaluateConfig, EvaluationError, EvaluationPart};
use serde_json::Value;

use crate::evaluation::{SIDE, config, spec, untrained};
use crate::fixtures::moving_squares;

const PARTS: usize = 3;

/// The report as JSON, without its duration.
fn report(loaded: &Model, dataset: &Dataset, config: &EvaluateConfig) -> Value {
    let mut report = evaluation::run(loaded, dataset, config, &|_| {}).unwrap();
    report.stamp.wall_time_s = 0.0;
    serde_json::to_value(report).unwrap()
}

fn part(dir: &Path, index: usize) -> EvaluationPart {
    let dir = dir.join(index.to_string());
    std::fs::create_dir_all(&dir).unwrap();
    EvaluationPart {
        dir,
        index,
        count: PARTS,
    }
}

/// Computes all parts; returns their directories.
fn parts(loaded: &Model, dataset: &Dataset, config: &EvaluateConfig, dir: &Path) -> Vec<PathBuf> {
    let compute = |index| {
        let part = part(dir, index);
        evaluation::run_part(loaded, dataset, config, &part, &|_| {}).unwrap();
        part.dir
    };
    (0..PARTS).map(compute).collect()
}

/// The files of a directory, without their endings.
fn passes(dir: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(dir).unwrap();
    let stem = |path: PathBuf| path.file_stem().unwrap().to_string_lossy().into_owned();
    let mut passes: Vec<String> = entries.map(|entry| stem(entry.unwrap().path())).collect();
    passes.sort();
    passes
}

#[test]
fn parts_give_the_same_report_whatever_is_missing() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::StateAction), &dataset);
    let twin = untrained("twin", spec(Conditioning::None), &dataset);
    let config = EvaluateConfig {
        twins: vec![&twin],
        ..config()
    };
    let expected = report(&model, &dataset, &config);
    let dir = tempfile::tempdir().unwrap();
    let joined = EvaluateConfig {
        saved: parts(&model, &dataset, &config, dir.path()),
        ..config.clone()
    };
    let actions = (0..5).map(|variant| format!("test-actions-{variant}"));
    let mut expected_passes: Vec<String> = actions.collect();
    expected_passes.extend(["nearest-windows", "test-scores-0"].map(str::to_owned));
    expected_passes.sort();
    assert_eq!(passes(&joined.saved[0]), expected_passes);
    assert_eq!(report(&model, &dataset, &joined), expected);

    // The last number of the last window's scores: what is saved is not computed again.
    let file = joined.saved[2].join("test-scores-0.msgpack");
    let saved = std::fs::read(&file).unwrap();
    let mut changed = saved.clone();
    let place = changed.len() - 4;
    changed[place] ^= 1;
    std::fs::write(&file, changed).unwrap();
    assert_ne!(report(&model, &dataset, &joined), expected);
    // With another seed, everything is computed again.
    let [other, other_joined] = [&config, &joined].map(|config| {
        let config = EvaluateConfig {
            seed: Seed(9),
            ..config.clone()
        };
        report(&model, &dataset, &config)
    });
    assert_eq!(other, other_joined);

    std::fs::write(&file, &saved[..saved.len() / 2]).unwrap();
    std::fs::remove_file(joined.saved[0].join("test-actions-1.msgpack")).unwrap();
    std::fs::remove_dir_all(&joined.saved[1]).unwrap();
    assert_eq!(report(&model, &dataset, &joined), expected);
}

#[test]
fn a_part_that_was_stopped_continues_with_the_next_pass() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::Action), &dataset);
    let dir = tempfile::tempdir().unwrap();
    let part = part(dir.path(), 0);
    let cancelled = AtomicBool::new(false);
    let stoppable = EvaluateConfig {
        cancelled: Some(&cancelled),
        ..config()
    };
    let stopped = evaluation::run_part(&model, &dataset, &stoppable, &part, &|now| {
        cancelled.store(now.stage.name() == "actions", Ordering::Release);
    });
    assert!(matches!(stopped, Err(EvaluationError::Cancelled)));
    assert!(passes(&part.dir).contains(&"test-scores-0".to_owned()));
    let scores = part.dir.join("test-scores-0.msgpack");
    let written = std::fs::metadata(&scores).unwrap().modified().unwrap();
    evaluation::run_part(&model, &dataset, &config(), &part, &|_| {}).unwrap();
    assert_eq!(passes(&part.dir).len(), 6);
    assert_eq!(std::fs::metadata(&scores).unwrap().modified().unwrap(), written);
}

/// The model has all that can be measured: actions, plans, movers, depths and a calibration.
#[test]
fn every_pass_of_a_shipped_model_can_be_divided() {
    let dir = tempfile::tempdir().unwrap();
    let collection = CollectConfig {
        world: WorldConfig {
            max_duration_s: 3.0,
            rooms: Some(RoomSet::NewCameras),
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::MovingObserver, 12, Seed(2), &dir.path().join("set"))
    };
    collect(&collection, &|_| {}, &AtomicBool::new(false)).unwrap();
    let dataset = Dataset::open(&collection.out).unwrap();
    let model = registry::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("models/rooms")).unwrap();
    let config = EvaluateConfig {
        max_windows: 17,
        batch: 8,
        ..config()
    };
    let expected = report(&model, &dataset, &config);
    let scores = &expected["sets"][0];
    assert_eq!(scores["plans"]["contexts"], 17, "{scores}");
    for measured in [
        "/surroundings/movers/now",
        "/surroundings/depth/frames",
        "/visibility/methods/0/mse/3",
        "/uncertainty/novelty",
    ] {
        assert!(
            scores.pointer(measured).is_some_and(|value| !value.is_null()),
            "{measured}"
        );
    }
    let saved = parts(&model, &dataset, &config, dir.path());
    let stages: Vec<String> = passes(&saved[1]);
    for stage in [
        "actions-3",
        "calibration-0",
        "depth-0",
        "plans-0",
        "scores-0",
        "surroundings-0",
        "visibility-0",
    ] {
        assert!(stages.contains(&format!("test-{stage}")), "{stages:?}");
    }
    let joined = EvaluateConfig { saved, ..config };
    assert_eq!(report(&model, &dataset, &joined), expected);
}
