//! Pages of lists that are ordered by name or id.

use serde::Deserialize;

use super::problem::ApiError;

/// Entries of a page by default.
pub(in crate::server) const DEFAULT_LIMIT: usize = 100;
/// The maximum number of entries of a page.
pub(in crate::server) const MAX_LIMIT: usize = 1000;

/// Which page of a list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
pub(in crate::server) struct Page {
    /// Only entries after this one: the `next` of the previous page.
    #[serde(default)]
    pub(in crate::server) after: String,
    /// The maximum number of entries, 1 to 1000. Default: 100.
    #[serde(default)]
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
}

impl Page {
    /// The maximum number of entries. Errors: `Unprocessable` if it is out of range.
    pub(in crate::server) fn limit(&self) -> Result<usize, ApiError> {
        checked_limit(self.limit, DEFAULT_LIMIT)
    }

    /// Takes sorted entries; returns this page, and the key of its last entry if more follow. Errors: as [`Page::limit`].
    pub(in crate::server) fn of<T>(
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

/// Shortens `limit + 1` entries to `limit`. Also gives the key of the last entry kept, if there are more.
pub(in crate::server) fn cut<T, K>(mut entries: Vec<T>, limit: usize, key: impl Fn(&T) -> K) -> (Vec<T>, Option<K>) {
    let has_more = entries.len() > limit;
    entries.truncate(limit);
    let next = entries.last().filter(|_| has_more).map(key);
    (entries, next)
}

/// The maximum number of entries of a page. Errors: `Unprocessable` if it is out of range.
pub(in crate::server) fn checked_limit(limit: Option<usize>, default: usize) -> Result<usize, ApiError> {
    let limit = limit.unwrap_or(default);
    if (1..=MAX_LIMIT).contains(&limit) {
        return Ok(limit);
    }
    Err(ApiError::Unprocessable(format!(
        "limit is {limit}; it must be 1 to {MAX_LIMIT}"
    )))
}
