//! An S3 server behind a proxy that answers slowly, with errors, and with half of the answer: jobs end as with a good
//! connection, and no half of an object is taken for the whole. Needs the feature `cloud` and an S3 server.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use foreframe_core::files::sha256_hex;
use foreframe_jobs::store::{Store, StoreConfig};
use serde_json::Value;

use crate::jobs_killed::{collect, weights};
use crate::jobs_outage::{short_training, undisturbed};
use crate::process::RunningServer;
use crate::store_away::{status, wait_for_status};

/// What the proxy does to a request, one after another.
#[derive(Clone, Copy, Debug, PartialEq)]
enum ProxyFault {
    None,
    Slow,
    /// An answer with that status, without asking the S3 server.
    Status(&'static str),
    /// The connection is cut in the middle of the request.
    HalfRequest,
    /// The S3 server answers, and the connection is cut in the middle of the answer.
    HalfAnswer,
    /// Half of an object, with the length of the half.
    Truncated,
}

const FAULTS: [ProxyFault; 9] = [
    ProxyFault::Status("500 Internal Server Error"),
    ProxyFault::None,
    ProxyFault::HalfAnswer,
    ProxyFault::None,
    ProxyFault::HalfRequest,
    ProxyFault::Status("503 Slow Down"),
    ProxyFault::Slow,
    ProxyFault::Truncated,
    ProxyFault::None,
];

#[derive(Default)]
struct ProxyState {
    requests: AtomicUsize,
    truncated: AtomicUsize,
    is_away: AtomicBool,
    /// Takes connections and never answers, as behind a cut network.
    is_silent: AtomicBool,
}

/// A proxy in front of an S3 server. It ends with the test's process.
struct FaultyProxy {
    address: SocketAddr,
    state: Arc<ProxyState>,
}

impl FaultyProxy {
    fn start(server: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let state = Arc::<ProxyState>::default();
        let (shared, server) = (Arc::clone(&state), server.to_owned());
        std::thread::spawn(move || {
            for client in listener.incoming() {
                let (client, state, server) = (client.unwrap(), Arc::clone(&shared), server.clone());
                // Errors are what this is for.
                std::thread::spawn(move || forward(client, &server, &state));
            }
        });
        Self { address, state }
    }
}

/// Forwards one request and closes the connection.
fn forward(mut client: TcpStream, server: &str, state: &ProxyState) -> std::io::Result<()> {
    while state.is_silent.load(Ordering::Acquire) {
        std::thread::sleep(Duration::from_millis(50));
    }
    if state.is_away.load(Ordering::Acquire) {
        return Ok(());
    }
    client.set_read_timeout(Some(Duration::from_secs(10)))?;
    let (head, body) = read_message(&mut client)?;
    let number = state.requests.fetch_add(1, Ordering::AcqRel);
    // Mixed, so that a client that asks for the same again does not always meet the same fault.
    let mixed = (number as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32;
    let fault = FAULTS[mixed as usize % FAULTS.len()];
    let connected = || TcpStream::connect(server);
    let ask = |body: &[u8]| -> std::io::Result<Vec<u8>> {
        let (mut server, mut answer) = (connected()?, Vec::new());
        server.write_all(with_close(&head).as_bytes())?;
        server.write_all(body)?;
        server.read_to_end(&mut answer)?;
        Ok(answer)
    };
    match fault {
        ProxyFault::Status(status) => {
            return client
                .write_all(format!("HTTP/1.1 {status}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n").as_bytes());
        }
        ProxyFault::HalfRequest => {
            let mut server = connected()?;
            server.write_all(head.as_bytes())?;
            return server.write_all(&body[..body.len() / 2]);
        }
        ProxyFault::Slow => std::thread::sleep(Duration::from_millis(500)),
        ProxyFault::None | ProxyFault::HalfAnswer | ProxyFault::Truncated => {}
    }
    let answer = ask(&body)?;
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").unwrap_or(0) + 4;
    let answer_head = String::from_utf8_lossy(&answer[..end]).into_owned();
    let body = &answer[end..];
    let is_object = head.starts_with("GET ") && !head.contains("list-type=") && answer_head.contains(" 200 ");
    match fault {
        ProxyFault::HalfAnswer if body.len() > 1 => {
            client.write_all(answer_head.as_bytes())?;
            client.write_all(&body[..body.len() / 2])
        }
        ProxyFault::Truncated if is_object && body.len() > 1 => {
            state.truncated.fetch_add(1, Ordering::AcqRel);
            let half = &body[..body.len() / 2];
            let length = |line: &str| line.to_ascii_lowercase().starts_with("content-length:");
            for line in answer_head.trim_end().lines().filter(|line| !length(line)) {
                client.write_all(format!("{line}\r\n").as_bytes())?;
            }
            client.write_all(format!("Content-Length: {}\r\n\r\n", half.len()).as_bytes())?;
            client.write_all(half)
        }
        _ => client.write_all(&answer),
    }
}

/// The head with its empty line, and the body by its `Content-Length`.
fn read_message(stream: &mut TcpStream) -> std::io::Result<(String, Vec<u8>)> {
    let (mut head, mut byte) = (Vec::new(), [0]);
    while !head.ends_with(b"\r\n\r\n") {
        stream.read_exact(&mut byte)?;
        head.push(byte[0]);
    }
    let head = String::from_utf8_lossy(&head).into_owned();
    let length = head.lines().find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case("content-length")
            .then(|| value.trim().parse().ok())?
    });
    let mut body = vec![0; length.unwrap_or(0)];
    stream.read_exact(&mut body)?;
    Ok((head, body))
}

/// The same head that asks for a single answer.
fn with_close(head: &str) -> String {
    let is_connection = |line: &&str| !line.to_ascii_lowercase().starts_with("connection:");
    let lines: Vec<&str> = head.trim_end().lines().filter(is_connection).collect();
    format!("{}\r\nConnection: close\r\n\r\n", lines.join("\r\n"))
}

/// The hash of each file below a directory, by its path in it.
fn hashes(dir: &Path) -> Vec<(String, String)> {
    let (mut dirs, mut found) = (vec![dir.to_owned()], Vec::new());
    while let Some(below) = dirs.pop() {
        for entry in std::fs::read_dir(below).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                dirs.push(path);
            } else {
                let name = path.strip_prefix(dir).unwrap().display().to_string();
                found.push((name, sha256_hex(&std::fs::read(path).unwrap())));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn jobs_end_the_same_behind_a_faulty_connection_to_s3() {
    let (Ok(bucket), Ok(endpoint), true) = (
        std::env::var("FOREFRAME_TEST_S3"),
        std::env::var("AWS_ENDPOINT_URL"),
        cfg!(feature = "cloud"),
    ) else {
        println!(
            "skipped: built without the feature cloud, or FOREFRAME_TEST_S3 and AWS_ENDPOINT_URL name no S3 server"
        );
        return;
    };
    let whole = undisturbed(&short_training());
    let proxy = FaultyProxy::start(endpoint.trim_start_matches("http://"));
    let through = format!("http://{}", proxy.address);
    let (here, there) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let run = here.path().file_name().unwrap().to_string_lossy().replace('.', "");
    let url = format!("{bucket}/faulty-{run}");
    let serve = |dir: &Path| {
        let data = dir.join("data").display().to_string();
        let arguments = ["--data-dir", &data, "--objects-url", &url];
        RunningServer::start_with(dir, &arguments, &[("AWS_ENDPOINT_URL", &through)])
    };
    let server = serve(here.path());
    // A submission looks for the data set in S3, so it can be refused with 503.
    let submit = |body: &Value| {
        loop {
            let answer = server.send("POST", "/v1/jobs", &body.to_string());
            match status(&answer) {
                "202" => return,
                "503" => {}
                _ => panic!("{answer}"),
            }
        }
    };
    submit(&collect());
    server.wait_for_job("job-1", |job| job["state"] == "succeeded");
    submit(&short_training());
    server.wait_for_job("job-2", |job| job["progress"]["done"].as_u64() > Some(0));
    proxy.state.is_away.store(true, Ordering::Release);
    let refused = wait_for_status(&server, "/v1/datasets", "503");
    assert!(refused.to_lowercase().contains("\r\nretry-after: "), "{refused}");
    proxy.state.is_silent.store(true, Ordering::Release);
    let refused = server.get("/v1/datasets");
    assert!(
        status(&refused) == "503" && refused.contains("no answer within 10 s"),
        "{refused}"
    );
    proxy.state.is_away.store(false, Ordering::Release);
    proxy.state.is_silent.store(false, Ordering::Release);
    let job = server.wait_for_job("job-2", |job| job["state"] == "succeeded");
    assert_eq!(
        (&job["attempts"], &job["result"]["version"]),
        (&Value::from(1), &Value::from(1))
    );

    let other = serve(there.path());
    let picture = "/v1/datasets/seen/episodes/0/preview.png";
    let deadline = std::time::Instant::now() + Duration::from_mins(2);
    while status(&other.get(picture)) != "200" {
        assert!(std::time::Instant::now() < deadline);
    }
    let set = |dir: &Path| hashes(&dir.join("data/datasets/seen"));
    let expected = hashes(&whole.path().join("datasets/seen"));
    let names = |found: &[(String, String)]| found.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert!(set(there.path()) == set(here.path()), "{:?}", names(&set(there.path())));
    assert_eq!(names(&set(here.path())), names(&expected));

    // What was published, by a good connection.
    let direct = tempfile::tempdir().unwrap();
    let config = StoreConfig {
        data_dir: direct.path().to_owned(),
        database: None,
        objects: Some(url),
    };
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let store = Store::open(&config).await.unwrap();
        assert_eq!(store.objects().directories("models/m").await.unwrap(), ["1"]);
        assert!(store.objects().pull("models/m/1", "manifest.json").await.unwrap());
    });
    assert!(weights(direct.path()) == weights(whole.path()), "the weights differ");
    let (requests, truncated) = (&proxy.state.requests, &proxy.state.truncated);
    assert!(requests.load(Ordering::Acquire) > 50 && truncated.load(Ordering::Acquire) > 0);
}
