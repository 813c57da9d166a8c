//! The five commands of docs/own-data.md, from a recording to a served model, run as they stand there.

use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

use crate::process::RunningServer;
use crate::readme::{checkout, commands, run};
use crate::recordings;

/// The only difference from the document: the training takes 4 steps instead of 1,500.
const FEWER_STEPS: &str = " --set sequence.steps=4";
/// Frames of the recording: 50 s at 20 frames/s.
const FRAMES: u32 = 1000;

/// The commands of the document's blocks up to where it describes the options: the five, then those that show a prediction.
fn first_commands() -> Vec<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/own-data.md");
    let document = std::fs::read_to_string(path).unwrap();
    commands(document.split("\n- `--every 4`").next().unwrap())
}

#[test]
fn five_commands_turn_a_recording_into_a_served_model() {
    let dir = checkout();
    recordings::tub(&dir.path().join("mycar/data"), FRAMES);
    let mut names = Vec::new();
    for written in first_commands() {
        let is_training = written.starts_with("foreframe train ");
        let command = written.clone() + if is_training { FEWER_STEPS } else { "" };
        let printed = run(dir.path(), &command);
        assert!(!printed.is_empty(), "{command} printed nothing");
        names.push(written.split_whitespace().nth(1).unwrap().to_owned());
    }
    let five = ["import", "inspect", "train", "evaluate", "publish"];
    assert_eq!(names, [&five[..], &["export", "predict"]].concat());
    for file in [
        "mycar.html",
        "reports/mycar/report.md",
        "look/episode.gif",
        "predicted/predicted-5.png",
    ] {
        assert!(dir.path().join(file).is_file(), "{file} is missing");
    }
    let server = RunningServer::start(dir.path(), &[]);
    let model = server.ask("GET", "/v1/models/mycar", &Value::Null);
    let channels: Vec<&str> = model["spec"]["actions"]
        .as_array()
        .unwrap_or_else(|| panic!("{model}"))
        .iter()
        .map(|channel| channel["name"].as_str().unwrap())
        .collect();
    assert_eq!(channels, ["angle", "throttle"]);
    let image = |index: u32| {
        std::fs::read(
            dir.path()
                .join(format!("mycar/data/images/{index}_cam_image_array_.jpg")),
        )
    };
    let frames: Vec<String> = (0..5).map(|index| STANDARD.encode(image(4 * index).unwrap())).collect();
    let body = json!({"frames": frames, "resize": "crop", "plan": vec![[0.1, 0.5]; 5]});
    let answer = server.ask("POST", "/v1/models/mycar/predict", &body);
    assert_eq!(answer["frames"].as_array().map(Vec::len), Some(5), "{answer}");
}
