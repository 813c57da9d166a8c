//! Images as they travel in messages: PNG, JPEG, or raw gray bytes; base64 in text, as they are in binary.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use crate::frame::{Frame, FrameError, codec};
use crate::nn::ModelSpec;
use crate::registry::Manifest;
use crate::serving::{InputError, check_size};

/// How images are encoded, in both directions: `raw` is gray bytes, row by row, of the model's size; `jpeg` is answered by
/// `png`, which loses nothing; `png` where nothing is said.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum ImageFormat {
    /// Gray bytes, row by row, of the model's size.
    Raw,
    /// PNG.
    #[default]
    Png,
    /// JPEG; answered by PNG, which loses nothing.
    Jpeg,
}

impl ImageFormat {
    /// The format of the answer to images of this one.
    pub(super) fn answer(self) -> Self {
        match self {
            Self::Raw => Self::Raw,
            Self::Png | Self::Jpeg => Self::Png,
        }
    }
}

/// An image's bytes: base64 in text, as they are in binary messages.
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
    /// From text as base64, from bytes as they are, whichever is there.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        // JSON would give a string's letters as bytes.
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

/// Why an image was refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum ImageError {
    #[error("{field} is {source}")]
    Decode { field: String, source: FrameError },
    #[error("{field} holds {found} raw bytes; model \"{model}\" takes {width}×{height} px, {expected} bytes")]
    RawLength {
        field: String,
        model: String,
        found: usize,
        expected: usize,
        width: u32,
        height: u32,
    },
    #[error(transparent)]
    Size(#[from] InputError),
    #[error("an image of the answer could not be encoded")]
    Encode(#[source] FrameError),
}

/// The image in `field` as a frame of the model's size, which is checked before its pixels are decoded.
pub(super) fn decode(
    field: &str,
    ImageBytes(bytes): ImageBytes,
    format: ImageFormat,
    manifest: &Manifest,
) -> Result<Frame, ImageError> {
    let decode_error = |source| ImageError::Decode {
        field: field.to_owned(),
        source,
    };
    let (model, spec) = (manifest.name.as_str(), &manifest.spec);
    if format == ImageFormat::Raw {
        return raw(field, bytes, model, spec);
    }
    let size = codec::dimensions(&bytes).map_err(decode_error)?;
    check_size(field, model, spec, size)?;
    codec::decode(&bytes).map_err(decode_error)
}

fn raw(field: &str, bytes: Vec<u8>, model: &str, spec: &ModelSpec) -> Result<Frame, ImageError> {
    let (width, height) = (spec.frame_width_px, spec.frame_height_px);
    let expected = width as usize * height as usize;
    if bytes.len() != expected {
        return Err(ImageError::RawLength {
            field: field.to_owned(),
            model: model.to_owned(),
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

/// The frames in the format that answers `format`.
pub(super) fn encode(frames: &[Frame], format: ImageFormat) -> Result<Vec<ImageBytes>, ImageError> {
    frames.iter().map(|frame| encode_one(frame, format)).collect()
}

/// A frame in that format.
pub(super) fn encode_one(frame: &Frame, format: ImageFormat) -> Result<ImageBytes, ImageError> {
    match format {
        ImageFormat::Raw => Ok(ImageBytes(frame.pixels().to_vec())),
        ImageFormat::Png | ImageFormat::Jpeg => codec::encode_png(frame).map(ImageBytes).map_err(ImageError::Encode),
    }
}
