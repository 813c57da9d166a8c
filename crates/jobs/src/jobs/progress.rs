//! Buffers the report of a running job between two writes to the store. The time is an argument, in seconds since 1970.

use std::collections::VecDeque;

use metrics::gauge;
use serde::{Deserialize, Serialize};

use crate::store::LossRow;
use foreframe_core::metric_names;

/// How many lines and points are buffered at most; the oldest are dropped first.
const MAX_WAITING: usize = 1000;
/// The shortest time that a rate is computed from, in seconds.
const MIN_MEASURED_S: f64 = 1.0;

/// How much of a job is done.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct JobProgress {
    /// Units done: trials of a collection, frames of an import, steps of a training, windows of an evaluation.
    pub done: u64,
    /// Units in total; 0 until it is known.
    pub total: u64,
    /// Units per second in this attempt, or in this stage of a training.
    pub rate_per_s: Option<f64>,
    /// Seconds left at that rate.
    pub remaining_s: Option<f64>,
    /// What the job is doing, or what it waits for.
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

/// A job's progress as the store keeps it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct StoredProgress {
    /// How much is done.
    pub progress: JobProgress,
    /// The latest losses.
    pub losses: Losses,
}

/// A part of a job's report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum ReportEvent {
    /// Units done, their total, and what the job is doing.
    Progress(u64, u64, String),
    /// A stage with units of another duration starts.
    Stage,
    /// The latest losses.
    Losses(Losses),
    /// What the job waits for; `None` once it goes on.
    Waiting(Option<String>),
    /// A line for the log.
    Line(String),
    /// A point of the loss curves.
    Point(LossRow),
    /// Units that are saved.
    Checkpoint(u64),
}

/// The part of a running job's report that is not yet written to the store.
#[derive(Debug, Default)]
pub(super) struct ReportBuffer {
    stored: StoredProgress,
    lines: VecDeque<(f64, String)>,
    points: VecDeque<LossRow>,
    /// When the rate measurement started, and how many units were done then, for example in an earlier attempt.
    measured_from: Option<(f64, u64)>,
    /// Units that are saved.
    checkpoint: u64,
    /// How often something new was reported.
    changes: u64,
    /// What the job did before it began to wait.
    before_wait: Option<String>,
}

impl ReportBuffer {
    /// Continues from the stored progress.
    pub(super) fn new(stored: StoredProgress) -> Self {
        Self {
            stored,
            ..Self::default()
        }
    }

    /// Adds an event.
    pub(super) fn apply(&mut self, event: ReportEvent, now_s: f64) {
        match event {
            ReportEvent::Progress(done, total, message) => self.set_progress(done, total, message, now_s),
            ReportEvent::Stage => self.measured_from = None,
            ReportEvent::Losses(losses) => {
                for (split, loss) in [("train", losses.train), ("validation", losses.validation)] {
                    if let Some(loss) = loss {
                        gauge!(metric_names::TRAINING_LOSS, "split" => split).set(loss);
                    }
                }
                // A loss that is `None` keeps its last value.
                let last = &mut self.stored.losses;
                last.train = losses.train.or(last.train);
                last.validation = losses.validation.or(last.validation);
            }
            ReportEvent::Waiting(message) => self.set_waiting(message),
            ReportEvent::Line(line) => {
                self.changes += 1;
                push(&mut self.lines, (now_s, line));
            }
            ReportEvent::Point(point) => {
                self.changes += 1;
                push(&mut self.points, point);
            }
            ReportEvent::Checkpoint(units) => {
                self.changes += u64::from(units > self.checkpoint);
                self.checkpoint = self.checkpoint.max(units);
            }
        }
    }

    fn set_waiting(&mut self, message: Option<String>) {
        let progress = &mut self.stored.progress;
        let Some(message) = message else {
            if let Some(before) = self.before_wait.take() {
                progress.message = before;
            }
            return;
        };
        progress.remaining_s = None;
        let before = std::mem::replace(&mut progress.message, message);
        self.before_wait.get_or_insert(before);
    }

    fn set_progress(&mut self, done: u64, total: u64, message: String, now_s: f64) {
        self.before_wait = None;
        let last = &self.stored.progress;
        // Without a total nothing is measured yet; fewer units than before belong to new work.
        if total == 0 || total != last.total || done < last.done {
            self.measured_from = None;
        }
        let (from_s, before) = *self.measured_from.get_or_insert((now_s, done));
        let (gained, elapsed_s) = (done.saturating_sub(before) as f64, now_s - from_s);
        let rate = (gained > 0.0 && elapsed_s >= MIN_MEASURED_S).then(|| gained / elapsed_s);
        if (last.done, last.total, &last.message) != (done, total, &message) {
            self.changes += 1;
        }
        self.stored.progress = JobProgress {
            done,
            total,
            rate_per_s: rate,
            remaining_s: rate.map(|rate| total.saturating_sub(done) as f64 / rate),
            message,
        };
    }

    /// A number that grows whenever the job reports something new.
    pub(super) fn changes(&self) -> u64 {
        self.changes
    }

    /// How many units are saved, as far as this attempt knows.
    pub(super) fn saved(&self) -> u64 {
        self.checkpoint
    }

    /// The progress to store.
    pub(super) fn stored(&self) -> &StoredProgress {
        &self.stored
    }

    /// Removes and returns the buffered lines and points.
    pub(super) fn drain(&mut self) -> (Vec<(f64, String)>, Vec<LossRow>) {
        (self.lines.drain(..).collect(), self.points.drain(..).collect())
    }

    /// Puts back what could not be written, before what was added since.
    pub(super) fn restore_unwritten(&mut self, lines: Vec<(f64, String)>, points: Vec<LossRow>) {
        prepend(&mut self.lines, lines);
        prepend(&mut self.points, points);
    }
}

fn push<T>(waiting: &mut VecDeque<T>, item: T) {
    if waiting.len() == MAX_WAITING {
        waiting.pop_front();
    }
    waiting.push_back(item);
}

fn prepend<T>(waiting: &mut VecDeque<T>, items: Vec<T>) {
    let later = std::mem::replace(waiting, items.into());
    for item in later {
        push(waiting, item);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl ReportBuffer {
        fn progress(&mut self, done: u64, total: u64, message: &str, now_s: f64) {
            self.apply(ReportEvent::Progress(done, total, message.to_owned()), now_s);
        }

        fn line(&mut self, line: &str, now_s: f64) {
            self.apply(ReportEvent::Line(line.to_owned()), now_s);
        }

        fn checkpoint(&mut self, units: u64) {
            self.apply(ReportEvent::Checkpoint(units), 0.0);
        }
    }

    #[test]
    fn rate_and_time_left_count_only_this_attempt() {
        let mut buffer = ReportBuffer::default();
        buffer.progress(100, 200, "", 10.0);
        buffer.progress(120, 200, "", 20.0);
        let progress = &buffer.stored().progress;
        assert_eq!((progress.rate_per_s, progress.remaining_s), (Some(2.0), Some(40.0)));
    }

    #[test]
    fn a_resumed_attempt_measures_no_earlier_work() {
        let mut buffer = ReportBuffer::default();
        buffer.progress(0, 0, "reading the data set", 0.0);
        buffer.progress(500, 1000, "sequence", 10.0);
        assert_eq!(buffer.stored().progress.rate_per_s, None);
        buffer.progress(501, 1000, "sequence", 10.001);
        assert_eq!(buffer.stored().progress.rate_per_s, None);
        buffer.progress(520, 1000, "sequence", 20.0);
        assert_eq!(buffer.stored().progress.rate_per_s, Some(2.0));
    }

    #[test]
    fn a_repeated_report_is_no_progress() {
        let mut buffer = ReportBuffer::default();
        buffer.progress(1, 9, "sequence", 1.0);
        buffer.checkpoint(1);
        let reported = buffer.changes();
        buffer.progress(1, 9, "sequence", 2.0);
        buffer.checkpoint(1);
        assert_eq!(buffer.changes(), reported);
        buffer.progress(2, 9, "sequence", 3.0);
        buffer.line("a line", 4.0);
        assert_eq!(buffer.changes(), reported + 2);
    }

    #[test]
    fn a_waiting_job_says_for_what_until_it_goes_on() {
        let mut buffer = ReportBuffer::default();
        let message = |buffer: &ReportBuffer| buffer.stored().progress.message.clone();
        buffer.progress(1, 9, "sequence", 1.0);
        buffer.apply(ReportEvent::Waiting(Some("waiting for the disk".to_owned())), 2.0);
        assert_eq!(message(&buffer), "waiting for the disk");
        buffer.apply(ReportEvent::Waiting(None), 3.0);
        assert_eq!(message(&buffer), "sequence");
        // What was reported meanwhile stays.
        buffer.apply(ReportEvent::Waiting(Some("waiting for the disk".to_owned())), 4.0);
        buffer.progress(2, 9, "evaluation", 5.0);
        buffer.apply(ReportEvent::Waiting(None), 6.0);
        assert_eq!(message(&buffer), "evaluation");
    }

    #[test]
    fn unwritten_lines_come_before_later_ones() {
        let mut buffer = ReportBuffer::default();
        buffer.line("one", 1.0);
        let (lines, points) = buffer.drain();
        buffer.line("two", 2.0);
        buffer.restore_unwritten(lines, points);
        let (lines, _) = buffer.drain();
        assert_eq!(lines, [(1.0, "one".to_owned()), (2.0, "two".to_owned())]);
    }

    #[test]
    fn the_buffer_is_bounded_while_the_store_is_unreachable() {
        let mut buffer = ReportBuffer::default();
        (0..5000).for_each(|i| buffer.line(&i.to_string(), 0.0));
        let (lines, _) = buffer.drain();
        assert_eq!((lines.len(), lines[0].1.as_str()), (MAX_WAITING, "4000"));
    }
}
