//! Reads PNG and JPEG images; writes PNG images and animated GIFs. Sizes are checked before pixels are allocated.

use std::io::Cursor;

use image::codecs::gif::{GifEncoder, Repeat};
use image::metadata::Orientation;
use image::{DynamicImage, ExtendedColorType, GrayImage, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits};

use super::{Frame, FrameError, FrameSize, MAX_SIDE_PX, jpeg};

/// Limit for an image's metadata after decompression, in bytes: colour profiles and similar.
const MAX_METADATA_BYTES: u64 = 1 << 20;
/// Largest pixel format, in bytes: four channels of 16 bits.
const MAX_PIXEL_BYTES: u64 = 8;
/// The least and the most seconds for which a GIF shows a frame. Viewers show shorter ones at speeds of their own.
const GIF_PERIODS_S: [f64; 2] = [0.02, 10.0];

/// Reads a PNG or JPEG image and converts it to gray. A JPEG image is turned as its EXIF data says. Errors: `Size` if a side is
/// larger than [`MAX_SIDE_PX`]; `Decode` if the bytes are not PNG or JPEG; `Damaged` for a JPEG image whose data is incomplete or
/// not valid.
pub fn decode(bytes: &[u8]) -> Result<Frame, FrameError> {
    let sides = reader(bytes, MAX_METADATA_BYTES)?.into_dimensions();
    let (width, height) = sides.map_err(FrameError::Decode)?;
    if width.max(height) > MAX_SIDE_PX {
        return Err(FrameError::Size { width, height });
    }
    // The decoder fills what is missing with gray.
    if is_jpeg(bytes) {
        jpeg::check(bytes).map_err(|damage| FrameError::Damaged(damage.into()))?;
    }
    let pixel_bytes = u64::from(width) * u64::from(height) * MAX_PIXEL_BYTES;
    let reader = reader(bytes, pixel_bytes + MAX_METADATA_BYTES)?;
    let mut decoder = reader.into_decoder().map_err(FrameError::Decode)?;
    let orientation = orientation(bytes, &mut decoder)?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(FrameError::Decode)?;
    image.apply_orientation(orientation);
    let (width, height) = (image.width(), image.height());
    let pixels = match image {
        DynamicImage::ImageLuma8(gray) => gray.into_raw(),
        other => gray_from_rgb(other.into_rgb8().as_raw()),
    };
    Frame::new(width, height, pixels)
}

/// Reads width and height of a PNG or JPEG image, as [`decode`] returns it, without decoding its pixels. Errors: `Decode` if
/// the bytes are not PNG or JPEG.
pub fn dimensions(bytes: &[u8]) -> Result<FrameSize, FrameError> {
    let reader = reader(bytes, MAX_METADATA_BYTES)?;
    let mut decoder = reader.into_decoder().map_err(FrameError::Decode)?;
    let (width, height) = decoder.dimensions();
    let is_on_its_side = matches!(
        orientation(bytes, &mut decoder)?,
        Orientation::Rotate90 | Orientation::Rotate270 | Orientation::Rotate90FlipH | Orientation::Rotate270FlipH
    );
    let (width, height) = if is_on_its_side {
        (height, width)
    } else {
        (width, height)
    };
    Ok(FrameSize { width, height })
}

fn is_jpeg(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0xff, 0xd8])
}

/// How the image must be turned to be upright. Cameras write it in JPEG images; PNG images are taken as they are.
fn orientation(bytes: &[u8], decoder: &mut impl ImageDecoder) -> Result<Orientation, FrameError> {
    if is_jpeg(bytes) {
        decoder.orientation().map_err(FrameError::Decode)
    } else {
        Ok(Orientation::NoTransforms)
    }
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

/// Encodes the frames as a GIF that repeats forever, with this time between two frames. Errors: `Encode`.
pub fn encode_gif(frames: &[Frame], period_s: f64) -> Result<Vec<u8>, FrameError> {
    let mut bytes = Vec::new();
    let mut encoder = GifEncoder::new(&mut bytes);
    encoder.set_repeat(Repeat::Infinite).map_err(FrameError::Encode)?;
    let [least, most] = GIF_PERIODS_S;
    let delay_ms = (period_s.clamp(least, most) * 1000.0).round() as u32;
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
    fn a_jpeg_is_turned_as_its_exif_data_says() {
        // Left half black, right half white.
        let pixels = [[0; 16], [255; 16]].concat().repeat(16);
        let of = |orientation: u8| {
            let mut bytes = Vec::new();
            let mut encoder = image::codecs::jpeg::JpegEncoder::new(&mut bytes);
            // One entry: the tag 0x0112, a short.
            let exif = [
                b"MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0",
                &[orientation][..],
                &[0; 6],
            ]
            .concat();
            encoder.set_exif_metadata(exif).unwrap();
            encoder.write_image(&pixels, 32, 16, ExtendedColorType::L8).unwrap();
            let frame = decode(&bytes).unwrap();
            assert_eq!(dimensions(&bytes).unwrap(), frame.size());
            let (first, last) = (frame.pixels()[0], frame.pixels()[frame.pixels().len() - 1]);
            let corner = frame.pixels()[frame.width() as usize - 1];
            (frame.width(), [first, corner, last].map(|level| level > 127))
        };
        assert_eq!(of(1), (32, [false, true, true]));
        assert_eq!(of(3), (32, [true, false, false]));
        assert_eq!(of(6), (16, [false, false, true]));
        assert_eq!(of(8), (16, [true, true, false]));
    }

    #[test]
    fn gray_of_pure_green_is_587_thousandths() {
        assert_eq!(gray_from_rgb(&[0, 255, 0, 255, 255, 255]), [150, 255]);
    }

    #[test]
    fn a_gif_of_two_frames_is_written() {
        let frame = Frame::new(2, 2, vec![0, 80, 160, 255]).unwrap();
        let bytes = encode_gif(&[frame.clone(), frame], 0.2).unwrap();
        assert!(bytes.starts_with(b"GIF89a"));
        assert!(decode(&bytes).is_err(), "only PNG and JPEG are read");
    }
}
