//! Simulates a few trials, trains a small model on them, and publishes it. A few seconds: the model is not good.
//!
//! `cargo run --release --example train -- OUT_DIR`

use std::error::Error;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use foreframe::Seed;
use foreframe::dataset::{CollectConfig, Dataset, collect};
use foreframe::sim::Scenario;
use foreframe::training::{self, TrainConfig, Training, TrainingEvent, TrainingOutcome};

/// A small network and few updates; `presets/*.toml` hold the settings of the shipped models.
const SETTINGS: [&str; 7] = [
    "name=small",
    "model.features=16",
    "model.hidden=32",
    "data.windows=200",
    "data.validation_windows=32",
    "sequence.steps=60",
    "run.validate_every_steps=20",
];

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::args().nth(1).ok_or("usage: train OUT_DIR")?);
    let never = AtomicBool::new(false);
    let dataset_dir = out.join("dataset");
    collect(
        &CollectConfig::new(Scenario::StaticObserver, 40, Seed(1), &dataset_dir),
        &|_| {},
        &never,
    )?;
    let dataset = Dataset::open(&dataset_dir)?;

    let config = TrainConfig::layered("paper", None, &SETTINGS.map(str::to_owned))?;
    let job = Training {
        config: &config,
        dataset: &dataset,
        run_dir: &out.join("run"),
        command: "examples/train.rs",
        start: None,
    };
    let mut report = |event: TrainingEvent| {
        if let TrainingEvent::Validated { stage, step, loss, .. } = event {
            println!("{stage} step {step}: validation error {loss:.5}");
        }
    };
    if let TrainingOutcome::Finished { model_dir, manifest } = training::run(&job, &mut report, &never)? {
        println!("{}: {} parameters", model_dir.display(), manifest.parameters);
    }
    Ok(())
}
