//! Load on the real server over loopback, by scenarios; `--help` tells of each. Loads that come at times are open loop:
//! they come whether or not answers have, and a latency counts from the time that its frame or request was *scheduled*
//! for. Linux, for what the server takes is read from `/proc`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod churn;
mod report;
mod robots;
mod health;
mod http;
mod workload;
mod schedule;
mod process_usage;
mod robot;
mod saturate;
mod server;
mod session;
mod slow_reader;
mod stream;

use std::process::ExitCode;
use std::time::Instant;

use clap::Parser as _;
use report::Bounds;

/// Load on the real server over loopback: starts one of its own, prints what received of it, and ends with exit code 1 if a
/// stated bound did not hold.
#[derive(clap::Parser)]
#[command(
    name = "load",
    args_conflicts_with_subcommands = true,
    after_help = "Without a scenario: stream, with the options above.

Give each side a core of its own (Linux):
  taskset -c 1 cargo bench --bench load -- stream --sessions 100 --server-cpu 0"
)]
struct Cli {
    #[command(subcommand)]
    scenario: Option<Scenario>,
    #[command(flatten)]
    stream: stream::Args,
    /// A short form of every scenario, as CI does it
    #[arg(long)]
    test: bool,
    /// Given by cargo
    #[arg(long, hide = true, global = true)]
    bench: bool,
}

#[derive(clap::Subcommand)]
enum Scenario {
    /// Robots at a fixed rate: their latencies, or by --find how many there can be
    Stream(stream::Args),
    /// Twice of what the server can do: goodput, refusals, and the server's memory over time
    Saturate(saturate::Args),
    /// A socket that sends and never reads, beside robots that do
    SlowReader(slow_reader::Args),
    /// Sessions opened and closed, then requests: what of memory, descriptors and threads stays
    Churn(churn::Args),
    /// How quickly the server says that it lives while a training takes every core
    Health(health::Args),
}

/// The scenarios as CI runs them: on a machine that is busy, so latencies are only kept from growing absurd.
const SHORT_FORMS: [&str; 6] = [
    "stream --sessions 4 --seconds 2 --warm-up-s 0.5 --p99-ms 1000",
    "saturate --peak-s 1 --seconds 4 --goodput-share 0.3 --growth-mb 40 --sessions 32",
    "saturate --over streams --skip-late --late-p99-ms 1000 --peak-s 1 --seconds 3 --growth-mb 40 --sessions 32",
    "slow-reader --rounds 1 --seconds 2 --warm-up-s 0.5 --noise-ms 1000 --growth-mb 40",
    "churn --sessions 300 --requests 3000 --growth-mb 40",
    "health --seconds 3 --livez-p99-ms 1000 --p99-ms 1000",
];

fn main() -> ExitCode {
    let cli = Cli::parse();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap();
    let scenarios = if cli.test {
        SHORT_FORMS.map(short_form).into()
    } else {
        vec![cli.scenario.unwrap_or(Scenario::Stream(cli.stream))]
    };
    let mut bounds = Bounds::default();
    for scenario in scenarios {
        let started = Instant::now();
        runtime.block_on(Box::pin(run(&scenario, &mut bounds)));
        println!("in {:.0} s\n", started.elapsed().as_secs_f64());
    }
    bounds.exit_code()
}

fn short_form(line: &'static str) -> Scenario {
    println!("short form: {line}");
    let cli = Cli::parse_from(["load"].into_iter().chain(line.split(' ')));
    cli.scenario.expect("a short form names its scenario")
}

async fn run(scenario: &Scenario, bounds: &mut Bounds) {
    match scenario {
        Scenario::Stream(args) => stream::run(args, bounds).await,
        Scenario::Saturate(args) => saturate::run(args, bounds).await,
        Scenario::SlowReader(args) => slow_reader::run(args, bounds).await,
        Scenario::Churn(args) => churn::run(args, bounds).await,
        Scenario::Health(args) => health::run(args, bounds).await,
    }
}
