//! Robots that stream at a fixed frame rate.

use std::sync::Arc;
use std::time::Duration;

use foreframe::server::protocol::OnLate;

use crate::report::Bounds;
use crate::robots::{RobotLoad, RobotLoadResult, SendMode};
use crate::server::{Server, Target};
use crate::workload::Workload;

/// Relative precision of the search.
const FIND_PRECISION: f64 = 0.05;

#[derive(clap::Args)]
pub(crate) struct StreamArgs {
    #[command(flatten)]
    target: Target,
    /// Concurrent sessions; with --find, the number to start with, which must keep the bound
    #[arg(long, default_value_t = 16)]
    sessions: usize,
    /// Frames per second of each session
    #[arg(long, default_value_t = 30.0)]
    rate_hz: f64,
    /// Seconds to measure
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Seconds of warm-up before the measurement
    #[arg(long, default_value_t = 2.0)]
    warm_up_s: f64,
    /// Bound: 99th percentile of the latency from schedule to prediction
    #[arg(long, default_value_t = 33.0)]
    p99_ms: f64,
    /// Search for the largest number of sessions that keeps the bound
    #[arg(long)]
    find: bool,
    /// Largest number of sessions to try
    #[arg(long, default_value_t = 512, requires = "find")]
    find_max: usize,
}

pub(crate) async fn run(args: &StreamArgs, bounds: &mut Bounds) {
    let capacity = if args.find { args.find_max } else { args.sessions } + 1;
    let settings = [
        ("max_streams", capacity),
        ("max_sessions", capacity),
        ("max_connections", 2 * capacity),
        ("max_queued_predictions", 4 * capacity),
    ];
    let mut server = Server::start(&args.target, &settings).await;
    let workload = Arc::new(Workload::of(&args.target.model));
    if args.find {
        find(args, &server, &workload, bounds).await;
    } else {
        let result = args.load(args.sessions).run(&server, &workload).await;
        report(args, &result);
        let p99_ms = result.since_schedule().at_ms(0.99);
        bounds.check(
            p99_ms <= args.p99_ms,
            format!("p99 from schedule within {} ms", args.p99_ms),
        );
        bounds.check(all_predicted(&result), "every frame was predicted");
    }
    println!(
        "peak memory of the server: {:.0} MiB",
        server.process.usage().peak_rss_mib
    );
    server.check(bounds);
}

impl StreamArgs {
    fn load(&self, sessions: usize) -> RobotLoad {
        RobotLoad {
            plan_samples: None,
            sessions,
            mode: SendMode::Scheduled(self.rate_hz),
            on_late: OnLate::Predict,
            warm_up: Duration::from_secs_f64(self.warm_up_s),
            measured: Duration::from_secs_f64(self.seconds),
        }
    }
}

fn all_predicted(result: &RobotLoadResult) -> bool {
    let counts = &result.counts;
    counts.overloaded + counts.refused + counts.dropped + counts.unanswered() == 0 && !counts.answers.is_empty()
}

fn report(args: &StreamArgs, result: &RobotLoadResult) {
    let (counts, from_schedule) = (&result.counts, result.since_schedule());
    println!(
        "{} sessions at {} Hz for {} s: {} frames sent, {} predicted, {} of them measured; {} refused, {} dropped, {} \
         unanswered",
        args.sessions,
        args.rate_hz,
        args.seconds,
        counts.sent,
        counts.answers.len(),
        from_schedule.len(),
        counts.overloaded + counts.refused,
        counts.dropped,
        counts.unanswered()
    );
    println!("from schedule to prediction: {from_schedule}");
    let from_sending = result.latencies(|answer| answer.received - answer.sent);
    println!("from sending to prediction:  {from_sending}");
    println!(
        "time in the model:           {}",
        result.latencies(|answer| answer.compute)
    );
    let beyond = result.latencies(|answer| (answer.received - answer.sent).saturating_sub(answer.compute));
    println!("time outside the model:      {beyond}");
    println!(
        "the server uses {:.0} % of a core, this program {:.0} %",
        result.server_cpu, result.own_cpu
    );
}

/// Doubles the number of sessions until the bound fails, then bisects. A failed number is tried a second time.
async fn find(args: &StreamArgs, server: &Server, workload: &Arc<Workload>, bounds: &mut Bounds) {
    let (mut passed, mut failed, mut sessions) = (0, None, args.sessions.clamp(1, args.find_max));
    loop {
        let holds = passes(args, sessions, server, workload).await || passes(args, sessions, server, workload).await;
        if holds {
            passed = sessions;
        } else {
            failed = Some(sessions);
        }
        sessions = match failed {
            None if passed == args.find_max => break,
            None => (2 * passed).min(args.find_max),
            Some(failed) if (failed - passed) as f64 <= (FIND_PRECISION * passed as f64).max(1.0) => break,
            Some(failed) => usize::midpoint(passed, failed),
        };
    }
    println!(
        "{passed} sessions at {} Hz keep p99 within {} ms",
        args.rate_hz, args.p99_ms
    );
    bounds.check(passed >= args.sessions, format!("at least {} sessions", args.sessions));
}

async fn passes(args: &StreamArgs, sessions: usize, server: &Server, workload: &Arc<Workload>) -> bool {
    let result = args.load(sessions).run(server, workload).await;
    let latencies = result.since_schedule();
    println!(
        "{sessions} sessions: {latencies}; {} of {} frames not predicted; the server uses {:.0} % of a core",
        result.counts.sent - result.counts.buffering - result.counts.answers.len() as u64,
        result.counts.sent,
        result.server_cpu
    );
    all_predicted(&result) && latencies.at_ms(0.99) <= args.p99_ms
}
