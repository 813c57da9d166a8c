//! Many short sessions and requests, to find leaks.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use foreframe::server::protocol::{ClientMessage, CloseMessage, OnLate, ServerMessage};
use futures_util::SinkExt as _;
use tokio::task::JoinSet;

use crate::http::{Http, Request};
use crate::process_usage::Usage;
use crate::report::Bounds;
use crate::server::{Server, Target};
use crate::session::{self, Session};
use crate::workload::{self, Workload};

/// Number of parts of the load; memory is printed after each.
const PARTS: u64 = 5;
/// The warm-up is a tenth of the load, at most this many sessions, and ten times as many requests.
const MAX_WARM_UP: u64 = 1000;
/// How long the server may take to notice closed connections and to end idle threads.
const SETTLE_LIMIT: Duration = Duration::from_secs(20);
/// Idle time before memory is measured.
const IDLE_TIME: Duration = Duration::from_secs(1);

#[derive(clap::Args)]
pub(crate) struct ChurnArgs {
    #[command(flatten)]
    target: Target,
    /// Sessions to open, stream on, close and delete
    #[arg(long, default_value_t = 500)]
    sessions: u64,
    /// Requests of many kinds after the sessions, a fifth of them predictions
    #[arg(long, default_value_t = 5000)]
    requests: u64,
    /// Frames per session
    #[arg(long, default_value_t = 6)]
    frames: u64,
    /// Concurrent clients, each with a kept-alive connection
    #[arg(long, default_value_t = 8)]
    workers: usize,
    /// Bound: growth of the server's memory in MiB after the warm-up
    #[arg(long, default_value_t = 10.0)]
    growth_mib: f64,
}

/// The repeated work.
#[derive(Clone)]
enum Task {
    /// A session from opening to deletion, with this many frames.
    Session(u64),
    /// Requests in turn, each with its expected status.
    Requests(Arc<[(Request, u16)]>),
}

type Faults = BTreeMap<String, u64>;

pub(crate) async fn run(args: &ChurnArgs, bounds: &mut Bounds) {
    let mut server = Server::start(&args.target, &[]).await;
    let workload = Arc::new(Workload::of(&args.target.model));
    let tasks = [
        (Task::Session(args.frames), args.sessions, MAX_WARM_UP, "sessions"),
        (
            Task::Requests(kinds(&workload)),
            args.requests,
            10 * MAX_WARM_UP,
            "requests",
        ),
    ];
    let mut faults = Faults::new();
    let mut repeat = async |task: &Task, count| {
        for fault in many(args.workers, server.address, task, count, &workload).await {
            *faults.entry(fault).or_default() += 1;
        }
    };
    for (task, count, max, _) in &tasks {
        repeat(task, (count / 10).min(*max)).await;
    }
    tokio::time::sleep(IDLE_TIME).await;
    let before = server.process.usage();
    println!("after the warm-up: {}", list(&before));
    // The server returns memory of its start with a delay: after the first part it may use less than after the warm-up.
    let mut least_mib = before.rss_mib;
    for (task, count, _, name) in &tasks {
        let (since, part) = (Instant::now(), count / PARTS);
        for done in 1..=PARTS {
            repeat(task, part).await;
            let usage = server.process.usage();
            println!("after {} {name}: {}", done * part, list(&usage));
            if done == 1 {
                least_mib = least_mib.min(usage.rss_mib);
            }
        }
        println!("{:.0} {name}/s", (PARTS * part) as f64 / since.elapsed().as_secs_f64());
    }
    bounds.check(
        faults.is_empty(),
        format!("every request and every frame was answered as expected; faults: {faults:?}"),
    );
    let after = settled(&server, &before).await;
    println!("at the end: {}", list(&after));
    let growth_mib = after.rss_mib - least_mib;
    let what = format!("memory grew by {growth_mib:.1} MiB; limit {} MiB", args.growth_mib);
    bounds.check(growth_mib <= args.growth_mib, what);
    bounds.check(after.descriptors <= before.descriptors, "no file descriptor leaked");
    bounds.check(after.threads <= before.threads, "no thread leaked");
    server.check(bounds);
}

fn list(usage: &Usage) -> String {
    format!(
        "{:.1} MiB, {} file descriptors, {} threads",
        usage.rss_mib, usage.descriptors, usage.threads
    )
}

/// The idle server's usage, once it is no more than before or the time limit has passed.
async fn settled(server: &Server, before: &Usage) -> Usage {
    let since = Instant::now();
    loop {
        tokio::time::sleep(IDLE_TIME).await;
        let usage = server.process.usage();
        let is_settled = usage.descriptors <= before.descriptors && usage.threads <= before.threads;
        if is_settled || since.elapsed() > SETTLE_LIMIT {
            return usage;
        }
    }
}

/// Cheap and expensive requests, among them predictions and refusals.
fn kinds(workload: &Workload) -> Arc<[(Request, u16)]> {
    let get = |path: &str, status| (Request::get(path), status);
    Arc::new([
        (workload.predict_json(), 200),
        get("/livez", 200),
        get(&format!("/v1/models/{}", workload.model()), 200),
        get("/v1/sessions", 200),
        get("/v1/sessions/none", 404),
        (workload.predict_form(), 200),
        get("/readyz", 200),
        get("/v1/models", 200),
        get("/v1/jobs", 200),
        get("/metrics", 200),
    ])
}

/// Repeats a task `count` times with several workers, and returns the faults.
async fn many(workers: usize, address: SocketAddr, task: &Task, count: u64, workload: &Arc<Workload>) -> Vec<String> {
    let next = Arc::new(AtomicU64::new(0));
    let mut working = JoinSet::new();
    for _ in 0..workers {
        let (next, task, workload) = (Arc::clone(&next), task.clone(), Arc::clone(workload));
        let mut http = Http::new(address);
        working.spawn(async move {
            let mut faults = Vec::new();
            loop {
                let index = next.fetch_add(1, Ordering::Relaxed);
                if index >= count {
                    return faults;
                }
                let done = match &task {
                    Task::Session(frames) => session(&mut http, address, &workload, *frames).await,
                    Task::Requests(kinds) => {
                        let (request, status) = &kinds[index as usize % kinds.len()];
                        ask(&mut http, request, *status).await.map(drop)
                    }
                };
                faults.extend(done.err());
            }
        });
    }
    working.join_all().await.concat()
}

async fn ask(http: &mut Http, request: &Request, status: u16) -> Result<crate::http::Response, String> {
    let answer = http.ask(request).await.map_err(|error| format!("no answer: {error}"))?;
    if answer.status == status {
        Ok(answer)
    } else {
        Err(format!(
            "status {} instead of {status}: {}",
            answer.status,
            answer.text()
        ))
    }
}

/// Opens a session and its stream, sends frames, checks each answer, closes the stream and deletes the session.
async fn session(http: &mut Http, address: SocketAddr, workload: &Workload, frames: u64) -> Result<(), String> {
    let session = Session::of(&ask(http, &Session::request(workload.model(), OnLate::Predict), 201).await?);
    let socket = session::connect(address, &session.stream_path()).await;
    let mut socket = socket.map_err(|error| format!("no stream: {error}"))?;
    for seq in 0..frames {
        socket
            .send(workload.frame(seq))
            .await
            .map_err(|error| error.to_string())?;
        let is_full = seq + 1 >= workload.context();
        match session::receive(&mut socket).await {
            Some(ServerMessage::Prediction { seq: of, .. }) if is_full && of == seq => {}
            Some(ServerMessage::Buffering { seq: of, .. }) if !is_full && of == seq => {}
            other => return Err(format!("frame {seq} was answered with {other:?}")),
        }
    }
    let close = workload::message(&ClientMessage::Close(CloseMessage {}));
    socket.send(close).await.map_err(|error| error.to_string())?;
    match session::receive(&mut socket).await {
        Some(ServerMessage::Closing { .. }) => {}
        other => return Err(format!("the close was answered with {other:?}")),
    }
    // Read until the end, so that the closing handshake completes.
    while session::receive(&mut socket).await.is_some() {}
    ask(http, &session.deletion(), 204).await.map(drop)
}
