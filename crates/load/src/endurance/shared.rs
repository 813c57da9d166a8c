//! What the parts of an endurance run share: the server's address and keys, whether the server is up, what was acknowledged,
//! and what went wrong.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

use super::supervisor::Supervisor;
use crate::http::{Http, Request, Response};
use crate::workload::Workload;

/// Pause before a refused or unanswered request is sent again.
const RETRY_PERIOD: Duration = Duration::from_millis(500);

/// The state of an endurance run.
pub(super) struct EnduranceRun {
    pub(super) address: SocketAddr,
    /// A key of scope `admin`.
    pub(super) admin_key: String,
    /// A key of scope `predict`, for the robots and the hostile clients.
    pub(super) robot_key: String,
    pub(super) data_dir: PathBuf,
    /// The arguments that name the store.
    pub(super) store_arguments: Vec<String>,
    pub(super) workload: Workload,
    pub(super) availability: Availability,
    pub(super) ledger: Mutex<Ledger>,
    /// When the robots, the clients and the hostile part end; set once.
    end: OnceLock<Instant>,
    counts: Mutex<BTreeMap<&'static str, AnswerCounts>>,
    faults: Mutex<BTreeMap<String, u64>>,
}

/// Counts the changes between up and down: even while the server is up.
#[derive(Default)]
pub(super) struct Availability(AtomicU64);

impl Availability {
    /// The server goes down, or it is up again.
    pub(super) fn change(&self) {
        self.0.fetch_add(1, Ordering::SeqCst);
    }

    pub(super) fn now(&self) -> u64 {
        self.0.load(Ordering::SeqCst)
    }

    /// Whether the server has been up since `then`.
    pub(super) fn was_up_since(&self, then: u64) -> bool {
        then.is_multiple_of(2) && self.now() == then
    }
}

/// The changes that the server acknowledged.
#[derive(Default)]
pub(super) struct Ledger {
    /// The ids of the jobs, by idempotency key.
    pub(super) jobs: BTreeMap<String, String>,
    pub(super) deleted_datasets: BTreeSet<String>,
    pub(super) deleted_versions: BTreeSet<u64>,
    /// The version that was activated last.
    pub(super) active_version: Option<u64>,
    pub(super) keys: Vec<CreatedKey>,
}

/// An API key that `foreframe keys create` printed.
pub(super) struct CreatedKey {
    pub(super) text: String,
    pub(super) is_revoked: bool,
}

impl CreatedKey {
    /// Its public part.
    pub(super) fn id(&self) -> &str {
        self.text.split('_').nth(1).expect("a key has an id")
    }
}

/// How the requests of one part of the load ended.
#[derive(Clone, Copy, Default)]
pub(super) struct AnswerCounts {
    pub(super) answered: u64,
    /// 429 and 503 that say when to try again.
    pub(super) refused: u64,
    /// Not answered because the server was killed.
    pub(super) unanswered: u64,
}

impl EnduranceRun {
    pub(super) fn new(supervisor: &Supervisor, workload: Workload) -> Self {
        Self {
            workload,
            address: supervisor.address,
            data_dir: supervisor.data_dir.clone(),
            store_arguments: supervisor.store_arguments.clone(),
            admin_key: String::new(),
            robot_key: String::new(),
            end: OnceLock::new(),
            availability: Availability::default(),
            ledger: Mutex::default(),
            counts: Mutex::default(),
            faults: Mutex::default(),
        }
    }

    pub(super) fn end_at(&self, end: Instant) {
        self.end.set(end).expect("the end is set once");
    }

    pub(super) fn end(&self) -> Instant {
        *self.end.get().expect("the end is set before the load starts")
    }

    pub(super) fn is_over(&self) -> bool {
        Instant::now() >= self.end()
    }

    /// Records something that must not happen.
    pub(super) fn fault(&self, what: impl Into<String>) {
        let what = what.into();
        let mut faults = self.faults.lock().unwrap();
        let count = faults.entry(what.clone()).or_default();
        *count += 1;
        if *count == 1 {
            println!("  FAULT: {what}");
        }
    }

    /// What must not happen and did, with counts.
    pub(super) fn faults(&self) -> BTreeMap<String, u64> {
        self.faults.lock().unwrap().clone()
    }

    pub(super) fn counts(&self) -> BTreeMap<&'static str, AnswerCounts> {
        self.counts.lock().unwrap().clone()
    }

    pub(super) fn count(&self, part: &'static str, count: impl FnOnce(&mut AnswerCounts)) {
        count(self.counts.lock().unwrap().entry(part).or_default());
    }
}

/// A client of one part of the load.
pub(super) struct RunClient<'a> {
    run: &'a EnduranceRun,
    http: Http,
    /// The server's availability when the client was made.
    since: u64,
    part: &'static str,
}

impl<'a> RunClient<'a> {
    pub(super) fn new(run: &'a EnduranceRun, part: &'static str) -> Self {
        Self {
            run,
            part,
            http: Http::new(run.address),
            since: run.availability.now(),
        }
    }

    /// Sends a request with the admin key and counts the answer. `None` if the server was killed meanwhile. Other missing
    /// answers and server errors are faults.
    pub(super) async fn ask(&mut self, request: &Request) -> Option<Response> {
        let before = self.run.availability.now();
        if before != self.since {
            // The kept connection was to a server that was killed.
            (self.http, self.since) = (Http::new(self.run.address), before);
        }
        let answer = self.http.ask(&request.clone().with_key(&self.run.admin_key)).await;
        match answer {
            Ok(answer) => {
                let is_refusal = answer.is_refusal();
                if answer.status >= 500 && !is_refusal {
                    self.run
                        .fault(format!("{}: {} {}", self.part, answer.status, detail(&answer)));
                }
                self.run.count(self.part, |counts| {
                    *if is_refusal {
                        &mut counts.refused
                    } else {
                        &mut counts.answered
                    } += 1;
                });
                Some(answer)
            }
            Err(error) => {
                if self.run.availability.was_up_since(before) {
                    self.run
                        .fault(format!("{}: no answer from a running server: {error}", self.part));
                }
                self.run.count(self.part, |counts| counts.unanswered += 1);
                None
            }
        }
    }

    /// Sends a request until it is neither refused nor unanswered.
    pub(super) async fn until_answered(&mut self, request: &Request) -> Response {
        loop {
            match self.ask(request).await {
                Some(answer) if !answer.is_refusal() => return answer,
                _ => tokio::time::sleep(RETRY_PERIOD).await,
            }
        }
    }

    /// Records an answer with a status that the part does not expect.
    pub(super) fn expect(&self, answer: &Response, statuses: &[u16]) -> bool {
        let is_expected = statuses.contains(&answer.status);
        if !is_expected && answer.status < 500 {
            self.run
                .fault(format!("{}: {} {}", self.part, answer.status, detail(answer)));
        }
        is_expected
    }
}

/// The reason in a refusal.
fn detail(answer: &Response) -> String {
    let problem: Option<serde_json::Value> = serde_json::from_slice(&answer.body).ok();
    problem.map_or_else(|| answer.text(), |problem| problem["detail"].to_string())
}
