//! Lists of a client's message that are bounded while they are read: an empty list is one byte in a message and 24 in memory.

use serde::de::{Error as _, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

/// The maximum number of items of a list in a message: more than any model takes.
const MAX_ITEMS: usize = 4096;

/// A list; the first item over the limit is an error.
pub(in crate::server) struct List<T>(pub(in crate::server) Vec<T>);

impl<'de, T: Deserialize<'de>> Deserialize<'de> for List<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(ListVisitor(std::marker::PhantomData))
    }
}

struct ListVisitor<T>(std::marker::PhantomData<T>);

impl<'de, T: Deserialize<'de>> Visitor<'de> for ListVisitor<T> {
    type Value = List<T>;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a list")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<List<T>, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            if list.len() == MAX_ITEMS {
                return Err(A::Error::custom(format_args!(
                    "the list has more than {MAX_ITEMS} items"
                )));
            }
            list.push(item);
        }
        Ok(List(list))
    }
}

/// For a field: a list.
pub(in crate::server) fn list<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<Vec<T>>, D::Error> {
    Ok(Option::<List<T>>::deserialize(deserializer)?.map(|list| list.0))
}

/// For a field: a list of lists.
pub(in crate::server) fn rows<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<Vec<Vec<T>>>, D::Error> {
    let rows = Option::<List<List<T>>>::deserialize(deserializer)?;
    Ok(rows.map(|rows| rows.0.into_iter().map(|row| row.0).collect()))
}
