//! What an import leaves out: damaged lines, messages and images.

use std::path::Path;

use serde::{Deserialize, Serialize};

/// How many items are listed; more are only counted, so that a recording with endless damage needs little memory.
pub(super) const MAX_ITEMS: usize = 10_000;
/// The longest text of an item, in bytes.
const MAX_TEXT_BYTES: usize = 500;
/// How many names a message lists, and how much of each.
const LISTED_NAMES: usize = 40;
const LISTED_BYTES: usize = 200;

/// Something in the recording that was left out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedItem {
    /// File and line, frame or position; about 500 bytes at most.
    pub place: String,
    /// What was wrong; about 500 bytes at most.
    pub reason: String,
    /// How many items this entry stands for: 1, or more in an entry for all that are not listed.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub count: u64,
}

fn one() -> u64 {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_one(count: &u64) -> bool {
    *count == 1
}

impl SkippedItem {
    pub(super) fn new(place: &str, reason: &str) -> Self {
        Self {
            place: shortened(place, MAX_TEXT_BYTES),
            reason: shortened(reason, MAX_TEXT_BYTES),
            count: 1,
        }
    }
}

/// The beginning of a text, with `…` if something is missing.
pub(super) fn shortened(text: &str, bytes: usize) -> String {
    if text.len() <= bytes {
        return text.to_owned();
    }
    format!("{}…", &text[..text.floor_char_boundary(bytes)])
}

/// A text that names paths below one folder, with those below another instead.
pub(super) fn moved_text(text: &str, from: &Path, to: &Path) -> String {
    text.replace(&*from.to_string_lossy(), &to.to_string_lossy())
}

/// Names for a message, with commas; of many, the first ones.
pub(super) fn listed(names: impl IntoIterator<Item = impl AsRef<str>>) -> String {
    let mut names = names.into_iter();
    let shown = names.by_ref().take(LISTED_NAMES);
    let shown: Vec<String> = shown.map(|name| shortened(name.as_ref(), LISTED_BYTES)).collect();
    match (shown.as_slice(), names.count()) {
        ([], _) => "none".to_owned(),
        (_, 0) => shown.join(", "),
        (_, more) => format!("{} and {more} more", shown.join(", ")),
    }
}

/// What was left out, in the order in which it was found.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct SkippedList {
    items: Vec<SkippedItem>,
    /// Items that are not listed.
    more: u64,
}

impl SkippedList {
    pub(super) fn push(&mut self, item: SkippedItem) {
        if self.items.len() < MAX_ITEMS {
            self.items.push(item);
        } else {
            self.more += item.count;
        }
    }

    pub(super) fn append(&mut self, other: Self) {
        for item in other.items {
            self.push(item);
        }
        self.more += other.more;
    }

    /// The same with another path instead of one that the items name.
    pub(super) fn moved(mut self, from: &Path, to: &Path) -> Self {
        for text in self
            .items
            .iter_mut()
            .flat_map(|item| [&mut item.place, &mut item.reason])
        {
            *text = moved_text(text, from, to);
        }
        self
    }

    /// How many items there are, also those that are not listed.
    pub(super) fn count(&self) -> u64 {
        self.more + self.items.iter().map(|item| item.count).sum::<u64>()
    }

    /// The first item.
    pub(super) fn first(&self) -> Option<&SkippedItem> {
        self.items.first()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// At most `most` items, and one for all others.
    pub(super) fn items(&self, most: usize) -> Vec<SkippedItem> {
        let (listed, others) = self.items.split_at(most.min(self.items.len()));
        let count = self.more + others.iter().map(|item| item.count).sum::<u64>();
        let others = (count > 0).then(|| SkippedItem {
            count,
            ..SkippedItem::new(
                "after these",
                &format!("{count} more items were left out; they are not listed"),
            )
        });
        listed.iter().cloned().chain(others).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endless_damage_is_counted_and_its_beginning_listed() {
        let mut list = SkippedList::default();
        let long = "ä".repeat(2000);
        (0..MAX_ITEMS + 5).for_each(|_| list.push(SkippedItem::new("line 1", &long)));
        let items = list.items(MAX_ITEMS);
        assert_eq!(items.len(), MAX_ITEMS + 1);
        assert_eq!(items.iter().map(|item| item.count).sum::<u64>(), MAX_ITEMS as u64 + 5);
        assert!(
            items
                .iter()
                .all(|item| item.reason.len() <= MAX_TEXT_BYTES + '…'.len_utf8())
        );
    }
}
