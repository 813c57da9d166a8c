//! A server process that is killed during a stream.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use foreframe::server::protocol::{ClientMessage, Codec, FrameMessage, ServerMessage};
use foreframe::server::{ImageBytes, ImageFormat};
use foreframe_core::frame::codec;
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle};

struct KillableServer {
    child: Child,
    address: SocketAddr,
}

impl KillableServer {
    fn start(data_dir: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_foreframe"))
            .args(["serve", "--bind", "127.0.0.1:0", "--models-dir", "models", "--data-dir"])
            .arg(data_dir)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap())
            .read_line(&mut line)
            .unwrap();
        let address = line
            .split("http://")
            .nth(1)
            .and_then(|rest| rest.split('/').next())
            .unwrap();
        Self {
            address: address.parse().unwrap(),
            child,
        }
    }

    fn ask(&self, method: &str, path: &str, body: &Value) -> Value {
        let body = body.to_string();
        let mut socket = TcpStream::connect(self.address).unwrap();
        let head = format!(
            "{method} {path} HTTP/1.1\r\nhost: a\r\nconnection: close\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n",
            body.len()
        );
        socket.write_all((head + &body).as_bytes()).unwrap();
        let mut answer = String::new();
        socket.read_to_string(&mut answer).unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(head.starts_with("HTTP/1.1 20"), "{answer}");
        serde_json::from_str(body).unwrap()
    }

    /// Kills the process with SIGKILL.
    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for KillableServer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn frame(seq: u64) -> ClientMessage {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/frames");
    let image = std::fs::read(dir.join(format!("frame-{seq:03}.png"))).unwrap();
    let recorded: Value = serde_json::from_slice(&std::fs::read(dir.join("actions.json")).unwrap()).unwrap();
    let numbers = |field: &str| serde_json::from_value(recorded[field][seq as usize].clone()).unwrap();
    ClientMessage::Frame(FrameMessage {
        steps: None,
        seq,
        timestamp_us: 0,
        image: ImageBytes(codec::decode(&image).unwrap().pixels().to_vec()),
        format: ImageFormat::Raw,
        action: Some(numbers("actions")),
        state: Some(numbers("states")),
        plan: None,
    })
}

fn images(answer: ServerMessage) -> Vec<ImageBytes> {
    match answer {
        ServerMessage::Prediction { frames, .. } => frames,
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn an_exported_state_outlives_a_killed_server() {
    let dir = tempfile::tempdir().unwrap();
    let mut first = KillableServer::start(&dir.path().join("first"));
    let open = |server: &KillableServer, body: &Value| SessionHandle::of(&server.ask("POST", "/v1/sessions", body));
    let connect = async |server: &KillableServer, session: &SessionHandle| {
        Client::connect(server.address, &session.path("/stream"), Codec::Msgpack)
            .await
            .unwrap()
    };
    let session = open(&first, &json!({"model": "moving"}));
    let mut client = connect(&first, &session).await;
    for seq in 0..8 {
        client.ask(&frame(seq)).await;
    }
    let state = first.ask("GET", &session.path("/state"), &Value::Null);
    let expected = images(client.ask(&frame(8)).await);
    first.kill();

    let second = KillableServer::start(&dir.path().join("second"));
    let session = open(&second, &json!({"state": state}));
    let mut client = connect(&second, &session).await;
    assert_eq!(client.next_seq, 8);
    assert_eq!(images(client.ask(&frame(8)).await), expected);
}
