//! What `foreframe bridge` takes from a robot, and what it says when something is missing, old or cannot be read.

use std::path::Path;

use foreframe_core::frame::Frame;
use foreframe_core::nn::Conditioning;
use foreframe_data::dataset::import::live::LiveType;
use serde_json::{Value, json};

use crate::bag_files::{image, odometry, twist};
use crate::bridge::{PERIOD_NS, Robot, channel};
use crate::service::{CONTEXT, HORIZON, frame, model, spec};

const PUBLISHES: [&str; 1] = ["clientPublish"];

/// What a model of a moving camera needs.
fn inputs() -> [Value; 3] {
    [
        channel(1, "/camera/image", "sensor_msgs/msg/Image"),
        channel(2, "/cmd_vel", "geometry_msgs/msg/Twist"),
        channel(3, "/odom", "nav_msgs/msg/Odometry"),
    ]
}

/// A camera, a command and an odometry that are subscribed.
struct Inputs {
    camera: u32,
    command: u32,
    odom: u32,
}

impl Inputs {
    /// Reads what the bridge publishes, then its subscriptions.
    fn of(robot: &mut Robot) -> Self {
        assert_eq!(robot.heard()["op"], "advertise");
        let asked = robot.subscriptions(3);
        let [camera, command, odom] = [1, 2, 3].map(|channel| asked[&channel]);
        Self { camera, command, odom }
    }

    fn send_image(&self, robot: &mut Robot, time_ns: u64, frame: &Frame) {
        let size = (frame.width(), frame.height());
        let message = image(false, time_ns as i64, "mono8", size, frame.pixels());
        robot.data(self.camera, time_ns, &message);
    }
}

#[test]
fn predictions_are_never_the_camera_unless_named() {
    let dir = tempfile::tempdir().unwrap();
    let predicted = |id, prefix| channel(id, &format!("{prefix}/predicted"), "sensor_msgs/msg/CompressedImage");
    let [camera, command, odom] = inputs();
    let rear = channel(7, "/rear/image", "sensor_msgs/msg/Image");
    let first = json!([predicted(8, "/foreframe"), predicted(9, "/moving"), command, odom]);
    let mut robot = Robot::start(dir.path(), &[], &PUBLISHES, &first);
    // The camera starts after the bridge.
    robot.say(&json!({"op": "advertise", "channels": [camera, rear]}));
    Inputs::of(&mut robot);
    let line = robot.warned("not chosen as image");
    assert!(line.contains(": /moving/predicted;"), "{line}");
    let line = robot.warned("/camera/image was chosen as image");
    assert!(line.contains("so could be: /rear/image;"), "{line}");
    robot.end();
}

#[test]
fn a_channel_that_cannot_be_read_does_not_hide_the_others() {
    let dir = tempfile::tempdir().unwrap();
    let [camera, command, odom] = inputs();
    let wrong = json!({"id": 9, "topic": "/map", "encoding": "json", "schemaName": null});
    let mut robot = Robot::start(dir.path(), &[], &PUBLISHES, &json!([camera, wrong, command, odom]));
    Inputs::of(&mut robot);
    let line = robot.warned("channels that cannot be read are left out");
    assert!(line.contains("/map: invalid type: null"), "{line}");
    robot.say(&json!({"op": "advertise", "channels": 5}));
    robot.warned("is no message of Foxglove's protocol");
    robot.end();
}

#[test]
fn a_robot_that_answers_no_ping_ends_the_bridge() {
    let dir = tempfile::tempdir().unwrap();
    let mut robot = Robot::start(dir.path(), &["--idle-limit", "1"], &PUBLISHES, &json!([]));
    assert_eq!(robot.heard()["op"], "advertise");
    // So long it answers: each comes half of the limit after the answer to the one before.
    for _ in 0..4 {
        assert!(robot.read().is_ping());
    }
    let [_, error] = robot.wait();
    assert!(
        error.contains("nothing came from the robot at ws://127.0.0.1:") && error.contains("for 1s"),
        "{error}"
    );
}

#[test]
fn what_is_missing_is_named_after_some_seconds() {
    let dir = tempfile::tempdir().unwrap();
    let [camera, command, odom] = inputs();
    model(dir.path(), "moving", spec(Conditioning::StateAction));
    let mut robot = Robot::connect(dir.path(), "./moving", &["--idle-limit", "60", "--action", "/cmd_vel"]);
    robot.warned("the robot has sent no serverInfo");
    robot.say(&json!({"op": "serverInfo", "name": "test robot", "capabilities": PUBLISHES}));
    robot.say(&json!({"op": "advertise", "channels": [camera]}));
    let line = robot.warned("no message of /camera/image (image) came that can be read");
    assert!(
        line.contains("the robot has no topic /cmd_vel, named by --action")
            && line.contains("the robot has no topic for the state (nav_msgs/msg/Odometry or"),
        "{line}"
    );
    robot.say(&json!({"op": "advertise", "channels": [command, odom]}));
    let line = robot.warned("no message of /odom (state) came");
    assert!(line.contains("no message of /cmd_vel (action) came"), "{line}");
    let inputs = Inputs::of(&mut robot);
    robot.data(inputs.command, 0, &twist(false, 0.5, 0.1));
    robot.data(inputs.odom, 0, &odometry(0, 0.2, 0.0, 0.5));
    for index in 0..CONTEXT as u64 {
        inputs.send_image(&mut robot, index * PERIOD_NS, &frame(9));
    }
    robot.predicted();
    let line = robot.warned("has no new images");
    assert!(line.contains("/camera/image") && !line.contains("/odom"), "{line}");
    robot.end();
}

/// The time in the header of a message.
fn stamp_ns(message: &[u8]) -> u64 {
    let number = |at: usize| u64::from(u32::from_le_bytes(*message[at..].first_chunk().unwrap()));
    number(4) * 1_000_000_000 + number(8)
}

#[test]
fn an_old_state_pauses_the_predictions() {
    let dir = tempfile::tempdir().unwrap();
    let arguments = ["--idle-limit", "60", "--state-age-limit", "0.9"];
    let mut robot = Robot::start(dir.path(), &arguments, &PUBLISHES, &json!(inputs()));
    let inputs = Inputs::of(&mut robot);
    robot.data(inputs.command, 0, &twist(false, 0.5, 0.1));
    robot.data(inputs.odom, 0, &odometry(0, 0.2, 0.0, 0.5));
    for index in 0..10 {
        inputs.send_image(&mut robot, index * PERIOD_NS, &frame(index as u8));
    }
    let later = |index: u64| (index + HORIZON as u64) * PERIOD_NS;
    for index in CONTEXT as u64 - 1..5 {
        assert_eq!(stamp_ns(&robot.predicted()), later(index));
    }
    let line = robot.warned("the last state of /odom is more than 900ms from the last image");
    assert!(line.contains("predictions pause until a new one comes"), "{line}");
    robot.data(inputs.odom, 10 * PERIOD_NS, &odometry(0, 0.3, 0.0, 0.5));
    for index in 10..10 + CONTEXT as u64 {
        inputs.send_image(&mut robot, index * PERIOD_NS, &frame(index as u8));
    }
    // The context began anew.
    assert_eq!(stamp_ns(&robot.predicted()), later(10 + CONTEXT as u64 - 1));
    robot.end();
}

/// The last of some predictions of the shipped model that sees speeds, after one state or none, at the time 0.
fn without_state(state: Option<Vec<u8>>, limit_s: &str) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let rooms = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/rooms");
    let arguments = ["--idle-limit", "60", "--state-age-limit", limit_s];
    let mut robot = Robot::connect(dir.path(), rooms.to_str().unwrap(), &arguments);
    robot.say(&json!({"op": "serverInfo", "name": "test robot", "capabilities": PUBLISHES}));
    robot.say(&json!({"op": "advertise", "channels": inputs()}));
    let inputs = Inputs::of(&mut robot);
    robot.data(inputs.command, 0, &twist(false, 0.2, 0.1));
    let has_state = state.is_some();
    if let Some(state) = state {
        robot.data(inputs.odom, 0, &state);
    }
    for index in 0..12 {
        let pixels = (0..64 * 64).map(|place| (place % 64 * 3 + place / 64 + index * 2) as u8);
        let seen = Frame::new(64, 64, pixels.collect()).unwrap();
        inputs.send_image(&mut robot, index * PERIOD_NS, &seen);
    }
    let predicted = (4..12).map(|_| robot.predicted()).last().unwrap();
    if has_state && limit_s == "1" {
        robot.warned("predictions go on without it");
    }
    robot.end();
    predicted
}

#[test]
fn a_model_that_sees_speeds_goes_on_without_an_old_state() {
    let state = || Some(odometry(0, 0.2, 0.0, 0.5));
    let old = without_state(state(), "1");
    assert!(old == without_state(None, "1"), "the old state counts");
    assert!(old != without_state(state(), "100"), "a state does not count at all");
}

#[test]
fn the_largest_images_are_taken() {
    let dir = tempfile::tempdir().unwrap();
    let mut robot = Robot::start(dir.path(), &[], &PUBLISHES, &json!(inputs()));
    let inputs = Inputs::of(&mut robot);
    robot.data(inputs.command, 0, &twist(false, 0.5, 0.1));
    robot.data(inputs.odom, 0, &odometry(0, 0.2, 0.0, 0.5));
    let size = 4096;
    let message = image(false, 0, "rgba8", (size, size), &vec![99; 4 * (size * size) as usize]);
    robot.data(inputs.camera, 0, &message);
    for index in 1..CONTEXT as u64 {
        inputs.send_image(&mut robot, index * PERIOD_NS, &frame(index as u8));
    }
    robot.predicted();
    robot.end();
}

#[test]
fn what_is_wrong_with_an_image_in_json_is_named() {
    let raw = LiveType::of("json", "foxglove.RawImage").unwrap();
    let message = |change: &dyn Fn(&mut Value)| {
        let mut message = json!({"width": 3, "height": 2, "encoding": "mono8", "step": 3, "data": "YWJjZGVm"});
        change(&mut message);
        raw.image(message.to_string().as_bytes())
    };
    let right = message(&|_| {}).unwrap();
    assert_eq!((right.width(), right.height(), right.pixels()), (3, 2, &b"abcdef"[..]));
    for (name, value, reason) in [
        ("step", Value::Null, "its step is missing"),
        ("step", json!(3.5), "its step is no whole number"),
        ("width", json!("3"), "its width is no whole number"),
        ("height", json!(-2), "its height is no whole number"),
        ("encoding", json!(8), "expected a string"),
        ("data", json!("?"), "its data is not base64"),
    ] {
        let error = message(&|message| message[name] = value.clone()).unwrap_err();
        assert!(error.contains(reason), "{name}: {error}");
    }
    for name in ["step", "width", "height", "encoding", "data"] {
        let without = |message: &mut Value| drop(message.as_object_mut().unwrap().remove(name));
        let error = message(&without).unwrap_err();
        assert!(error.contains(name) && error.contains("missing"), "{name}: {error}");
    }
}
