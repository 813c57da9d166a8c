//! Images as they travel in messages: base64 of PNG, JPEG, or raw gray bytes.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};

use crate::frame::{Frame, FrameError, codec};
use crate::nn::ModelSpec;
use crate::registry::Manifest;
use crate::serving::{InputError, check_size};

/// How images are encoded, in both directions.
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

/// Why an image was refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum ImageError {
    #[error("{field} is not base64: {source}")]
    Base64 { field: String, source: base64::DecodeError },
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
pub(super) fn decode(field: &str, text: &str, format: ImageFormat, manifest: &Manifest) -> Result<Frame, ImageError> {
    let bytes = STANDARD.decode(text).map_err(|source| ImageError::Base64 {
        field: field.to_owned(),
        source,
    })?;
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

/// The frames in the format that answers `format`, base64.
pub(super) fn encode(frames: &[Frame], format: ImageFormat) -> Result<Vec<String>, ImageError> {
    let encoded = frames.iter().map(|frame| match format {
        ImageFormat::Raw => Ok(STANDARD.encode(frame.pixels())),
        ImageFormat::Png | ImageFormat::Jpeg => codec::encode_png(frame)
            .map(|bytes| STANDARD.encode(bytes))
            .map_err(ImageError::Encode),
    });
    encoded.collect()
}
