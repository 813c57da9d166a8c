//! Feeds a model one frame after another, as a camera does, and prints how well each prediction fits the frame that
//! followed. The session keeps the features of the last frames, so each frame is encoded once.
//!
//! `cargo run --release --example session`

use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;

use foreframe::images::{decode, mse, psnr_db};
use foreframe::{Action, Frame, RobotState, Session, load};
use serde::Deserialize;

const FRAMES: usize = 15;

/// What the robot measured and did: one entry for each frame.
#[derive(Deserialize)]
struct Recording {
    states: Vec<RobotState>,
    actions: Vec<Action>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let model = load(&root.join("models/moving"))?;
    let horizon = model.spec().horizon;
    let recording: Recording = serde_json::from_slice(&std::fs::read(root.join("examples/frames/actions.json"))?)?;

    let mut session = Session::new(Arc::new(model));
    let mut predicted: Option<Frame> = None;
    for i in 0..FRAMES {
        let frame = decode(&std::fs::read(root.join(format!("examples/frames/frame-{i:03}.png")))?)?;
        if let Some(predicted) = &predicted {
            let error = mse(&intensities(predicted), &intensities(&frame));
            println!("frame {i}: PSNR of the prediction {:.1} dB", psnr_db(error));
        }
        // The robot plans to go on as it does now.
        let plan = vec![recording.actions[i].clone(); horizon];
        let prediction = session.step(frame, Some(&recording.states[i]), Some(&plan))?;
        predicted = prediction.and_then(|rollout| rollout.frames.into_iter().next());
    }
    println!(
        "the session holds {} frames of context",
        session.snapshot().features.len()
    );
    Ok(())
}

/// 0 (black) to 1 (white).
fn intensities(frame: &Frame) -> Vec<f32> {
    frame.pixels().iter().map(|&pixel| f32::from(pixel) / 255.0).collect()
}
