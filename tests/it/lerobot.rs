//! Data sets of `LeRobot`, in and out, and videos. `tests/python/lerobot_sets.py` does the same with sets that Python wrote.

use std::fs;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use foreframe_core::types::Seed;
use foreframe_data::dataset::export::{to_lerobot_images, to_lerobot_videos, to_mp4};
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, Imported, import,
};
use foreframe_data::dataset::{CollectConfig, Dataset, DatasetError, collect};
use foreframe_sim::{Scenario, WorldConfig};
use serde_json::{Value, json};

use crate::recordings::has_ffmpeg;

const SIDE: u32 = 32;

fn run(source: &Path, out: &Path, options: ImportOptions) -> Result<Imported, ImportError> {
    let config = ImportConfig {
        source: source.to_owned(),
        out: out.to_owned(),
        options: ImportOptions {
            frame_width_px: SIDE,
            frame_height_px: SIDE,
            ..options
        },
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    };
    import(&config, &|_| {}, &AtomicBool::new(false))
}

/// A simulated data set in `dir/set`.
fn collected(dir: &Path) -> Dataset {
    let config = CollectConfig {
        world: WorldConfig {
            frame_width_px: SIDE,
            frame_height_px: SIDE,
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::MovingObserver, 5, Seed(9), &dir.join("set"))
    };
    collect(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
    Dataset::open(&config.out).unwrap()
}

/// Deletes what other tools do not write.
fn remove_own_files(set: &Path) {
    for name in ["meta/foreframe.json", "meta/collect.json"] {
        let _ = fs::remove_file(set.join(name));
    }
}

fn change_info(set: &Path, change: impl Fn(&mut Value)) {
    let path = set.join("meta/info.json");
    let mut info: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut info);
    fs::write(path, info.to_string()).unwrap();
}

/// Largest difference of two frames in gray levels, averaged over the pixels.
fn worst_difference(a: &Dataset, b: &Dataset) -> f64 {
    let difference = |frame: usize| {
        let (left, right) = (a.pixels(frame).unwrap(), b.pixels(frame).unwrap());
        let pairs = left.iter().zip(&*right);
        pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.info().frame_pixels() as f64
    };
    (0..a.info().frame_count).map(difference).fold(0.0, f64::max)
}

fn same_numbers(a: &Dataset, b: &Dataset) -> bool {
    let all = |set: &Dataset| -> Vec<f32> {
        let frames = 0..set.info().frame_count;
        frames
            .flat_map(|frame| [set.action(frame), set.state(frame)].concat())
            .collect()
    };
    a.episodes().len() == b.episodes().len() && all(a) == all(b)
}

#[test]
fn a_set_without_our_metadata_is_imported() {
    let dir = tempfile::tempdir().unwrap();
    let (original, set) = (collected(dir.path()), dir.path().join("set"));
    remove_own_files(&set);
    let error = Dataset::open(&set).unwrap_err();
    assert!(matches!(error, DatasetError::OtherTool { .. }));
    assert!(error.to_string().contains("foreframe import"), "{error}");
    let choice = ImportOptions {
        image: Some("observation.image".to_owned()),
        ..ImportOptions::default()
    };
    run(&set, &dir.path().join("out"), choice).unwrap();
    let dataset = Dataset::open(&dir.path().join("out")).unwrap();
    assert!(same_numbers(&original, &dataset));
    assert_eq!(
        (worst_difference(&original, &dataset), dataset.info().frame_period_s),
        (0.0, 0.2)
    );
    let names = |set: &Dataset| {
        set.info()
            .action_channels
            .iter()
            .map(|c| c.name.clone())
            .collect::<Vec<_>>()
    };
    assert_eq!(names(&dataset), names(&original));
}

#[test]
fn features_are_chosen_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let original = collected(dir.path());
    let set = dir.path().join("set");
    // The masks are images, too.
    let error = run(&set, &dir.path().join("a"), ImportOptions::default())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("--image: observation.image, observation.mask"),
        "{error}"
    );
    let options = |action: &str| ImportOptions {
        image: Some("image".to_owned()),
        actions: vec![action.to_owned()],
        states: vec!["heading_sin".to_owned()],
        ..ImportOptions::default()
    };
    let error = run(&set, &dir.path().join("b"), options("gripper"))
        .unwrap_err()
        .to_string();
    assert!(error.contains("action (linear, angular)"), "{error}");
    run(&set, &dir.path().join("c"), options("angular")).unwrap();
    let dataset = Dataset::open(&dir.path().join("c")).unwrap();
    let whole = (original.action(7)[1], original.state(7)[3]);
    assert_eq!((dataset.action(7), dataset.state(7)), (&[whole.0][..], &[whole.1][..]));
}

#[test]
fn damaged_descriptions_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    collected(dir.path());
    let (set, image) = (dir.path().join("set"), || ImportOptions {
        image: Some("image".to_owned()),
        ..ImportOptions::default()
    });
    let refused = |name: &str| {
        let error = run(&set, &dir.path().join(name), image()).unwrap_err();
        foreframe_core::error_text::with_causes(&error)
    };
    change_info(&set, |info| info["data_path"] = json!("../../{file_index:03d}.parquet"));
    assert!(refused("a").contains("it must be a file below"), "{}", refused("a"));
    change_info(&set, |info| info["data_path"] = json!("data/{file_index:03d}.parquet"));
    assert!(refused("b").contains("000.parquet is missing"), "{}", refused("b"));
    change_info(&set, |info| info["codebase_version"] = json!("v1.6"));
    assert!(
        refused("c").contains("versions v2.0, v2.1 and v3.0 are read"),
        "{}",
        refused("c")
    );
    fs::write(set.join("meta/info.json"), "{").unwrap();
    assert!(refused("d").contains("info.json: EOF"), "{}", refused("d"));
}

#[test]
fn an_export_with_images_is_the_same_data_set() {
    let dir = tempfile::tempdir().unwrap();
    let original = collected(dir.path());
    let out = dir.path().join("out");
    to_lerobot_images(&original, &out, Some("rover")).unwrap();
    let exported = Dataset::open(&out).unwrap();
    assert!(same_numbers(&original, &exported) && worst_difference(&original, &exported) == 0.0);
    assert_eq!(exported.mask(3).unwrap(), original.mask(3).unwrap());
    let json = |name: &str| -> Value { serde_json::from_slice(&fs::read(out.join(name)).unwrap()).unwrap() };
    let info = json("meta/info.json");
    assert_eq!(info["robot_type"], "rover");
    // LeRobot merges data sets whose statistics of images have the shape 3 × 1 × 1.
    for key in ["observation.image", "observation.mask"] {
        assert_eq!(info["features"][key]["shape"], json!([SIDE, SIDE, 3]));
        let mean = json("meta/stats.json")[key]["mean"].clone();
        let one = mean[0][0][0].as_f64().unwrap();
        assert_eq!(mean, json!([[[one]], [[one]], [[one]]]));
    }
}

#[test]
fn an_export_with_videos_is_read_back() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let original = collected(dir.path());
    let (exported, back) = (dir.path().join("videos"), dir.path().join("back"));
    to_lerobot_videos(&original, &exported, None).unwrap();
    run(&exported, &back, ImportOptions::default()).unwrap();
    let dataset = Dataset::open(&back).unwrap();
    assert!(same_numbers(&original, &dataset));
    let worst = worst_difference(&original, &dataset);
    assert!(worst < 4.0, "{worst}");
    // Without its last second, the video is shorter than its table.
    let video = exported.join("videos/observation.image/chunk-000/file-000.mp4");
    to_mp4(&original, 0..original.info().frame_count - 5, &video).unwrap();
    let error = run(&exported, &dir.path().join("short"), ImportOptions::default())
        .unwrap_err()
        .to_string();
    assert!(error.contains("the video is shorter than its table"), "{error}");
    let skipping = ImportOptions {
        skip_bad: true,
        ..ImportOptions::default()
    };
    let imported = run(&exported, &dir.path().join("skipped"), skipping).unwrap();
    assert_eq!(
        (imported.skipped.len(), imported.info.frame_count),
        (1, original.info().frame_count - 5)
    );
}

#[test]
fn an_episode_becomes_a_video() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let original = collected(dir.path());
    let video = dir.path().join("look.mp4");
    let episode = &original.episodes()[1];
    to_mp4(&original, episode.frames(), &video).unwrap();
    let imported = run(&video, &dir.path().join("out"), ImportOptions::default()).unwrap();
    assert_eq!(
        (imported.info.frame_count, imported.info.frame_period_s),
        (episode.frame_count, 0.2)
    );
}
