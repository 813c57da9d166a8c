//! The id of a job.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The id of a job, `job-1` for the first one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct JobId(i64);

/// A text that is no job's id.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("\"{}\" is not a job id; an example of one is job-12", .0.escape_default())]
pub struct JobIdError(pub String);

impl JobId {
    /// The id of the job of that number, from 1.
    #[must_use]
    pub const fn new(number: i64) -> Self {
        Self(number)
    }

    /// The job's number, by which the database knows it.
    pub(super) const fn number(self) -> i64 {
        self.0
    }
}

impl fmt::Display for JobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "job-{}", self.0)
    }
}

impl FromStr for JobId {
    type Err = JobIdError;

    fn from_str(text: &str) -> Result<Self, JobIdError> {
        text.strip_prefix("job-")
            .filter(|digits| digits.bytes().all(|byte| byte.is_ascii_digit()))
            .and_then(|digits| digits.parse().ok())
            .map(Self)
            .ok_or_else(|| JobIdError(text.to_owned()))
    }
}

impl TryFrom<String> for JobId {
    type Error = JobIdError;

    fn try_from(text: String) -> Result<Self, JobIdError> {
        text.parse()
    }
}

impl From<JobId> for String {
    fn from(id: JobId) -> Self {
        id.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_is_read_as_it_is_written() {
        assert_eq!("job-12".parse(), Ok(JobId::new(12)));
        assert_eq!(JobId::new(12).to_string(), "job-12");
        for text in [
            "12",
            "job-",
            "job--1",
            "job-+1",
            "job-1a",
            "job-9223372036854775808",
            "Job-1",
        ] {
            assert!(text.parse::<JobId>().is_err(), "{text}");
        }
    }
}
