//! Resizes a frame of any size to the size that a model takes.

use serde::{Deserialize, Serialize};

use super::catmull_rom::{GrayView, resample};
use super::{Frame, FrameError, check_size};
use crate::named_enum;

named_enum! {
    /// How a frame of another shape becomes one of the wanted shape.
    #[derive(Deserialize, Serialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "snake_case")]
    pub enum Resize {
        /// Keeps the proportions and cuts off what does not fit, equally on both sides.
        Crop = "crop",
        /// Keeps the proportions and the whole picture; adds equal black bars on both sides.
        Letterbox = "letterbox",
        /// Keeps the whole picture and changes its proportions.
        Stretch = "stretch",
    }
    else |name| -> ResizeError { ResizeError(name.to_owned()) }
}

/// A name that is no way to resize a frame.
#[derive(Debug, thiserror::Error)]
#[error("resize is \"{}\"; it must be crop, letterbox or stretch", .0.escape_default())]
pub struct ResizeError(String);

/// The frame at `width_px`×`height_px`, resized with a Catmull-Rom filter (widened when it makes the frame smaller, so
/// that details do not alias). A frame of that size comes back unchanged. Errors: `Size` if a side is out of range.
pub fn resize(frame: &Frame, width_px: u32, height_px: u32, resize: Resize) -> Result<Frame, FrameError> {
    check_size(width_px, height_px)?;
    if (frame.width(), frame.height()) == (width_px, height_px) {
        return Ok(frame.clone());
    }
    let view = GrayView {
        pixels: frame.pixels(),
        stride: frame.width() as usize,
        width: frame.width() as usize,
        height: frame.height() as usize,
    };
    let (width, height) = (width_px as usize, height_px as usize);
    let resized = match resize {
        Resize::Crop => resample(cropped(view, width, height), width, height),
        Resize::Letterbox => letterbox(view, width, height),
        Resize::Stretch => resample(view, width, height),
    };
    Frame::new(width_px, height_px, resized)
}

/// The largest part of the view, in its middle, of the shape of `width`×`height`.
fn cropped(view: GrayView<'_>, width: usize, height: usize) -> GrayView<'_> {
    let kept_width = view.width.min(scaled(view.height, width, height));
    let kept_height = view.height.min(scaled(view.width, height, width));
    let (left, top) = ((view.width - kept_width) / 2, (view.height - kept_height) / 2);
    GrayView {
        pixels: &view.pixels[top * view.stride + left..],
        width: kept_width,
        height: kept_height,
        ..view
    }
}

fn letterbox(view: GrayView<'_>, width: usize, height: usize) -> Vec<u8> {
    let inner_width = width.min(scaled(height, view.width, view.height));
    let inner_height = height.min(scaled(width, view.height, view.width));
    let inner = resample(view, inner_width, inner_height);
    let (left, top) = ((width - inner_width) / 2, (height - inner_height) / 2);
    let mut whole = vec![0; width * height];
    for (row, pixels) in inner.chunks(inner_width).enumerate() {
        whole[(top + row) * width + left..][..inner_width].copy_from_slice(pixels);
    }
    whole
}

/// `length` · `numerator` / `denominator`, rounded, at least 1. Sides are at most [`super::MAX_SIDE_PX`], so nothing overflows.
fn scaled(length: usize, numerator: usize, denominator: usize) -> usize {
    ((length * numerator + denominator / 2) / denominator).max(1)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn flat(width: u32, height: u32, value: u8) -> Frame {
        Frame::new(width, height, vec![value; (width * height) as usize]).unwrap()
    }

    fn rows(frame: &Frame) -> Vec<&[u8]> {
        frame.pixels().chunks(frame.width() as usize).collect()
    }

    proptest! {
        #[test]
        fn every_way_gives_the_asked_size(
            from in (1u32..90, 1u32..90), to in (1u32..90, 1u32..90), value in any::<u8>(), way in 0usize..3,
        ) {
            let resized = resize(&flat(from.0, from.1, value), to.0, to.1, Resize::ALL[way]).unwrap();
            prop_assert_eq!((resized.width(), resized.height()), to);
            let is_expected = |&pixel: &u8| pixel.abs_diff(value) <= 1 || (way == 1 && pixel == 0);
            prop_assert!(resized.pixels().iter().all(is_expected));
        }
    }

    #[test]
    fn a_frame_of_the_right_size_stays_as_it_is() {
        let frame = Frame::new(3, 2, vec![9, 1, 200, 4, 77, 255]).unwrap();
        for way in Resize::ALL {
            assert_eq!(resize(&frame, 3, 2, way).unwrap(), frame);
        }
    }

    #[test]
    fn crop_cuts_both_sides_equally() {
        let row: Vec<u8> = [[0; 4], [200; 4], [200; 4], [0; 4]].concat();
        let wide = Frame::new(16, 8, row.repeat(8)).unwrap();
        assert_eq!(resize(&wide, 4, 4, Resize::Crop).unwrap(), flat(4, 4, 200));
    }

    #[test]
    fn letterbox_adds_equal_bars() {
        let resized = resize(&flat(16, 8, 200), 4, 4, Resize::Letterbox).unwrap();
        assert_eq!(rows(&resized), [[0; 4], [200; 4], [200; 4], [0; 4]]);
    }

    #[test]
    fn stretch_keeps_the_whole_picture() {
        let halves = Frame::new(64, 8, [[0; 32], [200; 32]].concat().repeat(8)).unwrap();
        let resized = resize(&halves, 8, 8, Resize::Stretch).unwrap();
        assert!(rows(&resized).iter().all(|row| row[0] == 0 && row[7] == 200));
    }

    #[test]
    fn fine_stripes_average_instead_of_aliasing() {
        let stripes = Frame::new(64, 64, [0u8, 200].repeat(64 * 32)).unwrap();
        let resized = resize(&stripes, 8, 8, Resize::Stretch).unwrap();
        assert!(
            resized.pixels().iter().all(|pixel| pixel.abs_diff(100) < 12),
            "{resized:?}"
        );
    }

    #[test]
    fn a_size_out_of_range_is_refused() {
        assert!(matches!(
            resize(&flat(2, 2, 0), 0, 4, Resize::Crop),
            Err(FrameError::Size { .. })
        ));
        assert!(matches!(
            resize(&flat(2, 2, 0), 4, 5000, Resize::Crop),
            Err(FrameError::Size { .. })
        ));
        assert_eq!("crop".parse::<Resize>().unwrap(), Resize::Crop);
        let error = "zoom".parse::<Resize>().unwrap_err();
        assert_eq!(
            error.to_string(),
            "resize is \"zoom\"; it must be crop, letterbox or stretch"
        );
    }
}
