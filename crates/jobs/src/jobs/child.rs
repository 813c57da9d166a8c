//! Each job of the program runs in a child process, so that a job that runs out of memory or aborts does not stop the
//! server. The parent keeps the lease, writes the reports and the outcome. The child does the work and writes its report as
//! lines of JSON to standard output. Closing the child's standard input cancels its work.

use std::io::{BufRead as _, BufReader, Write as _};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use futures_util::future::BoxFuture;
use serde::{Deserialize, Serialize};

use super::executor::{JobExecutor, JobFailure, JobResult};
use super::pipeline::{JobResources, Pipeline};
use super::progress::ReportEvent;
use super::report::{JobReporter, ReportTarget};
use super::retry_policy::RetryPolicy;
use super::{JobError, JobSpec};
use crate::store::{Lease, Store, StoreConfig};
use crate::versions::Versions;
use foreframe_core::nn::{device, precision};

/// The subcommand of the child process.
pub const COMMAND: &str = "run-job";
/// How often the parent checks whether the job was cancelled.
const POLL_EVERY: Duration = Duration::from_millis(20);
/// A cancelled child that has not stopped after this time is killed.
const CANCEL_GRACE: Duration = Duration::from_secs(8);
/// The format of log lines, which a child needs before it reads its order.
pub const LOG_FORMAT: &str = "FOREFRAME_LOG_FORMAT";
/// After how many milliseconds the allocator gives freed memory back; -1: never.
const PURGE_DELAY: &str = "MIMALLOC_PURGE_DELAY";

/// How to start the child processes of jobs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobProcess {
    /// This program.
    pub program: PathBuf,
    /// The store.
    pub store: StoreConfig,
    /// The directory of the shipped models.
    pub models_dir: PathBuf,
    /// What a job can use.
    pub resources: JobResources,
    /// The format of its log lines: `text` or `json`.
    pub log_format: String,
}

/// What the parent writes to the child's standard input, in one line.
#[derive(Serialize, Deserialize)]
struct JobOrder {
    process: JobProcess,
    lease: Lease,
    spec: JobSpec,
}

/// A line that the child writes to its standard output.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum ChildMessage {
    Report(ReportEvent),
    Result(Result<JobResult, JobFailure>),
}

/// Runs jobs in child processes, or in this process if `process` is `None`.
#[must_use]
pub fn executor(pipeline: Pipeline, process: Option<JobProcess>) -> Arc<dyn JobExecutor> {
    match process {
        Some(process) => Arc::new(ChildExecutor { pipeline, process }),
        None => Arc::new(pipeline),
    }
}

/// Runs each job in a child process.
struct ChildExecutor {
    /// Checks submitted jobs.
    pipeline: Pipeline,
    process: JobProcess,
}

impl JobExecutor for ChildExecutor {
    fn check<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<JobSpec, JobError>> {
        self.pipeline.check(spec)
    }

    fn check_again<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<(), JobError>> {
        self.pipeline.check_again(spec)
    }

    fn execute(&self, spec: &JobSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure> {
        let mut child = self.spawn().map_err(|error| crashed("could not start", &error))?;
        let result = self.communicate(&mut child, spec, report, cancelled);
        if result.is_err() {
            // It has ended already, unless the communication with it failed.
            let _ = child.kill();
        }
        let status = child.wait().map_err(|error| crashed("could not wait for", &error))?;
        match result? {
            Some(result) => result,
            None if cancelled.load(Ordering::Acquire) => Err(JobFailure::Cancelled),
            None => Err(ended_without_result(status)),
        }
    }
}

impl ChildExecutor {
    fn spawn(&self) -> std::io::Result<Child> {
        let mut command = Command::new(&self.process.program);
        command
            .arg(COMMAND)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // The allocator must not reserve more memory than the limit at its start.
            .env("MIMALLOC_ARENA_EAGER_COMMIT", "0")
            .env(LOG_FORMAT, &self.process.log_format);
        // A job keeps freed memory until it ends: the next step of a training needs it again.
        if std::env::var_os(PURGE_DELAY).is_none() {
            command.env(PURGE_DELAY, "-1");
        }
        #[cfg(unix)]
        {
            // Ctrl-C in a terminal goes to the whole process group. The parent alone tells the child to stop.
            use std::os::unix::process::CommandExt as _;
            command.process_group(0);
        }
        command.spawn()
    }

    /// Sends the order, passes the reports on, and returns the result; `None` if the child ended without one.
    fn communicate(
        &self,
        child: &mut Child,
        spec: &JobSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<Option<Result<JobResult, JobFailure>>, JobFailure> {
        let (Some(mut stdin), Some(stdout)) = (child.stdin.take(), child.stdout.take()) else {
            let reason = "the job's process has no standard streams";
            return Err(JobFailure::Crashed(reason.to_owned()));
        };
        let failed = |error: std::io::Error| crashed("could not send its order to", &error);
        let order = JobOrder {
            process: self.process.clone(),
            lease: report.lease(),
            spec: spec.clone(),
        };
        let order = json_line(&order).map_err(failed)?;
        match stdin.write_all(&order) {
            // The exit status of a child that ended before it read its order says why.
            Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => return Ok(None),
            sent => sent.map_err(failed)?,
        }
        let report = report.clone();
        let reader = std::thread::spawn(move || {
            let mut result = None;
            for line in BufReader::new(stdout).lines().map_while(Result::ok) {
                match serde_json::from_str(&line) {
                    Ok(ChildMessage::Report(event)) => report.apply(event),
                    Ok(ChildMessage::Result(ended)) => result = Some(ended),
                    Err(error) => tracing::warn!(%error, line, "a job's process wrote an unknown line"),
                }
            }
            result
        });
        wait(child, stdin, &|| reader.is_finished(), cancelled);
        reader
            .join()
            .map_err(|_| JobFailure::Failed("the reader of the job's report panicked".to_owned()))
    }
}

/// Waits for the end of the child's output. Closes its standard input when the job is cancelled, and kills it if it does not
/// stop then.
fn wait(child: &mut Child, stdin: ChildStdin, has_ended: &dyn Fn() -> bool, cancelled: &AtomicBool) {
    let (mut stdin, mut cancelled_at) = (Some(stdin), None::<Instant>);
    while !has_ended() {
        if cancelled.load(Ordering::Acquire) {
            drop(stdin.take());
            if cancelled_at.get_or_insert_with(Instant::now).elapsed() > CANCEL_GRACE {
                // It ends with its process; the next attempt resumes from its last checkpoint.
                let _ = child.kill();
            }
        }
        std::thread::sleep(POLL_EVERY);
    }
}

fn crashed(action: &str, error: &dyn std::error::Error) -> JobFailure {
    JobFailure::Crashed(format!("{action} the job's process: {error}"))
}

fn ended_without_result(status: ExitStatus) -> JobFailure {
    #[cfg(unix)]
    if let Some(signal) = std::os::unix::process::ExitStatusExt::signal(&status) {
        return JobFailure::Crashed(format!(
            "the job's process was killed by signal {signal} (out of memory?); the server's log can say more"
        ));
    }
    JobFailure::Failed(format!(
        "the job's process ended with {status}; the server's log says why"
    ))
}

/// The child process: reads its order from standard input, does the work and writes its report to standard output.
/// Errors: a sentence, if there is no order.
pub fn run() -> Result<(), String> {
    let mut line = String::new();
    let read = std::io::stdin().lock().read_line(&mut line);
    if read.map_err(|error| error.to_string())? == 0 {
        return Err("run-job is started by the server, which sends it the job".to_owned());
    }
    let order: JobOrder = serde_json::from_str(&line).map_err(|error| error.to_string())?;
    limit(order.process.resources.memory.limit_mib);
    let resources = &order.process.resources;
    let chosen = device::choose(resources.device).and_then(|()| precision::choose(resources.precision));
    chosen.map_err(|error| error.to_string())?;
    let cancelled = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&cancelled);
    std::thread::spawn(move || {
        // The parent writes nothing more. It closes the stream, or the stream closes with the parent.
        let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
        flag.store(true, Ordering::Release);
    });
    let target = ReportTarget::Stdout(|event, out| write_line(out, &ChildMessage::Report(event)));
    let report = JobReporter::new(order.lease, target);
    let result = work(&order, &report, &cancelled).unwrap_or_else(|reason| Err(JobFailure::Crashed(reason)));
    write_line(&mut std::io::stdout(), &ChildMessage::Result(result)).map_err(|error| error.to_string())
}

fn work(
    order: &JobOrder,
    report: &JobReporter,
    cancelled: &AtomicBool,
) -> Result<Result<JobResult, JobFailure>, String> {
    let JobProcess {
        store,
        models_dir,
        resources,
        ..
    } = &order.process;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(|error| error.to_string())?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(resources.threads)
        .thread_name(|index| format!("jobs-{index}"))
        .build()
        .map_err(|error| error.to_string())?;
    let retry = RetryPolicy {
        runtime: runtime.handle(),
        report,
        cancelled,
    };
    let store = match retry.run(async || Store::open_existing(store).await) {
        Ok(store) => store,
        Err(JobFailure::Failed(reason)) => return Err(reason),
        Err(failure) => return Ok(Err(failure)),
    };
    let _entered = runtime.enter();
    let versions = Versions::new(store.clone(), models_dir);
    let pipeline = Pipeline::new(store, versions, resources.clone());
    Ok(pool.install(|| pipeline.execute(&order.spec, report, cancelled)))
}

fn write_line(out: &mut dyn std::io::Write, message: &ChildMessage) -> std::io::Result<()> {
    out.write_all(&json_line(message)?)?;
    out.flush()
}

fn json_line(value: &impl Serialize) -> std::io::Result<Vec<u8>> {
    let mut line = serde_json::to_vec(value)?;
    line.push(b'\n');
    Ok(line)
}

/// Limits this process's memory, and ends it with its parent. Only on Linux.
fn limit(memory_mib: u64) {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Resource, Rlimit, Signal, set_parent_process_death_signal, setrlimit};
        if let Err(error) = set_parent_process_death_signal(Some(Signal::KILL)) {
            tracing::warn!(%error, "a job's process can outlive the server");
        }
        let bytes = (memory_mib > 0).then_some(memory_mib << 20);
        let (current, maximum) = (bytes, bytes);
        if let (Some(_), Err(error)) = (bytes, setrlimit(Resource::Data, Rlimit { current, maximum })) {
            tracing::warn!(%error, "could not limit the memory of a job");
        }
    }
    #[cfg(not(target_os = "linux"))]
    let _ = memory_mib;
}
