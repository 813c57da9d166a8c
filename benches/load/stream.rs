//! Robots at a fixed rate.

use std::sync::Arc;
use std::time::Duration;

use foreframe::server::protocol::OnLate;

use crate::figures::Bounds;
use crate::flight::{Drive, Flight, Flown};
use crate::material::Material;
use crate::server::{Server, Target};

/// A search ends when the answer is known to this share.
const FIND_SHARE: f64 = 0.05;

#[derive(clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    target: Target,
    /// Sessions at a time; with --find, the number to begin with, which has to hold
    #[arg(long, default_value_t = 16)]
    sessions: usize,
    /// Frames a second of each session
    #[arg(long, default_value_t = 30.0)]
    rate_hz: f64,
    /// How long to measure
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// How long to send before that; frames of that time are not counted
    #[arg(long, default_value_t = 2.0)]
    warm_up_s: f64,
    /// Bound of the 99th percentile of the latency from schedule to prediction
    #[arg(long, default_value_t = 33.0)]
    p99_ms: f64,
    /// Search for the largest number of sessions that keeps the bound
    #[arg(long)]
    find: bool,
    /// The search's end
    #[arg(long, default_value_t = 512, requires = "find")]
    find_most: usize,
}

pub(crate) async fn run(args: &Args, bounds: &mut Bounds) {
    let places = if args.find { args.find_most } else { args.sessions } + 1;
    let settings = [
        ("max_streams", places),
        ("max_sessions", places),
        ("max_connections", 2 * places),
        ("max_queued_predictions", 4 * places),
    ];
    let mut server = Server::start(&args.target, &settings).await;
    let material = Arc::new(Material::of(&args.target.model));
    if args.find {
        find(args, &server, &material, bounds).await;
    } else {
        let flown = args.flight(args.sessions).run(&server, &material).await;
        report(args, &flown);
        let p99_ms = flown.since_schedule().at_ms(0.99);
        bounds.hold(
            p99_ms <= args.p99_ms,
            format!("p99 from schedule within {} ms", args.p99_ms),
        );
        bounds.hold(all_predicted(&flown), "every frame was predicted");
    }
    println!(
        "the server's memory: {:.0} MB at most",
        server.process.taken().peak_rss_mb
    );
    server.check(bounds);
}

impl Args {
    fn flight(&self, sessions: usize) -> Flight {
        Flight {
            sessions,
            drive: Drive::Paced(self.rate_hz),
            on_late: OnLate::Predict,
            warm_up: Duration::from_secs_f64(self.warm_up_s),
            measured: Duration::from_secs_f64(self.seconds),
        }
    }
}

fn all_predicted(flown: &Flown) -> bool {
    let tally = &flown.tally;
    tally.overloaded + tally.refused + tally.dropped + tally.unanswered() == 0 && !tally.answers.is_empty()
}

fn report(args: &Args, flown: &Flown) {
    let (tally, from_schedule) = (&flown.tally, flown.since_schedule());
    println!(
        "{} sessions at {} Hz for {} s: {} frames sent, {} predicted, of these {} counted; {} refused, {} dropped, {} \
         unanswered",
        args.sessions,
        args.rate_hz,
        args.seconds,
        tally.sent,
        tally.answers.len(),
        from_schedule.len(),
        tally.overloaded + tally.refused,
        tally.dropped,
        tally.unanswered()
    );
    println!("from schedule to prediction: {from_schedule}");
    let from_sending = flown.latencies(|answer| answer.came - answer.sent);
    println!("from sending to prediction:  {from_sending}");
    println!(
        "of it the model's own time:  {}",
        flown.latencies(|answer| answer.compute)
    );
    let beyond = flown.latencies(|answer| (answer.came - answer.sent).saturating_sub(answer.compute));
    println!("beyond the model's own time: {beyond}");
    println!(
        "the server takes {:.0} % of a core, this program {:.0} %",
        flown.server_cpu, flown.own_cpu
    );
}

/// Doubles until the bound breaks, then halves the way between; what breaks it has a second try.
async fn find(args: &Args, server: &Server, material: &Arc<Material>, bounds: &mut Bounds) {
    let (mut held, mut broke, mut sessions) = (0, None, args.sessions.clamp(1, args.find_most));
    loop {
        let holds = keeps(args, sessions, server, material).await || keeps(args, sessions, server, material).await;
        if holds {
            held = sessions;
        } else {
            broke = Some(sessions);
        }
        sessions = match broke {
            None if held == args.find_most => break,
            None => (2 * held).min(args.find_most),
            Some(broke) if (broke - held) as f64 <= (FIND_SHARE * held as f64).max(1.0) => break,
            Some(broke) => usize::midpoint(held, broke),
        };
    }
    println!(
        "{held} sessions at {} Hz with p99 within {} ms",
        args.rate_hz, args.p99_ms
    );
    bounds.hold(held >= args.sessions, format!("at least {} sessions", args.sessions));
}

async fn keeps(args: &Args, sessions: usize, server: &Server, material: &Arc<Material>) -> bool {
    let flown = args.flight(sessions).run(server, material).await;
    let latencies = flown.since_schedule();
    println!(
        "{sessions} sessions: {latencies}; {} of {} frames not predicted; the server takes {:.0} % of a core",
        flown.tally.sent - flown.tally.buffering - flown.tally.answers.len() as u64,
        flown.tally.sent,
        flown.server_cpu
    );
    all_predicted(&flown) && latencies.at_ms(0.99) <= args.p99_ms
}
