//! The states of a job and the transitions between them, as a pure function.

use std::fmt;

use foreframe_core::named_enum;
use serde::{Deserialize, Serialize};

named_enum! {
    /// The state of a job.
    #[derive(Serialize, Deserialize, utoipa::ToSchema)]
    #[serde(rename_all = "snake_case")]
    pub enum JobState {
        /// Waits for a worker.
        Queued = "queued",
        /// A worker runs it.
        Running = "running",
        /// Ended with its result.
        Succeeded = "succeeded",
        /// Ended with an error.
        Failed = "failed",
        /// Ended by request.
        Cancelled = "cancelled",
    }
    else |text| -> String {
        let known = Self::ALL.map(Self::name).join(", ");
        format!("there is no state \"{}\"; there are: {known}", text.escape_default())
    }
}

/// An event that changes a job's state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JobTransition {
    /// A runner claims it.
    Start,
    /// The work is done.
    Succeed,
    /// The work failed.
    Fail,
    /// The work was stopped by request.
    Cancel,
    /// The runner stopped before the work was done; the job goes back to the queue.
    Release,
    /// The job is enqueued again by request.
    Resume,
}

impl JobState {
    /// The state after the event, or `None` if the event is not legal in this state.
    #[must_use]
    pub fn after(self, event: JobTransition) -> Option<Self> {
        match (self, event) {
            (Self::Queued, JobTransition::Start) => Some(Self::Running),
            (Self::Running, JobTransition::Succeed) => Some(Self::Succeeded),
            (Self::Running, JobTransition::Fail) => Some(Self::Failed),
            (Self::Queued | Self::Running, JobTransition::Cancel) => Some(Self::Cancelled),
            (Self::Running, JobTransition::Release) | (Self::Failed | Self::Cancelled, JobTransition::Resume) => {
                Some(Self::Queued)
            }
            _ => None,
        }
    }

    /// Whether the job has ended.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }
}

impl JobTransition {
    /// What it does to a job, and the states in which it is legal, for error messages.
    fn texts(self) -> [&'static str; 2] {
        match self {
            Self::Start => ["start", "queued"],
            Self::Succeed => ["succeed", "running"],
            Self::Fail => ["fail", "running"],
            Self::Cancel => ["be cancelled", "queued or running"],
            Self::Release => ["be released", "running"],
            Self::Resume => ["be resumed", "failed or cancelled"],
        }
    }

    /// The states in which it is legal, for error messages.
    #[must_use]
    pub fn allowed_states(self) -> &'static str {
        let [_, states] = self.texts();
        states
    }
}

impl fmt::Display for JobTransition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [event, _] = self.texts();
        f.pad(event)
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
        JobTransition::Release,
        JobTransition::Resume,
    ];

    proptest! {
        #[test]
        fn only_a_resume_leaves_a_final_state(events in proptest::collection::vec(0usize..6, 0..24)) {
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
    fn a_state_is_parsed_from_its_name() {
        for state in JobState::ALL {
            assert_eq!(state.name().parse(), Ok(state));
            assert_eq!(serde_json::to_value(state).unwrap(), state.name());
        }
    }
}
