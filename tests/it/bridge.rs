//! `foreframe bridge` with a robot that speaks Foxglove's WebSocket protocol, played by the test.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader, Read as _};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, ChildStderr, Stdio};

use foreframe_core::frame::{Frame, codec};
use foreframe_core::nn::Conditioning;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::handshake::server::{Request, Response};
use tokio_tungstenite::tungstenite::http::HeaderValue;
use tokio_tungstenite::tungstenite::{Message, WebSocket, accept_hdr};

use crate::bag_files::{image, odometry, twist};
use crate::process::foreframe;
use crate::service::{CONTEXT, HEIGHT, HORIZON, TIMEOUT, WIDTH, frame, model, spec};

pub(crate) const PERIOD_NS: u64 = 200_000_000;
pub(crate) const PROTOCOL: &str = "foxglove.sdk.v1";

/// The bridge as a process, and the robot that it has connected to.
pub(crate) struct Robot {
    bridge: Child,
    stderr: BufReader<ChildStderr>,
    socket: WebSocket<TcpStream>,
}

impl Robot {
    /// Starts the bridge with a small model, and says which channels there are.
    pub(crate) fn start(dir: &Path, arguments: &[&str], capabilities: &[&str], channels: &Value) -> Self {
        model(dir, "moving", spec(Conditioning::StateAction));
        let mut robot = Self::connect(dir, "./moving", arguments);
        robot.say(&json!({"op": "serverInfo", "name": "test robot", "capabilities": capabilities}));
        robot.say(&json!({"op": "advertise", "channels": channels}));
        robot
    }

    /// Starts the bridge with this model, and says nothing yet.
    pub(crate) fn connect(dir: &Path, model: &str, arguments: &[&str]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("ws://{}", listener.local_addr().unwrap());
        let mut bridge = foreframe(dir)
            .args(["bridge", &address, "--model", model])
            .args(arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        let choose = |request: &Request, mut response: Response| {
            let offered = request.headers()["sec-websocket-protocol"].to_str().unwrap();
            assert!(offered.split(", ").any(|protocol| protocol == PROTOCOL), "{offered}");
            let headers = response.headers_mut();
            headers.insert("sec-websocket-protocol", HeaderValue::from_static(PROTOCOL));
            Ok(response)
        };
        Self {
            stderr: BufReader::new(bridge.stderr.take().unwrap()),
            bridge,
            socket: accept_hdr(stream, choose).unwrap(),
        }
    }

    pub(crate) fn say(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).unwrap();
    }

    /// The next message of the bridge; a ping gets its answer when the next one is read.
    pub(crate) fn read(&mut self) -> Message {
        self.socket.read().unwrap()
    }

    fn read_data(&mut self) -> Message {
        loop {
            let message = self.read();
            if !message.is_ping() {
                return message;
            }
        }
    }

    pub(crate) fn heard(&mut self) -> Value {
        serde_json::from_str(self.read_data().to_text().unwrap()).unwrap()
    }

    /// The subscriptions that come next: the number of each, by its channel.
    pub(crate) fn subscriptions(&mut self, count: usize) -> BTreeMap<u64, u32> {
        let mut subscriptions = BTreeMap::new();
        for _ in 0..count {
            let asked = &self.heard()["subscriptions"][0];
            let [channel, id] = ["channelId", "id"].map(|name| asked[name].as_u64().unwrap());
            subscriptions.insert(channel, id as u32);
        }
        subscriptions
    }

    pub(crate) fn data(&mut self, subscription: u32, time_ns: u64, payload: &[u8]) {
        let message = [&[1][..], &subscription.to_le_bytes(), &time_ns.to_le_bytes(), payload].concat();
        self.socket.send(Message::binary(message)).unwrap();
    }

    /// The next message of the bridge with data: the number of its channel, and the message.
    pub(crate) fn published(&mut self) -> (u32, Vec<u8>) {
        let message = self.read_data().into_data();
        assert_eq!(message[0], 1);
        (
            u32::from_le_bytes(*message[1..].first_chunk().unwrap()),
            message[5..].to_vec(),
        )
    }

    /// The next predicted frame as a message.
    pub(crate) fn predicted(&mut self) -> Vec<u8> {
        loop {
            let (topic, message) = self.published();
            if topic == 1 {
                return message;
            }
        }
    }

    /// The next line on standard error that has this text. Without one, fails when the bridge ends.
    pub(crate) fn warned(&mut self, text: &str) -> String {
        let mut read = String::new();
        loop {
            let mut line = String::new();
            let count = self.stderr.read_line(&mut line).unwrap();
            assert!(count > 0, "no \"{text}\" in:\n{read}");
            if line.contains(text) {
                return line;
            }
            read += &line;
        }
    }

    /// Ends the connection; what the bridge printed to standard output, and to standard error.
    pub(crate) fn end(self) -> [String; 2] {
        let Self { bridge, stderr, socket } = self;
        drop(socket);
        ended(bridge, stderr)
    }

    /// The same when the bridge ends by itself.
    pub(crate) fn wait(self) -> [String; 2] {
        let Self {
            bridge,
            stderr,
            socket: _open,
        } = self;
        ended(bridge, stderr)
    }
}

fn ended(mut bridge: Child, mut stderr: BufReader<ChildStderr>) -> [String; 2] {
    assert!(!bridge.wait().unwrap().success());
    let mut texts = [String::new(), String::new()];
    bridge.stdout.unwrap().read_to_string(&mut texts[0]).unwrap();
    stderr.read_to_string(&mut texts[1]).unwrap();
    texts
}

pub(crate) fn channel(id: u32, topic: &str, schema: &str) -> Value {
    json!({"id": id, "topic": topic, "encoding": "cdr", "schemaName": schema, "schema": "", "schemaEncoding": "ros2msg"})
}

/// The number at the end of a `std_msgs/msg/Float64`.
fn number(message: &[u8]) -> f64 {
    f64::from_le_bytes(*message.last_chunk().unwrap())
}

/// The PNG at the end of a `sensor_msgs/msg/CompressedImage`.
fn picture(message: &[u8]) -> Frame {
    let start = message.windows(4).position(|bytes| bytes == b"\x89PNG").unwrap();
    codec::decode(&message[start..]).unwrap()
}

fn mse(one: &Frame, other: &Frame) -> f64 {
    let pairs = one.pixels().iter().zip(other.pixels());
    let squares = pairs.map(|(&one, &other)| ((f64::from(one) - f64::from(other)) / 255.0).powi(2));
    squares.sum::<f64>() / one.pixels().len() as f64
}

#[test]
fn a_robot_gets_predictions_and_their_errors() {
    let dir = tempfile::tempdir().unwrap();
    let channels = json!([
        channel(7, "/rear/image", "sensor_msgs/msg/Image"),
        channel(4, "/camera/image", "sensor_msgs/msg/Image"),
        channel(5, "/cmd_vel", "geometry_msgs/msg/Twist"),
        channel(6, "/odom", "nav_msgs/msg/Odometry"),
        channel(8, "/imu", "sensor_msgs/msg/Imu"),
    ]);
    let arguments = ["--image", "/camera/image"];
    let mut robot = Robot::start(dir.path(), &arguments, &["clientPublish", "time"], &channels);
    let advertised = robot.heard();
    assert_eq!(advertised["op"], "advertise");
    let topics: Vec<&str> = advertised["channels"]
        .as_array()
        .unwrap()
        .iter()
        .map(|one| one["topic"].as_str().unwrap())
        .collect();
    assert_eq!(
        topics,
        ["/foreframe/predicted", "/foreframe/error", "/foreframe/expected_error"]
    );
    let subscriptions = robot.subscriptions(3);
    assert_eq!(subscriptions.keys().copied().collect::<Vec<_>>(), [4, 5, 6]);
    let (camera, command, odom) = (subscriptions[&4], subscriptions[&5], subscriptions[&6]);
    // An image before the first action and state is not used.
    let send_image = |robot: &mut Robot, time_ns: u64, frame: &Frame| {
        let message = image(false, time_ns as i64, "mono8", (WIDTH, HEIGHT), frame.pixels());
        robot.data(camera, time_ns, &message);
    };
    send_image(&mut robot, 0, &frame(99));
    // One that cannot be read is left out.
    robot.data(camera, 1, b"half an image");
    robot.data(command, 1, &twist(false, 0.5, 0.1));
    let (mut predicted, begin) = (Vec::new(), 1_000_000_000);
    for index in 0..8u64 {
        let seen = frame(20 * index as u8);
        robot.data(odom, begin + index * PERIOD_NS, &odometry(1, 0.2, 0.0, 0.5));
        send_image(&mut robot, begin + index * PERIOD_NS, &seen);
        // The camera has three times the rate of the model.
        send_image(&mut robot, begin + index * PERIOD_NS + PERIOD_NS / 3, &frame(7));
        send_image(&mut robot, begin + index * PERIOD_NS + 2 * PERIOD_NS / 3, &frame(9));
        if (index as usize) + 1 < CONTEXT {
            continue;
        }
        let (topic, message) = robot.published();
        assert_eq!(topic, 1);
        predicted.push(picture(&message));
        assert_eq!((predicted[0].width(), predicted[0].height()), (WIDTH, HEIGHT));
        if predicted.len() > HORIZON {
            let (topic, message) = robot.published();
            assert_eq!(topic, 2);
            let expected = mse(&predicted[predicted.len() - 1 - HORIZON], &seen);
            assert!(
                (number(&message) - expected).abs() < 1e-6,
                "{} {expected}",
                number(&message)
            );
        }
    }
    // After a gap, the context begins anew, and nothing was predicted for these frames.
    robot.data(odom, begin + 60 * PERIOD_NS, &odometry(1, 0.2, 0.0, 0.5));
    for index in 0..CONTEXT as u64 {
        send_image(
            &mut robot,
            begin + 60 * PERIOD_NS + index * PERIOD_NS,
            &frame(index as u8),
        );
    }
    assert_eq!(robot.published().0, 1);
    let [out, error] = robot.end();
    assert!(
        out.contains("connected to \"test robot\"") && out.contains("image: /camera/image\n"),
        "{out}"
    );
    assert!(
        error.contains("left out: a message of /camera/image cannot be read")
            && error.contains("could not read from the robot at ws://127.0.0.1:"),
        "{error}"
    );
}

#[test]
fn a_robot_that_takes_no_messages_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let robot = Robot::start(dir.path(), &[], &[], &json!([]));
    let [_, error] = robot.end();
    assert!(error.contains("\"test robot\" takes no messages of clients"), "{error}");
}

#[test]
fn what_cannot_be_used_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let channels = json!([channel(1, "/map", "nav_msgs/msg/OccupancyGrid")]);
    let robot = Robot::start(dir.path(), &["--image", "/map"], &["clientPublish"], &channels);
    let [_, error] = robot.wait();
    assert!(
        error.contains("/map has messages of the type \"nav_msgs/msg/OccupancyGrid\""),
        "{error}"
    );
    for address in ["http://localhost:1", "robot"] {
        let refused = crate::process::output(dir.path(), &["bridge", address, "--model", "./moving"]);
        assert_eq!(refused.status.code(), Some(2), "{address}");
    }
    let bridge = ["bridge", "ws://127.0.0.1:1", "--model", "./moving"];
    let silent = crate::process::output(dir.path(), &bridge);
    assert_eq!(silent.status.code(), Some(1));
    for (name, value, reason) in [
        ("--image", "/foreframe/predicted", "which this bridge itself publishes"),
        ("--idle-limit", "0", "give a number of seconds"),
        ("--state-age-limit", "soon", "give a number of seconds"),
    ] {
        let refused = crate::process::output(dir.path(), &[&bridge[..], &[name, value]].concat());
        let error = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(2), "{error}");
        assert!(error.contains(reason), "{error}");
    }
}

#[cfg(not(feature = "tls"))]
#[test]
fn a_secure_address_needs_a_program_with_tls() {
    let dir = tempfile::tempdir().unwrap();
    model(dir.path(), "moving", spec(Conditioning::StateAction));
    let refused = crate::process::output(dir.path(), &["bridge", "wss://127.0.0.1:1", "--model", "./moving"]);
    let error = String::from_utf8_lossy(&refused.stderr);
    assert_eq!(refused.status.code(), Some(2), "{error}");
    assert!(
        error.contains("built without TLS") && error.contains("--features tls"),
        "{error}"
    );
}
