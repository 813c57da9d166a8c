//! Collecting into a directory: the written files, resuming, and refusals.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use foreframe_core::frame::warp::CameraModel;
use foreframe_core::types::Seed;
use foreframe_data::dataset::{
    CollectConfig, CollectProgress, CollectionStatus, Dataset, DatasetError, DatasetInfo, collect,
};
use foreframe_sim::{RoomSet, Scenario, World, WorldConfig};
use proptest::prelude::*;
use tempfile::TempDir;

const TRIALS: u64 = 11;

fn config(out: &Path) -> CollectConfig {
    CollectConfig {
        world: WorldConfig {
            frame_width_px: 12,
            frame_height_px: 8,
            max_duration_s: 1.6,
            ..WorldConfig::default()
        },
        threads: 2,
        trials_per_shard: 3,
        ..CollectConfig::new(Scenario::MovingObserver, TRIALS, Seed(4), out)
    }
}

fn run(config: &CollectConfig) -> Result<DatasetInfo, DatasetError> {
    collect(config, &|_| {}, &AtomicBool::new(false))
}

/// Collects, and cancels after this many trials.
fn run_until(config: &CollectConfig, trials: u64) -> Result<DatasetInfo, DatasetError> {
    let cancelled = AtomicBool::new(false);
    let seen = AtomicU64::new(0);
    let on_progress = |_: CollectProgress| {
        if seen.fetch_add(1, Ordering::Relaxed) >= trials {
            cancelled.store(true, Ordering::Relaxed);
        }
    };
    collect(config, &on_progress, &cancelled)
}

fn finished() -> (TempDir, PathBuf) {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("set");
    run(&config(&out)).unwrap();
    (directory, out)
}

/// Every file below a directory, with its bytes.
fn contents(root: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    let mut open = vec![root.to_owned()];
    while let Some(directory) = open.pop() {
        for entry in fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.push((path.strip_prefix(root).unwrap().to_owned(), fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn a_data_set_reads_back_what_was_simulated() {
    let (_directory, out) = finished();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.info().episode_count as u64, TRIALS);
    let config = config(&out);
    for trial in [0, TRIALS - 1] {
        let mut world = World::new(config.scenario, &config.world, config.seed, trial).unwrap();
        let episode = &dataset.episodes()[trial as usize];
        assert_eq!(episode.trial.as_ref(), Some(world.parameters()));
        for frame in episode.frames() {
            let observation = world.observe();
            assert_eq!(*dataset.pixels(frame).unwrap(), *observation.frame.pixels());
            assert_eq!(
                dataset.mask(frame).unwrap().as_deref(),
                Some(observation.mask.as_slice())
            );
            assert_eq!(dataset.state(frame), observation.state.as_slice());
            assert!((dataset.timestamp_s(frame) - observation.time_s).abs() < 1e-6);
            if frame + 1 < episode.frames().end {
                let action = world.policy_action();
                assert_eq!(dataset.action(frame), action.as_slice());
                world.step(&action).unwrap();
            }
        }
    }
}

#[test]
fn the_camera_is_recorded_and_older_data_sets_still_open() {
    let (_directory, out) = finished();
    let recorded = Dataset::open(&out).unwrap();
    let camera = &config(&out).world.camera;
    let expected = CameraModel::new(camera.horizontal_fov_rad as f32, camera.tilt_down_rad as f32).unwrap();
    assert_eq!(recorded.info().camera, Some(expected));

    let path = out.join("meta/foreframe.json");
    let mut stamp: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    stamp.as_object_mut().unwrap().remove("camera");
    fs::write(&path, stamp.to_string()).unwrap();
    let older = Dataset::open(&out).unwrap();
    assert_eq!(
        older.info(),
        recorded.info(),
        "the collection's arguments describe the camera too"
    );
    let arguments = fs::read(out.join("meta/collect.json")).unwrap();
    fs::remove_file(out.join("meta/collect.json")).unwrap();
    assert_eq!(Dataset::open(&out).unwrap().info().camera, None);
    fs::write(out.join("meta/collect.json"), arguments).unwrap();

    stamp["camera"] = serde_json::json!({"horizontal_fov_rad": 4.0, "tilt_down_rad": 0.0});
    fs::write(&path, stamp.to_string()).unwrap();
    let refused = Dataset::open(&out).unwrap_err().to_string();
    assert!(
        refused.contains("the camera model has a field of view of 4 rad"),
        "{refused}"
    );
}

#[test]
fn the_number_of_threads_does_not_change_the_bytes() {
    let (_directory, two) = finished();
    let directory = tempfile::tempdir().unwrap();
    let one = directory.path().join("one");
    run(&CollectConfig {
        threads: 1,
        ..config(&one)
    })
    .unwrap();
    assert_eq!(contents(&one), contents(&two));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn a_stopped_and_resumed_collection_has_the_same_bytes(
        stops in proptest::collection::vec(0..TRIALS, 1..4),
    ) {
        let (_directory, whole) = finished();
        let directory = tempfile::tempdir().unwrap();
        let out = directory.path().join("set");
        let mut kept_before = 0;
        for trials in stops {
            if let Err(error) = run_until(&config(&out), trials) {
                let DatasetError::Cancelled { done, total } = error else { panic!("{error}") };
                prop_assert!(total == TRIALS && done >= kept_before, "finished trials were lost");
                prop_assert!(done >= trials, "{done} of {trials} finished trials were kept");
                kept_before = done;
                prop_assert!(Dataset::open(&out).is_err());
            }
        }
        run(&config(&out)).unwrap();
        prop_assert_eq!(contents(&out), contents(&whole));
    }
}

#[test]
fn resuming_simulates_only_missing_trials() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("set");
    let one_thread = CollectConfig {
        threads: 1,
        ..config(&out)
    };
    let error = run_until(&one_thread, 7).unwrap_err();
    assert_eq!(
        error.to_string(),
        "stopped after 7 of 11 trials were saved; run the same command again to resume"
    );
    assert_eq!(
        CollectionStatus::of(&one_thread).unwrap(),
        CollectionStatus::Unfinished { trials: 7 }
    );
    let first = AtomicU64::new(u64::MAX);
    let on_progress = |progress: CollectProgress| {
        first.fetch_min(progress.done, Ordering::Relaxed);
    };
    collect(&one_thread, &on_progress, &AtomicBool::new(false)).unwrap();
    assert_eq!(first.into_inner(), 7);
}

#[test]
fn resuming_replaces_a_damaged_shard() {
    let (_directory, whole) = finished();
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("set");
    let one_thread = CollectConfig {
        threads: 1,
        ..config(&out)
    };
    run_until(&one_thread, 8).unwrap_err();
    let shard = out.join("data/chunk-000/file-000.parquet");
    let bytes = fs::read(&shard).unwrap();
    fs::write(&shard, &bytes[..bytes.len() / 2]).unwrap();
    run(&config(&out)).unwrap();
    assert_eq!(contents(&out), contents(&whole));
}

#[test]
fn opening_an_unfinished_data_set_explains_how_to_resume() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("set");
    run_until(&config(&out), 4).unwrap_err();
    let message = Dataset::open(&out).unwrap_err().to_string();
    assert!(
        message.contains("is unfinished; run the same `foreframe collect` or `foreframe import` again to resume it")
    );
    assert!(message.contains("\"trials\":11"), "{message}");
}

#[test]
fn collecting_a_finished_data_set_again_does_nothing() {
    let (_directory, out) = finished();
    let before = contents(&out);
    let info = collect(
        &config(&out),
        &|_| panic!("nothing is left to do"),
        &AtomicBool::new(false),
    )
    .unwrap();
    assert_eq!(
        CollectionStatus::of(&config(&out)).unwrap(),
        CollectionStatus::Finished(Box::new(info))
    );
    assert_eq!(contents(&out), before);
}

#[test]
fn resuming_with_other_arguments_is_refused() {
    let (_directory, out) = finished();
    let other = CollectConfig {
        trials: 10,
        ..config(&out)
    };
    let message = run(&other).unwrap_err().to_string();
    assert!(
        message.ends_with(
            "holds a collection with other arguments (trials: 11 in the directory, 10 requested); use the same arguments to \
             resume it, or use another directory"
        ),
        "{message}"
    );
}

#[test]
fn more_trials_extend_a_collection_to_the_same_bytes() {
    let (directory, out) = finished();
    let more = |out: &Path| CollectConfig {
        trials: TRIALS + 6,
        ..config(out)
    };
    assert_eq!(run(&more(&out)).unwrap().episode_count as u64, TRIALS + 6);
    let whole = directory.path().join("whole");
    run(&more(&whole)).unwrap();
    assert!(contents(&out) == contents(&whole), "the extended data set differs");
}

#[test]
fn a_foreign_directory_is_refused_and_unchanged() {
    let directory = tempfile::tempdir().unwrap();
    fs::write(directory.path().join("thesis.txt"), "years of work").unwrap();
    let error = run(&config(directory.path())).unwrap_err();
    assert!(error.to_string().contains("exists and is not a collection"));
    assert_eq!(contents(directory.path()).len(), 1);
    let error = run(&config(&directory.path().join("thesis.txt"))).unwrap_err();
    assert!(matches!(error, DatasetError::OutExists { .. }));
}

#[test]
fn an_empty_directory_is_accepted() {
    let directory = tempfile::tempdir().unwrap();
    run(&config(directory.path())).unwrap();
}

#[test]
fn zero_trials_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let none = CollectConfig {
        trials: 0,
        ..config(&directory.path().join("set"))
    };
    assert_eq!(
        run(&none).unwrap_err().to_string(),
        "the number of trials is 0; it must be at least 1"
    );
    assert!(!none.out.exists());
}

#[test]
fn a_changed_file_is_reported_by_name() {
    for file in [
        "data/chunk-000/file-001.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
    ] {
        let (_directory, out) = finished();
        let path = out.join(file);
        let mut bytes = fs::read(&path).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(&path, bytes).unwrap();
        let error = Dataset::open(&out).unwrap_err();
        assert!(matches!(error, DatasetError::HashDiffers { .. }));
        assert!(error.to_string().contains(file));
    }
}

#[test]
fn a_truncated_file_is_reported_by_name() {
    let (_directory, out) = finished();
    let path = out.join("data/chunk-000/file-002.parquet");
    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 9]).unwrap();
    assert!(
        Dataset::open(&out)
            .unwrap_err()
            .to_string()
            .contains("file-002.parquet")
    );
}

#[test]
fn a_missing_file_is_reported_by_name() {
    let (_directory, out) = finished();
    fs::remove_file(out.join("data/chunk-000/file-002.parquet")).unwrap();
    let error = Dataset::open(&out).unwrap_err();
    assert!(matches!(&error, DatasetError::Io { .. }) && error.to_string().contains("file-002.parquet"));
}

#[test]
fn a_directory_without_a_data_set_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let error = Dataset::open(directory.path()).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("holds no data set (meta/info.json is missing)")
    );
}

#[test]
fn the_camera_of_all_trials_has_its_height() {
    let (_directory, out) = finished();
    let dataset = Dataset::open(&out).unwrap();
    let camera = dataset.camera(3).unwrap();
    assert_eq!(camera.height_m, Some(0.6));
    // The description has none, so that models are described as before.
    assert_eq!(
        dataset.info().camera,
        Some(CameraModel {
            height_m: None,
            ..camera
        })
    );
}

#[test]
fn in_rooms_of_their_own_episodes_have_their_own_cameras() {
    let directory = tempfile::tempdir().unwrap();
    let mut config = config(&directory.path().join("rooms"));
    config.world.rooms = Some(RoomSet::Varied);
    config.trials = 4;
    run(&config).unwrap();
    let dataset = Dataset::open(&config.out).unwrap();
    assert_eq!(dataset.info().camera, None);
    let cameras: Vec<CameraModel> = dataset
        .episodes()
        .iter()
        .map(|episode| {
            let camera = dataset.camera(episode.index).unwrap();
            let trial = episode.trial.as_ref().unwrap();
            assert_eq!(camera, trial.room.as_ref().unwrap().camera.model_with_height());
            camera
        })
        .collect();
    assert_ne!(cameras[0], cameras[1]);
}
