//! The states of a job and the steps between them, as a pure function.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Where a job is on its way.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for the jobs before it.
    Queued,
    /// Is being worked on.
    Running,
    /// Ended with what was asked for.
    Succeeded,
    /// Ended with an error.
    Failed,
    /// Ended because someone asked it to.
    Cancelled,
}

/// What can happen to a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobTransition {
    /// A runner takes it up.
    Start,
    /// The work is done.
    Succeed,
    /// The work ended with an error.
    Fail,
    /// The work ended before its end because that was asked.
    Cancel,
    /// The runner stopped; another, or the same at its next start, goes on.
    Leave,
    /// Someone wants it to go on after all.
    Resume,
}

impl JobState {
    /// Every state.
    pub const ALL: [Self; 5] = [
        Self::Queued,
        Self::Running,
        Self::Succeeded,
        Self::Failed,
        Self::Cancelled,
    ];

    /// The state after the event, or `None` where the event cannot happen in this state.
    #[must_use]
    pub fn after(self, event: JobTransition) -> Option<Self> {
        match (self, event) {
            (Self::Queued, JobTransition::Start) => Some(Self::Running),
            (Self::Running, JobTransition::Succeed) => Some(Self::Succeeded),
            (Self::Running, JobTransition::Fail) => Some(Self::Failed),
            (Self::Queued | Self::Running, JobTransition::Cancel) => Some(Self::Cancelled),
            (Self::Running, JobTransition::Leave) | (Self::Failed | Self::Cancelled, JobTransition::Resume) => {
                Some(Self::Queued)
            }
            _ => None,
        }
    }

    /// Whether nothing more happens to it by itself.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// Its name on the wire and in the store.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }
}

impl JobTransition {
    /// Of which jobs it may be said.
    #[must_use]
    pub fn whose(self) -> &'static str {
        match self {
            Self::Start => "waits",
            Self::Succeed | Self::Fail | Self::Leave => "runs",
            Self::Cancel => "waits or runs",
            Self::Resume => "failed or was cancelled",
        }
    }
}

impl FromStr for JobState {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|state| state.name() == text).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            format!("\"{}\" is no state; there are: {known}", text.escape_default())
        })
    }
}

impl fmt::Display for JobState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Queued => "not started",
            Self::Running => "started",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "been cancelled",
        })
    }
}

impl fmt::Display for JobTransition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Start => "start",
            Self::Succeed => "succeed",
            Self::Fail => "fail",
            Self::Cancel => "be cancelled",
            Self::Leave => "be left",
            Self::Resume => "be resumed",
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const EVENTS: [JobTransition; 6] = [
        JobTransition::Start,
        JobTransition::Succeed,
        JobTransition::Fail,
        JobTransition::Cancel,
        JobTransition::Leave,
        JobTransition::Resume,
    ];

    proptest! {
        #[test]
        fn success_is_for_ever_and_only_a_resume_leaves_another_end(events in proptest::collection::vec(0usize..6, 0..24)) {
            let (mut state, mut started) = (JobState::Queued, false);
            for event in events.into_iter().map(|i| EVENTS[i]) {
                if let Some(next) = state.after(event) {
                    prop_assert_ne!(state, JobState::Succeeded);
                    prop_assert!(!state.is_final() || event == JobTransition::Resume);
                    prop_assert_ne!(next, state);
                    started |= next == JobState::Running;
                    state = next;
                } else {
                    prop_assert!(state.is_final() || event != JobTransition::Cancel);
                }
                if matches!(state, JobState::Succeeded | JobState::Failed) {
                    prop_assert!(started);
                }
            }
        }
    }

    #[test]
    fn a_state_is_read_by_the_name_it_is_written_with() {
        for state in JobState::ALL {
            assert_eq!(state.name().parse(), Ok(state));
            assert_eq!(serde_json::to_value(state).unwrap(), state.name());
        }
    }
}
