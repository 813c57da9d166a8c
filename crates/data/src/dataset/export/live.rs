//! Messages of ROS 2 for a running robot, in CDR.

use super::cdr::CdrWriter;

/// A `sensor_msgs/msg/CompressedImage` of a PNG file. The header has the time that the picture is of.
#[must_use]
pub fn png_message(time_ns: u64, png: &[u8]) -> Vec<u8> {
    CdrWriter::new().header(time_ns).text("png").bytes(png).end()
}

/// A `std_msgs/msg/Float64`.
#[must_use]
pub fn number_message(value: f64) -> Vec<u8> {
    CdrWriter::new().f64s(&[value]).end()
}
