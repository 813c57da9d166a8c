//! Arrays of `NumPy` in `MessagePack`, as openpi's client writes and reads them: a map with the keys `__ndarray__`, `data`, `dtype`
//! and `shape`, which are binary.

use std::fmt;

use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{Error, MapAccess, SeqAccess, Visitor};
use serde::ser::SerializeMap as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::server::nested_numbers::NestedNumbers;

/// An array that a client sent: of `NumPy`, or numbers in lists, or a number.
#[derive(Debug)]
pub(super) struct ReceivedArray {
    pub(super) shape: Vec<usize>,
    values: ReceivedValues,
}

#[derive(Debug)]
enum ReceivedValues {
    Numpy { dtype: String, data: Vec<u8> },
    Numbers(Vec<f32>),
}

/// An array for a client, in the order of its rows.
pub(super) struct SentArray {
    pub(super) dtype: &'static str,
    pub(super) shape: Vec<usize>,
    pub(super) data: Vec<u8>,
}

/// `NumPy`'s name of bytes.
const UINT8: &str = "|u1";
/// `NumPy`'s name of little-endian numbers of 32 bits.
const FLOAT32: &str = "<f4";

impl ReceivedArray {
    /// The values. Errors: what is wrong, to follow the array's name.
    pub(super) fn numbers(self) -> Result<Vec<f32>, String> {
        match self.values {
            ReceivedValues::Numbers(values) => Ok(values),
            ReceivedValues::Numpy { dtype, data } => {
                let numbers = numbers(&dtype, &data).ok_or_else(|| {
                    let dtype = dtype.escape_default();
                    format!("has the dtype {dtype}; this server takes whole numbers, float32 and float64")
                })?;
                check_count(&self.shape, numbers.len())?;
                Ok(numbers)
            }
        }
    }

    /// The values, whole numbers from 0 to 255. Errors: what is wrong, to follow the array's name.
    pub(super) fn bytes(self) -> Result<Vec<u8>, String> {
        match self.values {
            ReceivedValues::Numpy { dtype, data } if dtype == UINT8 => {
                check_count(&self.shape, data.len())?;
                Ok(data)
            }
            ReceivedValues::Numpy { dtype, .. } => {
                Err(format!("has the dtype {}; it must be uint8", dtype.escape_default()))
            }
            ReceivedValues::Numbers(values) => NestedNumbers::bytes(values),
        }
    }
}

fn check_count(shape: &[usize], found: usize) -> Result<(), String> {
    let count = shape.iter().try_fold(1_usize, |count, side| count.checked_mul(*side));
    if count == Some(found) {
        return Ok(());
    }
    Err(format!("holds {found} values, which do not fit its shape {shape:?}"))
}

/// The numbers of an array; `None` if they are of no known type.
fn numbers(dtype: &str, data: &[u8]) -> Option<Vec<f32>> {
    let (order, kind) = dtype.split_at_checked(1)?;
    let is_big_endian = match order {
        "<" | "|" => false,
        ">" => true,
        _ => return None,
    };
    let numbers = match kind {
        "b1" | "u1" => each(data, is_big_endian, |[byte]| f32::from(byte)),
        "i1" => each(data, is_big_endian, |bytes| f32::from(i8::from_le_bytes(bytes))),
        "u2" => each(data, is_big_endian, |bytes| f32::from(u16::from_le_bytes(bytes))),
        "i2" => each(data, is_big_endian, |bytes| f32::from(i16::from_le_bytes(bytes))),
        "u4" => each(data, is_big_endian, |bytes| u32::from_le_bytes(bytes) as f32),
        "i4" => each(data, is_big_endian, |bytes| i32::from_le_bytes(bytes) as f32),
        "u8" => each(data, is_big_endian, |bytes| u64::from_le_bytes(bytes) as f32),
        "i8" => each(data, is_big_endian, |bytes| i64::from_le_bytes(bytes) as f32),
        "f4" => each(data, is_big_endian, f32::from_le_bytes),
        "f8" => each(data, is_big_endian, |bytes| f64::from_le_bytes(bytes) as f32),
        _ => return None,
    };
    Some(numbers)
}

/// Reads each value of N bytes; bytes that are left over count as one more, so that the number of values does not fit.
fn each<const N: usize>(data: &[u8], is_big_endian: bool, read: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    let (values, rest) = data.as_chunks::<N>();
    let value = |bytes: &[u8; N]| {
        let mut bytes = *bytes;
        if is_big_endian {
            bytes.reverse();
        }
        read(bytes)
    };
    let surplus = (!rest.is_empty()).then_some(0.0);
    values.iter().map(value).chain(surplus).collect()
}

impl<'de> Deserialize<'de> for ReceivedArray {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(ArrayVisitor)
    }
}

/// An array's map; with `__npgeneric__`, it is a number of `NumPy`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ArrayMap {
    #[serde(rename = "__ndarray__")]
    _is_array: Option<bool>,
    #[serde(rename = "__npgeneric__")]
    _is_number: Option<bool>,
    data: ArrayData,
    dtype: String,
    #[serde(default)]
    shape: Vec<usize>,
}

enum ArrayData {
    Bytes(Vec<u8>),
    Number(f32),
}

struct ArrayVisitor;

impl<'de> Visitor<'de> for ArrayVisitor {
    type Value = ReceivedArray;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an array of NumPy, or numbers in lists")
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<ReceivedArray, A::Error> {
        let ArrayMap { data, dtype, shape, .. } = ArrayMap::deserialize(MapAccessDeserializer::new(map))?;
        let values = match data {
            ArrayData::Bytes(data) => ReceivedValues::Numpy { dtype, data },
            ArrayData::Number(value) => ReceivedValues::Numbers(vec![value]),
        };
        Ok(ReceivedArray { shape, values })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, items: A) -> Result<ReceivedArray, A::Error> {
        let NestedNumbers { shape, values } = NestedNumbers::deserialize(SeqAccessDeserializer::new(items))?;
        let values = ReceivedValues::Numbers(values);
        Ok(ReceivedArray { shape, values })
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<ReceivedArray, E> {
        Ok(number(value as f32))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<ReceivedArray, E> {
        Ok(number(value as f32))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<ReceivedArray, E> {
        Ok(number(value as f32))
    }
}

fn number(value: f32) -> ReceivedArray {
    ReceivedArray {
        shape: Vec::new(),
        values: ReceivedValues::Numbers(vec![value]),
    }
}

impl<'de> Deserialize<'de> for ArrayData {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(DataVisitor)
    }
}

struct DataVisitor;

impl Visitor<'_> for DataVisitor {
    type Value = ArrayData;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the bytes of an array")
    }

    fn visit_bytes<E>(self, bytes: &[u8]) -> Result<ArrayData, E> {
        Ok(ArrayData::Bytes(bytes.to_vec()))
    }

    fn visit_bool<E>(self, value: bool) -> Result<ArrayData, E> {
        Ok(ArrayData::Number(f32::from(u8::from(value))))
    }

    fn visit_f64<E>(self, value: f64) -> Result<ArrayData, E> {
        Ok(ArrayData::Number(value as f32))
    }

    fn visit_i64<E>(self, value: i64) -> Result<ArrayData, E> {
        Ok(ArrayData::Number(value as f32))
    }

    fn visit_u64<E>(self, value: u64) -> Result<ArrayData, E> {
        Ok(ArrayData::Number(value as f32))
    }
}

impl SentArray {
    pub(super) fn of_bytes(shape: Vec<usize>, data: Vec<u8>) -> Self {
        Self {
            dtype: UINT8,
            shape,
            data,
        }
    }

    pub(super) fn of_numbers(shape: Vec<usize>, values: impl IntoIterator<Item = f32>) -> Self {
        Self {
            dtype: FLOAT32,
            shape,
            data: values.into_iter().flat_map(f32::to_le_bytes).collect(),
        }
    }
}

impl Serialize for SentArray {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(4))?;
        map.serialize_entry(&Binary(b"__ndarray__"), &true)?;
        map.serialize_entry(&Binary(b"data"), &Binary(&self.data))?;
        map.serialize_entry(&Binary(b"dtype"), self.dtype)?;
        map.serialize_entry(&Binary(b"shape"), &self.shape)?;
        map.end()
    }
}

/// Bytes, which are not a list of numbers.
struct Binary<'a>(&'a [u8]);

impl Serialize for Binary<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::server::msgpack;

    fn received(dtype: &'static str, shape: &[usize], data: &[u8]) -> ReceivedArray {
        let sent = SentArray {
            dtype,
            shape: shape.to_vec(),
            data: data.to_vec(),
        };
        msgpack::read(&msgpack::write(&sent)).unwrap()
    }

    #[test]
    fn numbers_of_every_type_and_byte_order_are_read() {
        for (dtype, data) in [
            ("|u1", vec![2, 3]),
            ("|i1", vec![2, 3]),
            ("<i2", vec![2, 0, 3, 0]),
            (">u2", vec![0, 2, 0, 3]),
            (">i4", [2_i32, 3].map(i32::to_be_bytes).concat()),
            ("<i8", [2_i64, 3].map(i64::to_le_bytes).concat()),
            ("<f4", [2_f32, 3.0].map(f32::to_le_bytes).concat()),
            (">f8", [2_f64, 3.0].map(f64::to_be_bytes).concat()),
        ] {
            assert_eq!(received(dtype, &[2], &data).numbers().unwrap(), [2.0, 3.0], "{dtype}");
        }
    }

    #[test]
    fn arrays_that_do_not_fit_their_shape_or_type_are_refused() {
        for (dtype, shape, data, words) in [
            ("<f4", vec![2], vec![0; 4], "holds 1 values"),
            ("<f4", vec![1], vec![0; 5], "holds 2 values"),
            ("<f4", vec![usize::MAX, 2], vec![0; 4], "do not fit"),
            ("<c8", vec![1], vec![0; 8], "has the dtype <c8"),
            ("é", vec![1], vec![0; 8], "has the dtype"),
            ("", vec![], vec![], "has the dtype"),
        ] {
            let error = received(dtype, &shape, &data).numbers().unwrap_err();
            assert!(error.contains(words), "{error}");
        }
        let error = received("<f4", &[1], &[0; 4]).bytes().unwrap_err();
        assert_eq!(error, "has the dtype <f4; it must be uint8");
    }
}
