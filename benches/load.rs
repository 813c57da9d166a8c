//! Many robots at once, against the real server over loopback: every session sends frames at a fixed rate whether or not
//! answers have come (open loop), and a latency counts from the time that its frame was *scheduled* for.
//!
//!     cargo bench --bench load -- --sessions 100 --rate-hz 30 --seconds 20
//!
//! Give each side a core of its own by `taskset -c 1 cargo bench --bench load -- --server-cpu 0 …` (Linux).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use std::collections::VecDeque;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::http::HeaderValue;
use clap::Parser as _;
use foreframe::registry;
use foreframe::server::protocol::{ClientMessage, Codec, FrameMessage, ServerMessage};
use foreframe::server::{ImageBytes, ImageFormat};
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

#[derive(clap::Parser, Clone)]
struct Args {
    /// Sessions at a time
    #[arg(long, default_value_t = 16)]
    sessions: usize,
    /// Frames a second of each session
    #[arg(long, default_value_t = 30.0)]
    rate_hz: f64,
    /// How long to send
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// A shipped model
    #[arg(long, default_value = "moving")]
    model: String,
    /// The only core that the server may use
    #[arg(long)]
    server_cpu: Option<usize>,
    /// A short run, as CI does it
    #[arg(long)]
    test: bool,
    /// Given by cargo
    #[arg(long, hide = true)]
    bench: bool,
}

/// The server's process, ended with this value.
struct Server {
    child: Child,
    address: String,
    _data: tempfile::TempDir,
}

impl Server {
    fn start(args: &Args) -> Self {
        let (program, data) = (env!("CARGO_BIN_EXE_foreframe"), tempfile::tempdir().unwrap());
        let mut command = match args.server_cpu {
            Some(cpu) => {
                let mut command = Command::new("taskset");
                command.args(["-c", &cpu.to_string(), program]);
                command
            }
            None => Command::new(program),
        };
        let places = args.sessions + 1;
        let mut child = command
            .args(["serve", "--bind", "127.0.0.1:0", "--data-dir"])
            .arg(data.path())
            .args([
                "--set",
                &format!("max_streams={places}"),
                "--set",
                &format!("max_connections={}", 2 * places),
            ])
            .args([
                "--set",
                &format!("max_sessions={places}"),
                "--set",
                &format!("max_queued_predictions={}", 4 * places),
            ])
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap())
            .read_line(&mut line)
            .unwrap();
        let address = line.split("http://").nth(1).and_then(|rest| rest.split('/').next());
        Self {
            address: address.expect("the server did not start").to_owned(),
            child,
            _data: data,
        }
    }

    /// Opens a session and gives its stream's address.
    fn session(&self, model: &str) -> String {
        let body = json!({"model": model}).to_string();
        let mut socket = std::net::TcpStream::connect(&self.address).unwrap();
        let head = "POST /v1/sessions HTTP/1.1\r\nhost: a\r\nconnection: close\r\ncontent-type: application/json";
        write!(socket, "{head}\r\ncontent-length: {}\r\n\r\n{body}", body.len()).unwrap();
        let mut answer = String::new();
        socket.read_to_string(&mut answer).unwrap();
        let (_, body) = answer.split_once("\r\n\r\n").unwrap();
        let opened: Value = serde_json::from_str(body).unwrap();
        let text = |field: &str| opened[field].as_str().expect("no session").to_owned();
        format!("ws://{}{}?token={}", self.address, text("stream"), text("token"))
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// What came of all frames.
#[derive(Default)]
struct Tally {
    sent: u64,
    refused: u64,
    dropped: u64,
    answers: Vec<Answer>,
}

/// How long a prediction took.
struct Answer {
    /// From when its frame was scheduled.
    since_schedule: Duration,
    /// From when its frame was in fact sent.
    since_sent: Duration,
    /// Of it the model's computation.
    compute: Duration,
}

type Socket = WebSocketStream<MaybeTlsStream<TcpStream>>;

async fn connect(url: &str) -> Socket {
    let mut request = url.into_client_request().unwrap();
    let protocol = HeaderValue::from_static(Codec::Msgpack.name());
    request.headers_mut().insert("sec-websocket-protocol", protocol);
    tokio_tungstenite::connect_async(request).await.unwrap().0
}

/// One robot: sends on schedule in one half and notes the answers in the other.
async fn robot(args: Args, url: String, first: Instant, tally: Arc<Mutex<Tally>>) {
    let (mut sender, mut receiver) = connect(&url).await.split();
    let manifest = registry::manifest::read(&std::path::Path::new("models").join(&args.model)).unwrap();
    let spec = manifest.spec;
    let frames = (args.seconds * args.rate_hz) as u64;
    let period = Duration::from_secs_f64(1.0 / args.rate_hz);
    let scheduled = move |seq: u64| first + period * seq as u32;
    let pixels = spec.pixels();
    let sent = Arc::new(Mutex::new(Vec::new()));
    let of_sender = Arc::clone(&sent);
    let sending = async move {
        for seq in 0..frames {
            tokio::time::sleep_until(scheduled(seq).into()).await;
            let message = ClientMessage::Frame(FrameMessage {
                seq,
                timestamp_us: 0,
                image: ImageBytes((0..pixels).map(|pixel| (pixel as u64 * 7 + seq) as u8).collect()),
                format: ImageFormat::Raw,
                action: spec.action_inputs().map(|count| vec![0.1; count]),
                state: spec.state_inputs().map(|count| vec![0.1; count]),
                plan: None,
            });
            let bytes = rmp_serde::to_vec_named(&message).unwrap();
            of_sender.lock().unwrap().push(Instant::now());
            sender.send(Message::binary(bytes)).await.unwrap();
        }
        sender
    };
    let of_receiver = Arc::clone(&tally);
    let receiving = async move {
        let mut left = frames;
        while left > 0 {
            let limit = scheduled(frames) + Duration::from_secs(10);
            let Ok(Some(Ok(message))) = tokio::time::timeout_at(limit.into(), receiver.next()).await else {
                break;
            };
            let Message::Binary(bytes) = message else { continue };
            let now = Instant::now();
            let mut tally = of_receiver.lock().unwrap();
            match rmp_serde::from_slice(&bytes).unwrap() {
                ServerMessage::Prediction {
                    seq, timing, dropped, ..
                } => {
                    let compute = Duration::from_micros(timing.compute_us);
                    tally.answers.push(Answer {
                        since_schedule: now - scheduled(seq),
                        since_sent: now - sent.lock().unwrap()[seq as usize],
                        compute,
                    });
                    tally.dropped += dropped;
                    left -= (1 + dropped).min(left);
                }
                ServerMessage::Warming { .. } => left -= 1,
                ServerMessage::Error { .. } => {
                    tally.refused += 1;
                    left -= 1;
                }
                _ => {}
            }
        }
    };
    let (_sender, ()) = tokio::join!(sending, receiving);
    tally.lock().unwrap().sent += frames;
}

fn main() {
    let mut args = Args::parse();
    if args.test {
        (args.sessions, args.seconds) = (4, 1.0);
    }
    let server = Server::start(&args);
    let mut urls: VecDeque<String> = (0..args.sessions).map(|_| server.session(&args.model)).collect();
    let tally = Arc::new(Mutex::new(Tally::default()));
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let begin = Instant::now() + Duration::from_millis(500 + 2 * args.sessions as u64);
        let robots: Vec<_> = (0..args.sessions)
            .map(|index| {
                // Spread over a period, as robots are.
                let first = begin + Duration::from_secs_f64(index as f64 / args.sessions as f64 / args.rate_hz);
                tokio::spawn(robot(
                    args.clone(),
                    urls.pop_front().unwrap(),
                    first,
                    Arc::clone(&tally),
                ))
            })
            .collect();
        for robot in robots {
            robot.await.unwrap();
        }
    });
    report(&args, &mut tally.lock().unwrap());
}

fn report(args: &Args, tally: &mut Tally) {
    let answered = tally.answers.len();
    assert!(answered > 0, "no frame was answered");
    println!(
        "{} sessions at {} Hz for {} s: {} frames sent, {answered} predicted, {} refused, {} dropped",
        args.sessions, args.rate_hz, args.seconds, tally.sent, tally.refused, tally.dropped
    );
    let row = |name: &str, mut values: Vec<Duration>| {
        values.sort_unstable();
        let at = |share: f64| values[((values.len() - 1) as f64 * share) as usize].as_secs_f64() * 1e3;
        println!(
            "{name}: p50 {:.2} ms, p90 {:.2}, p99 {:.2}, most {:.2}",
            at(0.5),
            at(0.9),
            at(0.99),
            at(1.0)
        );
    };
    let of = |time: fn(&Answer) -> Duration| tally.answers.iter().map(time).collect();
    row("from schedule to prediction", of(|answer| answer.since_schedule));
    row("from sending to prediction ", of(|answer| answer.since_sent));
    row("of it the model's own time ", of(|answer| answer.compute));
    row(
        "beyond the model's own time",
        of(|answer| answer.since_sent.saturating_sub(answer.compute)),
    );
}
