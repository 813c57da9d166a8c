//! Overload by frames of streams.

use std::sync::Arc;
use std::time::Duration;

use foreframe::server::protocol::OnLate;
use tokio_tungstenite::tungstenite::Error;

use super::{SaturateArgs, watch_memory};
use crate::report::Bounds;
use crate::robots::{RobotLoad, SendMode};
use crate::server::Server;
use crate::session;
use crate::workload::Workload;

const WARM_UP: Duration = Duration::from_millis(500);
/// Frames that each robot is ahead of its answers when the peak is measured.
const AHEAD: usize = 2;
/// Period of the attempts to open a stream over the limit.
const RETRY_PERIOD: Duration = Duration::from_millis(100);

pub(super) async fn run(args: &SaturateArgs, bounds: &mut Bounds) {
    let settings = [("max_streams", args.sessions), ("max_queued_predictions", args.queue)];
    let mut server = Server::start(&args.target, &settings).await;
    let workload = Arc::new(Workload::of(&args.target.model));
    let mut peak_hz: f64 = 0.0;
    for sessions in [args.sessions / 8, args.sessions / 4, args.sessions / 2] {
        let load = RobotLoad {
            plan_samples: None,
            sessions: sessions.max(1),
            mode: SendMode::ClosedLoop(AHEAD),
            on_late: OnLate::Predict,
            warm_up: WARM_UP,
            measured: args.peak_time(),
        };
        let result = load.run(&server, &workload).await;
        let goodput_hz = result.goodput_hz();
        println!(
            "streams: {goodput_hz:.0} predictions/s with {sessions} sessions in a closed loop, {AHEAD} frames ahead; {:.0} µs of \
             server processor time per prediction",
            result.each_us()
        );
        peak_hz = peak_hz.max(goodput_hz);
    }
    let offered_hz = args.times * peak_hz;
    let load = RobotLoad {
        plan_samples: None,
        sessions: args.sessions,
        mode: SendMode::ScheduledOrDropped(offered_hz / args.sessions as f64),
        on_late: if args.skip_late { OnLate::Skip } else { OnLate::Predict },
        warm_up: WARM_UP,
        measured: args.time(),
    };
    let memory = tokio::spawn(watch_memory(server.process.clone(), args.time()));
    let (result, (refused_streams, unexpected)) =
        tokio::join!(load.run(&server, &workload), open_over_limit(args, &server));
    let (goodput_hz, counts) = (result.goodput_hz(), &result.counts);
    println!(
        "streams: {offered_hz:.0} frames/s offered for {} s: {goodput_hz:.0} predictions/s, {:.0} µs each; of {} frames {} \
         overtaken, {} refused, {} dropped, {} not sent because the socket was busy; {refused_streams} streams over the limit refused; latency {}",
        args.seconds,
        result.each_us(),
        counts.sent + result.not_sent,
        counts.overtaken,
        counts.overloaded,
        counts.dropped,
        result.not_sent,
        result.since_schedule()
    );
    if args.skip_late {
        let what = format!("p99 from schedule to prediction within {} ms", args.late_p99_ms);
        bounds.check(result.since_schedule().at_ms(0.99) <= args.late_p99_ms, what);
    } else {
        args.check_goodput(goodput_hz, peak_hz, bounds);
    }
    let lost = counts.refused + counts.unanswered();
    let first = counts.first_refusal.as_deref().unwrap_or_default();
    bounds.check(
        lost == 0,
        format!("every sent frame was predicted, overtaken or refused as overload {first}"),
    );
    bounds.check(
        unexpected == 0 && refused_streams > 0,
        "every stream over the limit was refused with Retry-After",
    );
    args.check_memory(&memory.await.unwrap(), &mut server, bounds);
}

/// Tries to open streams while the limit is reached. Returns how many were refused with `Retry-After`, and how many had
/// another outcome.
async fn open_over_limit(args: &SaturateArgs, server: &Server) -> (u64, u64) {
    let path = format!("/v1/models/{}/stream", args.target.model);
    let (mut refused, mut unexpected) = (0, 0);
    // At this time all streams are open, and none has closed yet.
    tokio::time::sleep(WARM_UP + args.time() / 4).await;
    for _ in 0..(args.seconds / 2.0 / RETRY_PERIOD.as_secs_f64()) as usize {
        match session::connect(server.address, &path).await.map_err(|error| *error) {
            Err(Error::Http(answer)) if answer.status() == 503 && answer.headers().contains_key("retry-after") => {
                refused += 1;
            }
            _ => unexpected += 1,
        }
        tokio::time::sleep(RETRY_PERIOD).await;
    }
    (refused, unexpected)
}
