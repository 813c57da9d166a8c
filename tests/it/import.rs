//! Recordings become data sets: every source, resumed runs, and damaged input.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::{Frame, codec};
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, Imported, import,
};
use serde_json::json;

use crate::recordings::{has_ffmpeg, numpy_array as npy, video};

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
fn columns_that_nobody_asked_for_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let csv = source.join("log.csv");
    let text = fs::read_to_string(&csv)
        .unwrap()
        .replace("action.", "")
        .replace("state.", "");
    fs::write(&csv, text).unwrap();
    let imported = run(&source, &dir.path().join("frames"), small()).unwrap();
    assert_eq!(imported.notes.len(), 1);
    let named = imported.notes[0].contains("not imported: speed") && imported.notes[0].contains("--action COLUMN");
    assert!(named, "{:?}", imported.notes);
    let options = ImportOptions {
        actions: vec!["speed".to_owned()],
        ..small()
    };
    let notes = run(&source, &dir.path().join("speed"), options).unwrap().notes;
    assert!(
        notes.len() == 1 && notes[0].contains("not imported: heading"),
        "{notes:?}"
    );
}

#[test]
fn a_numpy_array_of_sequences_becomes_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("moving.npy");
    let text = "{'descr': '|u1', 'fortran_order': False, 'shape': (3, 5, 12, 16), }\n";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend((0..3 * 5).flat_map(|frame| vec![frame as u8; 16 * 12]));
    fs::write(&source, &bytes).unwrap();
    let missing = run(&source, &dir.path().join("a"), small()).unwrap_err().to_string();
    assert!(missing.contains("--rate"), "{missing}");
    let options = ImportOptions {
        rate_hz: Some(10.0),
        ..small()
    };
    let out = dir.path().join("out");
    run(&source, &out, options.clone()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!((dataset.episodes().len(), dataset.info().frame_count), (5, 15));
    // Sequence 1 holds the array's frames 1, 6 and 11.
    assert_eq!([3, 4, 5].map(|frame| dataset.pixels(frame).unwrap()[0]), [1, 6, 11]);
    fs::write(&source, &bytes[..bytes.len() - 1]).unwrap();
    let cut = run(&source, &dir.path().join("b"), options).unwrap_err().to_string();
    assert!(cut.contains("the file ends here"), "{cut}");
}

pub(crate) fn npz(path: &Path, arrays: &[(&str, Vec<u8>)], method: zip::CompressionMethod) {
    let mut archive = zip::ZipWriter::new(fs::File::create(path).unwrap());
    for (name, array) in arrays {
        let options = zip::write::SimpleFileOptions::default().compression_method(method);
        archive.start_file(format!("{name}.npy"), options).unwrap();
        std::io::Write::write_all(&mut archive, array).unwrap();
    }
    archive.finish().unwrap();
}

/// Arrays by name.
type NamedArrays = Vec<(&'static str, Vec<u8>)>;

/// Six color frames, one action component, three state components, times 0.1 s apart.
fn arrays() -> NamedArrays {
    let floats = |count: u8| -> Vec<u8> { (0..count).flat_map(|value| f32::from(value).to_le_bytes()).collect() };
    let frames = (0..6)
        .flat_map(|frame| vec![frame * 10; 16 * 12 * 3])
        .collect::<Vec<u8>>();
    let times: Vec<u8> = (0..6i64)
        .flat_map(|frame| (5_000 + frame * 100).to_le_bytes())
        .collect();
    vec![
        ("frames", npy("|u1", "6, 12, 16, 3", &frames)),
        ("actions", npy("<f4", "6,", &floats(6))),
        ("states", npy("<f4", "6, 3", &floats(18))),
        ("timestamps_ms", npy("<i8", "6,", &times)),
    ]
}

#[test]
fn arrays_of_one_file_become_frames_actions_and_states() {
    let dir = tempfile::tempdir().unwrap();
    let mut hashes = Vec::new();
    for method in [zip::CompressionMethod::Stored, zip::CompressionMethod::Deflated] {
        let source = dir.path().join(format!("{method}.npz"));
        npz(&source, &arrays(), method);
        let options = ImportOptions {
            units: vec!["states.1=m".to_owned()],
            ..small()
        };
        let out = dir.path().join(format!("out-{method}"));
        hashes.push(run(&source, &out, options).unwrap().info.content_hash);
        let dataset = Dataset::open(&out).unwrap();
        assert_eq!((dataset.info().frame_count, dataset.info().frame_period_s), (6, 0.1));
        assert_eq!(
            (dataset.action(2), dataset.state(2)),
            (&[2.0f32][..], &[6.0f32, 7.0, 8.0][..])
        );
        assert_eq!(dataset.pixels(4).unwrap()[0], 40);
        let names: Vec<String> = dataset.info().state_channels.iter().map(ToString::to_string).collect();
        assert_eq!(names, ["states.0", "states.1 m", "states.2"]);
        assert!(!out.join("decoded.gray.tmp").exists());
    }
    assert_eq!(hashes[0], hashes[1]);
}

#[test]
fn arrays_of_any_numbers_are_read_and_colors_of_floats() {
    let dir = tempfile::tempdir().unwrap();
    let floats = |values: Vec<f32>| values.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let colors = (0..6).flat_map(|_| [1.0, 0.0, 0.0].repeat(16 * 12)).collect();
    let times: Vec<u8> = (0..6u64).flat_map(|frame| (frame * 100).to_le_bytes()).collect();
    let arrays: NamedArrays = vec![
        ("frames", npy("<f4", "6, 12, 16, 3", &floats(colors))),
        ("actions", npy("<f2", "6,", &[0x00, 0xbe].repeat(6))),
        ("states", npy("|b1", "6,", &[1; 6])),
        ("timestamps_ms", npy("<u8", "6,", &times)),
    ];
    let (source, out) = (dir.path().join("a.npz"), dir.path().join("out"));
    npz(&source, &arrays, zip::CompressionMethod::Stored);
    run(&source, &out, small()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!((dataset.info().frame_count, dataset.info().frame_period_s), (6, 0.1));
    assert_eq!((dataset.action(2), dataset.state(2)), (&[-1.5f32][..], &[1.0f32][..]));
    assert_eq!(dataset.pixels(4).unwrap()[0], 76);
}

#[test]
fn wrong_arrays_of_a_file_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("a.npz");
    let error = |change: &dyn Fn(&mut NamedArrays), options: ImportOptions| {
        let mut arrays = arrays();
        change(&mut arrays);
        npz(&source, &arrays, zip::CompressionMethod::Deflated);
        run(&source, &dir.path().join("out"), options).unwrap_err().to_string()
    };
    let text = error(&|arrays| arrays[1].1 = npy("|O", "6,", b"\x80\x04."), small());
    assert!(
        text.contains("a.npz array actions: it holds Python objects (pickle)"),
        "{text}"
    );
    let text = error(&|arrays| arrays[1].1 = npy("<f4", "5,", &[0; 20]), small());
    assert!(
        text.contains("array actions: its shape is [5]; it must begin with [6]"),
        "{text}"
    );
    let text = error(&|arrays| arrays[1].1 = npy("<f4", "6,", &[255; 24]), small());
    assert!(text.contains("value 0 is NaN"), "{text}");
    let text = error(&|arrays| arrays[0].1.truncate(900), small());
    assert!(text.contains("array frames: it has 900 bytes"), "{text}");
    let text = error(&|arrays| arrays[3].1 = npy("<i8", "6,", &[0; 48]), small());
    assert!(text.contains("times must grow"), "{text}");
    let text = error(&|arrays| drop(arrays.pop()), small());
    assert!(
        text.contains("no array of timestamps") && text.contains("--rate"),
        "{text}"
    );
    let named = ImportOptions {
        image: Some("camera".to_owned()),
        ..small()
    };
    let text = error(&|_| {}, named);
    assert!(
        text.contains("no array \"camera\"") && text.contains("frames, actions, states"),
        "{text}"
    );
    fs::write(&source, b"PK\x03\x04 cut off").unwrap();
    let text = run(&source, &dir.path().join("out"), small()).unwrap_err().to_string();
    assert!(text.contains("not a .npz file"), "{text}");
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
fn columns_of_a_single_action_and_state_need_no_suffix() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let text = fs::read_to_string(source.join("log.csv")).unwrap();
    let text = text.replace("action.speed", "action").replace("state.heading", "state");
    fs::write(source.join("log.csv"), text).unwrap();
    // What macOS writes beside a file on a foreign disk.
    fs::write(source.join("._log.csv"), b"\0\x05\x16\x07").unwrap();
    let info = run(&source, &dir.path().join("out"), small()).unwrap().info;
    assert_eq!(info.action_channels[0].to_string(), "action m/s");
    assert_eq!(info.state_channels[0].to_string(), "state");
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
fn csv_mistakes_name_column_and_line() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let options = ImportOptions {
        actions: vec!["turn".to_owned()],
        ..small()
    };
    let error = run(&source, &dir.path().join("a"), options).unwrap_err().to_string();
    assert!(
        error.contains("no column \"turn\"") && error.contains("action.speed"),
        "{error}"
    );
    let options = ImportOptions {
        units: vec!["turns=rad/s".to_owned()],
        ..small()
    };
    let error = run(&source, &dir.path().join("u"), options).unwrap_err().to_string();
    assert!(
        error.contains("--unit names the channel \"turns\", which is not imported; there are: "),
        "{error}"
    );
    let csv = source.join("log.csv");
    let text = fs::read_to_string(&csv).unwrap();
    fs::write(&csv, text.replacen(",0.3,", ",NaN,", 1)).unwrap();
    let error = run(&source, &dir.path().join("b"), small()).unwrap_err().to_string();
    assert!(
        error.contains("log.csv line 5") && error.contains("finite number"),
        "{error}"
    );
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

/// A camera of 90° whose images lose a quarter of their columns.
fn described() -> ImportOptions {
    ImportOptions {
        frame_width_px: 12,
        frame_height_px: 12,
        rate_hz: Some(10.0),
        fov_deg: Some(90.0),
        tilt_deg: Some(-10.0),
        camera_height_m: Some(0.3),
        ..ImportOptions::default()
    }
}

fn assert_described(source: &Path, out: &Path) {
    run(source, out, described()).unwrap();
    let camera = Dataset::open(out).unwrap().camera(0).unwrap();
    // 2 · atan(24 / 32).
    let fov_deg = camera.horizontal_fov_rad.to_degrees();
    assert!((fov_deg - 73.74).abs() < 0.01, "{}: {fov_deg}", source.display());
    assert!((camera.tilt_down_rad.to_degrees() + 10.0).abs() < 1e-4);
    assert_eq!(camera.height_m, Some(0.3));
}

#[test]
fn options_describe_the_camera_of_images_and_arrays() {
    let dir = tempfile::tempdir().unwrap();
    assert_described(&folder(dir.path()), &dir.path().join("a"));
    let source = dir.path().join("walk.npz");
    let frames = npy("|u1", "6, 24, 32", &[7; 6 * 24 * 32]);
    npz(&source, &[("frames", frames)], zip::CompressionMethod::Deflated);
    assert_described(&source, &dir.path().join("b"));
}

#[test]
fn options_describe_the_camera_of_a_video() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("drive.mp4");
    video(&source, 20);
    let out = dir.path().join("out");
    run(&source, &out, described()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(
        (dataset.info().frame_count, dataset.camera(0).unwrap().height_m),
        (10, Some(0.3))
    );
}

#[test]
fn a_camera_that_cannot_be_described_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let error = |options: ImportOptions| run(&source, &dir.path().join("out"), options).unwrap_err().to_string();
    for (change, expected) in [
        (
            ImportOptions {
                fov_deg: Some(180.0),
                ..described()
            },
            "--fov is 180; it must be 5 to 170 degrees",
        ),
        (
            ImportOptions {
                tilt_deg: Some(f64::NAN),
                ..described()
            },
            "--tilt is NaN; it must be -85 to 85 degrees",
        ),
        (
            ImportOptions {
                camera_height_m: Some(0.0),
                ..described()
            },
            "--camera-height is 0; it must be 0.01 to 10 metres",
        ),
        (
            ImportOptions {
                fov_deg: None,
                ..described()
            },
            "--tilt and --camera-height need --fov, since the recording does not say",
        ),
        (
            ImportOptions {
                resize: Resize::Stretch,
                ..described()
            },
            "--fov cannot describe images that are stretched from 32×24 to 12×12 px",
        ),
    ] {
        let error = error(change);
        assert!(error.starts_with(expected), "{error}");
    }
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
