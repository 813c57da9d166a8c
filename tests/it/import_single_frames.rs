//! Recordings that lose every second frame: what the error advises, and that the advice helps.

use std::fs;
use std::path::{Path, PathBuf};

use foreframe_data::dataset::import::ImportOptions;

use crate::bag_files::{BagMessage, Chunks, image, mcap, odometry};
use crate::import::{folder, run, small};
use crate::recordings::tub;

const SIZE: (u32, u32) = (16, 12);

/// 12 images at 10 Hz, and odometry with every second one.
fn bag(dir: &Path) -> PathBuf {
    let mut messages = Vec::new();
    for index in 0..12i64 {
        let log_ns = 1_700_000_000_000_000_000 + index * 100_000_000;
        if index % 2 == 0 {
            messages.push(BagMessage {
                topic: "/odom",
                type_name: "nav_msgs/msg/Odometry",
                log_ns,
                content: odometry(log_ns, index as f64, 0.1, 0.5),
            });
        }
        messages.push(BagMessage {
            topic: "/camera",
            type_name: "sensor_msgs/msg/Image",
            log_ns,
            content: image(false, log_ns, "mono8", SIZE, &[index as u8 * 9; 16 * 12]),
        });
    }
    let path = dir.join("drive.mcap");
    fs::write(&path, mcap(&messages, Chunks::None, 100)).unwrap();
    path
}

#[test]
fn a_state_of_every_second_image_holds_longer_if_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let source = bag(dir.path());
    let with_hold = |hold_s: f64, name: &str| {
        let options = ImportOptions { hold_s, ..small() };
        run(&source, &dir.path().join(name), options)
    };
    let error = with_hold(0.05, "a").unwrap_err().to_string();
    assert_eq!(
        error,
        "no two consecutive images of /camera have a value of /odom: its values come every 0.200 s (median) and hold for 0.05 s; \
         let them hold longer with --hold, or leave the topic out with --state none"
    );
    let info = with_hold(0.2, "b").unwrap().info;
    assert_eq!((info.frame_count, info.frame_period_s), (12, 0.1));
    let options = ImportOptions {
        hold_s: 0.05,
        states: vec!["none".to_owned()],
        ..small()
    };
    assert_eq!(
        run(&source, &dir.path().join("c"), options).unwrap().info.frame_count,
        12
    );
}

#[test]
fn a_tub_of_which_every_second_record_is_deleted_names_the_option() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("car");
    tub(&source, 8);
    let manifest = fs::read_to_string(source.join("manifest.json")).unwrap();
    fs::write(source.join("manifest.json"), manifest.replace("[]", "[1,3,5,7]")).unwrap();
    let error = run(&source, &dir.path().join("a"), small()).unwrap_err().to_string();
    assert!(
        error.starts_with("4 of the 8 records of ") && error.ends_with("--include-deleted imports them, too"),
        "{error}"
    );
}

#[test]
fn damage_in_every_second_line_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let csv = source.join("log.csv");
    let text = fs::read_to_string(&csv).unwrap();
    let damage = |(index, line): (usize, &str)| match index % 2 {
        0 if index > 0 => format!("{line}x\n"),
        _ => format!("{line}\n"),
    };
    fs::write(&csv, text.lines().enumerate().map(damage).collect::<String>()).unwrap();
    let options = ImportOptions {
        skip_bad: true,
        ..small()
    };
    let error = run(&source, &dir.path().join("a"), options).unwrap_err().to_string();
    assert!(
        error.contains(" holds no two consecutive frames, since something was left out 6 times;"),
        "{error}"
    );
    assert!(
        error.contains("The first that was left out: ")
            && error.contains("log.csv line 3: the column \"state.heading\" is \"2x\""),
        "{error}"
    );
}
