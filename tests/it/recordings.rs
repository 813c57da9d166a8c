//! Recordings of every kind that can be imported, with several episodes each, written for tests.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use foreframe_core::frame::{Frame, codec};
use foreframe_core::types::Channel;
use foreframe_data::dataset::export::{to_lerobot_images, to_lerobot_videos};
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData};
use serde_json::json;

use crate::bag_files::{BagMessage, Chunks, image, mcap, odometry, twist};
use crate::skip::skip_without;

/// Size of the recorded images in pixels.
pub(crate) const SIZE: (u32, u32) = (48, 32);
/// Frames from one gap in time to the next.
const EPISODE_FRAMES: u32 = 50;
/// Frames per second.
const RATE_HZ: u32 = 20;

/// A square that moves to the left, as fast as the steering turns to the right, on a ground with texture.
pub(crate) fn pixels(index: u32) -> Vec<u8> {
    let center = (i64::from(index) * 2).rem_euclid(i64::from(SIZE.0));
    let pixel = |at: u32| {
        let (x, y) = (i64::from(at % SIZE.0), i64::from(at / SIZE.0));
        let is_square = (x + center).rem_euclid(i64::from(SIZE.0)) < 10 && (8..20).contains(&y);
        if is_square {
            220
        } else {
            ((x * 7 + y * 13 + i64::from(index)) % 90) as u8
        }
    };
    (0..SIZE.0 * SIZE.1).map(pixel).collect()
}

fn png(index: u32) -> Vec<u8> {
    codec::encode_png(&Frame::new(SIZE.0, SIZE.1, pixels(index)).unwrap()).unwrap()
}

/// When a frame was taken, in milliseconds: regular, with a gap after each episode.
fn time_ms(index: u32) -> u64 {
    1_700_000_000_000 + u64::from(index * 1000 / RATE_HZ + index / EPISODE_FRAMES * 5000)
}

fn steering(index: u32) -> f32 {
    (index as f32 * 0.1).sin()
}

/// A folder of PNG images with a CSV of times, an action and a state.
pub(crate) fn images_with_csv(path: &Path, frames: u32) {
    fs::create_dir_all(path).unwrap();
    let mut csv = "timestamp_ms,file,action.steering [rad],state.heading [rad]\n".to_owned();
    for index in 0..frames {
        fs::write(path.join(format!("{index}.png")), png(index)).unwrap();
        let (time, angle) = (time_ms(index), steering(index));
        let line = format!("{time},{index}.png,{angle},{}\n", angle / 2.0);
        csv.push_str(&line);
    }
    fs::write(path.join("log.csv"), csv).unwrap();
}

/// A Donkeycar tub with one session per episode.
pub(crate) fn tub(path: &Path, frames: u32) {
    fs::create_dir_all(path.join("images")).unwrap();
    let manifest = [
        json!(["cam/image_array", "user/angle", "user/throttle", "user/mode"]),
        json!(["image_array", "float", "float", "str"]),
        json!({}),
        json!({"created_at": 1.0}),
        json!({"paths": ["catalog_0.catalog"], "current_index": frames, "max_len": 1000, "deleted_indexes": []}),
    ];
    fs::write(
        path.join("manifest.json"),
        manifest.map(|line| line.to_string()).join("\n"),
    )
    .unwrap();
    let mut catalog = String::new();
    for index in 0..frames {
        let name = format!("{index}_cam_image_array_.jpg");
        // The content decides how an image is decoded, not the name.
        fs::write(path.join("images").join(&name), png(index)).unwrap();
        let line = json!({
            "_index": index, "_session_id": (index / EPISODE_FRAMES).to_string(), "_timestamp_ms": time_ms(index),
            "cam/image_array": name, "user/angle": steering(index), "user/throttle": 0.5, "user/mode": "user",
        });
        catalog.push_str(&line.to_string());
        catalog.push('\n');
    }
    fs::write(path.join("catalog_0.catalog"), catalog).unwrap();
}

/// A `NumPy` array of that type and shape.
pub(crate) fn numpy_array(kind: &str, shape: &str, values: &[u8]) -> Vec<u8> {
    let text = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend(values);
    bytes
}

fn all_pixels(frames: u32) -> Vec<u8> {
    (0..frames).flat_map(pixels).collect()
}

/// An array of T×N×H×W, with N sequences.
pub(crate) fn npy(path: &Path, frames: u32) {
    let shape = format!("{EPISODE_FRAMES}, {}, {}, {}", frames / EPISODE_FRAMES, SIZE.1, SIZE.0);
    let kept = frames / EPISODE_FRAMES * EPISODE_FRAMES;
    fs::write(path, numpy_array("|u1", &shape, &all_pixels(kept))).unwrap();
}

/// A compressed archive of frames, actions and times.
pub(crate) fn npz(path: &Path, frames: u32) {
    let actions: Vec<u8> = (0..frames).flat_map(|index| steering(index).to_le_bytes()).collect();
    let times: Vec<u8> = (0..frames).flat_map(|index| time_ms(index).to_le_bytes()).collect();
    let shape = format!("{frames}, {}, {}", SIZE.1, SIZE.0);
    let arrays = [
        ("frames", numpy_array("|u1", &shape, &all_pixels(frames))),
        ("actions", numpy_array("<f4", &format!("{frames},"), &actions)),
        ("timestamps_ms", numpy_array("<i8", &format!("{frames},"), &times)),
    ];
    let mut archive = zip::ZipWriter::new(fs::File::create(path).unwrap());
    for (name, array) in arrays {
        let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        archive.start_file(format!("{name}.npy"), options).unwrap();
        std::io::Write::write_all(&mut archive, &array).unwrap();
    }
    archive.finish().unwrap();
}

/// The messages of a drive: images, commands and odometry.
fn messages(frames: u32) -> Vec<BagMessage> {
    let of_frame = |index: u32| {
        let time_ns = time_ms(index) as i64 * 1_000_000;
        let (angle, speed) = (f64::from(steering(index)), 0.5);
        let message = |topic, type_name, content| BagMessage {
            topic,
            type_name,
            log_ns: time_ns,
            content,
        };
        let gray = image(false, time_ns, "mono8", SIZE, &pixels(index));
        [
            message("/cmd_vel", "geometry_msgs/msg/Twist", twist(false, speed, angle)),
            message(
                "/odom",
                "nav_msgs/msg/Odometry",
                odometry(time_ns, f64::from(index), angle, speed),
            ),
            message("/camera/image_raw", "sensor_msgs/msg/Image", gray),
        ]
    };
    (0..frames).flat_map(of_frame).collect()
}

/// A bag in chunks that are compressed with zstd.
pub(crate) fn mcap_bag(path: &Path, frames: u32) {
    fs::write(path, mcap(&messages(frames), Chunks::Zstd, 30)).unwrap();
}

/// A bag as a database of rosbag2.
pub(crate) fn db3_bag(path: &Path, frames: u32) {
    database(path, &messages(frames));
}

/// A database as rosbag2 writes it.
pub(crate) fn database(path: &Path, messages: &[BagMessage]) {
    let connection = rusqlite::Connection::open(path).unwrap();
    let tables = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
            serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);
        BEGIN;";
    connection.execute_batch(tables).unwrap();
    let mut topics: Vec<&str> = Vec::new();
    for message in messages {
        if !topics.contains(&message.topic) {
            topics.push(message.topic);
            let row = (topics.len() as i64, message.topic, message.type_name);
            connection
                .execute("INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr', '')", row)
                .unwrap();
        }
        let topic = topics.iter().position(|topic| *topic == message.topic).unwrap() as i64 + 1;
        let row = (topic, message.log_ns, &message.content);
        let insert = "INSERT INTO messages(topic_id, timestamp, data) VALUES (?1, ?2, ?3)";
        connection.execute(insert, row).unwrap();
    }
    connection.execute_batch("COMMIT").unwrap();
}

/// The recording as a data set in memory, with an action and a state.
pub(crate) fn dataset(frames: u32) -> Dataset {
    let info = DatasetInfo {
        name: "drive".to_owned(),
        frame_width_px: SIZE.0,
        frame_height_px: SIZE.1,
        frame_period_s: 1.0 / f64::from(RATE_HZ),
        action_channels: vec![Channel::new("steering", "rad")],
        state_channels: vec![Channel::new("heading", "rad")],
        ..DatasetInfo::default()
    };
    let episode = |first: u32| {
        let frames = first..frames.min(first + EPISODE_FRAMES);
        EpisodeData {
            timestamps_s: frames
                .clone()
                .map(|index| f64::from(index - first) / f64::from(RATE_HZ))
                .collect(),
            pixels: frames.clone().flat_map(pixels).collect(),
            actions: frames.clone().map(steering).collect(),
            states: frames.map(|index| steering(index) / 2.0).collect(),
            ..EpisodeData::default()
        }
    };
    let starts = (0..frames).step_by(EPISODE_FRAMES as usize);
    Dataset::from_episodes(info, starts.map(episode).collect()).unwrap()
}

/// A data set of `LeRobot` with images in its tables.
pub(crate) fn lerobot_images(path: &Path, frames: u32) {
    to_lerobot_images(&dataset(frames), path, None).unwrap();
}

/// A data set of `LeRobot` with videos. Needs ffmpeg.
pub(crate) fn lerobot_videos(path: &Path, frames: u32) {
    to_lerobot_videos(&dataset(frames), path, None).unwrap();
}

/// An MP4 file without gaps. Needs ffmpeg.
pub(crate) fn video(path: &Path, frames: u32) {
    let source = format!("testsrc=size={}x{}:rate={RATE_HZ}", SIZE.0, SIZE.1);
    let status = Command::new("ffmpeg")
        .args([
            "-v",
            "error",
            "-f",
            "lavfi",
            "-i",
            &source,
            "-frames:v",
            &frames.to_string(),
        ])
        .args(["-c:v", "mpeg4", "-q:v", "2"])
        .arg(path)
        .status();
    assert!(status.unwrap().success());
}

/// Whether ffmpeg and ffprobe can be started; if not, says so.
pub(crate) fn has_ffmpeg() -> bool {
    let starts = |program: &str| {
        Command::new(program)
            .arg("-version")
            .stdout(Stdio::null())
            .status()
            .is_ok()
    };
    let found = starts("ffmpeg") && starts("ffprobe");
    if !found {
        skip_without("ffmpeg and ffprobe are not installed");
    }
    found
}

/// Every file below a directory with its content, by its path in the directory.
pub(crate) fn contents(dir: &Path) -> std::collections::BTreeMap<PathBuf, Vec<u8>> {
    let (mut dirs, mut found) = (vec![dir.to_owned()], std::collections::BTreeMap::new());
    while let Some(folder) = dirs.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                dirs.push(path);
            } else {
                found.insert(path.strip_prefix(dir).unwrap().to_owned(), fs::read(&path).unwrap());
            }
        }
    }
    found
}
