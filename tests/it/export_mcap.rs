//! Data sets as bags of ROS 2. `tests/python/import_bags.py` reads them with the packages of ROS users.

use std::fs;
use std::ops::Range;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use foreframe_core::frame::warp::CameraModel;
use foreframe_core::types::{Channel, Seed};
use foreframe_data::dataset::export::{ACTION_TOPIC, STATE_TOPIC, to_mcap};
use foreframe_data::dataset::import::{DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportOptions, import};
use foreframe_data::dataset::{CollectConfig, Dataset, DatasetInfo, Episode, EpisodeData, collect};
use foreframe_sim::{RoomSet, Scenario, WorldConfig};

use crate::process::{output, text};
use crate::recordings;

/// Two episodes of 8 and 5 frames of 6×4 pixels; every number is different.
fn dataset(actions: &[(&str, &str)], states: &[(&str, &str)], period_s: f64) -> Dataset {
    let channels = |names: &[(&str, &str)]| names.iter().map(|(name, unit)| Channel::new(name, unit)).collect();
    let info = DatasetInfo {
        name: "made".to_owned(),
        frame_width_px: 6,
        frame_height_px: 4,
        frame_period_s: period_s,
        action_channels: channels(actions),
        state_channels: channels(states),
        camera: Some(CameraModel::new(1.2, 0.0).unwrap()),
        ..DatasetInfo::default()
    };
    let numbers = |count: usize, start: f32| (0..count).map(|index| start - index as f32 / 3.0).collect();
    let episode = |number: u8, frames: usize| EpisodeData {
        timestamps_s: (0..frames).map(|frame| frame as f64 * period_s).collect(),
        pixels: (0..frames * 24).map(|pixel| (pixel * 7) as u8 ^ number).collect(),
        actions: numbers(frames * actions.len(), f32::from(number) + 0.1),
        states: numbers(frames * states.len(), f32::from(number) * 7.3),
        ..EpisodeData::default()
    };
    Dataset::from_episodes(info, vec![episode(1, 8), episode(2, 5)]).unwrap()
}

fn exported_and_imported(dataset: &Dataset, dir: &Path) -> Dataset {
    let episodes: Vec<_> = dataset.episodes().iter().map(Episode::frames).collect();
    imported_from(dataset, &episodes, dir)
}

/// Some episodes, exported and imported again.
fn imported_from(dataset: &Dataset, episodes: &[Range<usize>], dir: &Path) -> Dataset {
    let (bag, out) = (dir.join("made.mcap"), dir.join("back"));
    to_mcap(dataset, episodes, &bag).unwrap();
    let config = ImportConfig {
        source: bag,
        out: out.clone(),
        options: ImportOptions {
            frame_width_px: dataset.info().frame_width_px,
            frame_height_px: dataset.info().frame_height_px,
            actions: vec![ACTION_TOPIC.to_owned()],
            states: vec![STATE_TOPIC.to_owned()],
            ..ImportOptions::default()
        },
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    };
    let imported = import(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
    assert_eq!(imported.skipped, []);
    Dataset::open(&out).unwrap()
}

/// Episodes, frames, actions and states are the same.
fn assert_same(one: &Dataset, other: &Dataset) {
    let lengths = |set: &Dataset| {
        set.episodes()
            .iter()
            .map(|episode| episode.frame_count)
            .collect::<Vec<_>>()
    };
    assert_eq!(lengths(one), lengths(other));
    for frame in 0..one.info().frame_count {
        assert_eq!(
            one.pixels(frame).unwrap(),
            other.pixels(frame).unwrap(),
            "frame {frame}"
        );
        assert_eq!(one.action(frame), other.action(frame), "action {frame}");
        assert_eq!(one.state(frame), other.state(frame), "state {frame}");
    }
    let periods = (one.info().frame_period_s, other.info().frame_period_s);
    assert!((periods.0 - periods.1).abs() < 1e-6, "{periods:?}");
}

fn names(channels: &[Channel]) -> Vec<String> {
    channels.iter().map(ToString::to_string).collect()
}

#[test]
fn velocities_come_back_as_the_same_channels() {
    let dir = tempfile::tempdir().unwrap();
    let actions = [("linear.x", "m/s"), ("linear.y", "m/s"), ("angular.z", "rad/s")];
    let original = dataset(&actions, &[("linear", ""), ("angular", "rad/s")], 0.1);
    let back = exported_and_imported(&original, dir.path());
    assert_same(&original, &back);
    assert_eq!(back.info().action_channels, original.info().action_channels);
    assert_eq!(names(&back.info().state_channels), ["linear.x m/s", "angular.z rad/s"]);
    let fov = back.info().camera.unwrap().horizontal_fov_rad;
    assert!((fov - 1.2).abs() < 1e-5, "{fov}");
}

#[test]
fn each_episode_has_the_messages_of_its_own_camera() {
    let dir = tempfile::tempdir().unwrap();
    let collection = CollectConfig {
        world: WorldConfig {
            frame_width_px: 12,
            frame_height_px: 8,
            max_duration_s: 1.6,
            rooms: Some(RoomSet::Varied),
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::MovingObserver, 2, Seed(4), &dir.path().join("set"))
    };
    collect(&collection, &|_| {}, &AtomicBool::new(false)).unwrap();
    let rooms = Dataset::open(&collection.out).unwrap();
    for episode in rooms.episodes() {
        let dir = dir.path().join(episode.index.to_string());
        fs::create_dir_all(&dir).unwrap();
        let back = imported_from(&rooms, &[episode.frames()], &dir);
        let fov = |camera: Option<CameraModel>| camera.unwrap().horizontal_fov_rad;
        let difference = fov(back.info().camera) - fov(rooms.camera(episode.index));
        assert!(difference.abs() < 1e-5, "{difference}");
    }
    // No camera model is true of both.
    assert_eq!(exported_and_imported(&rooms, dir.path()).info().camera, None);
}

#[test]
fn other_channels_come_back_with_their_values() {
    let dir = tempfile::tempdir().unwrap();
    // Not those of a Twist, in another order, without the speed ahead, or in other units; at an odd rate.
    for (number, (actions, period_s)) in [
        (&[("steering", "rad"), ("throttle", "")][..], 0.2),
        (&[("angular.z", "rad/s"), ("linear.x", "m/s")], 1.0 / 7.0),
        (&[("angular.z", "rad/s")], 0.4),
        (&[("linear.x", "km/h"), ("angular.z", "rad/s")], 2.0),
    ]
    .into_iter()
    .enumerate()
    {
        let dir = dir.path().join(number.to_string());
        fs::create_dir_all(&dir).unwrap();
        let original = dataset(actions, &[("x", "m"), ("y", "m"), ("heading", "rad")], period_s);
        let back = exported_and_imported(&original, &dir);
        assert_same(&original, &back);
        let first = names(&back.info().action_channels)[0].clone();
        assert_eq!(first, format!("{}.position rad", actions[0].0));
    }
}

#[test]
fn the_printed_command_imports_the_bag_again() {
    let dir = tempfile::tempdir().unwrap();
    recordings::images_with_csv(&dir.path().join("drive"), 120);
    let program = |command: &str| {
        let output = output(dir.path(), &command.split_whitespace().collect::<Vec<_>>());
        assert!(output.status.success(), "{command}: {}", text(&output.stderr));
        text(&output.stdout)
    };
    program("import drive --out first --size 24x16");
    let printed = program("export --dataset first --to mcap --out bags/all.mcap");
    assert!(
        printed.starts_with("bags/all.mcap: 3 episodes, 120 frames\n"),
        "{printed}"
    );
    let again = printed.split("foreframe ").nth(1).unwrap();
    program(&again.replace("--name all", "--out second"));
    let open = |name: &str| Dataset::open(&dir.path().join(name)).unwrap();
    assert_same(&open("first"), &open("second"));
    let printed = program("export --dataset first --to mcap --episode 1 --first 5 --count 20 --out part.mcap");
    assert!(printed.starts_with("part.mcap: 1 episodes, 20 frames\n"), "{printed}");
    program("import part.mcap --out part --size 24x16 --action /action --state /state");
    let (first, part) = (open("first"), open("part"));
    let start = first.episodes()[1].first_frame + 5;
    assert_eq!(
        (part.info().frame_count, part.pixels(3).unwrap()),
        (20, first.pixels(start + 3).unwrap())
    );
    assert_eq!(part.action(7), first.action(start + 7));
    for (command, expected) in [
        (
            "export --dataset first --to mcap --out part.mcap",
            "part.mcap exists; name a new file",
        ),
        (
            "export --dataset first --to mcap --out bag",
            "name a file that ends with .mcap",
        ),
    ] {
        let output = output(dir.path(), &command.split_whitespace().collect::<Vec<_>>());
        let refused = text(&output.stderr);
        assert!(!output.status.success() && refused.contains(expected), "{refused}");
    }
}
