//! The states of a job and the steps between them, as a pure function.

use std::fmt;

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
pub enum Event {
    /// The runner takes it up.
    Start,
    /// The work is done.
    Succeed,
    /// The work ended with an error.
    Fail,
    /// The work ended before its end because that was asked.
    Cancel,
}

impl JobState {
    /// The state after the event, or `None` where the event cannot happen in this state.
    #[must_use]
    pub fn after(self, event: Event) -> Option<Self> {
        match (self, event) {
            (Self::Queued, Event::Start) => Some(Self::Running),
            (Self::Running, Event::Succeed) => Some(Self::Succeeded),
            (Self::Running, Event::Fail) => Some(Self::Failed),
            (Self::Queued | Self::Running, Event::Cancel) => Some(Self::Cancelled),
            _ => None,
        }
    }

    /// Whether nothing can happen to it any more.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
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

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Start => "start",
            Self::Succeed => "succeed",
            Self::Fail => "fail",
            Self::Cancel => "be cancelled",
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const EVENTS: [Event; 4] = [Event::Start, Event::Succeed, Event::Fail, Event::Cancel];

    proptest! {
        #[test]
        fn a_final_state_never_changes_and_success_needs_a_start(events in proptest::collection::vec(0usize..4, 0..12)) {
            let (mut state, mut started) = (JobState::Queued, false);
            for event in events.into_iter().map(|i| EVENTS[i]) {
                match state.after(event) {
                    Some(next) => {
                        prop_assert!(!state.is_final());
                        prop_assert_ne!(next, state);
                        started |= next == JobState::Running;
                        state = next;
                    }
                    None => prop_assert!(state.is_final() || event != Event::Cancel),
                }
                if matches!(state, JobState::Succeeded | JobState::Failed) {
                    prop_assert!(started);
                }
            }
        }
    }
}
