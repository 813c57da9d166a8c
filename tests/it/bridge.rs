//! `foreframe bridge` with a robot that speaks Foxglove's WebSocket protocol, played by the test.

use std::io::Read as _;
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Stdio};

use foreframe_core::frame::{Frame, codec};
use foreframe_core::nn::Conditioning;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::handshake::server::{Request, Response};
use tokio_tungstenite::tungstenite::http::HeaderValue;
use tokio_tungstenite::tungstenite::{Message, WebSocket, accept_hdr};

use crate::bag_files::{image, odometry, twist};
use crate::process::foreframe;
use crate::service::{CONTEXT, HEIGHT, HORIZON, TIMEOUT, WIDTH, frame, model, spec};

const PERIOD_NS: u64 = 200_000_000;
pub(crate) const PROTOCOL: &str = "foxglove.sdk.v1";

/// The bridge as a process, and the robot that it has connected to.
struct Robot {
    bridge: Child,
    socket: WebSocket<TcpStream>,
}

impl Robot {
    /// Starts the bridge with a small model, and says which channels there are.
    fn start(dir: &std::path::Path, arguments: &[&str], capabilities: &[&str], channels: &Value) -> Self {
        model(dir, "moving", spec(Conditioning::StateAction));
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("ws://{}", listener.local_addr().unwrap());
        let bridge = foreframe(dir)
            .args(["bridge", &address, "--model", "./moving"])
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
        let mut robot = Self {
            bridge,
            socket: accept_hdr(stream, choose).unwrap(),
        };
        robot.say(&json!({"op": "serverInfo", "name": "test robot", "capabilities": capabilities}));
        robot.say(&json!({"op": "advertise", "channels": channels}));
        robot
    }

    fn say(&mut self, message: &Value) {
        self.socket.send(Message::text(message.to_string())).unwrap();
    }

    fn heard(&mut self) -> Value {
        serde_json::from_str(self.socket.read().unwrap().to_text().unwrap()).unwrap()
    }

    fn data(&mut self, subscription: u32, time_ns: u64, payload: &[u8]) {
        let message = [&[1][..], &subscription.to_le_bytes(), &time_ns.to_le_bytes(), payload].concat();
        self.socket.send(Message::binary(message)).unwrap();
    }

    /// The next message of the bridge with data: the number of its channel, and the message.
    fn published(&mut self) -> (u32, Vec<u8>) {
        let message = self.socket.read().unwrap().into_data();
        assert_eq!(message[0], 1);
        (
            u32::from_le_bytes(*message[1..].first_chunk().unwrap()),
            message[5..].to_vec(),
        )
    }

    /// Ends the connection; what the bridge printed to standard output, and to standard error.
    fn end(mut self) -> [String; 2] {
        drop(self.socket);
        let status = self.bridge.wait().unwrap();
        assert!(!status.success());
        let mut texts = [String::new(), String::new()];
        self.bridge.stdout.unwrap().read_to_string(&mut texts[0]).unwrap();
        self.bridge.stderr.unwrap().read_to_string(&mut texts[1]).unwrap();
        texts
    }
}

fn channel(id: u32, topic: &str, schema: &str) -> Value {
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
    let mut subscriptions = std::collections::BTreeMap::new();
    for _ in 0..3 {
        let asked = &robot.heard()["subscriptions"][0];
        subscriptions.insert(
            asked["channelId"].as_u64().unwrap(),
            asked["id"].as_u64().unwrap() as u32,
        );
    }
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
    robot.data(odom, 1, &odometry(1, 0.2, 0.0, 0.5));
    let (mut predicted, begin) = (Vec::new(), 1_000_000_000);
    for index in 0..8u64 {
        let seen = frame(20 * index as u8);
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
    let mut bridge = robot.bridge;
    assert_eq!(bridge.wait().unwrap().code(), Some(2));
    let mut error = String::new();
    bridge.stderr.unwrap().read_to_string(&mut error).unwrap();
    assert!(
        error.contains("/map has messages of the type \"nav_msgs/msg/OccupancyGrid\""),
        "{error}"
    );
    for address in ["http://localhost:1", "robot"] {
        let refused = crate::process::output(dir.path(), &["bridge", address, "--model", "./moving"]);
        assert_eq!(refused.status.code(), Some(2), "{address}");
    }
    let silent = crate::process::output(dir.path(), &["bridge", "ws://127.0.0.1:1", "--model", "./moving"]);
    assert_eq!(silent.status.code(), Some(1));
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
