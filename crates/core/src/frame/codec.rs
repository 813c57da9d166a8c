//! Reads PNG and JPEG images; writes PNG images and animated GIFs. Sizes are checked before pixels are allocated.

use std::io::Cursor;

use image::codecs::gif::{GifEncoder, Repeat};
use image::{
    DynamicImage, ExtendedColorType, GrayImage, ImageDecoder as _, ImageEncoder, ImageFormat, ImageReader, Limits,
};

use super::{Frame, FrameError, FrameSize, MAX_SIDE_PX, jpeg};

/// Limit for an image's metadata after decompression, in bytes: colour profiles and similar.
const MAX_METADATA_BYTES: u64 = 1 << 20;
/// Largest pixel format, in bytes: four channels of 16 bits.
const MAX_PIXEL_BYTES: u64 = 8;

/// Reads a PNG or JPEG image and converts it to gray. Errors: `Size` if a side is larger than [`MAX_SIDE_PX`]; `Decode` if
/// the bytes are not PNG or JPEG; `Damaged` for a JPEG image whose data is incomplete or not valid.
pub fn decode(bytes: &[u8]) -> Result<Frame, FrameError> {
    let FrameSize { width, height } = dimensions(bytes)?;
    if width.max(height) > MAX_SIDE_PX {
        return Err(FrameError::Size { width, height });
    }
    // The decoder fills what is missing with gray.
    if bytes.starts_with(&[0xff, 0xd8]) {
        jpeg::check(bytes).map_err(|damage| FrameError::Damaged(damage.into()))?;
    }
    let pixel_bytes = u64::from(width) * u64::from(height) * MAX_PIXEL_BYTES;
    let image = reader(bytes, pixel_bytes + MAX_METADATA_BYTES)?.decode();
    let pixels = match image.map_err(FrameError::Decode)? {
        DynamicImage::ImageLuma8(gray) => gray.into_raw(),
        other => gray_from_rgb(other.into_rgb8().as_raw()),
    };
    Frame::new(width, height, pixels)
}

/// Reads width and height of a PNG or JPEG image without decoding its pixels. Errors: `Decode` if the bytes are not PNG
/// or JPEG.
pub fn dimensions(bytes: &[u8]) -> Result<FrameSize, FrameError> {
    let reader = reader(bytes, MAX_METADATA_BYTES)?;
    let (width, height) = reader.into_dimensions().map_err(FrameError::Decode)?;
    Ok(FrameSize { width, height })
}

/// Whether a PNG or JPEG image has color channels, without decoding its pixels. Errors: `Decode` if the bytes are neither.
pub fn is_color(bytes: &[u8]) -> Result<bool, FrameError> {
    let reader = reader(bytes, MAX_METADATA_BYTES)?;
    let decoder = reader.into_decoder().map_err(FrameError::Decode)?;
    Ok(decoder.color_type().has_color())
}

/// Reads the image; allocates at most this number of bytes.
fn reader(bytes: &[u8], max_bytes: u64) -> Result<ImageReader<Cursor<&[u8]>>, FrameError> {
    let mut limits = Limits::default();
    limits.max_alloc = Some(max_bytes);
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|error| FrameError::Decode(error.into()))?;
    if !matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg)) {
        reader.clear_format();
    }
    reader.limits(limits);
    Ok(reader)
}

/// Converts interleaved red, green and blue bytes to gray intensities (ITU-R BT.601).
#[must_use]
pub fn gray_from_rgb(rgb: &[u8]) -> Vec<u8> {
    let gray = |pixel: &[u8; 3]| {
        let [red, green, blue] = pixel.map(u32::from);
        ((299 * red + 587 * green + 114 * blue + 500) / 1000) as u8
    };
    rgb.as_chunks().0.iter().map(gray).collect()
}

/// Encodes the frame as a gray PNG. Errors: `Encode`.
pub fn encode_png(frame: &Frame) -> Result<Vec<u8>, FrameError> {
    let mut bytes = Vec::new();
    image::codecs::png::PngEncoder::new(&mut bytes)
        .write_image(frame.pixels(), frame.width(), frame.height(), ExtendedColorType::L8)
        .map_err(FrameError::Encode)?;
    Ok(bytes)
}

/// Encodes the frame as a PNG with red, green and blue, which are all its gray level. Errors: `Encode`.
pub fn encode_rgb_png(frame: &Frame) -> Result<Vec<u8>, FrameError> {
    let rgb: Vec<u8> = frame.pixels().iter().flat_map(|&gray| [gray; 3]).collect();
    let mut bytes = Vec::new();
    image::codecs::png::PngEncoder::new(&mut bytes)
        .write_image(&rgb, frame.width(), frame.height(), ExtendedColorType::Rgb8)
        .map_err(FrameError::Encode)?;
    Ok(bytes)
}

/// Encodes the frames as a GIF that repeats forever, with `delay_ms` between two frames. Errors: `Encode`.
pub fn encode_gif(frames: &[Frame], delay_ms: u32) -> Result<Vec<u8>, FrameError> {
    let mut bytes = Vec::new();
    let mut encoder = GifEncoder::new(&mut bytes);
    encoder.set_repeat(Repeat::Infinite).map_err(FrameError::Encode)?;
    let delay = image::Delay::from_numer_denom_ms(delay_ms, 1);
    let images = frames.iter().map(|frame| {
        let gray = GrayImage::from_raw(frame.width(), frame.height(), frame.pixels().to_vec());
        let gray = gray.expect("a frame with too few pixels is a bug");
        image::Frame::from_parts(DynamicImage::ImageLuma8(gray).into_rgba8(), 0, 0, delay)
    });
    encoder.encode_frames(images).map_err(FrameError::Encode)?;
    drop(encoder);
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_png_restores_every_pixel(width in 1u32..40, height in 1u32..40, seed in any::<u8>()) {
            let pixels = (0..width * height).map(|i| (i * 31 + u32::from(seed)) as u8).collect();
            let frame = Frame::new(width, height, pixels).unwrap();
            let png = encode_png(&frame).unwrap();
            prop_assert_eq!(dimensions(&png).unwrap(), FrameSize { width, height });
            prop_assert_eq!(decode(&encode_rgb_png(&frame).unwrap()).unwrap(), frame.clone());
            prop_assert_eq!(decode(&png).unwrap(), frame);
        }

        #[test]
        fn no_bytes_make_the_decoder_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = decode(&bytes);
            let _ = dimensions(&bytes);
        }
    }

    #[test]
    fn gray_of_pure_green_is_587_thousandths() {
        assert_eq!(gray_from_rgb(&[0, 255, 0, 255, 255, 255]), [150, 255]);
    }

    #[test]
    fn a_gif_of_two_frames_is_written() {
        let frame = Frame::new(2, 2, vec![0, 80, 160, 255]).unwrap();
        let bytes = encode_gif(&[frame.clone(), frame], 200).unwrap();
        assert!(bytes.starts_with(b"GIF89a"));
        assert!(decode(&bytes).is_err(), "only PNG and JPEG are read");
    }
}
