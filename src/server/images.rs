//! Images in messages: PNG, JPEG or raw gray bytes; as base64 in text, as bytes in binary.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use super::http::problem::ApiError;
use foreframe_core::error_text::with_causes;
use foreframe_core::frame::resize::{Resize, resize};
use foreframe_core::frame::{Frame, FrameError, codec};
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Manifest;
use foreframe_core::serving::{InputError, check_size};
use foreframe_core::types::ModelName;

/// The most pixels of an image that is resized. An image states its size in few bytes, so this bounds the memory that a
/// small body can take.
const MAX_FIT_PIXELS: u32 = 1 << 22;

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
        bytes
            .map(ImageBytes)
            .map_err(|error| E::custom(format_args!("the image is not base64: {error}")))
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
    #[error("{field} is {source}")]
    Decode { field: String, source: FrameError },
    #[error("{field} holds {found} raw bytes; model \"{model}\" takes {width}×{height} px, {expected} bytes")]
    RawLength {
        field: String,
        model: ModelName,
        found: usize,
        expected: usize,
        width: u32,
        height: u32,
    },
    #[error("{0}; set resize to crop, letterbox or stretch")]
    Size(InputError),
    #[error("{field} is {width}×{height} px; an image to resize has at most {MAX_FIT_PIXELS} pixels")]
    TooManyPixels { field: String, width: u32, height: u32 },
    #[error("an image of the answer could not be encoded")]
    Encode(#[source] FrameError),
}

impl From<ImageError> for ApiError {
    fn from(error: ImageError) -> Self {
        match error {
            ImageError::Encode(_) => Self::Internal(with_causes(&error)),
            _ => Self::Unprocessable(error.to_string()),
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
    let decode_error = |source| ImageError::Decode {
        field: field.to_owned(),
        source,
    };
    let (model, spec) = (&manifest.name, &manifest.spec);
    if input.format == ImageFormat::Raw {
        return raw(field, bytes, model, spec);
    }
    let (width, height) = codec::dimensions(&bytes).map_err(decode_error)?;
    let Some(way) = input.resize else {
        check_size(field, manifest, (width, height)).map_err(ImageError::Size)?;
        return codec::decode(&bytes).map_err(decode_error);
    };
    if width.saturating_mul(height) > MAX_FIT_PIXELS {
        let field = field.to_owned();
        return Err(ImageError::TooManyPixels { field, width, height });
    }
    let frame = codec::decode(&bytes).map_err(decode_error)?;
    resize(&frame, spec.frame_width_px, spec.frame_height_px, way).map_err(decode_error)
}

fn raw(field: &str, bytes: Vec<u8>, model: &ModelName, spec: &ModelSpec) -> Result<Frame, ImageError> {
    let (width, height) = (spec.frame_width_px, spec.frame_height_px);
    let expected = width as usize * height as usize;
    if bytes.len() != expected {
        return Err(ImageError::RawLength {
            field: field.to_owned(),
            model: model.clone(),
            found: bytes.len(),
            expected,
            width,
            height,
        });
    }
    Frame::new(width, height, bytes).map_err(|source| ImageError::Decode {
        field: field.to_owned(),
        source,
    })
}

/// The frames in that format.
pub(in crate::server) fn encode(frames: &[Frame], format: ImageFormat) -> Result<Vec<ImageBytes>, ImageError> {
    frames.iter().map(|frame| encode_one(frame, format)).collect()
}

/// As [`encode`]; raw pixels are not copied.
pub(in crate::server) fn encode_owned(frames: Vec<Frame>, format: ImageFormat) -> Result<Vec<ImageBytes>, ImageError> {
    match format {
        ImageFormat::Raw => Ok(frames
            .into_iter()
            .map(|frame| ImageBytes(frame.into_pixels()))
            .collect()),
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
