//! The ROS 2 messages that are read, from CDR to values. Errors: why a message cannot be read.

use std::borrow::Cow;

use super::cdr::CdrReader;
use super::pixels::RawImage;

/// What a topic's messages are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RosType {
    Image,
    CompressedImage,
    Twist,
    TwistStamped,
    Odometry,
    JointState,
    CameraInfo,
    /// Not read.
    Other,
}

impl RosType {
    /// The kind of a type's name, with or without `/msg/`.
    pub(super) fn of(type_name: &str) -> Self {
        match type_name.replace("/msg/", "/").as_str() {
            "sensor_msgs/Image" => Self::Image,
            "sensor_msgs/CompressedImage" => Self::CompressedImage,
            "geometry_msgs/Twist" => Self::Twist,
            "geometry_msgs/TwistStamped" => Self::TwistStamped,
            "nav_msgs/Odometry" => Self::Odometry,
            "sensor_msgs/JointState" => Self::JointState,
            "sensor_msgs/CameraInfo" => Self::CameraInfo,
            _ => Self::Other,
        }
    }

    pub(super) fn is_image(self) -> bool {
        matches!(self, Self::Image | Self::CompressedImage)
    }

    /// By default an action.
    pub(super) fn is_command(self) -> bool {
        matches!(self, Self::Twist | Self::TwistStamped)
    }

    /// By default a state.
    pub(super) fn is_measurement(self) -> bool {
        matches!(self, Self::Odometry | Self::JointState)
    }

    /// Whether a field belongs to the topic's values if none are chosen: those of a robot on wheels, and of others those
    /// that are ever different from 0.
    pub(super) fn is_default_field(self, field: &str, is_ever_other_than_0: bool) -> bool {
        match self {
            Self::Twist | Self::TwistStamped => matches!(field, "linear.x" | "angular.z") || is_ever_other_than_0,
            Self::Odometry => match field {
                "x" | "y" | "heading_cos" | "heading_sin" | "linear.x" | "angular.z" => true,
                "linear.y" => is_ever_other_than_0,
                _ => false,
            },
            _ => true,
        }
    }
}

/// One number of a message: its name within the topic, its unit, and its value.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct FieldValue {
    pub(super) name: Cow<'static, str>,
    pub(super) unit: &'static str,
    pub(super) value: f64,
}

/// The time in a message's header, in nanoseconds; 0 where nobody set it.
fn header_stamp(reader: &mut CdrReader<'_>) -> Result<i64, String> {
    let seconds = reader.i32("header.stamp.sec")?;
    let nanoseconds = reader.u32("header.stamp.nanosec")?;
    reader.text("header.frame_id")?;
    Ok(i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds))
}

/// Time and pixels of a `sensor_msgs/Image`.
pub(super) fn image(message: &[u8]) -> Result<(i64, RawImage<'_>), String> {
    let mut reader = CdrReader::new(message)?;
    let stamp = header_stamp(&mut reader)?;
    // The fields in the order of the message.
    let image = RawImage {
        height_px: reader.u32("height")?,
        width_px: reader.u32("width")?,
        encoding: reader.text("encoding")?,
        big_endian: reader.u8("is_bigendian")? != 0,
        row_bytes: reader.u32("step")?,
        bytes: reader.bytes("data")?,
    };
    Ok((stamp, image))
}

/// Time, format and file of a `sensor_msgs/CompressedImage`.
pub(super) fn compressed_image(message: &[u8]) -> Result<(i64, &str, &[u8]), String> {
    let mut reader = CdrReader::new(message)?;
    let stamp = header_stamp(&mut reader)?;
    Ok((stamp, reader.text("format")?, reader.bytes("data")?))
}

/// Time (`None` without a header) and values of a message that is an action or a state. A value that is not finite is one
/// that the robot does not measure in a `JointState`, and is left out there.
pub(super) fn values(kind: RosType, message: &[u8]) -> Result<(Option<i64>, Vec<FieldValue>), String> {
    let mut reader = CdrReader::new(message)?;
    let stamp = match kind {
        RosType::Twist => None,
        _ => Some(header_stamp(&mut reader)?),
    };
    let values = match kind {
        RosType::Odometry => odometry(&mut reader)?,
        RosType::JointState => joint_state(&mut reader)?,
        _ => twist(&mut reader)?,
    };
    Ok((stamp, values))
}

pub(super) fn field(name: impl Into<Cow<'static, str>>, unit: &'static str, value: f64) -> FieldValue {
    FieldValue {
        name: name.into(),
        unit,
        value,
    }
}

fn twist(reader: &mut CdrReader<'_>) -> Result<Vec<FieldValue>, String> {
    let mut parts = [0.0; 6];
    for (part, (name, _)) in parts.iter_mut().zip(SPEEDS) {
        *part = reader.f64(name)?;
    }
    Ok(speed_fields(parts))
}

const SPEEDS: [(&str, &str); 6] = [
    ("linear.x", "m/s"),
    ("linear.y", "m/s"),
    ("linear.z", "m/s"),
    ("angular.x", "rad/s"),
    ("angular.y", "rad/s"),
    ("angular.z", "rad/s"),
];

/// The fields of a twist: linear x, y, z, then angular x, y, z.
pub(super) fn speed_fields(parts: [f64; 6]) -> Vec<FieldValue> {
    let named = SPEEDS.into_iter().zip(parts);
    named.map(|((name, unit), value)| field(name, unit, value)).collect()
}

fn odometry(reader: &mut CdrReader<'_>) -> Result<Vec<FieldValue>, String> {
    reader.text("child_frame_id")?;
    let (mut position, mut quaternion) = ([0.0; 3], [0.0; 4]);
    for part in &mut position {
        *part = reader.f64("pose.position")?;
    }
    for part in &mut quaternion {
        *part = reader.f64("pose.orientation")?;
    }
    reader.f64_array(36, "pose.covariance")?;
    let mut fields = pose_fields(position, quaternion);
    fields.extend(twist(reader)?);
    Ok(fields)
}

/// The fields of a pose. The quaternion is x, y, z, w.
pub(super) fn pose_fields(position: [f64; 3], quaternion: [f64; 4]) -> Vec<FieldValue> {
    let named = ["x", "y", "z"].into_iter().zip(position);
    let mut fields: Vec<FieldValue> = named.map(|(name, value)| field(name, "m", value)).collect();
    let [x, y, z, w] = quaternion;
    let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let pitch = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin();
    let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    // Cosine and sine, because the angle itself jumps by a whole turn.
    fields.extend([
        field("heading_cos", "", yaw.cos()),
        field("heading_sin", "", yaw.sin()),
        field("roll", "rad", roll),
        field("pitch", "rad", pitch),
        field("yaw", "rad", yaw),
    ]);
    fields
}

fn joint_state(reader: &mut CdrReader<'_>) -> Result<Vec<FieldValue>, String> {
    let names = reader.texts("name")?;
    let (positions, velocities) = (reader.f64_sequence("position")?, reader.f64_sequence("velocity")?);
    Ok(joint_fields(&names, positions, velocities))
}

/// The fields of a `JointState`; positions or velocities may be absent.
pub(super) fn joint_fields(names: &[impl AsRef<str>], positions: Vec<f64>, velocities: Vec<f64>) -> Vec<FieldValue> {
    let of = |values: Vec<f64>, what: &'static str, unit: &'static str| {
        let named = names.iter().zip(values).filter(|(_, value)| value.is_finite());
        let named = named.map(move |(name, value)| field(format!("{}.{what}", name.as_ref()), unit, value));
        named.collect::<Vec<_>>()
    };
    let mut fields = of(positions, "position", "rad");
    fields.extend(of(velocities, "velocity", "rad/s"));
    fields
}

/// How a camera projects, as far as a [`foreframe_core::frame::warp::CameraModel`] can hold it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Projection {
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    /// Focal lengths of the recorded image, and of the image without distortion, in pixels.
    pub(super) focal_px: [f64; 2],
    pub(super) rectified_focal_px: [f64; 2],
    pub(super) is_distorted: bool,
}

/// The projection of a `sensor_msgs/CameraInfo`.
pub(super) fn camera_info(message: &[u8]) -> Result<Projection, String> {
    let mut reader = CdrReader::new(message)?;
    header_stamp(&mut reader)?;
    let (height_px, width_px) = (reader.u32("height")?, reader.u32("width")?);
    reader.text("distortion_model")?;
    let distortion = reader.f64_sequence("d")?;
    let camera = reader.f64_array(9, "k")?;
    reader.f64_array(9, "r")?;
    let projection = reader.f64_array(12, "p")?;
    Ok(Projection {
        width_px,
        height_px,
        focal_px: [camera[0], camera[4]],
        rectified_focal_px: [projection[0], projection[5]],
        is_distorted: distortion.iter().any(|&value| value != 0.0),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn no_bytes_make_a_message_panic(message in proptest::collection::vec(any::<u8>(), 0..300), order in 0u8..2) {
            let message = [&[0, order, 0, 0][..], &message].concat();
            let _ = image(&message).map(|(_, image)| image.gray());
            let _ = compressed_image(&message);
            let _ = camera_info(&message);
            for kind in [RosType::Twist, RosType::TwistStamped, RosType::Odometry, RosType::JointState] {
                let _ = values(kind, &message);
            }
        }
    }

    #[test]
    fn type_names_of_both_forms_are_known() {
        assert_eq!(RosType::of("sensor_msgs/msg/Image"), RosType::Image);
        assert_eq!(RosType::of("sensor_msgs/Image"), RosType::Image);
        assert_eq!(RosType::of("sensor_msgs/msg/Imu"), RosType::Other);
    }
}
