//! The table of an endurance run, and the bounds that it must keep.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::hostile::HostileCounts;
use super::robot::RobotReport;
use super::shared::EnduranceRun;
use super::{EnduranceArgs, Incidents, LoadResults};
use crate::report::{Bounds, Latencies};

/// Latencies in the calm part and in the hostile part.
struct BothParts {
    calm: Latencies,
    hostile: Latencies,
}

impl BothParts {
    fn of(attack: Instant, times: impl Iterator<Item = (Instant, Duration)>) -> Self {
        let (calm, hostile): (Vec<_>, Vec<_>) = times.partition(|(at, _)| *at < attack);
        let latencies = |times: Vec<(Instant, Duration)>| Latencies::of(times.into_iter().map(|(_, time)| time));
        Self {
            calm: latencies(calm),
            hostile: latencies(hostile),
        }
    }

    fn print(&self, what: &str) {
        for (part, latencies) in [("without the hostile part", &self.calm), ("with it", &self.hostile)] {
            println!("  {what} {part:25} {:8} answers, {latencies}", latencies.len());
        }
    }
}

impl LoadResults {
    fn new_frames(&self) -> BothParts {
        let answers = self.robots.iter().flat_map(|robot| &robot.answers);
        let live = answers.filter(|answer| answer.is_live);
        BothParts::of(self.attack, live.map(|answer| (answer.scheduled, answer.latency)))
    }

    fn sum(&self, of: impl Fn(&RobotReport) -> u64) -> u64 {
        self.robots.iter().map(of).sum()
    }
}

pub(super) fn print(
    args: &EnduranceArgs,
    run: &EnduranceRun,
    results: &LoadResults,
    incidents: &Incidents,
    hostile: &HostileCounts,
) {
    println!(
        "\n{} min with {} robots at {} Hz:",
        args.minutes, args.robots, args.rate_hz
    );
    results.new_frames().print("robots, new frames");
    BothParts::of(results.attack, results.predictions.iter().copied()).print("predictions by HTTP");
    let recoveries = Latencies::of(results.robots.iter().flat_map(|robot| robot.recoveries.iter().copied()));
    println!(
        "  streams lost and continued {} times, {} of them from an exported state; until a new frame was answered: {recoveries}",
        recoveries.len(),
        results.sum(|robot| robot.restored)
    );
    println!(
        "  {} frames sent again; {} left out because the stream was away or busy; {} refused as overload",
        results.sum(|robot| robot.sent_again),
        results.sum(|robot| robot.left_out),
        results.sum(|robot| robot.overloaded)
    );
    for (part, counts) in run.counts() {
        println!(
            "  {part:20} {:6} answered, {:5} refused, {:4} without an answer",
            counts.answered, counts.refused, counts.unanswered
        );
    }
    let restarts: Vec<String> = incidents.restarts.iter().map(|time| seconds(Some(*time))).collect();
    println!(
        "  kill -9: {} times, ready again after {}",
        restarts.len(),
        restarts.join(", ")
    );
    for outage in &incidents.outages {
        println!(
            "  {} for {} s: noticed after {}, store written again {} after its end",
            outage.name,
            args.outage_s,
            seconds(outage.noticed),
            seconds(outage.recovered)
        );
    }
    println!(
        "  hostile: {} connections, {} mutated messages, mutated requests by status: {:?}\n",
        hostile.connections.load(Ordering::Relaxed),
        hostile.messages.load(Ordering::Relaxed),
        hostile.statuses.lock().unwrap()
    );
}

fn seconds(time: Option<Duration>) -> String {
    time.map_or_else(|| "never".to_owned(), |time| format!("{:.1} s", time.as_secs_f64()))
}

pub(super) fn check(
    args: &EnduranceArgs,
    run: &EnduranceRun,
    results: &LoadResults,
    incidents: &Incidents,
    bounds: &mut Bounds,
) {
    let answers = results.sum(|robot| robot.answers.len() as u64);
    let unanswered = results.sum(|robot| robot.unanswered);
    bounds.check(
        answers > 0 && unanswered == 0,
        format!("every frame was answered; {answers} predictions, {unanswered} frames without an answer"),
    );
    let restored = results.sum(|robot| robot.restored);
    let expected = args.robots * incidents.restarts.len() as u64;
    bounds.check(
        restored >= expected,
        format!("every robot continued from its exported state after each kill ({restored} of {expected})"),
    );
    let p50_ms = results.new_frames().hostile.at_ms(0.5);
    bounds.check(
        p50_ms <= args.p50_ms,
        format!("p50 of the robots is {p50_ms:.2} ms; limit {} ms", args.p50_ms),
    );
    for outage in &incidents.outages {
        bounds.check(
            outage.noticed.is_some() && outage.recovered.is_some(),
            format!("the metrics told of the {}, and of its end", outage.name),
        );
    }
    bounds.check(!incidents.has_crashed, "the server ended only when it was killed");
    let faults = run.faults();
    bounds.check(
        faults.is_empty(),
        format!("every answer was right, or a refusal that says when to try again; faults: {faults:?}"),
    );
}
