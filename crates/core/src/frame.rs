//! A gray camera image with a checked size. [`codec`] reads and writes image files, [`preprocess`] converts frames to and
//! from the model's value range, [`quality`] compares two images, [`resize`](mod@resize) changes the size, [`warp`] moves pixels.

mod catmull_rom;
pub mod codec;
pub(crate) mod difference;
pub mod jpeg;
pub mod preprocess;
pub mod quality;
pub mod resize;
pub mod warp;

/// The largest accepted width and height of a frame, in pixels.
pub const MAX_SIDE_PX: u32 = 4096;

/// Why a frame was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FrameError {
    /// A side is zero or over [`MAX_SIDE_PX`].
    #[error("a frame of {width}×{height} px is out of range; each side must be 1 to {max} px", max = MAX_SIDE_PX)]
    Size {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// The number of pixels does not match the size.
    #[error("{found} pixels given for a frame of {width}×{height} px; it needs {expected}")]
    PixelCount {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Pixels given.
        found: usize,
        /// Pixels needed.
        expected: usize,
    },
    /// The bytes are not a PNG or JPEG image.
    #[error("not a readable PNG or JPEG image")]
    Decode(#[source] image::ImageError),
    /// A JPEG image is incomplete, or its data is not valid.
    #[error("a damaged JPEG image: {0}")]
    Damaged(Box<dyn std::error::Error + Send + Sync>),
    /// An image could not be written.
    #[error("could not encode the image")]
    Encode(#[source] image::ImageError),
    /// A pixel was NaN or infinite.
    #[error("pixel {index} is {value}; every pixel must be a finite number")]
    NotFinite {
        /// Position, row by row.
        index: usize,
        /// The value found.
        value: f32,
    },
    /// No pinhole camera has that field of view or tilt.
    #[error(
        "the camera model has a field of view of {horizontal_fov_rad} rad and a tilt of {tilt_down_rad} rad; the field of \
         view must be above 0 and below π, the tilt above -π/2 and below π/2"
    )]
    Camera {
        /// Horizontal field of view in radians.
        horizontal_fov_rad: f32,
        /// Tilt in radians.
        tilt_down_rad: f32,
    },
    /// No camera is at that height.
    #[error("the camera is at a height of {height_m} m; it must be a finite number above 0")]
    CameraHeight {
        /// Height above the floor in metres.
        height_m: f32,
    },
}

/// Width and height of an image in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameSize {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

/// A gray image with 8 bits per pixel, row by row from the top left.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    width: u32,
    height: u32,
    pixels: Vec<u8>,
}

impl Frame {
    /// A frame of the given size. Errors: `Size` if a side is out of range, `PixelCount` if the number of pixels is not
    /// width × height.
    pub fn new(width: u32, height: u32, pixels: Vec<u8>) -> Result<Self, FrameError> {
        check_size(width, height)?;
        let expected = width as usize * height as usize;
        if pixels.len() != expected {
            return Err(FrameError::PixelCount {
                width,
                height,
                found: pixels.len(),
                expected,
            });
        }
        Ok(Self { width, height, pixels })
    }

    /// Width in pixels.
    #[must_use]
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    #[must_use]
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Width and height in pixels.
    #[doc(hidden)]
    #[must_use]
    pub fn size(&self) -> FrameSize {
        FrameSize {
            width: self.width,
            height: self.height,
        }
    }

    /// Intensities 0 (black) to 255 (white), row by row.
    #[must_use]
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    /// The intensities, without a copy.
    #[must_use]
    pub fn into_pixels(self) -> Vec<u8> {
        self.pixels
    }

    /// The intensities, to change them.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        &mut self.pixels
    }
}

/// Errors: `Size` if a side is out of range.
fn check_size(width: u32, height: u32) -> Result<(), FrameError> {
    let sides = 1..=MAX_SIDE_PX;
    let is_in_range = sides.contains(&width) && sides.contains(&height);
    is_in_range.then_some(()).ok_or(FrameError::Size { width, height })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_few_pixels_are_refused() {
        let error = Frame::new(4, 4, vec![0; 15]).unwrap_err();
        assert_eq!(error.to_string(), "15 pixels given for a frame of 4×4 px; it needs 16");
    }

    #[test]
    fn a_frame_of_width_zero_is_refused() {
        assert!(Frame::new(0, 4, vec![]).is_err());
    }
}
