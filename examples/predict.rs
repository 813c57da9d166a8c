//! Predicts the frames that follow those in `examples/frames` and writes them as PNG files. Uses the library only: no
//! server, no network.
//!
//! `cargo run --release --example predict -- OUT_DIR`

use std::error::Error;
use std::path::PathBuf;

use foreframe::images::{decode, encode_png};
use foreframe::{Action, PredictionInput, RobotState, load, predict};
use serde::Deserialize;

/// What the robot measured and did: one entry for each frame.
#[derive(Deserialize)]
struct Recording {
    states: Vec<RobotState>,
    actions: Vec<Action>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::args().nth(1).ok_or("usage: predict OUT_DIR")?);
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let model = load(&root.join("models/moving"))?;
    let spec = model.spec();
    let recording: Recording = serde_json::from_slice(&std::fs::read(root.join("examples/frames/actions.json"))?)?;

    let mut frames = Vec::new();
    for i in 0..spec.context {
        let path = root.join(format!("examples/frames/frame-{i:03}.png"));
        frames.push(decode(&std::fs::read(path)?)?);
    }
    let last = spec.context - 1;
    let input = PredictionInput {
        frames,
        state: recording.states.get(last).cloned(),
        // The action of a frame acts from that frame to the next.
        plan: recording.actions.get(last..last + spec.horizon).map(<[Action]>::to_vec),
        ..PredictionInput::default()
    };

    std::fs::create_dir_all(&out)?;
    let rollout = predict(&model, &[&input])?.remove(0);
    for (number, frame) in (1..).zip(rollout.frames) {
        let path = out.join(format!("predicted-{number}.png"));
        std::fs::write(&path, encode_png(&frame)?)?;
        println!("{}", path.display());
    }
    Ok(())
}
