//! What a job's work says of itself between two writes to the store. Pure: the time is an argument, in seconds since 1970.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::store::LossRow;

/// Lines and points that wait for the next write, at most; the oldest go first.
const MAX_WAITING: usize = 1000;

/// How far a job is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct JobProgress {
    /// Units done: trials of a collection, steps of a training, windows of an evaluation.
    pub done: u64,
    /// Units in all; 0 until it is known.
    pub total: u64,
    /// Units a second since the job, or the stage of its training, was taken up.
    pub rate_per_s: Option<f64>,
    /// Seconds to go at that rate.
    pub remaining_s: Option<f64>,
    /// What is being done.
    pub message: String,
}

/// The latest losses of a training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Losses {
    /// On the training windows.
    pub train: Option<f64>,
    /// On the validation windows.
    pub validation: Option<f64>,
}

/// What the store keeps of a job's progress.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct StoredProgress {
    /// How far it is.
    pub progress: JobProgress,
    /// The latest losses.
    pub losses: Losses,
}

/// The notes of a job that runs.
#[derive(Debug, Default)]
pub(super) struct JobProgressLog {
    standing: StoredProgress,
    lines: VecDeque<(f64, String)>,
    points: VecDeque<LossRow>,
    /// When the rate's measurement began, and the units that were there then, for example from a checkpoint.
    measured_from: Option<(f64, u64)>,
}

impl JobProgressLog {
    /// Goes on from what the store kept.
    pub(super) fn new(standing: StoredProgress) -> Self {
        Self {
            standing,
            ..Self::default()
        }
    }

    /// Notes units done of a total, and what is being done.
    pub(super) fn progress(&mut self, (done, total): (u64, u64), message: &str, now_s: f64) {
        let (from_s, before) = *self.measured_from.get_or_insert((now_s, done));
        let (gained, elapsed_s) = (done.saturating_sub(before) as f64, now_s - from_s);
        let rate = (gained > 0.0 && elapsed_s > 0.0).then(|| gained / elapsed_s);
        self.standing.progress = JobProgress {
            done,
            total,
            rate_per_s: rate,
            remaining_s: rate.map(|rate| total.saturating_sub(done) as f64 / rate),
            message: message.to_owned(),
        };
    }

    /// Measures the rate anew, for a stage whose units take another time.
    pub(super) fn stage(&mut self) {
        self.measured_from = None;
    }

    /// Notes the latest losses; those not given keep their last value.
    pub(super) fn losses(&mut self, losses: Losses) {
        let known = self.standing.losses;
        self.standing.losses = Losses {
            train: losses.train.or(known.train),
            validation: losses.validation.or(known.validation),
        };
    }

    /// Adds a line to the log.
    pub(super) fn line(&mut self, line: String, now_s: f64) {
        push(&mut self.lines, (now_s, line));
    }

    /// Adds a point to the loss curves.
    pub(super) fn point(&mut self, point: LossRow) {
        push(&mut self.points, point);
    }

    /// How far it is.
    pub(super) fn standing(&self) -> &StoredProgress {
        &self.standing
    }

    /// The lines and points since the last call.
    pub(super) fn take(&mut self) -> (Vec<(f64, String)>, Vec<LossRow>) {
        (self.lines.drain(..).collect(), self.points.drain(..).collect())
    }

    /// Puts back what could not be written, before what came since.
    pub(super) fn restore_unwritten(&mut self, lines: Vec<(f64, String)>, points: Vec<LossRow>) {
        let later = (std::mem::take(&mut self.lines), std::mem::take(&mut self.points));
        lines
            .into_iter()
            .chain(later.0)
            .for_each(|line| push(&mut self.lines, line));
        points
            .into_iter()
            .chain(later.1)
            .for_each(|point| push(&mut self.points, point));
    }
}

fn push<T>(waiting: &mut VecDeque<T>, item: T) {
    if waiting.len() == MAX_WAITING {
        waiting.pop_front();
    }
    waiting.push_back(item);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_and_time_left_count_only_what_this_run_did() {
        let mut notes = JobProgressLog::default();
        notes.progress((100, 200), "", 10.0);
        notes.progress((120, 200), "", 20.0);
        let progress = &notes.standing().progress;
        assert_eq!((progress.rate_per_s, progress.remaining_s), (Some(2.0), Some(40.0)));
    }

    #[test]
    fn what_could_not_be_written_comes_before_what_came_since() {
        let mut notes = JobProgressLog::default();
        notes.line("one".to_owned(), 1.0);
        let (lines, points) = notes.take();
        notes.line("two".to_owned(), 2.0);
        notes.restore_unwritten(lines, points);
        let (lines, _) = notes.take();
        assert_eq!(lines, [(1.0, "one".to_owned()), (2.0, "two".to_owned())]);
    }

    #[test]
    fn a_store_that_cannot_be_reached_does_not_fill_the_memory() {
        let mut notes = JobProgressLog::default();
        (0..5000).for_each(|i| notes.line(i.to_string(), 0.0));
        let (lines, _) = notes.take();
        assert_eq!((lines.len(), lines[0].1.as_str()), (MAX_WAITING, "4000"));
    }
}
