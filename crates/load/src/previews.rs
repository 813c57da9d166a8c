//! Latencies of predictions while other clients ask for pictures of a data set.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use tokio::task::JoinSet;

use crate::health::{collect, post, until};
use crate::http::{Http, Request};
use crate::report::{Bounds, Latencies, median};
use crate::server::{Server, Target};
use crate::workload::Workload;

#[derive(clap::Args)]
pub(crate) struct PreviewsArgs {
    #[command(flatten)]
    target: Target,
    /// Number of clients that ask for pictures
    #[arg(long, default_value_t = 12)]
    clients: usize,
    /// How many different episodes they ask for, in turn; 1: always the same picture
    #[arg(long, default_value_t = 1)]
    episodes: u64,
    /// Rounds; each measures without and with the pictures
    #[arg(long, default_value_t = 4)]
    rounds: usize,
    /// Seconds to measure, first without and then with the pictures
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Bound: how much the 99th percentile of predictions rises, in percent; the median of the rounds
    #[arg(long, default_value_t = 20.0)]
    rise_percent: f64,
    /// Bound: a rise by less than this does not count, in milliseconds
    #[arg(long, default_value_t = 1.0)]
    noise_ms: f64,
}

pub(crate) async fn run(args: &PreviewsArgs, bounds: &mut Bounds) {
    let mut server = Server::start(&args.target, &[]).await;
    let mut http = Http::new(server.address);
    let collected = post(&mut http, &collect()).await;
    until(&mut http, &collected, |job| job["state"] == "succeeded").await;
    let predict = Workload::of(&args.target.model).predict_json();
    let time = Duration::from_secs_f64(args.seconds);
    predictions(&mut http, &predict, Duration::from_secs(1)).await;
    let (mut before, mut during) = (Vec::new(), Vec::new());
    for round in 1..=args.rounds {
        let alone = predictions(&mut http, &predict, time).await;
        let pictures = PictureClients::start(args, server.address);
        let beside = predictions(&mut http, &predict, time).await;
        let (answered, failed) = pictures.stop().await;
        println!("round {round}, predictions alone:           {alone}");
        println!("round {round}, beside {answered:6} pictures:      {beside}");
        bounds.check(answered > 0 && failed == 0, format!("{failed} pictures failed"));
        before.push(alone.at_ms(0.99));
        during.push(beside.at_ms(0.99));
    }
    let (before, during) = (median(before), median(during));
    let rise = 100.0 * (during / before - 1.0);
    println!("  median p99: {before:.2} ms alone, {during:.2} ms beside the pictures ({rise:+.0} %)");
    bounds.check(
        rise <= args.rise_percent || during - before <= args.noise_ms,
        format!("p99 of predictions rises by at most {} %", args.rise_percent),
    );
    server.check(bounds);
}

/// Sends one prediction after another.
async fn predictions(http: &mut Http, predict: &Request, time: Duration) -> Latencies {
    let (since, mut times) = (Instant::now(), Vec::new());
    while since.elapsed() < time {
        let sent = Instant::now();
        http.expect(200, predict).await;
        times.push(sent.elapsed());
    }
    Latencies::of(times)
}

/// Clients that ask for one animation after another.
struct PictureClients {
    tasks: JoinSet<()>,
    is_over: Arc<AtomicBool>,
    answered: Arc<AtomicU64>,
    failed: Arc<AtomicU64>,
}

impl PictureClients {
    fn start(args: &PreviewsArgs, address: SocketAddr) -> Self {
        let mut clients = Self {
            tasks: JoinSet::new(),
            is_over: Arc::default(),
            answered: Arc::default(),
            failed: Arc::default(),
        };
        for client in 0..args.clients as u64 {
            let (is_over, episodes) = (Arc::clone(&clients.is_over), args.episodes.max(1));
            let (answered, failed) = (Arc::clone(&clients.answered), Arc::clone(&clients.failed));
            clients.tasks.spawn(async move {
                let (mut http, mut next) = (Http::new(address), client);
                while !is_over.load(Ordering::Relaxed) {
                    let path = format!("/v1/datasets/seen/episodes/{}/preview.gif", next % episodes);
                    next += 1;
                    let is_answered = http.ask(&Request::get(&path)).await.is_ok_and(|gif| gif.status == 200);
                    if is_answered { &answered } else { &failed }.fetch_add(1, Ordering::Relaxed);
                }
            });
        }
        clients
    }

    /// How many pictures were answered, and how many were not.
    async fn stop(mut self) -> (u64, u64) {
        self.is_over.store(true, Ordering::Relaxed);
        while self.tasks.join_next().await.is_some() {}
        (
            self.answered.load(Ordering::Relaxed),
            self.failed.load(Ordering::Relaxed),
        )
    }
}
