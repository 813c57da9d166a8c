//! The jobs there are, bounded. Pure: the time is an argument, in seconds since 1970.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;

use super::{Event, JobError, JobSpec, JobState};

/// How many jobs there may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TableLimits {
    /// Jobs that may wait.
    pub queued: usize,
    /// Ended jobs that are remembered; the oldest is forgotten first.
    pub ended: usize,
}

/// How far a job is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Progress {
    /// Units done: trials of a collection, steps of a training.
    pub done: u64,
    /// Units in all; 0 until it is known.
    pub total: u64,
    /// Units a second since this job, or the stage of its training, started.
    pub rate_per_s: Option<f64>,
    /// Seconds to go at that rate.
    pub remaining_s: Option<f64>,
    /// What is being done.
    pub message: String,
}

/// The latest losses of a training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Losses {
    /// On the training windows.
    pub train: Option<f64>,
    /// On the validation windows.
    pub validation: Option<f64>,
}

/// One job as it is now.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Job {
    /// Its id.
    pub id: String,
    /// Where it is on its way.
    pub state: JobState,
    /// What was asked for.
    pub spec: JobSpec,
    /// How far it is.
    pub progress: Progress,
    /// The latest losses, of a training.
    pub losses: Losses,
    /// Why it failed.
    pub error: Option<String>,
    /// Whether it was asked to stop and has not yet.
    pub cancelling: bool,
    /// When it was asked for, in seconds since 1970.
    pub queued_unix_s: f64,
    /// When it was taken up, in seconds since 1970.
    pub started_unix_s: Option<f64>,
    /// When it ended, in seconds since 1970.
    pub ended_unix_s: Option<f64>,
}

struct Entry {
    job: Job,
    cancelled: Arc<AtomicBool>,
    /// When the rate's measurement began, and the units that were there then, for example from a job that was cancelled.
    measured_from: Option<(f64, u64)>,
}

/// All jobs, in the order they were asked for.
pub struct JobTable {
    limits: TableLimits,
    next: u64,
    entries: BTreeMap<u64, Entry>,
}

impl JobTable {
    /// A table without jobs.
    #[must_use]
    pub fn new(limits: TableLimits) -> Self {
        Self {
            limits,
            next: 1,
            entries: BTreeMap::new(),
        }
    }

    /// Adds a job that waits. Errors: `QueueFull`; `Taken` if a job that has not ended makes the same thing.
    pub fn add(&mut self, spec: JobSpec, now_s: f64) -> Result<Job, JobError> {
        let queued = self
            .entries
            .values()
            .filter(|entry| entry.job.state == JobState::Queued);
        if queued.count() >= self.limits.queued {
            return Err(JobError::QueueFull {
                limit: self.limits.queued,
            });
        }
        let mut open = self.entries.values().filter(|entry| !entry.job.state.is_final());
        if open.any(|entry| entry.job.spec.makes() == spec.makes()) {
            let (kind, name) = spec.makes();
            return Err(JobError::Taken {
                kind,
                name: name.to_owned(),
                why: "is being made by another job",
            });
        }
        let number = self.next;
        self.next += 1;
        let job = Job {
            id: format!("job-{number}"),
            state: JobState::Queued,
            spec,
            progress: Progress::default(),
            losses: Losses::default(),
            error: None,
            cancelling: false,
            queued_unix_s: now_s,
            started_unix_s: None,
            ended_unix_s: None,
        };
        let entry = Entry {
            job: job.clone(),
            cancelled: Arc::new(AtomicBool::new(false)),
            measured_from: None,
        };
        self.entries.insert(number, entry);
        Ok(job)
    }

    /// Every job, the newest first.
    pub fn all(&self) -> impl Iterator<Item = &Job> {
        self.entries.values().rev().map(|entry| &entry.job)
    }

    /// One job. Errors: `Unknown`.
    pub fn get(&self, id: &str) -> Result<&Job, JobError> {
        Ok(&self.entry(id)?.1.job)
    }

    /// Takes up the job that has waited longest: its id, what it is to do, and the flag that says to stop.
    pub fn start_next(&mut self, now_s: f64) -> Option<(String, JobSpec, Arc<AtomicBool>)> {
        let mut entries = self.entries.values_mut();
        let entry = entries.find(|entry| entry.job.state == JobState::Queued)?;
        entry.job.state = entry.job.state.after(Event::Start)?;
        entry.job.started_unix_s = Some(now_s);
        Some((
            entry.job.id.clone(),
            entry.job.spec.clone(),
            Arc::clone(&entry.cancelled),
        ))
    }

    /// Asks a job to stop: one that waits ends now, one that runs at its next checkpoint.
    /// Errors: `Unknown`, `IllegalTransition` if it has ended.
    pub fn cancel(&mut self, id: &str, now_s: f64) -> Result<Job, JobError> {
        let (_, entry) = self.entry(id)?;
        match entry.job.state {
            JobState::Running => {
                entry.cancelled.store(true, Ordering::Release);
                let (_, entry) = self.entry_mut(id)?;
                entry.job.cancelling = true;
            }
            _ => self.end(id, Event::Cancel, None, now_s)?,
        }
        self.get(id).cloned()
    }

    /// Notes how far a running job is; of one that does not run nothing is noted.
    pub fn note_progress(&mut self, id: &str, (done, total): (u64, u64), message: &str, now_s: f64) {
        let Ok((_, entry)) = self.entry_mut(id) else { return };
        if entry.job.state != JobState::Running {
            return;
        }
        let (from_s, before) = *entry.measured_from.get_or_insert((now_s, done));
        let (gained, elapsed_s) = (done.saturating_sub(before) as f64, now_s - from_s);
        let rate = (gained > 0.0 && elapsed_s > 0.0).then(|| gained / elapsed_s);
        entry.job.progress = Progress {
            done,
            total,
            rate_per_s: rate,
            remaining_s: rate.map(|rate| total.saturating_sub(done) as f64 / rate),
            message: message.to_owned(),
        };
    }

    /// Measures the rate anew, for a stage whose units take another time.
    pub fn note_stage(&mut self, id: &str) {
        if let Ok((_, entry)) = self.entry_mut(id) {
            entry.measured_from = None;
        }
    }

    /// Notes the latest losses; those not given keep their last value.
    pub fn note_losses(&mut self, id: &str, losses: Losses) {
        if let Ok((_, entry)) = self.entry_mut(id) {
            let known = entry.job.losses;
            entry.job.losses = Losses {
                train: losses.train.or(known.train),
                validation: losses.validation.or(known.validation),
            };
        }
    }

    /// Ends a job. Errors: `Unknown`, `IllegalTransition`.
    pub fn end(&mut self, id: &str, event: Event, error: Option<String>, now_s: f64) -> Result<(), JobError> {
        let (_, entry) = self.entry_mut(id)?;
        let state = entry.job.state;
        entry.job.state = state.after(event).ok_or_else(|| JobError::IllegalTransition {
            id: id.to_owned(),
            state,
            event,
        })?;
        entry.job.cancelling = false;
        entry.job.error = error;
        entry.job.ended_unix_s = Some(now_s);
        entry.job.progress.remaining_s = None;
        self.forget_oldest();
        Ok(())
    }

    fn forget_oldest(&mut self) {
        let ended: Vec<u64> = self
            .entries
            .iter()
            .filter(|(_, entry)| entry.job.state.is_final())
            .map(|(&number, _)| number)
            .collect();
        for number in &ended[..ended.len().saturating_sub(self.limits.ended)] {
            self.entries.remove(number);
        }
    }

    fn entry(&self, id: &str) -> Result<(u64, &Entry), JobError> {
        number(id)
            .and_then(|number| Some((number, self.entries.get(&number)?)))
            .ok_or_else(|| JobError::Unknown { id: id.to_owned() })
    }

    fn entry_mut(&mut self, id: &str) -> Result<(u64, &mut Entry), JobError> {
        number(id)
            .and_then(|number| Some((number, self.entries.get_mut(&number)?)))
            .ok_or_else(|| JobError::Unknown { id: id.to_owned() })
    }
}

fn number(id: &str) -> Option<u64> {
    id.strip_prefix("job-")?.parse().ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::CollectSpec;
    use super::*;

    const LIMITS: TableLimits = TableLimits { queued: 2, ended: 3 };

    fn collect(name: &str) -> JobSpec {
        JobSpec::Collect(CollectSpec {
            name: name.to_owned(),
            scenario: "static-observer".to_owned(),
            trials: 4,
            seed: 0,
        })
    }

    #[test]
    fn a_table_takes_no_more_than_its_limit_of_waiting_jobs() {
        let mut table = JobTable::new(LIMITS);
        table.add(collect("a"), 0.0).unwrap();
        table.add(collect("b"), 0.0).unwrap();
        assert!(matches!(
            table.add(collect("c"), 0.0),
            Err(JobError::QueueFull { limit: 2 })
        ));
        table.start_next(1.0).unwrap();
        table.add(collect("c"), 1.0).unwrap();
    }

    #[test]
    fn two_jobs_cannot_make_the_same_data_set() {
        let mut table = JobTable::new(LIMITS);
        table.add(collect("a"), 0.0).unwrap();
        assert!(matches!(table.add(collect("a"), 0.0), Err(JobError::Taken { .. })));
    }

    #[test]
    fn rate_and_time_left_count_only_what_this_job_did() {
        let mut table = JobTable::new(LIMITS);
        let id = table.add(collect("a"), 0.0).unwrap().id;
        table.start_next(10.0).unwrap();
        table.note_progress(&id, (100, 200), "", 10.0);
        table.note_progress(&id, (120, 200), "", 20.0);
        let progress = &table.get(&id).unwrap().progress;
        assert_eq!((progress.rate_per_s, progress.remaining_s), (Some(2.0), Some(40.0)));
    }

    #[test]
    fn cancelling_a_running_job_raises_its_flag_and_lets_it_end_itself() {
        let mut table = JobTable::new(LIMITS);
        let id = table.add(collect("a"), 0.0).unwrap().id;
        let (_, _, flag) = table.start_next(1.0).unwrap();
        let job = table.cancel(&id, 2.0).unwrap();
        assert!(flag.load(Ordering::Acquire) && job.cancelling && job.state == JobState::Running);
        table.end(&id, Event::Cancel, None, 3.0).unwrap();
        let error = table.cancel(&id, 4.0).unwrap_err();
        assert_eq!(
            error.to_string(),
            "job job-1 has been cancelled; it cannot be cancelled any more"
        );
    }

    proptest! {
        #[test]
        fn whatever_is_asked_the_table_keeps_its_bounds(steps in proptest::collection::vec((0u8..4, 0usize..12), 0..60)) {
            let mut table = JobTable::new(LIMITS);
            for (time, (step, which)) in steps.into_iter().enumerate() {
                let id = table.all().nth(which).map_or_else(|| "job-0".to_owned(), |job| job.id.clone());
                let now_s = time as f64;
                match step {
                    0 => drop(table.add(collect(&format!("n{time}")), now_s)),
                    1 => drop(table.start_next(now_s)),
                    2 => drop(table.cancel(&id, now_s)),
                    _ => drop(table.end(&id, Event::Succeed, None, now_s)),
                }
                prop_assert!(table.all().filter(|job| job.state == JobState::Queued).count() <= LIMITS.queued);
                prop_assert!(table.all().filter(|job| job.state.is_final()).count() <= LIMITS.ended);
                prop_assert!(table.all().all(|job| job.state.is_final() == job.ended_unix_s.is_some()));
            }
        }
    }
}
