//! Recordings become data sets: every source, resumed runs, and damaged input.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use foreframe_core::frame::{Frame, codec};
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, Imported, import,
};
use serde_json::json;

use crate::recordings::{has_ffmpeg, video};

pub(crate) fn run(source: &Path, out: &Path, options: ImportOptions) -> Result<Imported, ImportError> {
    let config = ImportConfig {
        source: source.to_owned(),
        out: out.to_owned(),
        options,
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    };
    import(&config, &|_| {}, &AtomicBool::new(false))
}

pub(crate) fn small() -> ImportOptions {
    ImportOptions {
        frame_width_px: 16,
        frame_height_px: 12,
        ..ImportOptions::default()
    }
}

fn image(level: u8) -> Frame {
    Frame::new(32, 24, (0..32 * 24).map(|i| level.wrapping_add(i as u8)).collect()).unwrap()
}

/// A folder of images with a CSV: 8 frames at 10 Hz, a gap, 4 frames.
pub(crate) fn folder(dir: &Path) -> PathBuf {
    let source = dir.join("walk");
    fs::create_dir_all(&source).unwrap();
    let mut csv = "timestamp,file,action.speed [m/s],state.heading\n".to_owned();
    for index in 0..12u32 {
        let name = format!("{index}.png");
        fs::write(source.join(&name), codec::encode_png(&image(index as u8)).unwrap()).unwrap();
        let time_s = f64::from(index) * 0.1 + if index < 8 { 0.0 } else { 5.0 };
        let line = format!("{time_s},{name},{},{}\n", f64::from(index) / 10.0, index * 2);
        csv.push_str(&line);
    }
    fs::write(source.join("log.csv"), csv).unwrap();
    source
}

fn tub(dir: &Path) -> PathBuf {
    let source = dir.join("tub");
    fs::create_dir_all(source.join("images")).unwrap();
    let manifest = [
        json!(["cam/image_array", "user/angle", "user/throttle", "user/mode"]),
        json!(["image_array", "float", "float", "str"]),
        json!({}),
        json!({"created_at": 1.0}),
        json!({"paths": ["catalog_0.catalog"], "current_index": 10, "max_len": 1000, "deleted_indexes": [9]}),
    ];
    fs::write(
        source.join("manifest.json"),
        manifest.map(|line| line.to_string()).join("\n"),
    )
    .unwrap();
    let mut catalog = String::new();
    for index in 0..10u32 {
        let name = format!("{index}_cam_image_array_.jpg");
        fs::write(
            source.join("images").join(&name),
            codec::encode_png(&image(index as u8)).unwrap(),
        )
        .unwrap();
        let line = json!({"_index": index, "_session_id": "1", "_timestamp_ms": 1000 + 50 * index, "cam/image_array": name,
            "user/angle": f64::from(index) / 10.0, "user/throttle": 0.5, "user/mode": "user"});
        catalog.push_str(&line.to_string());
        catalog.push('\n');
    }
    fs::write(source.join("catalog_0.catalog"), catalog).unwrap();
    source
}

#[test]
fn a_folder_with_csv_becomes_episodes_with_actions() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let imported = run(&folder(dir.path()), &out, small()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(dataset.info(), &imported.info);
    let lengths: Vec<usize> = dataset.episodes().iter().map(|episode| episode.frame_count).collect();
    assert_eq!((lengths, dataset.info().frame_period_s), (vec![8, 4], 0.1));
    let channels: Vec<String> = dataset.info().action_channels.iter().map(ToString::to_string).collect();
    assert_eq!(channels, ["action.speed m/s"]);
    assert_eq!((dataset.action(3), dataset.state(9)), (&[0.3f32][..], &[18.0f32][..]));
    assert!((dataset.timestamp_s(9) - 0.1).abs() < 1e-6);
}

#[test]
fn a_donkeycar_tub_leaves_out_deleted_records() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let imported = run(&tub(dir.path()), &out, small()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!((imported.info.frame_count, imported.info.frame_period_s), (9, 0.05));
    assert_eq!(dataset.action(4), [0.4, 0.5]);
}

#[test]
fn a_tub_of_deleted_records_is_imported_if_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (tub(dir.path()), dir.path().join("sets/out"));
    let some = run(&source, &dir.path().join("some"), small()).unwrap();
    assert_eq!(
        some.notes,
        ["1 records are marked as deleted and were left out; --include-deleted imports them, too"]
    );
    let manifest = fs::read_to_string(source.join("manifest.json")).unwrap();
    let all = manifest.replace("[9]", "[0,1,2,3,4,5,6,7,8,9]");
    fs::write(source.join("manifest.json"), all).unwrap();
    let error = run(&source, &out, small()).unwrap_err().to_string();
    assert!(error.starts_with("10 of the 10 records of "), "{error}");
    assert!(error.ends_with("--include-deleted imports them, too"), "{error}");
    assert!(!dir.path().join("sets").exists(), "a failed import leaves nothing");
    let options = ImportOptions {
        include_deleted: true,
        ..small()
    };
    let imported = run(&source, &out, options).unwrap();
    assert_eq!((imported.info.frame_count, imported.info.name.as_str()), (10, "out"));
}

#[test]
fn a_stopped_import_continues_to_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("long.npy");
    let text = "{'descr': '|u1', 'fortran_order': False, 'shape': (600, 9, 12, 16), }\n";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend((0..600usize * 9 * 192).map(|i| (i / 7) as u8));
    fs::write(&source, &bytes).unwrap();
    let options = ImportOptions {
        rate_hz: Some(10.0),
        ..small()
    };
    let whole = run(&source, &dir.path().join("whole"), options.clone()).unwrap();
    for stop_after in [1, 1500, 2300, 5000] {
        let config = ImportConfig {
            source: source.clone(),
            out: dir.path().join(format!("stopped-{stop_after}")),
            options: options.clone(),
            disk_mib: DEFAULT_DISK_MIB,
            max_files: DEFAULT_MAX_FILES,
        };
        let (cancelled, most) = (AtomicBool::new(false), AtomicU64::new(0));
        let stopped = import(
            &config,
            &|now| {
                most.fetch_max(now.done, Ordering::Relaxed);
                cancelled.store(now.done >= stop_after, Ordering::Relaxed);
            },
            &cancelled,
        );
        assert!(matches!(stopped, Err(ImportError::Cancelled { .. })), "{stopped:?}");
        let continued = import(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
        assert_eq!(continued.info.content_hash, whole.info.content_hash);
        // A finished import is recognised.
        assert_eq!(import(&config, &|_| {}, &AtomicBool::new(false)).unwrap(), continued);
    }
}

/// The error of a changed tub, and what is left out of it with `--skip-bad`.
fn damaged(change: impl Fn(&Path)) -> (String, usize) {
    let dir = tempfile::tempdir().unwrap();
    let source = tub(dir.path());
    change(&source);
    let error = run(&source, &dir.path().join("strict"), small()).unwrap_err();
    let options = ImportOptions {
        skip_bad: true,
        ..small()
    };
    let imported = run(&source, &dir.path().join("skipping"), options).unwrap();
    (foreframe_core::error_text::with_causes(&error), imported.skipped.len())
}

#[test]
fn damage_in_a_tub_is_named_or_skipped() {
    let (text, skipped) = damaged(|tub| fs::remove_file(tub.join("images/4_cam_image_array_.jpg")).unwrap());
    assert!(
        text.contains("catalog_0.catalog line 5") && text.contains("is missing"),
        "{text}"
    );
    assert_eq!(skipped, 1);
    let (text, skipped) =
        damaged(|tub| fs::write(tub.join("images/2_cam_image_array_.jpg"), b"\xff\xd8nothing").unwrap());
    assert!(text.contains("line 3") && text.contains("is damaged"), "{text}");
    assert_eq!(skipped, 1);
    let rewrite = |tub: &Path, from: &str, to: &str| {
        let path = tub.join("catalog_0.catalog");
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(from));
        fs::write(path, text.replacen(from, to, 1)).unwrap();
    };
    let (text, skipped) = damaged(|tub| rewrite(tub, "\"_timestamp_ms\":1150", "\"_timestamp_ms\":1000"));
    assert!(text.contains("line 4") && text.contains("times must grow"), "{text}");
    assert_eq!(skipped, 1);
    let (text, skipped) = damaged(|tub| rewrite(tub, "3_cam_image_array_.jpg", "../../secret.jpg"));
    assert!(text.contains("it must be a file below"), "{text}");
    assert_eq!(skipped, 1);
    let (text, skipped) = damaged(|tub| rewrite(tub, "\"user/angle\":0.6", "\"user/angle\":null"));
    assert!(text.contains("line 7") && text.contains("user/angle"), "{text}");
    assert_eq!(skipped, 1);
}

/// The lengths of the data set's episodes.
fn lengths(set: &Path) -> Vec<usize> {
    let dataset = Dataset::open(set).unwrap();
    dataset.episodes().iter().map(|episode| episode.frame_count).collect()
}

#[test]
fn an_episode_ends_at_what_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let skipping = ImportOptions {
        skip_bad: true,
        ..small()
    };
    let (walk, car) = (folder(dir.path()), tub(dir.path()));
    let rewrite = |path: PathBuf, from: &str, to: &str| {
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(from));
        fs::write(path, text.replacen(from, to, 1)).unwrap();
    };
    rewrite(walk.join("log.csv"), ",0.3,", ",NaN,");
    run(&walk, &dir.path().join("a"), skipping.clone()).unwrap();
    assert_eq!(lengths(&dir.path().join("a")), [3, 4, 4]);
    rewrite(
        car.join("catalog_0.catalog"),
        "\"user/angle\":0.6",
        "\"user/angle\":null",
    );
    rewrite(car.join("manifest.json"), "[9]", "[2]");
    run(&car, &dir.path().join("b"), skipping).unwrap();
    assert_eq!(lengths(&dir.path().join("b")), [2, 3, 3]);
}

#[test]
fn options_that_name_values_are_refused_where_there_are_frames_alone() {
    let dir = tempfile::tempdir().unwrap();
    let images = folder(dir.path());
    fs::remove_file(images.join("log.csv")).unwrap();
    let array = dir.path().join("frames.npy");
    fs::write(&array, []).unwrap();
    let name = || Some("x".to_owned());
    for (source, what) in [
        (&images, "a folder of images without a CSV file"),
        (&array, "an .npy file"),
    ] {
        for (option, options) in [
            (
                "--image",
                ImportOptions {
                    image: name(),
                    ..small()
                },
            ),
            (
                "--time",
                ImportOptions {
                    time: name(),
                    ..small()
                },
            ),
            (
                "--action",
                ImportOptions {
                    actions: vec!["x".to_owned()],
                    ..small()
                },
            ),
            (
                "--state",
                ImportOptions {
                    states: vec!["x".to_owned()],
                    ..small()
                },
            ),
        ] {
            let options = ImportOptions {
                rate_hz: Some(5.0),
                ..options
            };
            let error = run(source, &dir.path().join("out"), options).unwrap_err().to_string();
            assert_eq!(error, format!("{what} has only frames; leave out {option}"));
        }
    }
}

#[test]
fn a_used_directory_and_other_options_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (folder(dir.path()), dir.path().join("out"));
    run(&source, &out, small()).unwrap();
    let error = run(&source, &out, ImportOptions::default()).unwrap_err().to_string();
    assert!(error.contains("other options"), "{error}");
    let error = run(&source, &source, small()).unwrap_err().to_string();
    assert!(error.contains("other files"), "{error}");
    let error = run(&dir.path().join("none"), &dir.path().join("c"), small()).unwrap_err();
    assert!(
        foreframe_core::error_text::with_causes(&error).contains("none"),
        "{error}"
    );
}

#[test]
fn a_failed_import_can_be_repeated_with_other_options() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (folder(dir.path()), dir.path().join("out"));
    let wrong = ImportOptions {
        actions: vec!["turn".to_owned()],
        ..small()
    };
    assert!(run(&source, &out, wrong).is_err());
    assert_eq!(run(&source, &out, small()).unwrap().info.episode_count, 2);
}

#[test]
fn a_playlist_named_as_a_video_reads_no_other_file() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    video(&dir.path().join("other.mp4"), 20);
    let source = dir.path().join("list.mp4");
    fs::write(&source, "ffconcat version 1.0\nfile other.mp4\n").unwrap();
    let error = run(&source, &dir.path().join("out"), small()).unwrap_err().to_string();
    assert!(error.contains("ffprobe cannot read the video"), "{error}");
}
