//! Hostile clients, all from another loopback address than the others: mutated requests and messages of the kept corpus, slow
//! request heads, unfinished bodies and idle connections.

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use foreframe::server::protocol::Codec;
use foreframe_core::registry::Model;
use futures_util::{SinkExt as _, StreamExt as _};
use proptest::strategy::{Strategy as _, ValueTree as _};
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::Message;

use super::shared::EnduranceRun;
use crate::corpus::{CorpusFile, files};
use crate::http::{self, Http, Request};
use crate::mutation::{mutated, mutations};
use crate::session::Handshake;

const SOURCE: IpAddr = IpAddr::V4(Ipv4Addr::new(127, 0, 0, 2));
/// Clients that send mutated requests, and clients that send mutated messages.
const MUTATORS: u8 = 2;
const MUTATION_PERIOD: Duration = Duration::from_millis(20);
/// Messages that are sent on one stream.
const STREAM_MESSAGES: usize = 20;
/// Connections that send a byte of their request's head now and then.
const SLOW_HEADS: usize = 150;
const SLOW_PERIOD: Duration = Duration::from_secs(1);
/// Connections that send nothing. With the slow heads and unfinished bodies, these are more than one address can have.
const IDLE: usize = 100;
/// Connections that announce a body of the greatest size and send a part of it.
const UNFINISHED: usize = 30;
const ANNOUNCED_BYTES: usize = 8 << 20;
const SENT_BYTES: usize = 1 << 20;
/// How long an answer to a mutated message is waited for.
const ANSWER_LIMIT: Duration = Duration::from_millis(50);

/// What the hostile clients did.
#[derive(Default)]
pub(super) struct HostileCounts {
    pub(super) connections: AtomicU64,
    pub(super) messages: AtomicU64,
    pub(super) statuses: std::sync::Mutex<BTreeMap<u16, u64>>,
}

/// One mutated file of the corpus.
struct MutatedFile {
    file: CorpusFile,
    bytes: Vec<u8>,
}

/// Starts all hostile clients. Dropping the set ends them.
pub(super) fn start(run: &Arc<EnduranceRun>, model: &Model, counts: &Arc<HostileCounts>) -> JoinSet<()> {
    let mut tasks = JoinSet::new();
    for seed in 0..MUTATORS {
        let weights = model.manifest.weights_sha256.clone();
        tasks.spawn(requests(Arc::clone(run), Arc::clone(counts), seed, weights));
        tasks.spawn(streams(Arc::clone(run), Arc::clone(counts), seed));
    }
    let spawn = |tasks: &mut JoinSet<()>, connections, behavior| {
        for index in 0..connections {
            tasks.spawn(hold(Arc::clone(run), Arc::clone(counts), behavior, index));
        }
    };
    spawn(&mut tasks, SLOW_HEADS, Behavior::SlowHead);
    spawn(&mut tasks, IDLE, Behavior::Idle);
    spawn(&mut tasks, UNFINISHED, Behavior::UnfinishedBody);
    tasks
}

/// Mutated files of some folders of the corpus, without end.
fn attacks(folders: &'static [&'static str], seed: u8) -> mpsc::Receiver<MutatedFile> {
    let (sender, receiver) = mpsc::channel(1);
    std::thread::spawn(move || {
        let files: Vec<CorpusFile> = folders.iter().flat_map(|folder| files(folder)).collect();
        let rng = TestRng::from_seed(RngAlgorithm::ChaCha, &[seed; 32]);
        let mut runner = TestRunner::new_with_rng(Config::default(), rng);
        let strategy = (proptest::sample::select(files), mutations());
        loop {
            let (file, mutations) = strategy.new_tree(&mut runner).unwrap().current();
            let bytes = mutated(&file.bytes, &mutations);
            if sender.blocking_send(MutatedFile { file, bytes }).is_err() {
                return;
            }
        }
    });
    receiver
}

/// Sends mutated bodies and exported states. A server error is a fault.
async fn requests(run: Arc<EnduranceRun>, counts: Arc<HostileCounts>, seed: u8, weights: String) {
    let mut attacks = attacks(&["bodies", "states"], seed);
    let mut http = Http::from_source(run.address, SOURCE);
    while let Some(attack) = attacks.recv().await {
        let request = request(&run, &attack, &weights).with_key(&run.robot_key);
        if let Ok(answer) = http.ask(&request).await {
            *counts.statuses.lock().unwrap().entry(answer.status).or_default() += 1;
            if answer.status >= 500 && !answer.is_refusal() {
                let text = answer.text();
                run.fault(format!(
                    "{} got {} after a mutation: {text}",
                    attack.file.name, answer.status
                ));
            }
        }
        sleep(MUTATION_PERIOD).await;
    }
}

fn request(run: &EnduranceRun, attack: &MutatedFile, weights: &str) -> Request {
    let (file, endpoint) = (&attack.file, attack.file.part(1));
    let model = run.workload.model();
    match endpoint {
        "predict" | "rollouts" if file.is("form") => Request::post(
            &format!("/v1/models/{model}/{endpoint}"),
            "multipart/form-data; boundary=X",
            &attack.bytes,
        ),
        "predict" | "rollouts" => json(&format!("/v1/models/{model}/{endpoint}"), &attack.bytes),
        "step" => json("/v1/environments/none/step", &attack.bytes),
        "environments" | "jobs" | "sessions" => json(&format!("/v1/{endpoint}"), &attack.bytes),
        // A state.
        _ => {
            let state = String::from_utf8_lossy(&attack.bytes).replace("WEIGHTS", weights);
            json("/v1/sessions", format!(r#"{{"state":{state}}}"#).as_bytes())
        }
    }
}

fn json(path: &str, body: &[u8]) -> Request {
    Request::post(path, "application/json", body)
}

/// Opens streams and sends mutated messages.
async fn streams(run: Arc<EnduranceRun>, counts: Arc<HostileCounts>, seed: u8) {
    let path = format!("/v1/models/{}/stream", run.workload.model());
    let is_text = seed.is_multiple_of(2);
    let mut attacks = attacks(&["messages"], seed);
    loop {
        let handshake = Handshake {
            key: Some(&run.robot_key),
            codec: if is_text { Codec::Json } else { Codec::Msgpack },
            ..Handshake::new(run.address, &path)
        };
        if let Ok(stream) = http::connect(run.address, Some(SOURCE)).await
            && let Ok(mut socket) = handshake.over(stream).await
        {
            counts.connections.fetch_add(1, Ordering::Relaxed);
            for _ in 0..STREAM_MESSAGES {
                let Some(attack) = attacks.recv().await else { return };
                if attack.file.is("json") != is_text {
                    continue;
                }
                let message = if is_text {
                    Message::text(String::from_utf8_lossy(&attack.bytes).into_owned())
                } else {
                    Message::binary(attack.bytes)
                };
                if socket.send(message).await.is_err() {
                    break;
                }
                counts.messages.fetch_add(1, Ordering::Relaxed);
                // Whatever it answers: it must only go on.
                let _ = timeout(ANSWER_LIMIT, socket.next()).await;
                sleep(MUTATION_PERIOD).await;
            }
        }
        sleep(MUTATION_PERIOD).await;
    }
}

/// What a connection does that is held open.
#[derive(Clone, Copy)]
enum Behavior {
    SlowHead,
    Idle,
    UnfinishedBody,
}

/// Holds a connection, and opens it again when the server closes it.
async fn hold(run: Arc<EnduranceRun>, counts: Arc<HostileCounts>, behavior: Behavior, index: usize) {
    // Not all at the same moment.
    sleep(SLOW_PERIOD.mul_f64((index % 32) as f64 / 32.0)).await;
    loop {
        if let Ok(stream) = http::connect(run.address, Some(SOURCE)).await {
            counts.connections.fetch_add(1, Ordering::Relaxed);
            // Until the server closes it.
            let _ = act(&run, stream, behavior).await;
        }
        sleep(SLOW_PERIOD).await;
    }
}

async fn act(run: &EnduranceRun, mut stream: TcpStream, behavior: Behavior) -> std::io::Result<()> {
    match behavior {
        Behavior::Idle => {}
        Behavior::SlowHead => {
            stream.write_all(b"GET /v1/models HTTP/1.1\r\nx-slow: ").await?;
            loop {
                stream.write_all(b"a").await?;
                sleep(SLOW_PERIOD).await;
            }
        }
        Behavior::UnfinishedBody => {
            let head = format!(
                "POST /v1/models/{}/predict HTTP/1.1\r\nhost: a\r\nauthorization: Bearer {}\r\n\
                 content-type: application/json\r\ncontent-length: {ANNOUNCED_BYTES}\r\n\r\n",
                run.workload.model(),
                run.robot_key
            );
            stream.write_all(head.as_bytes()).await?;
            stream.write_all(&vec![b' '; SENT_BYTES]).await?;
        }
    }
    let mut rest = Vec::new();
    stream.read_to_end(&mut rest).await.map(drop)
}
