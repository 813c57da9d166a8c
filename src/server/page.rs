//! Parts of lists that are ordered by name or id.

use serde::Deserialize;

use super::error::ApiError;

/// Entries of a page, unless asked otherwise.
const DEFAULT: usize = 100;
/// Entries of a page at most.
const MOST: usize = 1000;

/// Which part of a list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
pub(super) struct Page {
    /// Only those after this one: the `next` of the page before.
    #[serde(default)]
    pub(super) after: String,
    /// How many at most, 1 to 1000; 100 unless given.
    #[serde(default)]
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
}

impl Page {
    /// How many at most. Errors: `Unprocessable` if it is out of range.
    pub(super) fn limit(&self) -> Result<usize, ApiError> {
        let limit = self.limit.unwrap_or(DEFAULT);
        if (1..=MOST).contains(&limit) {
            return Ok(limit);
        }
        Err(ApiError::Unprocessable(format!(
            "limit is {limit}; it must be 1 to {MOST}"
        )))
    }

    /// Of entries in their order, those of this page, and the last of them if more follow. Errors: as [`Page::limit`].
    pub(super) fn of<T>(
        &self,
        all: impl IntoIterator<Item = T>,
        key: impl Fn(&T) -> &str,
    ) -> Result<(Vec<T>, Option<String>), ApiError> {
        let limit = self.limit()?;
        let mut rest = all.into_iter().filter(|entry| key(entry) > self.after.as_str());
        let page: Vec<T> = rest.by_ref().take(limit).collect();
        let next = rest.next().and_then(|_| page.last().map(|last| key(last).to_owned()));
        Ok((page, next))
    }
}
