//! Latencies of predictions and of plans, of robots that plan beside robots that only stream.

use std::sync::Arc;
use std::time::Duration;

use foreframe::server::protocol::OnLate;

use crate::report::Bounds;
use crate::robots::{RobotLoad, RobotLoadResult, SendMode};
use crate::server::{Server, Target};
use crate::workload::Workload;

#[derive(clap::Args)]
pub(crate) struct PlansArgs {
    #[command(flatten)]
    target: Target,
    /// Robots that ask for a plan with every prediction
    #[arg(long, default_value_t = 3)]
    planners: usize,
    /// Plans from which each plan is chosen
    #[arg(long, default_value_t = 256)]
    samples: usize,
    /// Robots that only stream
    #[arg(long, default_value_t = 10)]
    sessions: usize,
    /// Frames per second of each robot
    #[arg(long, default_value_t = 5.0)]
    rate_hz: f64,
    /// Seconds to measure
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Seconds of warm-up before the measurement
    #[arg(long, default_value_t = 2.0)]
    warm_up_s: f64,
    /// Bound: 99th percentile from schedule to prediction, and to plan [default: the period of the frames]
    #[arg(long)]
    p99_ms: Option<f64>,
}

pub(crate) async fn run(args: &PlansArgs, bounds: &mut Bounds) {
    let mut server = Server::start(&args.target, &[]).await;
    let workload = Arc::new(Workload::of(&args.target.model));
    let (streaming, planning) = (
        args.load(args.sessions, None),
        args.load(args.planners, Some(args.samples)),
    );
    let (streaming, planning) = tokio::join!(streaming.run(&server, &workload), planning.run(&server, &workload));
    let limit_ms = args.p99_ms.unwrap_or(1000.0 / args.rate_hz);
    for (what, result) in [("robots that stream", &streaming), ("robots that plan", &planning)] {
        println!("{what}, from schedule to prediction: {}", result.since_schedule());
        check_predictions(result, limit_ms, what, bounds);
    }
    let plans = planning.plans_since_schedule();
    let skipped = planning.counts.plans_skipped;
    println!(
        "robots that plan, from schedule to plan:       {plans}; {} plans, {skipped} skipped",
        plans.len()
    );
    bounds.check(
        plans.at_ms(0.99) <= limit_ms,
        format!("p99 from schedule to plan within {limit_ms} ms"),
    );
    println!("the server uses {:.0} % of a core", planning.server_cpu);
    server.check(bounds);
}

impl PlansArgs {
    fn load(&self, sessions: usize, plan_samples: Option<usize>) -> RobotLoad {
        RobotLoad {
            sessions,
            plan_samples,
            mode: SendMode::Scheduled(self.rate_hz),
            on_late: OnLate::Predict,
            warm_up: Duration::from_secs_f64(self.warm_up_s),
            measured: Duration::from_secs_f64(self.seconds),
        }
    }
}

fn check_predictions(result: &RobotLoadResult, limit_ms: f64, what: &str, bounds: &mut Bounds) {
    let counts = &result.counts;
    let lost = counts.overloaded + counts.refused + counts.dropped + counts.unanswered();
    bounds.check(lost == 0, format!("{what}: every frame was answered"));
    let p99_ms = result.since_schedule().at_ms(0.99);
    bounds.check(
        p99_ms <= limit_ms,
        format!("{what}: p99 from schedule to prediction within {limit_ms} ms"),
    );
}
