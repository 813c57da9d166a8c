//! Raw images of ROS as gray frames.

use foreframe_core::frame::codec::gray_from_rgb;
use foreframe_core::frame::{Frame, FrameError, MAX_SIDE_PX};

/// Names for a message.
const ENCODINGS: &str = "mono8, mono16, rgb8, bgr8, rgba8, bgra8, yuyv (yuv422_yuy2) or uyvy (yuv422)";

/// Why an image cannot be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum PixelError {
    #[error("its encoding is {0:?}; it must be {ENCODINGS}")]
    Encoding(String),
    #[error("its size is {width_px}×{height_px} px; each side must be 1 to {MAX_SIDE_PX} px")]
    Size { width_px: u32, height_px: u32 },
    #[error("its rows have {found} bytes (step); {width_px} px in {encoding} need {needed}")]
    Row {
        found: u32,
        width_px: u32,
        encoding: String,
        needed: u32,
    },
    #[error("its data has {found} bytes; {height_px} rows of {row_bytes} bytes need {needed}")]
    Data {
        found: usize,
        height_px: u32,
        row_bytes: u32,
        needed: usize,
    },
    #[error(transparent)]
    Frame(#[from] FrameError),
}

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

/// How a pixel lies in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PixelLayout {
    Gray8,
    Gray16,
    /// Positions of red, green and blue in a pixel of `bytes` bytes.
    Color {
        bytes: usize,
        red: usize,
        blue: usize,
    },
    /// Two bytes, of which this one is the brightness.
    Yuv422 {
        luma: usize,
    },
}

impl PixelLayout {
    fn of(encoding: &str) -> Option<Self> {
        Some(match encoding {
            "mono8" | "8UC1" => Self::Gray8,
            "mono16" => Self::Gray16,
            "rgb8" => Self::Color {
                bytes: 3,
                red: 0,
                blue: 2,
            },
            "bgr8" | "8UC3" => Self::Color {
                bytes: 3,
                red: 2,
                blue: 0,
            },
            "rgba8" => Self::Color {
                bytes: 4,
                red: 0,
                blue: 2,
            },
            "bgra8" | "8UC4" => Self::Color {
                bytes: 4,
                red: 2,
                blue: 0,
            },
            "yuyv" | "yuv422_yuy2" => Self::Yuv422 { luma: 0 },
            "uyvy" | "yuv422" => Self::Yuv422 { luma: 1 },
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::Gray8 => 1,
            Self::Gray16 | Self::Yuv422 { .. } => 2,
            Self::Color { bytes, .. } => bytes,
        }
    }
}

impl RawImage<'_> {
    /// Checks encoding, size and number of bytes. Errors: `Encoding`, `Size`, `Row`, `Data`.
    pub(super) fn check(&self) -> Result<(), PixelError> {
        self.layout().map(drop)
    }

    fn layout(&self) -> Result<PixelLayout, PixelError> {
        let Some(layout) = PixelLayout::of(self.encoding) else {
            return Err(PixelError::Encoding(self.encoding.chars().take(40).collect()));
        };
        let sides = 1..=MAX_SIDE_PX;
        if !sides.contains(&self.width_px) || !sides.contains(&self.height_px) {
            return Err(PixelError::Size {
                width_px: self.width_px,
                height_px: self.height_px,
            });
        }
        let needed = self.width_px * layout.bytes() as u32;
        if self.row_bytes < needed {
            return Err(PixelError::Row {
                found: self.row_bytes,
                width_px: self.width_px,
                encoding: self.encoding.to_owned(),
                needed,
            });
        }
        // The last row needs no padding.
        let needed = self.row_bytes as usize * (self.height_px as usize - 1) + needed as usize;
        if self.bytes.len() < needed {
            return Err(PixelError::Data {
                found: self.bytes.len(),
                height_px: self.height_px,
                row_bytes: self.row_bytes,
                needed,
            });
        }
        Ok(layout)
    }

    /// The image in gray. Colors become gray by ITU-R BT.601, 16-bit intensities are rounded to 8 bits. Errors: as
    /// [`RawImage::check`].
    pub(super) fn gray(&self) -> Result<Frame, PixelError> {
        let layout = self.layout()?;
        let row_pixels = self.width_px as usize * layout.bytes();
        let mut pixels = Vec::with_capacity(self.width_px as usize * self.height_px as usize);
        let rows = self.bytes.chunks(self.row_bytes as usize).take(self.height_px as usize);
        let mut rgb = Vec::new();
        for row in rows {
            let row = &row[..row_pixels];
            match layout {
                PixelLayout::Gray8 => pixels.extend_from_slice(row),
                PixelLayout::Gray16 => {
                    let levels = row.as_chunks::<2>().0.iter().map(|bytes| {
                        if self.big_endian {
                            u16::from_be_bytes(*bytes)
                        } else {
                            u16::from_le_bytes(*bytes)
                        }
                    });
                    pixels.extend(levels.map(|level| ((u32::from(level) * 255 + 32_767) / 65_535) as u8));
                }
                PixelLayout::Color { bytes: 3, red: 0, .. } => pixels.extend(gray_from_rgb(row)),
                PixelLayout::Color { bytes, red, blue } => {
                    rgb.clear();
                    rgb.extend(
                        row.chunks_exact(bytes)
                            .flat_map(|pixel| [pixel[red], pixel[1], pixel[blue]]),
                    );
                    pixels.extend(gray_from_rgb(&rgb));
                }
                PixelLayout::Yuv422 { luma } => {
                    pixels.extend(row.as_chunks::<2>().0.iter().map(|bytes| bytes[luma]));
                }
            }
        }
        Ok(Frame::new(self.width_px, self.height_px, pixels)?)
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
        let text = |image: RawImage<'_>| image.check().unwrap_err().to_string();
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
