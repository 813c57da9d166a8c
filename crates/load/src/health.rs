//! Latencies of health checks and streams while a training uses every core.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use foreframe::server::protocol::OnLate;
use serde_json::{Value, json};
use tokio::runtime::Handle;
use tokio::sync::mpsc;

use crate::http::{Http, Request};
use crate::report::{Bounds, Latencies};
use crate::robots::{RobotLoad, SendMode};
use crate::schedule::{Schedule, Tick};
use crate::server::{Server, Target};
use crate::workload::Workload;

const TRIALS: u64 = 40;
const POLL: Duration = Duration::from_millis(100);
/// How long a job may take to reach the expected state.
const JOB_LIMIT: Duration = Duration::from_mins(2);
/// Time before the measurement, so that all loads run at the same time.
const WARM_UP: Duration = Duration::from_millis(500);

#[derive(clap::Args)]
pub(crate) struct HealthArgs {
    #[command(flatten)]
    target: Target,
    /// Number of streams
    #[arg(long, default_value_t = 4)]
    sessions: usize,
    /// Frames per second of each stream
    #[arg(long, default_value_t = 30.0)]
    rate_hz: f64,
    /// Health checks per second, half of them on new connections
    #[arg(long, default_value_t = 100.0)]
    checks_hz: f64,
    /// Seconds to measure, first without and then with the training
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Threads of the training; default: one per core
    #[arg(long)]
    job_threads: Option<usize>,
    /// Bound: 99th percentile of the health checks' latency from schedule
    #[arg(long, default_value_t = 10.0)]
    livez_p99_ms: f64,
    /// Bound: 99th percentile of the latency from schedule to prediction
    #[arg(long, default_value_t = 33.0)]
    p99_ms: f64,
}

/// Latencies of the health checks, and the failures.
#[derive(Clone, Default)]
struct Checks {
    new_connection: Vec<Duration>,
    kept_alive: Vec<Duration>,
    faults: Vec<String>,
}

pub(crate) async fn run(args: &HealthArgs, bounds: &mut Bounds) {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let mut server = Server::start(&args.target, &[("job_threads", args.job_threads.unwrap_or(cores))]).await;
    let workload = Arc::new(Workload::of(&args.target.model));
    let mut http = Http::new(server.address);
    println!("without a training:");
    measure(args, &server, &workload).await;
    let collected = post(&mut http, &collect()).await;
    until(&mut http, &collected, |job| job["state"] == "succeeded").await;
    let training = post(&mut http, &train()).await;
    until(&mut http, &training, |job| job["progress"]["done"].as_u64() > Some(0)).await;
    println!("during a training:");
    let (livez_p99_ms, p99_ms, faults) = measure(args, &server, &workload).await;
    let job = http.expect(200, &Request::get(&training)).await.json();
    bounds.check(
        job["state"] == "running",
        "the training ran during the whole measurement",
    );
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
        format!("every health check and every frame was answered; faults: {faults:?}"),
    );
    server.check(bounds);
}

pub(crate) fn collect() -> Value {
    json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": TRIALS})
}

/// A training of the paper's model with too many steps to end during the measurement.
fn train() -> Value {
    let settings = json!({"data": {"windows": 200, "validation_windows": 32}, "sequence": {"steps": 1_000_000}});
    json!({"kind": "train", "name": "endless", "preset": "paper", "dataset": "seen", "settings": settings})
}

/// Creates a job and returns its path.
pub(crate) async fn post(http: &mut Http, job: &Value) -> String {
    let created = http.expect(202, &Request::json("/v1/jobs", job)).await.json();
    format!("/v1/jobs/{}", created["id"].as_str().expect("a job has an id"))
}

pub(crate) async fn until(http: &mut Http, path: &str, holds: impl Fn(&Value) -> bool) {
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

/// The 99th percentiles of health checks and of streams in milliseconds, and the faults.
async fn measure(args: &HealthArgs, server: &Server, workload: &Arc<Workload>) -> (f64, f64, Vec<String>) {
    let load = RobotLoad {
        plan_samples: None,
        sessions: args.sessions,
        mode: SendMode::Scheduled(args.rate_hz),
        on_late: OnLate::Predict,
        warm_up: WARM_UP,
        measured: Duration::from_secs_f64(args.seconds),
    };
    let (result, checks) = tokio::join!(load.run(server, workload), check(args, server.address));
    let (from_schedule, counts) = (result.since_schedule(), &result.counts);
    let (fresh, kept) = (Latencies::of(checks.new_connection), Latencies::of(checks.kept_alive));
    println!("  /livez on new connections:      {fresh}");
    println!("  /livez on a kept-alive one:     {kept}");
    println!("  {} streams at {} Hz: {from_schedule}", args.sessions, args.rate_hz);
    println!(
        "  delay of this program itself:   {}",
        result.latencies(|answer| answer.sent - answer.scheduled)
    );
    println!("  the server uses {:.0} % of a core", result.server_cpu);
    let mut faults = checks.faults;
    let predicted = counts.answers.len() as u64 + counts.buffering;
    faults.extend((predicted != counts.sent).then(|| format!("{predicted} of {} frames predicted", counts.sent)));
    (
        fresh.at_ms(0.99).max(kept.at_ms(0.99)),
        from_schedule.at_ms(0.99),
        faults,
    )
}

/// Sends scheduled health checks, in turn on new connections and on a kept-alive one.
async fn check(args: &HealthArgs, address: SocketAddr) -> Checks {
    let checks = Arc::new(Mutex::new(Checks::default()));
    let time = WARM_UP + Duration::from_secs_f64(args.seconds);
    let schedule = Schedule::lasting(Instant::now(), args.checks_hz, time);
    let (due, mut of_kept) = mpsc::channel::<Tick>(schedule.count as usize + 1);
    let (runtime, of_fresh) = (Handle::current(), Arc::clone(&checks));
    schedule.start(move |tick| {
        if tick.index % 2 == 0 {
            due.try_send(tick).expect("the channel has room for every tick");
        } else {
            let checks = Arc::clone(&of_fresh);
            runtime.spawn(async move {
                let took = live(&mut Http::new(address), tick).await;
                checks.lock().unwrap().note(took, |checks| &mut checks.new_connection);
            });
        }
    });
    let mut http = Http::new(address);
    while let Some(tick) = of_kept.recv().await {
        let took = live(&mut http, tick).await;
        checks.lock().unwrap().note(took, |checks| &mut checks.kept_alive);
    }
    // Wait for the last checks on new connections; those that are still open are counted as missing below.
    tokio::time::sleep(WARM_UP).await;
    let mut checks = checks.lock().unwrap().clone();
    let missing = schedule.count as usize - checks.new_connection.len() - checks.kept_alive.len() - checks.faults.len();
    checks
        .faults
        .extend((missing > 0).then(|| format!("{missing} health checks without an answer")));
    checks
}

/// Sends a health check and returns its latency from schedule, or what went wrong.
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
