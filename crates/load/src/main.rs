//! Load tests of the real server over loopback; `--help` describes each scenario. Loads at a fixed rate are open loop: the
//! next frame or request is sent whether or not the last one was answered, and a latency counts from the time that it was
//! *scheduled* for. Linux only, because the server's memory and processor time are read from `/proc`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod churn;
#[path = "../../../tests/malformed/corpus.rs"]
mod corpus;
mod endurance;
mod health;
mod http;
#[path = "../../../tests/malformed/mutation.rs"]
mod mutation;
mod plans;
mod previews;
mod process_usage;
mod project;
mod report;
mod robot;
mod robots;
mod saturate;
mod schedule;
mod server;
mod session;
mod slow_reader;
mod stream;
mod workload;

use std::process::ExitCode;
use std::time::Instant;

use clap::Parser as _;
use report::Bounds;

/// Load on the real server over loopback: starts one of its own, prints the measurements, and exits with code 1 if
/// a bound is exceeded.
#[derive(clap::Parser)]
#[command(
    name = "foreframe-load",
    args_conflicts_with_subcommands = true,
    after_help = "Without a scenario, `stream` runs with the options above.

To give the server and the load one core each (Linux):
  taskset -c 1 cargo run --release -p foreframe-load -- stream --sessions 100 --server-cpu 0"
)]
struct Cli {
    #[command(subcommand)]
    scenario: Option<Scenario>,
    #[command(flatten)]
    stream: stream::StreamArgs,
    /// Run a short form of every scenario but `endurance`, as CI does
    #[arg(long)]
    test: bool,
}

#[derive(clap::Subcommand)]
enum Scenario {
    /// Robots at a fixed frame rate: measure latencies, or with --find the largest number of robots
    Stream(stream::StreamArgs),
    /// Twice the load that the server can handle: measure goodput, refusals and memory over time
    Saturate(saturate::SaturateArgs),
    /// One client that sends and never reads: measure its effect on other robots
    SlowReader(slow_reader::SlowReaderArgs),
    /// Many sessions and requests: measure leaks of memory, file descriptors and threads
    Churn(churn::ChurnArgs),
    /// Predictions while other clients ask for pictures: measure latencies
    Previews(previews::PreviewsArgs),
    /// Robots that plan with every prediction, beside robots that only stream: measure latencies
    Plans(plans::PlansArgs),
    /// Health checks and streams while a training uses every core: measure latencies
    Health(health::HealthArgs),
    /// Everything at once, with hostile clients, kills, a full disk and a database that is away: check that nothing
    /// acknowledged is lost, and that every prediction is right
    Endurance(endurance::EnduranceArgs),
}

/// The scenarios as CI runs them. CI machines are busy, so the bounds on latencies are wide.
const SHORT_FORMS: [&str; 8] = [
    "stream --sessions 4 --seconds 2 --warm-up-s 0.5 --p99-ms 1000",
    "saturate --peak-s 1 --seconds 4 --goodput-share 0.3 --growth-mib 40 --sessions 32",
    "saturate --over streams --skip-late --late-p99-ms 1000 --peak-s 1 --seconds 3 --growth-mib 40 --sessions 32",
    "slow-reader --rounds 1 --seconds 2 --warm-up-s 0.5 --noise-ms 1000 --growth-mib 40",
    "churn --sessions 300 --requests 3000 --growth-mib 40",
    "previews --rounds 1 --seconds 2 --noise-ms 1000",
    "plans --seconds 2 --warm-up-s 0.5 --p99-ms 1000",
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
        println!("took {:.0} s\n", started.elapsed().as_secs_f64());
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
        Scenario::Previews(args) => previews::run(args, bounds).await,
        Scenario::Plans(args) => plans::run(args, bounds).await,
        Scenario::Health(args) => health::run(args, bounds).await,
        Scenario::Endurance(args) => endurance::run(args, bounds).await,
    }
}
