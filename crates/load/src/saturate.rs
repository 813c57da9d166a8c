//! Overload: more requests or frames than the server can handle.

mod rest;
mod streams;

use std::time::Duration;

use crate::process_usage::Process;
use crate::report::Bounds;
use crate::server::{Server, Target};

/// Period of the memory samples.
const SAMPLE_PERIOD: Duration = Duration::from_millis(200);
/// Memory is compared between the first and the last of this many equal parts of the time.
const PARTS: usize = 5;

#[derive(clap::Args)]
pub(crate) struct SaturateArgs {
    #[command(flatten)]
    target: Target,
    /// Which interface to overload
    #[arg(long, value_enum, default_value_t = Over::Both)]
    over: Over,
    /// Seconds to measure each of three loads; the best is the peak
    #[arg(long, default_value_t = 3.0)]
    peak_s: f64,
    /// Seconds of overload
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Offered load as a multiple of the peak
    #[arg(long, default_value_t = 2.0)]
    times: f64,
    /// Bound: goodput as a share of the peak
    #[arg(long, default_value_t = 0.9)]
    goodput_share: f64,
    /// Bound: growth of memory in MiB from the first to the last fifth of the time
    #[arg(long, default_value_t = 10.0)]
    growth_mib: f64,
    /// Give no prediction for overtaken frames (`on_late: skip`), and check the latency instead of the goodput
    #[arg(long)]
    skip_late: bool,
    /// Bound with --skip-late: 99th percentile of the latency from schedule to prediction
    #[arg(long, default_value_t = 100.0)]
    late_p99_ms: f64,
    /// Predictions that may wait in the server's queue
    #[arg(long, default_value_t = 256)]
    queue: usize,
    /// Connections that send the requests
    #[arg(long, default_value_t = 384)]
    connections: usize,
    /// Streams that send the frames
    #[arg(long, default_value_t = 128)]
    sessions: usize,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Over {
    /// POST /v1/models/{model}/predict
    Rest,
    /// Frames of streams
    Streams,
    /// Both, one after the other
    Both,
}

pub(crate) async fn run(args: &SaturateArgs, bounds: &mut Bounds) {
    if args.over != Over::Streams {
        rest::run(args, bounds).await;
    }
    if args.over != Over::Rest {
        streams::run(args, bounds).await;
    }
}

impl SaturateArgs {
    fn peak_time(&self) -> Duration {
        Duration::from_secs_f64(self.peak_s)
    }

    fn time(&self) -> Duration {
        Duration::from_secs_f64(self.seconds)
    }

    fn check_goodput(&self, goodput_hz: f64, peak_hz: f64, bounds: &mut Bounds) {
        let share = goodput_hz / peak_hz;
        let what = format!(
            "goodput is {:.0} % of the peak; limit {:.0} %",
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
        println!("the server's memory by fifths of the time: {} MiB", list.join(", "));
        let growth = most.last().unwrap_or(&0.0) - most.first().unwrap_or(&0.0);
        let what = format!("memory grew by {growth:.1} MiB; limit {} MiB", self.growth_mib);
        bounds.check(growth <= self.growth_mib, what);
        server.check(bounds);
    }
}

/// Samples the memory in MiB for this long.
async fn watch_memory(process: Process, time: Duration) -> Vec<f64> {
    let mut memory = Vec::new();
    for _ in 0..(time.as_secs_f64() / SAMPLE_PERIOD.as_secs_f64()) as usize {
        memory.push(process.usage().rss_mib);
        tokio::time::sleep(SAMPLE_PERIOD).await;
    }
    memory
}
