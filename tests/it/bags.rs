//! Bags of ROS 2 become data sets: encodings, containers, times, and damage.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use foreframe_core::error_text::with_causes;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::frame::{Frame, codec};
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, Imported, import,
};

use crate::bag_files::{
    BagMessage, Chunks, camera_info, compressed_image, image, joint_state, mcap, odometry, twist, twist_stamped,
};
use crate::recordings::database as db3;

/// The bags start at this time, in nanoseconds.
const START_NS: i64 = 1_700_000_000_000_000_000;
const SIZE: (u32, u32) = (16, 12);

fn options() -> ImportOptions {
    ImportOptions {
        frame_width_px: 16,
        frame_height_px: 12,
        ..ImportOptions::default()
    }
}

fn run(source: &Path, out: &Path, options: ImportOptions) -> Result<Imported, ImportError> {
    let config = ImportConfig {
        source: source.to_owned(),
        out: out.to_owned(),
        options,
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    };
    import(&config, &|_| {}, &AtomicBool::new(false))
}

fn message(topic: &'static str, type_name: &'static str, log_ns: i64, content: Vec<u8>) -> BagMessage {
    BagMessage {
        topic,
        type_name,
        log_ns,
        content,
    }
}

fn gray(index: i64) -> Vec<u8> {
    (0..SIZE.0 * SIZE.1)
        .map(|pixel| (pixel as u8).wrapping_add(index as u8 * 3))
        .collect()
}

/// 20 images at 10 Hz (made 20 ms before they are recorded), commands at 20 Hz, odometry at 10 Hz.
fn drive(big_endian: bool) -> Vec<BagMessage> {
    let mut messages = vec![message(
        "/camera/camera_info",
        "sensor_msgs/msg/CameraInfo",
        START_NS,
        camera_info(SIZE, 8.0),
    )];
    for index in 0..20i64 {
        let time_ns = START_NS + index * 100_000_000;
        for half in [0, 1] {
            let speed = index as f64 + 0.5 * f64::from(half);
            messages.push(message(
                "/cmd_vel",
                "geometry_msgs/msg/Twist",
                time_ns + i64::from(half) * 50_000_000,
                twist(big_endian, speed, -speed),
            ));
        }
        messages.push(message(
            "/odom",
            "nav_msgs/msg/Odometry",
            time_ns,
            odometry(time_ns, index as f64, 0.1, 0.5),
        ));
        messages.push(message(
            "/camera/image_raw",
            "sensor_msgs/msg/Image",
            time_ns + 20_000_000,
            image(big_endian, time_ns, "mono8", SIZE, &gray(index)),
        ));
    }
    messages
}

fn bag(dir: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = dir.join(name);
    fs::write(&path, bytes).unwrap();
    path
}

fn names(channels: &[foreframe_core::types::Channel]) -> Vec<String> {
    channels.iter().map(ToString::to_string).collect()
}

#[test]
fn a_bag_becomes_frames_with_actions_and_states() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let source = bag(dir.path(), "drive.mcap", &mcap(&drive(false), Chunks::Plain, 7));
    let imported = run(&source, &out, options()).unwrap();
    assert_eq!(imported.skipped, []);
    let dataset = Dataset::open(&out).unwrap();
    let info = dataset.info();
    assert_eq!(
        (info.frame_count, info.episode_count, info.frame_period_s),
        (20, 1, 0.1)
    );
    assert_eq!(names(&info.action_channels), ["linear.x m/s", "angular.z rad/s"]);
    assert_eq!(
        names(&info.state_channels),
        [
            "x m",
            "y m",
            "heading_cos",
            "heading_sin",
            "linear.x m/s",
            "angular.z rad/s"
        ]
    );
    // Half the time 3.0, half of it 3.5.
    assert_eq!(dataset.action(3), [3.25, -3.25]);
    assert_eq!(*dataset.pixels(7).unwrap(), gray(7));
    let state = dataset.state(4);
    assert_eq!((state[0], state[1], state[4]), (4.0, 0.0, 0.5));
    assert!((state[3] - 0.1f32.sin()).abs() < 1e-6, "{state:?}");
    // 2 · atan(16 / 2 / 8).
    let camera = info.camera.unwrap();
    assert!((camera.horizontal_fov_rad.to_degrees() - 90.0).abs() < 1e-3);
}

#[test]
fn options_replace_what_a_bag_says_of_its_camera() {
    let dir = tempfile::tempdir().unwrap();
    let camera = |name: &str, messages: &[BagMessage], options: ImportOptions| {
        let source = bag(dir.path(), &format!("{name}.mcap"), &mcap(messages, Chunks::Plain, 7));
        run(&source, &dir.path().join(name), options).unwrap().info.camera
    };
    let degrees =
        |camera: CameraModel| [camera.horizontal_fov_rad, camera.tilt_down_rad].map(|angle| angle.to_degrees().round());
    let tilted = ImportOptions {
        tilt_deg: Some(20.0),
        ..options()
    };
    assert_eq!(degrees(camera("a", &drive(false), tilted).unwrap()), [90.0, 20.0]);
    let narrower = ImportOptions {
        fov_deg: Some(60.0),
        ..options()
    };
    assert_eq!(
        degrees(camera("b", &drive(false), narrower.clone()).unwrap()),
        [60.0, 0.0]
    );
    let mut changing = drive(false);
    let type_name = "sensor_msgs/msg/CameraInfo";
    changing.push(message(
        "/camera/camera_info",
        type_name,
        START_NS + 1,
        camera_info(SIZE, 9.0),
    ));
    assert_eq!(camera("c", &changing, options()), None);
    assert_eq!(degrees(camera("d", &changing, narrower).unwrap()), [60.0, 0.0]);
}

#[test]
fn every_container_and_byte_order_gives_the_same_data_set() {
    let dir = tempfile::tempdir().unwrap();
    let mut hashes = Vec::new();
    for (big_endian, chunks) in [
        (false, Chunks::Plain),
        (true, Chunks::None),
        (false, Chunks::Lz4),
        (true, Chunks::Zstd),
    ] {
        let name = format!("{chunks:?}.mcap");
        let source = bag(dir.path(), &name, &mcap(&drive(big_endian), chunks, 7));
        let imported = run(&source, &dir.path().join(format!("{chunks:?}")), options()).unwrap();
        hashes.push(imported.info.content_hash);
    }
    assert!(hashes.iter().all(|hash| *hash == hashes[0]), "{hashes:?}");
}

#[test]
fn compressed_images_and_stamped_commands_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let mut messages = Vec::new();
    for index in 0..6i64 {
        let time_ns = START_NS + index * 100_000_000;
        let frame = Frame::new(SIZE.0, SIZE.1, gray(index)).unwrap();
        let stamped = twist_stamped(time_ns, index as f64, 0.0);
        messages.push(message(
            "/cmd",
            "geometry_msgs/msg/TwistStamped",
            time_ns + 900,
            stamped,
        ));
        let joints: &[(&str, f64, f64)] = match index % 2 {
            0 => &[("left", 1.0, 2.0), ("right", 3.0, f64::NAN)],
            _ => &[("right", 4.0, 5.0)],
        };
        let joints = joint_state(time_ns, joints);
        messages.push(message("/joints", "sensor_msgs/msg/JointState", time_ns, joints));
        let png = codec::encode_png(&frame).unwrap();
        let content = compressed_image(time_ns, "mono8; png compressed ", &png);
        messages.push(message("/image", "sensor_msgs/msg/CompressedImage", time_ns, content));
    }
    let source = bag(dir.path(), "small.mcap", &mcap(&messages, Chunks::Zstd, 100));
    let out = dir.path().join("out");
    let imported = run(&source, &out, options()).unwrap();
    // The right wheel's velocity is not known at the first image.
    assert_eq!(imported.skipped.len(), 1, "{:?}", imported.skipped);
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(*dataset.pixels(0).unwrap(), gray(1));
    assert_eq!(dataset.action(2), [3.0, 0.0]);
    assert_eq!(
        names(&dataset.info().state_channels),
        [
            "left.position rad",
            "right.position rad",
            "left.velocity rad/s",
            "right.velocity rad/s"
        ]
    );
    assert_eq!(dataset.state(0), [1.0, 4.0, 2.0, 5.0]);
    let wheels = ImportOptions {
        actions: vec!["none".to_owned()],
        states: vec!["/joints:right.position".to_owned(), "/cmd:linear.x".to_owned()],
        units: vec!["joints.right.position=m".to_owned()],
        ..options()
    };
    let out = dir.path().join("chosen");
    run(&source, &out, wheels).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(names(&dataset.info().action_channels), [""; 0]);
    assert_eq!(
        names(&dataset.info().state_channels),
        ["joints.right.position m", "cmd.linear.x m/s"]
    );
    assert_eq!(dataset.state(2), [3.0, 2.0]);
}

#[test]
fn a_stopped_import_of_a_bag_continues_to_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    // A gap every 500 images, so that there are several shards.
    let time_ns = |index: i64| START_NS + index * 50_000_000 + index / 500 * 10_000_000_000;
    let one = |index: i64| {
        let content = image(false, time_ns(index), "mono8", SIZE, &gray(index));
        message("/image", "sensor_msgs/msg/Image", time_ns(index), content)
    };
    let messages: Vec<BagMessage> = (0..5000).map(one).collect();
    let source = bag(dir.path(), "long.mcap", &mcap(&messages, Chunks::Lz4, 40));
    let whole = run(&source, &dir.path().join("whole"), options()).unwrap();
    assert_eq!((whole.info.frame_count, whole.info.episode_count), (5000, 10));
    for stop_after in [1, 1999, 2001, 4700] {
        let config = ImportConfig {
            source: source.clone(),
            out: dir.path().join(format!("stopped-{stop_after}")),
            options: options(),
            disk_mib: DEFAULT_DISK_MIB,
            max_files: DEFAULT_MAX_FILES,
        };
        let cancelled = AtomicBool::new(false);
        let stop = |now: foreframe_data::dataset::import::ImportProgress| {
            cancelled.store(now.done >= stop_after, Ordering::Relaxed);
        };
        let stopped = import(&config, &stop, &cancelled);
        assert!(matches!(stopped, Err(ImportError::Cancelled { .. })), "{stopped:?}");
        let continued = import(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
        assert_eq!(continued.info.content_hash, whole.info.content_hash);
    }
}

/// The error of an import, and what it leaves out with `--skip-bad`: frames and items.
fn damaged(name: &str, bytes: &[u8]) -> (String, usize, Vec<String>) {
    let dir = tempfile::tempdir().unwrap();
    let source = bag(dir.path(), name, bytes);
    let error = run(&source, &dir.path().join("strict"), options()).unwrap_err();
    let skipping = ImportOptions {
        skip_bad: true,
        ..options()
    };
    let imported = run(&source, &dir.path().join("skipping"), skipping).unwrap();
    let skipped = imported
        .skipped
        .into_iter()
        .map(|item| format!("{}: {}", item.place, item.reason));
    (with_causes(&error), imported.info.frame_count, skipped.collect())
}

#[test]
fn what_a_bag_has_before_its_cut_is_kept() {
    let whole = mcap(&drive(false), Chunks::Plain, 7);
    for chunks in [Chunks::None, Chunks::Plain, Chunks::Lz4, Chunks::Zstd] {
        let bytes = mcap(&drive(false), chunks, 7);
        let (text, frames, skipped) = damaged("cut.mcap", &bytes[..bytes.len() / 2]);
        assert!(
            text.contains("cut.mcap byte") && text.contains("the recording was cut off"),
            "{text}"
        );
        assert!((8..=10).contains(&frames), "{chunks:?}: {frames} frames");
        assert_eq!(skipped.len(), 1, "{skipped:?}");
    }
    let (text, frames, _) = damaged("cut.mcap", &whole[..whole.len() - 45]);
    assert!(text.contains("without the end of its data"), "{text}");
    assert_eq!(frames, 20);
}

#[test]
fn damage_in_a_chunk_leaves_out_that_chunk_only() {
    let pattern = gray(9);
    let mut bytes = mcap(&drive(false), Chunks::Plain, 7);
    let at = bytes
        .windows(pattern.len())
        .position(|window| window == pattern)
        .unwrap();
    bytes[at + 5] ^= 1;
    let (text, frames, skipped) = damaged("flipped.mcap", &bytes);
    assert!(text.contains("checksum (CRC-32)"), "{text}");
    assert!((17..20).contains(&frames) && skipped.len() == 1, "{frames} {skipped:?}");
}

#[test]
fn damaged_messages_are_named_with_topic_and_place() {
    let with = |change: &dyn Fn(&mut Vec<BagMessage>)| {
        let mut messages = drive(false);
        change(&mut messages);
        damaged("bad.mcap", &mcap(&messages, Chunks::None, 7))
    };
    let nth = |messages: &mut Vec<BagMessage>, topic: &str, nth: usize| -> usize {
        let mut of = messages
            .iter()
            .enumerate()
            .filter(|(_, message)| message.topic == topic);
        of.nth(nth).unwrap().0
    };
    let (text, frames, skipped) = with(&|messages| {
        let at = nth(messages, "/camera/image_raw", 6);
        messages[at].content = image(false, START_NS, "bayer_rggb8", SIZE, &gray(6));
    });
    assert!(
        text.contains("message 6 of /camera/image_raw: its encoding is \"bayer_rggb8\""),
        "{text}"
    );
    assert_eq!((frames, skipped.len()), (19, 1));
    let (text, frames, _) = with(&|messages| {
        let at = nth(messages, "/camera/image_raw", 6);
        messages[at].content.truncate(100);
    });
    assert!(text.contains("its field data needs 192 bytes at byte 56"), "{text}");
    assert_eq!(frames, 19);
    let (text, ..) = with(&|messages| {
        let at = nth(messages, "/cmd_vel", 3);
        messages[at].content = twist(false, f64::NAN, 0.0);
    });
    assert!(text.contains("message 3 of /cmd_vel: linear.x is NaN"), "{text}");
    let (text, ..) = with(&|messages| {
        let at = nth(messages, "/odom", 3);
        messages[at].content[1] = 7;
    });
    assert!(text.contains("message 3 of /odom: its encoding is [0, 7]"), "{text}");
    let (text, frames, _) = with(&|messages| {
        let at = nth(messages, "/camera/image_raw", 5);
        messages[at].content = image(false, START_NS, "mono8", SIZE, &gray(5));
    });
    assert!(
        text.contains("message 5 of /camera/image_raw") && text.contains("times must grow"),
        "{text}"
    );
    assert_eq!(frames, 19);
    let (text, frames, _) = with(&|messages| {
        let at = nth(messages, "/cmd_vel", 9);
        messages[at].log_ns = START_NS;
    });
    assert!(
        text.contains("message 9 of /cmd_vel") && text.contains("times must grow"),
        "{text}"
    );
    assert_eq!(frames, 20);
}

#[test]
fn an_episode_ends_at_a_damaged_image() {
    let mut messages = drive(false);
    let mut images = messages
        .iter_mut()
        .filter(|message| message.topic == "/camera/image_raw");
    images.nth(6).unwrap().content.truncate(100);
    let dir = tempfile::tempdir().unwrap();
    let source = bag(dir.path(), "bad.mcap", &mcap(&messages, Chunks::None, 7));
    let skipping = ImportOptions {
        skip_bad: true,
        ..options()
    };
    let out = dir.path().join("out");
    run(&source, &out, skipping).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    let lengths: Vec<usize> = dataset.episodes().iter().map(|episode| episode.frame_count).collect();
    assert_eq!(lengths, [6, 13]);
}

#[test]
fn a_missing_topic_lists_those_that_there_are() {
    let dir = tempfile::tempdir().unwrap();
    let source = bag(dir.path(), "drive.mcap", &mcap(&drive(false), Chunks::Lz4, 7));
    let error = |options: ImportOptions| run(&source, &dir.path().join("out"), options).unwrap_err().to_string();
    let wrong = ImportOptions {
        image: Some("/front/image".to_owned()),
        ..options()
    };
    let text = error(wrong);
    assert!(text.contains("no topic \"/front/image\""), "{text}");
    assert!(
        text.contains("/cmd_vel (geometry_msgs/msg/Twist, 40 messages)"),
        "{text}"
    );
    let wrong = ImportOptions {
        actions: vec!["/camera/camera_info".to_owned()],
        ..options()
    };
    let text = error(wrong);
    assert!(
        text.contains("that cannot be the action") && text.contains("--action"),
        "{text}"
    );
    let wrong = ImportOptions {
        states: vec!["/odom:speed".to_owned()],
        ..options()
    };
    assert!(error(wrong).contains("/odom has no field \"speed\"; its fields are: x, y, z, heading_cos"));
    let mut two = drive(false);
    two.push(message(
        "/teleop",
        "geometry_msgs/msg/Twist",
        START_NS,
        twist(false, 0.0, 0.0),
    ));
    let source = bag(dir.path(), "two.mcap", &mcap(&two, Chunks::Lz4, 7));
    let text = run(&source, &dir.path().join("out"), options())
        .unwrap_err()
        .to_string();
    assert!(text.contains("more than one topic for the action (or none)"), "{text}");
}

#[test]
fn a_file_that_is_no_mcap_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = bag(dir.path(), "not.mcap", b"#ROSBAG V2.0\n");
    let text = run(&source, &dir.path().join("out"), options())
        .unwrap_err()
        .to_string();
    assert!(text.contains("not.mcap byte 0: this is not an MCAP file"), "{text}");
}

#[test]
fn a_database_and_a_split_bag_give_the_data_set_of_the_mcap_file() {
    let dir = tempfile::tempdir().unwrap();
    let messages = drive(false);
    let source = bag(dir.path(), "drive.mcap", &mcap(&messages, Chunks::Plain, 7));
    let wanted = run(&source, &dir.path().join("mcap"), options())
        .unwrap()
        .info
        .content_hash;
    db3(&dir.path().join("drive.db3"), &messages);
    let hash = |source: &Path, out: &str| run(source, &dir.path().join(out), options()).unwrap().info.content_hash;
    assert_eq!(hash(&dir.path().join("drive.db3"), "db3"), wanted);
    let split = dir.path().join("split");
    fs::create_dir(&split).unwrap();
    let (first, second) = messages.split_at(41);
    db3(&split.join("split_0.db3"), first);
    db3(&split.join("split_1.db3"), second);
    assert_eq!(hash(&split, "without metadata"), wanted);
    let metadata =
        "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n    - split_0.db3\n    - split_1.db3\n";
    fs::write(split.join("metadata.yaml"), metadata).unwrap();
    assert_eq!(hash(&split, "with metadata"), wanted);
    fs::remove_file(split.join("split_1.db3")).unwrap();
    let text = run(&split, &dir.path().join("missing"), options())
        .unwrap_err()
        .to_string();
    assert!(
        text.contains("metadata.yaml: it lists split_1.db3, which is missing"),
        "{text}"
    );
    fs::write(split.join("metadata.yaml"), metadata.replace("_1.db3", "_1.db3.zstd")).unwrap();
    let text = run(&split, &dir.path().join("zstd"), options())
        .unwrap_err()
        .to_string();
    assert!(text.contains("unzstd split_1.db3.zstd"), "{text}");
}

#[test]
fn messages_compressed_one_by_one_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let messages = drive(false);
    let source = bag(dir.path(), "drive.mcap", &mcap(&messages, Chunks::Plain, 7));
    let wanted = run(&source, &dir.path().join("plain"), options())
        .unwrap()
        .info
        .content_hash;
    let level = ruzstd::encoding::CompressionLevel::Fastest;
    let compressed = messages.into_iter().map(|message| BagMessage {
        content: ruzstd::encoding::compress_to_vec(message.content.as_slice(), level),
        ..message
    });
    db3(&dir.path().join("zstd.db3"), &compressed.collect::<Vec<_>>());
    let found = run(&dir.path().join("zstd.db3"), &dir.path().join("zstd"), options()).unwrap();
    assert_eq!(found.info.content_hash, wanted);
}

#[test]
fn what_a_database_has_before_its_cut_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("whole.db3");
    db3(&path, &drive(false));
    let bytes = fs::read(&path).unwrap();
    let (text, frames, skipped) = damaged("cut.db3", &bytes[..bytes.len() / 8192 * 4096]);
    assert!(
        text.contains("cut.db3: this is not a bag in an SQLite database, or it is damaged"),
        "{text}"
    );
    assert!((5..20).contains(&frames) && skipped.len() == 1, "{frames} {skipped:?}");
    let source = bag(
        dir.path(),
        "not.db3",
        b"no database at all, but long enough to look like one",
    );
    let text = run(&source, &dir.path().join("out"), options())
        .unwrap_err()
        .to_string();
    assert!(text.contains("this is not a bag in an SQLite database"), "{text}");
}
