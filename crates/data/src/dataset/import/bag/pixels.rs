//! Raw images of ROS as gray frames.

use foreframe_core::frame::codec::gray_from_rgb;
use foreframe_core::frame::{Frame, MAX_SIDE_PX};

/// Names for a message.
const ENCODINGS: &str = "mono8, mono16, rgb8, bgr8, rgba8, bgra8, yuyv (yuv422_yuy2) or uyvy (yuv422)";

/// The fields of a `sensor_msgs/Image`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct RawImage<'a> {
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    pub(super) encoding: &'a str,
    pub(super) big_endian: bool,
    pub(super) row_bytes: u32,
    pub(super) bytes: &'a [u8],
}

/// What the bytes of a pixel hold.
#[derive(Clone, Copy)]
enum Samples {
    /// The brightness in this byte.
    Gray8(usize),
    /// The brightness in both bytes.
    Gray16,
    /// Red, green and blue in these bytes.
    Color([usize; 3]),
}

/// How a pixel lies in memory.
#[derive(Clone, Copy)]
struct PixelLayout {
    bytes: usize,
    samples: Samples,
}

impl PixelLayout {
    fn of(encoding: &str) -> Option<Self> {
        let (bytes, samples) = match encoding {
            "mono8" | "8UC1" => (1, Samples::Gray8(0)),
            "mono16" => (2, Samples::Gray16),
            "rgb8" => (3, Samples::Color([0, 1, 2])),
            "bgr8" | "8UC3" => (3, Samples::Color([2, 1, 0])),
            "rgba8" => (4, Samples::Color([0, 1, 2])),
            "bgra8" | "8UC4" => (4, Samples::Color([2, 1, 0])),
            "yuyv" | "yuv422_yuy2" => (2, Samples::Gray8(0)),
            "uyvy" | "yuv422" => (2, Samples::Gray8(1)),
            _ => return None,
        };
        Some(Self { bytes, samples })
    }
}

impl RawImage<'_> {
    /// Checks encoding, size and number of bytes. Errors: why the image cannot be read.
    pub(super) fn check(&self) -> Result<(), String> {
        self.layout().map(drop)
    }

    fn layout(&self) -> Result<PixelLayout, String> {
        let Self {
            width_px,
            height_px,
            row_bytes,
            encoding,
            ..
        } = *self;
        let Some(layout) = PixelLayout::of(encoding) else {
            let found: String = encoding.chars().take(40).collect();
            return Err(format!("its encoding is {found:?}; it must be {ENCODINGS}"));
        };
        let sides = 1..=MAX_SIDE_PX;
        if !sides.contains(&width_px) || !sides.contains(&height_px) {
            return Err(format!(
                "its size is {width_px}×{height_px} px; each side must be 1 to {MAX_SIDE_PX} px"
            ));
        }
        let needed = width_px * layout.bytes as u32;
        if row_bytes < needed {
            return Err(format!(
                "its rows have {row_bytes} bytes (step); {width_px} px in {encoding} need {needed}"
            ));
        }
        // The last row needs no padding.
        let needed = row_bytes as usize * (height_px as usize - 1) + needed as usize;
        let found = self.bytes.len();
        if found < needed {
            return Err(format!(
                "its data has {found} bytes; {height_px} rows of {row_bytes} bytes need {needed}"
            ));
        }
        Ok(layout)
    }

    /// The image in gray. Colors become gray by ITU-R BT.601, 16-bit intensities are rounded to 8 bits. Errors: as
    /// [`RawImage::check`].
    pub(super) fn gray(&self) -> Result<Frame, String> {
        let PixelLayout { bytes, samples } = self.layout()?;
        let (width, height) = (self.width_px as usize, self.height_px as usize);
        let mut pixels = Vec::with_capacity(width * height);
        for row in self.bytes.chunks(self.row_bytes as usize).take(height) {
            let row = &row[..width * bytes];
            match samples {
                Samples::Gray8(position) => pixels.extend(row.iter().skip(position).step_by(bytes)),
                Samples::Gray16 => {
                    let level = if self.big_endian {
                        u16::from_be_bytes
                    } else {
                        u16::from_le_bytes
                    };
                    let levels = row.as_chunks::<2>().0.iter().map(|bytes| u32::from(level(*bytes)));
                    pixels.extend(levels.map(|level| ((level * 255 + 32_767) / 65_535) as u8));
                }
                Samples::Color(positions) => {
                    let rgb = row
                        .chunks_exact(bytes)
                        .flat_map(|pixel| positions.map(|position| pixel[position]));
                    pixels.extend(gray_from_rgb(&rgb.collect::<Vec<_>>()));
                }
            }
        }
        Frame::new(self.width_px, self.height_px, pixels).map_err(|error| error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image<'a>(encoding: &'a str, row_bytes: u32, bytes: &'a [u8]) -> RawImage<'a> {
        RawImage {
            width_px: 2,
            height_px: 2,
            encoding,
            big_endian: false,
            row_bytes,
            bytes,
        }
    }

    fn gray(image: RawImage<'_>) -> Vec<u8> {
        image.gray().unwrap().pixels().to_vec()
    }

    #[test]
    fn every_encoding_gives_the_same_gray() {
        let rgb = [255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255];
        let wanted = [76, 150, 29, 255];
        assert_eq!(gray(image("rgb8", 6, &rgb)), wanted);
        let bgr: Vec<u8> = rgb.chunks(3).flat_map(|p| [p[2], p[1], p[0]]).collect();
        assert_eq!(gray(image("bgr8", 6, &bgr)), wanted);
        let rgba: Vec<u8> = rgb.chunks(3).flat_map(|p| [p[0], p[1], p[2], 9]).collect();
        assert_eq!(gray(image("rgba8", 8, &rgba)), wanted);
        let bgra: Vec<u8> = rgb.chunks(3).flat_map(|p| [p[2], p[1], p[0], 9]).collect();
        assert_eq!(gray(image("bgra8", 8, &bgra)), wanted);
        assert_eq!(gray(image("mono8", 2, &wanted)), wanted);
        assert_eq!(gray(image("yuyv", 4, &[76, 1, 150, 2, 29, 1, 255, 2])), wanted);
        assert_eq!(gray(image("uyvy", 4, &[1, 76, 2, 150, 1, 29, 2, 255])), wanted);
        let little: Vec<u8> = wanted
            .iter()
            .flat_map(|&v| (u16::from(v) * 257).to_le_bytes())
            .collect();
        assert_eq!(gray(image("mono16", 4, &little)), wanted);
        let big: Vec<u8> = wanted
            .iter()
            .flat_map(|&v| (u16::from(v) * 257).to_be_bytes())
            .collect();
        let swapped = RawImage {
            big_endian: true,
            ..image("mono16", 4, &big)
        };
        assert_eq!(gray(swapped), wanted);
    }

    #[test]
    fn padding_of_rows_is_left_out() {
        assert_eq!(gray(image("mono8", 3, &[1, 2, 0, 3, 4])), [1, 2, 3, 4]);
    }

    #[test]
    fn wrong_sizes_and_encodings_are_named() {
        let text = |image: RawImage<'_>| image.check().unwrap_err();
        assert!(text(image("bayer_rggb8", 2, &[0; 4])).contains("\"bayer_rggb8\"; it must be mono8"));
        assert!(text(image("rgb8", 5, &[0; 12])).contains("2 px in rgb8 need 6"));
        assert!(text(image("rgb8", 6, &[0; 11])).contains("11 bytes; 2 rows of 6 bytes need 12"));
        let empty = RawImage {
            width_px: 0,
            ..image("mono8", 2, &[])
        };
        assert!(text(empty).contains("0×2 px"));
    }
}
