//! How quickly the server answers while a training takes every core.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use foreframe::server::protocol::OnLate;
use serde_json::{Value, json};
use tokio::runtime::Handle;
use tokio::sync::mpsc;

use crate::report::{Bounds, Latencies};
use crate::robots::{SendMode, RobotLoad};
use crate::http::{Http, Request};
use crate::workload::Workload;
use crate::schedule::{Schedule, Tick};
use crate::server::{Server, Target};

const TRIALS: u64 = 40;
const POLL: Duration = Duration::from_millis(100);
/// How long a job may take until it does what it is for.
const JOB_LIMIT: Duration = Duration::from_mins(2);
/// Before the measurement, so that both load at once.
const WARM_UP: Duration = Duration::from_millis(500);

#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    target: Target,
    /// Streams beside the health checks
    #[arg(long, default_value_t = 4)]
    sessions: usize,
    /// Frames a second of each stream
    #[arg(long, default_value_t = 30.0)]
    rate_hz: f64,
    /// Health checks a second, half of them on new connections
    #[arg(long, default_value_t = 100.0)]
    checks_hz: f64,
    /// How long to measure, without the training and with it
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Threads of the training; default: one for each core
    #[arg(long)]
    job_threads: Option<usize>,
    /// Bound of the health checks' 99th percentile from schedule
    #[arg(long, default_value_t = 10.0)]
    livez_p99_ms: f64,
    /// Bound of the frames' 99th percentile from schedule
    #[arg(long, default_value_t = 33.0)]
    p99_ms: f64,
}

/// How long health checks took, or that one was not answered with 200.
#[derive(Clone, Default)]
struct Checks {
    fresh: Vec<Duration>,
    kept: Vec<Duration>,
    faults: Vec<String>,
}

pub(crate) async fn run(args: &Args, bounds: &mut Bounds) {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut server = Server::start(&args.target, &[("job_threads", args.job_threads.unwrap_or(cores))]).await;
    let workload = Arc::new(Workload::of(&args.target.model));
    let mut http = Http::new(server.address);
    println!("without a job:");
    measure(args, &server, &workload).await;
    let collected = post(&mut http, &collect()).await;
    until(&mut http, &collected, |job| job["state"] == "succeeded").await;
    let training = post(&mut http, &train()).await;
    until(&mut http, &training, |job| job["progress"]["done"].as_u64() > Some(0)).await;
    println!("beside a training:");
    let (livez_p99_ms, p99_ms, faults) = measure(args, &server, &workload).await;
    let job = http.expect(200, &Request::get(&training)).await.json();
    bounds.check(job["state"] == "running", "the training ran all the time");
    http.expect(202, &Request::json(&format!("{training}/cancel"), &Value::Null))
        .await;
    bounds.check(
        livez_p99_ms <= args.livez_p99_ms,
        format!("p99 of /livez within {} ms", args.livez_p99_ms),
    );
    bounds.check(
        p99_ms <= args.p99_ms,
        format!("p99 of the streams within {} ms", args.p99_ms),
    );
    bounds.check(
        faults.is_empty(),
        format!("every health check and every frame was answered {faults:?}"),
    );
    server.check(bounds);
}

fn collect() -> Value {
    json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": TRIALS})
}

/// A training of the paper's model that does not end.
fn train() -> Value {
    let settings = json!({"data": {"windows": 200, "validation_windows": 32}, "fit": {"steps": 1_000_000}});
    json!({"kind": "train", "name": "endless", "preset": "paper", "dataset": "seen", "settings": settings})
}

/// The path of the job that was usage.
async fn post(http: &mut Http, job: &Value) -> String {
    let usage = http.expect(202, &Request::json("/v1/jobs", job)).await.json();
    format!("/v1/jobs/{}", usage["id"].as_str().expect("a job"))
}

async fn until(http: &mut Http, path: &str, holds: impl Fn(&Value) -> bool) {
    let since = Instant::now();
    loop {
        let job = http.expect(200, &Request::get(path)).await.json();
        if holds(&job) {
            return;
        }
        let is_active = job["state"] == "queued" || job["state"] == "running";
        assert!(is_active && since.elapsed() < JOB_LIMIT, "{job}");
        tokio::time::sleep(POLL).await;
    }
}

/// The 99th percentiles of health checks and of streams in milliseconds, and what went wrong.
async fn measure(args: &Args, server: &Server, workload: &Arc<Workload>) -> (f64, f64, Vec<String>) {
    let load = RobotLoad {
        sessions: args.sessions,
        mode: SendMode::Scheduled(args.rate_hz),
        on_late: OnLate::Predict,
        warm_up: WARM_UP,
        measured: Duration::from_secs_f64(args.seconds),
    };
    let (result, checks) = tokio::join!(load.run(server, workload), check(args, server.address));
    let (from_schedule, counts) = (result.since_schedule(), &result.counts);
    let (fresh, kept) = (Latencies::of(checks.fresh), Latencies::of(checks.kept));
    println!("  /livez on new connections:  {fresh}");
    println!("  /livez on one that is kept: {kept}");
    println!("  {} streams at {} Hz: {from_schedule}", args.sessions, args.rate_hz);
    println!(
        "  this program was late by:   {}",
        result.latencies(|answer| answer.sent - answer.scheduled)
    );
    println!("  the server takes {:.0} % of a core", result.server_cpu);
    let mut faults = checks.faults;
    let predicted = counts.answers.len() as u64 + counts.buffering;
    faults.extend((predicted != counts.sent).then(|| format!("{predicted} of {} frames predicted", counts.sent)));
    (
        fresh.at_ms(0.99).max(kept.at_ms(0.99)),
        from_schedule.at_ms(0.99),
        faults,
    )
}

/// Health checks at times, on new connections and on one that is kept by turns.
async fn check(args: &Args, address: SocketAddr) -> Checks {
    let checks = Arc::new(Mutex::new(Checks::default()));
    let time = WARM_UP + Duration::from_secs_f64(args.seconds);
    let schedule = Schedule::lasting(Instant::now(), args.checks_hz, time);
    let (due, mut of_kept) = mpsc::channel::<Tick>(schedule.count as usize + 1);
    let (runtime, of_fresh) = (Handle::current(), Arc::clone(&checks));
    schedule.start(move |tick| {
        if tick.index % 2 == 0 {
            due.try_send(tick).expect("room for every tick");
        } else {
            let checks = Arc::clone(&of_fresh);
            runtime.spawn(async move {
                let took = live(&mut Http::new(address), tick).await;
                checks.lock().unwrap().note(took, |checks| &mut checks.fresh);
            });
        }
    });
    let mut http = Http::new(address);
    while let Some(tick) = of_kept.recv().await {
        let took = live(&mut http, tick).await;
        checks.lock().unwrap().note(took, |checks| &mut checks.kept);
    }
    // The last ones on new connections; those that are not there by then are missed below.
    tokio::time::sleep(WARM_UP).await;
    let mut checks = checks.lock().unwrap().clone();
    let missing = schedule.count as usize - checks.fresh.len() - checks.kept.len() - checks.faults.len();
    checks
        .faults
        .extend((missing > 0).then(|| format!("{missing} health checks without an answer")));
    checks
}

/// How long the server took to say that it lives.
async fn live(http: &mut Http, tick: Tick) -> Result<Duration, String> {
    match http.ask(&Request::get("/livez")).await {
        Ok(answer) if answer.status == 200 => Ok(tick.scheduled.elapsed()),
        Ok(answer) => Err(format!("{} {}", answer.status, answer.text())),
        Err(error) => Err(format!("no answer: {error}")),
    }
}

impl Checks {
    fn note(&mut self, took: Result<Duration, String>, of: impl Fn(&mut Self) -> &mut Vec<Duration>) {
        match took {
            Ok(took) => of(self).push(took),
            Err(fault) => self.faults.push(fault),
        }
    }
}
