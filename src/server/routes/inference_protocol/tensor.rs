//! Tensors: their types, and their values as JSON and as bytes.

use serde::{Deserialize, Serialize};

use crate::server::http::problem::ApiError;
use crate::server::nested_numbers::NestedNumbers;

/// The types of values that this server takes and gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Datatype {
    Uint8,
    Fp32,
}

impl Datatype {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Uint8 => "UINT8",
            Self::Fp32 => "FP32",
        }
    }

    fn bytes(self) -> usize {
        match self {
            Self::Uint8 => 1,
            Self::Fp32 => 4,
        }
    }
}

/// An input or output of a model.
pub(super) struct Field {
    pub(super) name: &'static str,
    pub(super) datatype: Datatype,
    pub(super) shape: Vec<i64>,
    pub(super) is_optional: bool,
}

impl Field {
    pub(super) fn new(name: &'static str, datatype: Datatype, shape: Vec<i64>) -> Self {
        Self {
            name,
            datatype,
            shape,
            is_optional: false,
        }
    }

    pub(super) fn optional(self) -> Self {
        Self {
            is_optional: true,
            ..self
        }
    }
}

/// Values in row-major order; in JSON, a list.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub(super) enum Values {
    Uint8(Vec<u8>),
    Fp32(Vec<f32>),
}

/// A tensor.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tensor {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) values: Values,
}

/// The head of an input in a request.
#[derive(Debug, Deserialize)]
pub(super) struct InputHead {
    pub(super) name: String,
    shape: Vec<usize>,
    datatype: String,
    #[serde(default)]
    parameters: InputParameters,
    data: Option<NestedNumbers>,
}

#[derive(Debug, Default, Deserialize)]
struct InputParameters {
    binary_data_size: Option<usize>,
    shared_memory_region: Option<String>,
}

/// The head of an output in an answer. It borrows the values: as JSON values, they would take many times their memory.
#[derive(Debug, Serialize)]
pub(super) struct OutputHead<'a> {
    name: &'a str,
    datatype: &'static str,
    shape: &'a [usize],
    #[serde(skip_serializing_if = "Option::is_none")]
    parameters: Option<BinarySize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    data: Option<&'a Values>,
}

#[derive(Debug, Serialize)]
struct BinarySize {
    binary_data_size: usize,
}

impl Tensor {
    /// The tensor of an input, and the bytes after it. Errors: `Unprocessable`, with the input's name.
    pub(super) fn read(head: InputHead, binary: &[u8]) -> Result<(Self, &[u8]), ApiError> {
        let name = head.name.escape_default().to_string();
        let refused = |reason: String| ApiError::Unprocessable(format!("input \"{name}\" {reason}"));
        let datatype = match head.datatype.as_str() {
            "UINT8" => Datatype::Uint8,
            "FP32" => Datatype::Fp32,
            other => {
                return Err(refused(format!(
                    "is {}; this server takes UINT8 and FP32",
                    other.escape_default()
                )));
            }
        };
        if head.parameters.shared_memory_region.is_some() {
            return Err(refused("is in shared memory; send its data".to_owned()));
        }
        let count = head
            .shape
            .iter()
            .try_fold(1_usize, |count, side| count.checked_mul(*side));
        let Some(count) = count else {
            return Err(refused(format!("has the shape {:?}, which is too large", head.shape)));
        };
        let wrong = |found: usize| refused(format!("holds {found} values; its shape {:?} has {count}", head.shape));
        let (values, rest) = match (head.data, head.parameters.binary_data_size) {
            (Some(NestedNumbers { shape, values: numbers }), None) => {
                if numbers.len() != count {
                    return Err(wrong(numbers.len()));
                }
                // A flat list is in row-major order.
                if shape.len() > 1 && shape != head.shape {
                    return Err(refused(format!(
                        "has lists of the shape {shape:?}; its shape is {:?}",
                        head.shape
                    )));
                }
                (from_numbers(datatype, numbers).map_err(refused)?, binary)
            }
            (None, Some(size)) => {
                if size > binary.len() {
                    return Err(refused(format!("has {size} bytes; {} follow the header", binary.len())));
                }
                let (bytes, rest) = binary.split_at(size);
                if Some(size) != count.checked_mul(datatype.bytes()) {
                    return Err(wrong(size / datatype.bytes()));
                }
                (from_bytes(datatype, bytes), rest)
            }
            _ => return Err(refused("needs either data or binary_data_size".to_owned())),
        };
        let tensor = Self {
            name: head.name,
            shape: head.shape,
            values,
        };
        Ok((tensor, rest))
    }

    /// The tensor as an output; `is_binary`: without its values, which [`Tensor::into_bytes`] gives.
    pub(super) fn described(&self, is_binary: bool) -> OutputHead<'_> {
        let (datatype, count) = match &self.values {
            Values::Uint8(values) => (Datatype::Uint8, values.len()),
            Values::Fp32(values) => (Datatype::Fp32, values.len()),
        };
        OutputHead {
            name: &self.name,
            datatype: datatype.name(),
            shape: &self.shape,
            parameters: is_binary.then(|| BinarySize {
                binary_data_size: count * datatype.bytes(),
            }),
            data: (!is_binary).then_some(&self.values),
        }
    }

    /// The values, little-endian.
    pub(super) fn into_bytes(self) -> Vec<u8> {
        match self.values {
            Values::Uint8(values) => values,
            Values::Fp32(values) => values.into_iter().flat_map(f32::to_le_bytes).collect(),
        }
    }
}

fn from_numbers(datatype: Datatype, numbers: Vec<f32>) -> Result<Values, String> {
    if datatype == Datatype::Fp32 {
        return Ok(Values::Fp32(numbers));
    }
    NestedNumbers::bytes(numbers).map(Values::Uint8)
}

fn from_bytes(datatype: Datatype, bytes: &[u8]) -> Values {
    match datatype {
        Datatype::Uint8 => Values::Uint8(bytes.to_vec()),
        Datatype::Fp32 => {
            let (words, _) = bytes.as_chunks::<4>();
            Values::Fp32(words.iter().map(|word| f32::from_le_bytes(*word)).collect())
        }
    }
}
