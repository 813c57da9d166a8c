//! Numbers in lists that may be nested, as JSON and `MessagePack` write tensors.

use std::fmt;

use serde::de::{DeserializeSeed, Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

/// Numbers, row by row, with the length of the lists at each level: a number alone has no level.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct NestedNumbers {
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f32>,
}

impl NestedNumbers {
    /// The values as bytes. Errors: what is wrong, to follow a name.
    pub(super) fn bytes(values: Vec<f32>) -> Result<Vec<u8>, String> {
        let byte = |value: f32| {
            let is_byte = (0.0..=255.0).contains(&value) && value.fract() == 0.0;
            is_byte.then_some(value as u8).ok_or(value)
        };
        let bytes: Result<Vec<u8>, f32> = values.into_iter().map(byte).collect();
        bytes.map_err(|value| format!("holds {value}; uint8 is a whole number from 0 to 255"))
    }
}

impl<'de> Deserialize<'de> for NestedNumbers {
    /// Errors: not numbers in lists, or lists of different lengths at one level.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut levels = Levels::default();
        let element = Element {
            levels: &mut levels,
            depth: 0,
        };
        element.deserialize(deserializer)?;
        Ok(Self {
            shape: levels.lengths.into_iter().map(Option::unwrap_or_default).collect(),
            values: levels.values,
        })
    }
}

/// What was read so far.
#[derive(Default)]
struct Levels {
    /// The length of the lists at each level; unknown until the first one has ended.
    lengths: Vec<Option<usize>>,
    values: Vec<f32>,
}

/// A number, or a list of elements.
struct Element<'a> {
    levels: &'a mut Levels,
    depth: usize,
}

impl Element<'_> {
    fn push<E: Error>(self, value: f32) -> Result<(), E> {
        // A list stood in this place before.
        if self.levels.lengths.len() != self.depth {
            return Err(uneven());
        }
        self.levels.values.push(value);
        Ok(())
    }
}

impl<'de> DeserializeSeed<'de> for Element<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Element<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("numbers in lists")
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<(), E> {
        self.push(value as f32)
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<(), E> {
        self.push(value as f32)
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<(), E> {
        self.push(value as f32)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        let Self { levels, depth } = self;
        if levels.lengths.len() == depth {
            // Numbers stood at this level before.
            if !levels.values.is_empty() {
                return Err(uneven());
            }
            levels.lengths.push(None);
        }
        let mut length = 0;
        let depth_below = depth + 1;
        while items
            .next_element_seed(Element {
                levels: &mut *levels,
                depth: depth_below,
            })?
            .is_some()
        {
            length += 1;
        }
        let known = levels.lengths[depth].get_or_insert(length);
        if *known == length { Ok(()) } else { Err(uneven()) }
    }
}

fn uneven<E: Error>() -> E {
    E::custom("lists of different lengths or depths; a tensor has equal ones")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_give_their_shape_and_numbers_in_order() {
        for (text, shape, values) in [
            ("7", vec![], vec![7.0]),
            ("[]", vec![0], vec![]),
            ("[[],[]]", vec![2, 0], vec![]),
            ("[1,-2,0.5]", vec![3], vec![1.0, -2.0, 0.5]),
            ("[[[1,2]],[[3,4]]]", vec![2, 1, 2], vec![1.0, 2.0, 3.0, 4.0]),
        ] {
            let found: NestedNumbers = serde_json::from_str(text).unwrap();
            assert_eq!(found, NestedNumbers { shape, values }, "{text}");
        }
    }

    #[test]
    fn uneven_lists_are_refused() {
        for text in [
            "[[1],[2,3]]",
            "[1,[2]]",
            "[[1],2]",
            "[[],1]",
            "[[],[1]]",
            "[[[1]],[2]]",
            "[\"a\"]",
            "{}",
        ] {
            assert!(serde_json::from_str::<NestedNumbers>(text).is_err(), "{text}");
        }
    }
}
