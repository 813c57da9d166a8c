//! Images in messages: PNG, JPEG or raw gray bytes; as base64 in text, as bytes in binary.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use super::http::problem::ApiError;
use foreframe_core::error_text::with_causes;
use foreframe_core::frame::resize::{Resize, resize};
use foreframe_core::frame::{Frame, FrameError, FrameSize, codec};
use foreframe_core::registry::Manifest;
use foreframe_core::serving::check_size;

/// The most pixels of an image that is resized. An image states its size in few bytes, so this bounds the memory that a
/// small body can take.
const MAX_RESIZED_PIXELS: u32 = 1 << 22;

/// How images are encoded, in both directions: `raw` is gray bytes, row by row, of the model's size; images sent as `jpeg`
/// are answered with `png`, which is lossless. An incomplete image is refused, and so is a changed one if the change can be
/// found: `jpeg` has no checksum. Default: `png`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ImageFormat {
    /// Gray bytes, row by row, of the model's size.
    Raw,
    /// PNG.
    #[default]
    Png,
    /// JPEG; answered with PNG, which is lossless.
    Jpeg,
}

impl ImageFormat {
    /// The format of the answer to images of this one.
    pub(in crate::server) fn answer(self) -> Self {
        match self {
            Self::Raw => Self::Raw,
            Self::Png | Self::Jpeg => Self::Png,
        }
    }
}

/// An image file or raw pixels: base64 in text, bytes in binary messages.
#[derive(Clone, Debug, Default, PartialEq, Eq, utoipa::ToSchema)]
#[schema(value_type = String, format = Byte)]
pub struct ImageBytes(pub Vec<u8>);

impl Serialize for ImageBytes {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            serializer.serialize_str(&STANDARD.encode(&self.0))
        } else {
            serializer.serialize_bytes(&self.0)
        }
    }
}

impl<'de> Deserialize<'de> for ImageBytes {
    /// From base64 in text, or from bytes.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        // Otherwise JSON would give the characters of a string as bytes.
        if deserializer.is_human_readable() {
            deserializer.deserialize_str(ImageVisitor)
        } else {
            deserializer.deserialize_byte_buf(ImageVisitor)
        }
    }
}

struct ImageVisitor;

impl de::Visitor<'_> for ImageVisitor {
    type Value = ImageBytes;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("an image: base64 in text, bytes in a binary message")
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<ImageBytes, E> {
        let bytes = STANDARD.decode(text);
        let bytes = bytes.map_err(|error| E::custom(format_args!("the image is not base64: {error}")))?;
        Ok(ImageBytes(bytes))
    }

    fn visit_bytes<E: de::Error>(self, bytes: &[u8]) -> Result<ImageBytes, E> {
        Ok(ImageBytes(bytes.to_vec()))
    }

    fn visit_byte_buf<E: de::Error>(self, bytes: Vec<u8>) -> Result<ImageBytes, E> {
        Ok(ImageBytes(bytes))
    }
}

/// Why an image was refused or could not be made.
#[derive(Debug, thiserror::Error)]
pub(in crate::server) enum ImageError {
    /// What is wrong with an image of the request.
    #[error("{0}")]
    Refused(String),
    #[error("an image of the answer could not be encoded")]
    Encode(#[source] FrameError),
}

impl From<ImageError> for ApiError {
    fn from(error: ImageError) -> Self {
        match error {
            ImageError::Encode(_) => Self::Internal(with_causes(&error)),
            ImageError::Refused(reason) => Self::Unprocessable(reason),
        }
    }
}

/// How the images of a request or session are read.
#[derive(Clone, Copy)]
pub(in crate::server) struct ImageInput {
    pub(in crate::server) format: ImageFormat,
    /// How an image of another size becomes a frame; `None` refuses it.
    pub(in crate::server) resize: Option<Resize>,
}

/// The image in `field` as a frame of the model's size. The size is checked before pixels are decoded.
pub(in crate::server) fn decode(
    field: &str,
    ImageBytes(bytes): ImageBytes,
    input: ImageInput,
    manifest: &Manifest,
) -> Result<Frame, ImageError> {
    let refused = |error: FrameError| ImageError::Refused(format!("{field} is {error}"));
    let (model, spec) = (&manifest.name, &manifest.spec);
    let (model_width, model_height) = (spec.frame_width_px, spec.frame_height_px);
    if input.format == ImageFormat::Raw {
        let (found, expected) = (bytes.len(), model_width as usize * model_height as usize);
        if found != expected {
            return Err(ImageError::Refused(format!(
                "{field} holds {found} raw bytes; model \"{model}\" takes {model_width}×{model_height} px, {expected} bytes"
            )));
        }
        return Frame::new(model_width, model_height, bytes).map_err(refused);
    }
    let size = codec::dimensions(&bytes).map_err(refused)?;
    check_resizable(field, size, input.resize, manifest)?;
    let frame = codec::decode(&bytes).map_err(refused)?;
    resized(field, frame, input.resize, manifest)
}

/// The gray image in an array `[height, width]`, `[height, width, 1]` or `[height, width, 3]` (red, green, blue).
pub(in crate::server) fn from_array(field: &str, shape: &[usize], values: Vec<u8>) -> Result<Frame, ImageError> {
    let refused = |reason: String| ImageError::Refused(format!("{field} {reason}"));
    let (height, width, pixels) = match shape {
        [height, width] | [height, width, 1] => (*height, *width, values),
        [height, width, 3] => (*height, *width, codec::gray_from_rgb(&values)),
        _ => {
            return Err(refused(format!(
                "has the shape {shape:?}; it is [height, width], also with 1 or 3 channels at the end"
            )));
        }
    };
    let side = |side: usize| u32::try_from(side).unwrap_or(u32::MAX);
    let frame = Frame::new(side(width), side(height), pixels);
    frame.map_err(|error| refused(format!("is {error}")))
}

/// Pixels of any size as a frame of the model's size. `way`: how another size is resized; `None` refuses it.
pub(in crate::server) fn resized(
    field: &str,
    frame: Frame,
    way: Option<Resize>,
    manifest: &Manifest,
) -> Result<Frame, ImageError> {
    check_resizable(field, frame.size(), way, manifest)?;
    let spec = &manifest.spec;
    let Some(way) = way else { return Ok(frame) };
    let frame = resize(&frame, spec.frame_width_px, spec.frame_height_px, way);
    frame.map_err(|error| ImageError::Refused(format!("{field} is {error}")))
}

/// Errors: `Refused` if an image of that size cannot become a frame of the model.
fn check_resizable(field: &str, size: FrameSize, way: Option<Resize>, manifest: &Manifest) -> Result<(), ImageError> {
    let FrameSize { width, height } = size;
    if way.is_none() {
        let checked = check_size(field, manifest, (width, height));
        return checked
            .map_err(|error| ImageError::Refused(format!("{error}; set resize to crop, letterbox or stretch")));
    }
    if width.saturating_mul(height) > MAX_RESIZED_PIXELS {
        return Err(ImageError::Refused(format!(
            "{field} is {width}×{height} px; an image to resize has at most {MAX_RESIZED_PIXELS} pixels"
        )));
    }
    Ok(())
}

/// The frames in that format.
pub(in crate::server) fn encode(frames: &[Frame], format: ImageFormat) -> Result<Vec<ImageBytes>, ImageError> {
    frames.iter().map(|frame| encode_one(frame, format)).collect()
}

/// As [`encode`]; raw pixels are not copied.
pub(in crate::server) fn encode_owned(frames: Vec<Frame>, format: ImageFormat) -> Result<Vec<ImageBytes>, ImageError> {
    match format {
        ImageFormat::Raw => Ok(frames.into_iter().map(Frame::into_pixels).map(ImageBytes).collect()),
        ImageFormat::Png | ImageFormat::Jpeg => encode(&frames, format),
    }
}

/// The frame in that format.
pub(in crate::server) fn encode_one(frame: &Frame, format: ImageFormat) -> Result<ImageBytes, ImageError> {
    match format {
        ImageFormat::Raw => Ok(ImageBytes(frame.pixels().to_vec())),
        ImageFormat::Png | ImageFormat::Jpeg => codec::encode_png(frame).map(ImageBytes).map_err(ImageError::Encode),
    }
}
