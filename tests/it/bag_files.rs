//! Writes ROS 2 messages and MCAP files for tests.

use std::io::Write as _;

/// A message being written in CDR.
pub(crate) struct Cdr {
    big_endian: bool,
    bytes: Vec<u8>,
}

impl Cdr {
    pub(crate) fn new(big_endian: bool) -> Self {
        Self {
            big_endian,
            bytes: vec![0, u8::from(!big_endian), 0, 0],
        }
    }

    fn number(mut self, little: &[u8]) -> Self {
        while !(self.bytes.len() - 4).is_multiple_of(little.len()) {
            self.bytes.push(0);
        }
        if self.big_endian {
            self.bytes.extend(little.iter().rev());
        } else {
            self.bytes.extend(little);
        }
        self
    }

    pub(crate) fn u8(self, value: u8) -> Self {
        self.number(&[value])
    }

    pub(crate) fn u32(self, value: u32) -> Self {
        self.number(&value.to_le_bytes())
    }

    pub(crate) fn f64s(self, values: &[f64]) -> Self {
        values.iter().fold(self, |cdr, value| cdr.number(&value.to_le_bytes()))
    }

    pub(crate) fn text(self, text: &str) -> Self {
        let mut cdr = self.u32(text.len() as u32 + 1);
        cdr.bytes.extend(text.as_bytes());
        cdr.bytes.push(0);
        cdr
    }

    pub(crate) fn blob(self, bytes: &[u8]) -> Self {
        let mut cdr = self.u32(bytes.len() as u32);
        cdr.bytes.extend(bytes);
        cdr
    }

    fn header(self, time_ns: i64) -> Self {
        let seconds = time_ns.div_euclid(1_000_000_000);
        self.u32(seconds as u32)
            .u32((time_ns - seconds * 1_000_000_000) as u32)
            .text("base_link")
    }

    pub(crate) fn end(self) -> Vec<u8> {
        self.bytes
    }
}

/// A `sensor_msgs/Image` without padding of rows.
pub(crate) fn image(big_endian: bool, time_ns: i64, encoding: &str, size: (u32, u32), pixels: &[u8]) -> Vec<u8> {
    Cdr::new(big_endian)
        .header(time_ns)
        .u32(size.1)
        .u32(size.0)
        .text(encoding)
        .u8(0)
        .u32(pixels.len() as u32 / size.1)
        .blob(pixels)
        .end()
}

pub(crate) fn compressed_image(time_ns: i64, format: &str, file: &[u8]) -> Vec<u8> {
    Cdr::new(false).header(time_ns).text(format).blob(file).end()
}

pub(crate) fn twist(big_endian: bool, linear: f64, angular: f64) -> Vec<u8> {
    Cdr::new(big_endian).f64s(&[linear, 0.0, 0.0, 0.0, 0.0, angular]).end()
}

pub(crate) fn twist_stamped(time_ns: i64, linear: f64, angular: f64) -> Vec<u8> {
    let values = [linear, 0.0, 0.0, 0.0, 0.0, angular];
    Cdr::new(false).header(time_ns).f64s(&values).end()
}

/// A `nav_msgs/Odometry` at x, with a heading, and a speed ahead.
pub(crate) fn odometry(time_ns: i64, x: f64, heading: f64, speed: f64) -> Vec<u8> {
    let (sin, cos) = (heading / 2.0).sin_cos();
    Cdr::new(false)
        .header(time_ns)
        .text("base_footprint")
        .f64s(&[x, 0.0, 0.0, 0.0, 0.0, sin, cos])
        .f64s(&[0.0; 36])
        .f64s(&[speed, 0.0, 0.0, 0.0, 0.0, 0.0])
        .f64s(&[0.0; 36])
        .end()
}

pub(crate) fn joint_state(time_ns: i64, joints: &[(&str, f64, f64)]) -> Vec<u8> {
    let count = joints.len() as u32;
    let named = Cdr::new(false).header(time_ns).u32(count);
    let named = joints.iter().fold(named, |cdr, joint| cdr.text(joint.0)).u32(count);
    let placed = joints.iter().fold(named, |cdr, joint| cdr.f64s(&[joint.1])).u32(count);
    let moving = joints.iter().fold(placed, |cdr, joint| cdr.f64s(&[joint.2]));
    moving.u32(0).end()
}

pub(crate) fn camera_info(size: (u32, u32), focal_px: f64) -> Vec<u8> {
    let mut projection = [0.0; 12];
    (projection[0], projection[5]) = (focal_px, focal_px);
    Cdr::new(false)
        .header(0)
        .u32(size.1)
        .u32(size.0)
        .text("plumb_bob")
        .u32(0)
        .f64s(&[focal_px, 0.0, 0.0, 0.0, focal_px, 0.0, 0.0, 0.0, 1.0])
        .f64s(&[0.0; 9])
        .f64s(&projection)
        .end()
}

/// A message for a bag: topic, type, time of recording, content.
#[derive(Clone)]
pub(crate) struct BagMessage {
    pub(crate) topic: &'static str,
    pub(crate) type_name: &'static str,
    pub(crate) log_ns: i64,
    pub(crate) content: Vec<u8>,
}

/// How an MCAP file is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Chunks {
    None,
    Plain,
    Lz4,
    Zstd,
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat()
}

fn record(code: u8, parts: &[&[u8]]) -> Vec<u8> {
    let content = parts.concat();
    [&[code][..], &(content.len() as u64).to_le_bytes(), &content].concat()
}

fn chunk(records: &[u8], chunks: Chunks) -> Vec<u8> {
    let (name, compressed) = match chunks {
        Chunks::Lz4 => {
            let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
            encoder.write_all(records).unwrap();
            ("lz4", encoder.finish().unwrap())
        }
        Chunks::Zstd => {
            let level = ruzstd::encoding::CompressionLevel::Fastest;
            ("zstd", ruzstd::encoding::compress_to_vec(records, level))
        }
        _ => ("", records.to_vec()),
    };
    let length = (records.len() as u64).to_le_bytes();
    let crc = crc32fast::hash(records).to_le_bytes();
    let parts: [&[u8]; 6] = [
        &[0; 16],
        &length,
        &crc,
        &text(name),
        &(compressed.len() as u64).to_le_bytes(),
        &compressed,
    ];
    record(6, &parts)
}

/// An MCAP file with the descriptions of many topics before everything else.
pub(crate) fn endless_topics(mcap: &[u8], count: u32) -> Vec<u8> {
    let (magic, rest) = mcap.split_at(8);
    let mut file = magic.to_vec();
    for number in 0..count {
        let names = [text(&format!("/topic/{number}")), text("cdr")].concat();
        // They share an identifier that the bag's own topics do not use.
        file.extend(record(
            4,
            &[&60_000u16.to_le_bytes(), &0u16.to_le_bytes(), &names, &[0; 4]],
        ));
    }
    file.extend(rest);
    file
}

/// An MCAP file with chunks of `per_chunk` messages.
pub(crate) fn mcap(messages: &[BagMessage], chunks: Chunks, per_chunk: usize) -> Vec<u8> {
    let mut file = b"\x89MCAP0\r\n".to_vec();
    file.extend(record(1, &[&text("ros2"), &text("test")]));
    let mut topics: Vec<&str> = Vec::new();
    for group in messages.chunks(per_chunk) {
        let mut records = Vec::new();
        for message in group {
            let known = topics.iter().position(|topic| *topic == message.topic);
            let id = known.unwrap_or_else(|| {
                topics.push(message.topic);
                let id = (topics.len() as u16).to_le_bytes();
                records.extend(record(3, &[&id, &text(message.type_name), &text("ros2msg"), &text("")]));
                let names = [text(message.topic), text("cdr")].concat();
                records.extend(record(4, &[&id, &id, &names, &[0; 4]]));
                topics.len() - 1
            });
            let (id, time) = ((id as u16 + 1).to_le_bytes(), message.log_ns.to_le_bytes());
            records.extend(record(5, &[&id, &[0; 4], &time, &time, &message.content]));
        }
        match chunks {
            Chunks::None => file.extend(records),
            _ => file.extend(chunk(&records, chunks)),
        }
    }
    file.extend(record(15, &[&[0; 4]]));
    file.extend(record(2, &[&[0; 20]]));
    file.extend(b"\x89MCAP0\r\n");
    file
}
