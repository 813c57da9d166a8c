//! Writes episodes as a bag of ROS 2: images, and actions and states as messages with the times of their images.

use std::fs::File;
use std::ops::Range;
use std::path::Path;

use super::cdr::CdrWriter;
use super::mcap::McapWriter;
use crate::dataset::store::files::write_whole;
use crate::dataset::{Dataset, DatasetError};
use foreframe_core::frame::FrameSize;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::types::Channel;

/// The topic of the images.
pub const IMAGE_TOPIC: &str = "/camera/image_raw";
/// Beside the images of episodes whose camera is known.
const CAMERA_TOPIC: &str = "/camera/camera_info";
/// The topic of the actions, if there are any.
pub const ACTION_TOPIC: &str = "/action";
/// The topic of the states, if there are any.
pub const STATE_TOPIC: &str = "/state";

/// The first frame's time. 0 would stand for no time.
const START_NS: u64 = 1_000_000_000;
/// The least time from one episode to the next; readers split the frames there.
const MIN_GAP_NS: u64 = 10_000_000_000;
/// The same in frames.
const GAP_FRAMES: u64 = 10;

const SEPARATOR: &str = "================================================================================\n";
const HEADER: &str = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n";
const TIME: &str = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
const TWIST: &str = "MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n";
const VECTOR: &str = "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n";
const REGION: &str = "MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n\
                      bool do_rectify\n";

/// Writes episodes, as ranges of frames counted over the whole data set, as one MCAP file, which `foreframe import` and ROS 2
/// read. Frame k of an episode is at k times the frame period. Errors: `Io`.
pub fn to_mcap(dataset: &Dataset, episodes: &[Range<usize>], path: &Path) -> Result<(), DatasetError> {
    write_whole(path, "partial.mcap", |partial| {
        let file = File::create(partial).map_err(DatasetError::io("write", path))?;
        write(dataset, episodes, McapWriter::new(file, path)?)
    })
}

/// How the values of a frame are read from a data set.
type FrameValues = fn(&Dataset, usize) -> &[f32];

fn write(dataset: &Dataset, episodes: &[Range<usize>], mut bag: McapWriter<'_>) -> Result<(), DatasetError> {
    let info = dataset.info();
    let image = bag.topic(IMAGE_TOPIC, "sensor_msgs/msg/Image", &image_definition());
    let cameras: Vec<Option<CameraModel>> = episodes.iter().map(|frames| camera_of(dataset, frames)).collect();
    let camera_topic = cameras
        .iter()
        .any(Option::is_some)
        .then(|| bag.topic(CAMERA_TOPIC, "sensor_msgs/msg/CameraInfo", &camera_definition()));
    let frames = || episodes.iter().cloned().flatten();
    let mut values = Vec::new();
    for (name, channels, of_frame) in [
        (ACTION_TOPIC, &info.action_channels, Dataset::action as FrameValues),
        (STATE_TOPIC, &info.state_channels, Dataset::state),
    ] {
        let row = move |frame: usize| {
            of_frame(dataset, frame)
                .iter()
                .copied()
                .map(f64::from)
                .collect::<Vec<_>>()
        };
        if !channels.is_empty() {
            let kind = ValueMessage::of(channels, || frames().map(row));
            let (type_name, definition) = kind.description();
            values.push((bag.topic(name, type_name, &definition), kind, row));
        }
    }
    let size = FrameSize {
        width: info.frame_width_px,
        height: info.frame_height_px,
    };
    let period_ns = info.frame_period_s * 1e9;
    let mut start_ns = START_NS;
    for (episode, camera) in episodes.iter().zip(cameras) {
        for (place, frame) in episode.clone().enumerate() {
            let time_ns = start_ns + (place as f64 * period_ns).round() as u64;
            for (topic, kind, row) in &values {
                bag.message(*topic, time_ns, &kind.message(time_ns, &row(frame)))?;
            }
            if let (Some(topic), Some(camera)) = (camera_topic, camera) {
                bag.message(topic, time_ns, &camera_info(time_ns, size, camera.horizontal_fov_rad))?;
            }
            bag.message(image, time_ns, &gray_image(time_ns, size, &dataset.pixels(frame)?))?;
        }
        let duration_ns = (episode.len() as f64 * period_ns) as u64;
        let gap_ns = MIN_GAP_NS.max((period_ns as u64).saturating_mul(GAP_FRAMES));
        start_ns = (start_ns + duration_ns + gap_ns).next_multiple_of(1_000_000_000);
    }
    bag.finish()
}

/// The camera of the episode with these frames.
fn camera_of(dataset: &Dataset, frames: &Range<usize>) -> Option<CameraModel> {
    let begun = dataset
        .episodes()
        .partition_point(|episode| episode.first_frame <= frames.start);
    dataset.camera(begun.checked_sub(1)?)
}

/// The message that holds an action or a state.
enum ValueMessage {
    /// A `TwistStamped`; for each channel, which of its six numbers it is.
    Twist(Vec<usize>),
    /// A `JointState` with these names; their values are its positions.
    Joints(Vec<String>),
}

impl ValueMessage {
    /// A `TwistStamped` where an import gives the same channels again: all are its numbers, in its order and units, those of a
    /// robot on wheels among them, and every other one is used.
    fn of<I: Iterator<Item = Vec<f64>>>(channels: &[Channel], rows: impl Fn() -> I) -> Self {
        let place = |channel: &Channel| {
            let place = match channel.name.as_str() {
                "linear" | "linear.x" => 0,
                "linear.y" => 1,
                "linear.z" => 2,
                "angular.x" => 3,
                "angular.y" => 4,
                "angular" | "angular.z" => 5,
                _ => return None,
            };
            let unit = if place < 3 { "m/s" } else { "rad/s" };
            (channel.unit.is_empty() || channel.unit == unit).then_some(place)
        };
        let places: Option<Vec<usize>> = channels.iter().map(place).collect();
        let fits = |places: &Vec<usize>| {
            let is_used = |(column, &place): (usize, &usize)| {
                matches!(place, 0 | 5) || rows().any(|row| row.get(column).is_some_and(|value| *value != 0.0))
            };
            places.is_sorted_by(|a, b| a < b)
                && [0, 5].iter().all(|place| places.contains(place))
                && places.iter().enumerate().all(is_used)
        };
        match places.filter(fits) {
            Some(places) => Self::Twist(places),
            None => Self::Joints(channels.iter().map(|channel| channel.name.clone()).collect()),
        }
    }

    /// The name of the type and its definition.
    fn description(&self) -> (&'static str, String) {
        match self {
            Self::Twist(_) => {
                let own = "geometry_msgs/Twist twist\n";
                let parts = [TWIST, VECTOR];
                ("geometry_msgs/msg/TwistStamped", definition(own, &parts))
            }
            Self::Joints(_) => {
                let own = "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n";
                ("sensor_msgs/msg/JointState", definition(own, &[]))
            }
        }
    }

    fn message(&self, time_ns: u64, values: &[f64]) -> Vec<u8> {
        let cdr = CdrWriter::new().header(time_ns);
        match self {
            Self::Twist(places) => {
                let mut numbers = [0.0; 6];
                for (&place, &value) in places.iter().zip(values) {
                    numbers[place] = value;
                }
                cdr.f64s(&numbers).end()
            }
            Self::Joints(names) => {
                let named = names
                    .iter()
                    .fold(cdr.u32(names.len() as u32), |cdr, name| cdr.text(name));
                named.f64_sequence(values).u32s(&[0; 2]).end()
            }
        }
    }
}

/// The definition of a message with a header and these fields, with those of its parts.
fn definition(own: &str, parts: &[&str]) -> String {
    let own = format!("std_msgs/Header header\n{own}");
    let parts = [HEADER, TIME].iter().chain(parts);
    parts.fold(own, |text, part| text + SEPARATOR + part)
}

fn image_definition() -> String {
    let own = "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n\
               uint8[] data\n";
    definition(own, &[])
}

fn gray_image(time_ns: u64, size: FrameSize, pixels: &[u8]) -> Vec<u8> {
    let head = CdrWriter::new().header(time_ns).u32s(&[size.height, size.width]);
    head.text("mono8").u8(0).u32(size.width).bytes(pixels).end()
}

fn camera_definition() -> String {
    let own = "uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n\
               float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n";
    definition(own, &[REGION])
}

/// A camera without distortion, whose axis goes through the middle of the image.
fn camera_info(time_ns: u64, size: FrameSize, horizontal_fov_rad: f32) -> Vec<u8> {
    let FrameSize { width, height } = size;
    let focal_px = f64::from(width) / 2.0 / (f64::from(horizontal_fov_rad) / 2.0).tan();
    let (middle_x, middle_y) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    let head = CdrWriter::new().header(time_ns).u32s(&[height, width]);
    head.text("plumb_bob")
        .f64_sequence(&[0.0; 5])
        .f64s(&[focal_px, 0.0, middle_x, 0.0, focal_px, middle_y, 0.0, 0.0, 1.0])
        .f64s(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
        .f64s(&[
            focal_px, 0.0, middle_x, 0.0, 0.0, focal_px, middle_y, 0.0, 0.0, 0.0, 1.0, 0.0,
        ])
        // No binning.
        .u32s(&[0; 2])
        // The region of interest: the whole image.
        .u32s(&[0; 4])
        .u8(0)
        .end()
}
