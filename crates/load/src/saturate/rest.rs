//! Overload by prediction requests.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::Semaphore;
use tokio::task::JoinSet;

use super::{SaturateArgs, watch_memory};
use crate::http::{Http, Request};
use crate::process_usage::CpuShare;
use crate::report::{Bounds, Latencies};
use crate::schedule::Schedule;
use crate::server::Server;
use crate::workload::Workload;

/// Numbers of connections tried to find the peak.
const LEVELS: [usize; 3] = [16, 64, 128];

/// Outcomes of requests.
#[derive(Default)]
struct RequestCounts {
    sent: u64,
    answered: Vec<Duration>,
    /// 429 and 503 that say when to try again.
    refused: u64,
    /// Other answers, or none, with their counts.
    faults: BTreeMap<String, u64>,
}

pub(super) async fn run(args: &SaturateArgs, bounds: &mut Bounds) {
    // Those of one phase may still be open when the next begins.
    let connections = args.connections + LEVELS.iter().sum::<usize>();
    let settings = [("max_queued_predictions", args.queue), ("max_connections", connections)];
    let mut server = Server::start(&args.target, &settings).await;
    let request = Workload::of(&args.target.model).predict_json();
    let mut peak_hz: f64 = 0.0;
    for level in LEVELS {
        let cpu = CpuShare::begin(server.process.clone());
        let answered = closed(level, &server, &request, args.peak_time()).await.answered.len();
        let (goodput_hz, each_us) = (answered as f64 / args.peak_s, cpu.each_us(answered));
        println!(
            "requests: {goodput_hz:.0} predictions/s with {level} connections in a closed loop; {each_us:.0} µs of server \
             processor time per prediction"
        );
        peak_hz = peak_hz.max(goodput_hz);
    }
    let (offered_hz, process) = (args.times * peak_hz, server.process.clone());
    let memory = tokio::spawn(watch_memory(process, args.time()));
    let cpu = CpuShare::begin(server.process.clone());
    let (counts, not_sent) = open(args, offered_hz, &server, &request).await;
    let latencies = Latencies::of(counts.answered);
    let (goodput_hz, each_us) = (latencies.len() as f64 / args.seconds, cpu.each_us(latencies.len()));
    println!(
        "requests: {offered_hz:.0}/s offered for {} s: {goodput_hz:.0} predictions/s, {each_us:.0} µs each; {} of {} \
         refused with Retry-After; {not_sent} not sent because no connection was free; latency {latencies}",
        args.seconds, counts.refused, counts.sent
    );
    args.check_goodput(goodput_hz, peak_hz, bounds);
    let faults = counts.faults;
    bounds.check(
        faults.is_empty(),
        format!("every request was predicted or refused with Retry-After; faults: {faults:?}"),
    );
    args.check_memory(&memory.await.unwrap(), &mut server, bounds);
}

/// Sends requests in a closed loop on each connection.
async fn closed(connections: usize, server: &Server, request: &Request, time: Duration) -> RequestCounts {
    let until = Instant::now() + time;
    let mut asking = JoinSet::new();
    for _ in 0..connections {
        let (mut http, request, mut counts) = (Http::new(server.address), request.clone(), RequestCounts::default());
        asking.spawn(async move {
            while Instant::now() < until {
                counts.ask(&mut http, &request, until).await;
            }
            counts
        });
    }
    sum(asking).await
}

/// Sends scheduled requests on free connections. Returns also how many found no free connection.
async fn open(args: &SaturateArgs, rate_hz: f64, server: &Server, request: &Request) -> (RequestCounts, u64) {
    let begin = Instant::now();
    let (until, limit) = (begin + args.time(), args.connections);
    let (due, not_sent) = (Arc::new(Semaphore::new(0)), Arc::new(AtomicU64::new(0)));
    let mut asking = JoinSet::new();
    for _ in 0..args.connections {
        let (mut http, request, mut counts) = (Http::new(server.address), request.clone(), RequestCounts::default());
        let due = Arc::clone(&due);
        asking.spawn(async move {
            while let Ok(one) = due.acquire().await {
                one.forget();
                counts.ask(&mut http, &request, until).await;
            }
            counts
        });
    }
    let (permits, count) = (Arc::clone(&due), Arc::clone(&not_sent));
    Schedule::lasting(begin, rate_hz, args.time()).start(move |_| {
        if permits.available_permits() < limit {
            permits.add_permits(1);
        } else {
            count.fetch_add(1, Ordering::Relaxed);
        }
    });
    tokio::time::sleep_until(until.into()).await;
    due.close();
    let never_sent = due.available_permits() as u64;
    (sum(asking).await, not_sent.load(Ordering::Relaxed) + never_sent)
}

async fn sum(asking: JoinSet<RequestCounts>) -> RequestCounts {
    let mut sum = RequestCounts::default();
    for counts in asking.join_all().await {
        sum.sent += counts.sent;
        sum.refused += counts.refused;
        sum.answered.extend(counts.answered);
        for (fault, count) in counts.faults {
            *sum.faults.entry(fault).or_default() += count;
        }
    }
    sum
}

impl RequestCounts {
    /// Sends a request and records the outcome. A prediction counts if it is received before `until`.
    async fn ask(&mut self, http: &mut Http, request: &Request, until: Instant) {
        self.sent += 1;
        let asked = Instant::now();
        let fault = match http.ask(request).await {
            Ok(answer) if answer.status == 200 => {
                self.answered.extend((Instant::now() < until).then(|| asked.elapsed()));
                return;
            }
            Ok(answer) if answer.is_refusal() => {
                self.refused += 1;
                return;
            }
            Ok(answer) => format!("{} {}", answer.status, answer.text()),
            Err(error) => format!("no answer: {error}"),
        };
        *self.faults.entry(fault).or_default() += 1;
    }
}
