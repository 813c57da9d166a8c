//! More than the server can do.

mod rest;
mod streams;

use std::time::Duration;

use crate::report::Bounds;
use crate::process_usage::Process;
use crate::server::{Server, Target};

/// How often memory is looked at.
const SAMPLE_PERIOD: Duration = Duration::from_millis(200);
/// Memory is compared between the first and the last of so many parts: of five minutes, a minute each.
const PARTS: usize = 5;

#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    target: Target,
    /// What is asked too much of
    #[arg(long, value_enum, default_value_t = Over::Both)]
    over: Over,
    /// How long each of three loads is measured whose best is the peak
    #[arg(long, default_value_t = 3.0)]
    peak_s: f64,
    /// How long to overload
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// How many times the peak is offered
    #[arg(long, default_value_t = 2.0)]
    times: f64,
    /// Bound: goodput as a share of the peak
    #[arg(long, default_value_t = 0.9)]
    goodput_share: f64,
    /// Bound: memory of the last fifth of the time over that of the first
    #[arg(long, default_value_t = 10.0)]
    growth_mb: f64,
    /// Frames that newer ones have overtaken are not predicted from (`on_late: skip`); what is bounded is the latency
    #[arg(long)]
    skip_late: bool,
    /// Bound with --skip-late: 99th percentile of the latency from schedule to prediction
    #[arg(long, default_value_t = 100.0)]
    late_p99_ms: f64,
    /// Predictions that may wait in the server
    #[arg(long, default_value_t = 256)]
    queue: usize,
    /// Connections that the requests share
    #[arg(long, default_value_t = 384)]
    connections: usize,
    /// Streams that the frames share
    #[arg(long, default_value_t = 128)]
    sessions: usize,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Over {
    /// POST /v1/models/{model}/predict
    Rest,
    /// Frames of streams
    Streams,
    /// One after the other
    Both,
}

pub(crate) async fn run(args: &Args, bounds: &mut Bounds) {
    if args.over != Over::Streams {
        rest::run(args, bounds).await;
    }
    if args.over != Over::Rest {
        streams::run(args, bounds).await;
    }
}

impl Args {
    fn peak_time(&self) -> Duration {
        Duration::from_secs_f64(self.peak_s)
    }

    fn time(&self) -> Duration {
        Duration::from_secs_f64(self.seconds)
    }

    fn check_goodput(&self, goodput_hz: f64, peak_hz: f64, bounds: &mut Bounds) {
        let share = goodput_hz / peak_hz;
        let what = format!(
            "goodput is {:.0} % of the peak, at least {:.0} %",
            100.0 * share,
            100.0 * self.goodput_share
        );
        bounds.check(share >= self.goodput_share, what);
    }

    fn check_memory(&self, memory: &[f64], server: &mut Server, bounds: &mut Bounds) {
        let most: Vec<f64> = memory
            .chunks(memory.len().div_ceil(PARTS).max(1))
            .map(|part| part.iter().copied().fold(0.0, f64::max))
            .collect();
        let list: Vec<String> = most.iter().map(|mb| format!("{mb:.0}")).collect();
        println!("the server's memory by fifths of the time: {} MB", list.join(", "));
        let growth = most.last().unwrap_or(&0.0) - most.first().unwrap_or(&0.0);
        let what = format!("memory grew by {growth:.1} MB, at most {} MB", self.growth_mb);
        bounds.check(growth <= self.growth_mb, what);
        server.check(bounds);
    }
}

/// Memory in MB until the time is over.
async fn watch_memory(process: Process, time: Duration) -> Vec<f64> {
    let mut memory = Vec::new();
    for _ in 0..(time.as_secs_f64() / SAMPLE_PERIOD.as_secs_f64()) as usize {
        memory.push(process.usage().rss_mb);
        tokio::time::sleep(SAMPLE_PERIOD).await;
    }
    memory
}
