//! The effect of a client that sends and never reads on other robots.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use foreframe::server::protocol::OnLate;
use futures_util::SinkExt as _;
use tokio::net::TcpSocket;

use crate::process_usage::Process;
use crate::report::{Bounds, median};
use crate::robots::{RobotLoad, SendMode};
use crate::server::{Server, Target};
use crate::session;
use crate::workload::Workload;

/// Small, so that unread data waits in the server and not in this process.
const RECEIVE_BUFFER_BYTES: u32 = 4096;

#[derive(clap::Args)]
pub(crate) struct SlowReaderArgs {
    #[command(flatten)]
    target: Target,
    /// Number of sessions that read
    #[arg(long, default_value_t = 20)]
    sessions: usize,
    /// Frames per second of each session
    #[arg(long, default_value_t = 30.0)]
    rate_hz: f64,
    /// Frames per second of the client that never reads; 0 for as many as possible
    #[arg(long, default_value_t = 30.0)]
    slow_rate_hz: f64,
    /// How often to measure, in turn without and with that client
    #[arg(long, default_value_t = 3)]
    rounds: usize,
    /// Seconds of each measurement
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Seconds of warm-up before each measurement
    #[arg(long, default_value_t = 1.0)]
    warm_up_s: f64,
    /// Bound: increase of the 99th percentile with that client, as a share
    #[arg(long, default_value_t = 0.1)]
    p99_share: f64,
    /// Allowance for noise in ms, used if it is larger than the differences between the measurements without that client
    #[arg(long, default_value_t = 0.2)]
    noise_ms: f64,
    /// Bound: increase of the server's memory in MiB with that client
    #[arg(long, default_value_t = 20.0)]
    growth_mib: f64,
}

/// One measurement.
struct Round {
    p99_ms: f64,
    rss_mib: f64,
    unanswered: u64,
}

pub(crate) async fn run(args: &SlowReaderArgs, bounds: &mut Bounds) {
    let mut server = Server::start(&args.target, &[]).await;
    let workload = Arc::new(Workload::of(&args.target.model));
    let (mut alone, mut beside) = (Vec::new(), Vec::new());
    for _ in 0..args.rounds {
        alone.push(round(args, &server, &workload).await);
        let stuck = tokio::spawn(never_read(server.address, Arc::clone(&workload), args.slow_rate_hz));
        beside.push(round(args, &server, &workload).await);
        stuck.abort();
    }
    let list = |rounds: &[Round]| {
        let each: Vec<String> = rounds.iter().map(|round| format!("{:.2}", round.p99_ms)).collect();
        each.join(", ")
    };
    println!(
        "p99 from schedule of {} sessions without a slow reader: {} ms",
        args.sessions,
        list(&alone)
    );
    println!("with a slow reader: {} ms", list(&beside));
    let p99_ms = |rounds: &[Round]| median(rounds.iter().map(|round| round.p99_ms).collect());
    let (before_ms, after_ms) = (p99_ms(&alone), p99_ms(&beside));
    let noise_ms = alone.iter().map(|round| round.p99_ms).fold(0.0, f64::max)
        - alone.iter().map(|round| round.p99_ms).fold(f64::INFINITY, f64::min);
    let limit_ms = before_ms * (1.0 + args.p99_share) + noise_ms.max(args.noise_ms);
    let what = format!(
        "the median p99 is {after_ms:.2} ms, without the slow reader {before_ms:.2} ms; limit {limit_ms:.2} ms"
    );
    bounds.check(after_ms <= limit_ms, what);
    let lost: u64 = alone.iter().chain(&beside).map(|round| round.unanswered).sum();
    bounds.check(lost == 0, "every frame of the other sessions was predicted");
    let rss_mib = |rounds: &[Round]| rounds.iter().map(|round| round.rss_mib).fold(0.0, f64::max);
    let growth_mib = rss_mib(&beside) - alone.first().map_or(0.0, |round| round.rss_mib);
    let what = format!(
        "the server's memory grew by {growth_mib:.1} MiB; limit {} MiB",
        args.growth_mib
    );
    bounds.check(growth_mib <= args.growth_mib, what);
    server.check(bounds);
}

async fn round(args: &SlowReaderArgs, server: &Server, workload: &Arc<Workload>) -> Round {
    let load = RobotLoad {
        plan_samples: None,
        sessions: args.sessions,
        mode: SendMode::Scheduled(args.rate_hz),
        on_late: OnLate::Predict,
        warm_up: Duration::from_secs_f64(args.warm_up_s),
        measured: Duration::from_secs_f64(args.seconds),
    };
    let result = load.run(server, workload).await;
    Round {
        p99_ms: result.since_schedule().at_ms(0.99),
        rss_mib: Process::usage(&server.process).rss_mib,
        unanswered: result.counts.sent - result.counts.buffering - result.counts.answers.len() as u64,
    }
}

/// Sends and never reads; connects again after the server closes the stream.
async fn never_read(address: SocketAddr, workload: Arc<Workload>, rate_hz: f64) {
    let path = format!("/v1/models/{}/stream", workload.model());
    loop {
        let socket = TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(RECEIVE_BUFFER_BYTES).unwrap();
        let stream = socket.connect(address).await.unwrap();
        let mut socket = session::over(stream, address, &path).await.expect("the stream opens");
        let mut seq = 0;
        while socket.send(workload.frame(seq)).await.is_ok() {
            seq += 1;
            if rate_hz > 0.0 {
                tokio::time::sleep(Duration::from_secs_f64(1.0 / rate_hz)).await;
            }
        }
    }
}
