//! Predictions of the shipped models on the CPU and on a graphics card: how far they differ, and the time of a window, of 64 windows
//! and of 256 plans. The least time of several rounds is printed.
//!
//! `cargo bench --features cuda --bench device [-- DEVICE MODEL...]`
#![allow(clippy::unwrap_used, missing_docs)]

use std::path::Path;
use std::time::{Duration, Instant};

use candle_core::{Device, Tensor};
use foreframe_core::nn::device::{self, DeviceName};
use foreframe_core::nn::{ConditioningTensors, ModelSpec, NnError};
use foreframe_core::registry::{self, Model};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const MODELS: [&str; 7] = [
    "static",
    "moving",
    "static-flow",
    "donkeycar",
    "moving-flow",
    "rooms",
    "home",
];
const ROUNDS: usize = 5;
const WINDOWS: usize = 64;
const PLANS: usize = 256;

/// A batch of windows with the rollouts that follow them.
struct Batch {
    codes: Tensor,
    windows: Vec<u32>,
    condition: ConditioningTensors,
}

impl Batch {
    /// `rollouts` that follow `windows` in turn.
    fn new(model: &Model, windows: usize, rollouts: usize) -> Self {
        let spec = model.spec();
        let codes = model.network.encode_frames(&frames(spec, windows)).unwrap();
        Self {
            codes: codes.reshape((windows, spec.context, ())).unwrap(),
            windows: (0..rollouts).map(|rollout| (rollout % windows) as u32).collect(),
            condition: condition(spec, windows, rollouts),
        }
    }

    /// The predicted frames.
    fn predict(&self, model: &Model) -> Result<Vec<f32>, NnError> {
        let network = &model.network;
        let codes = network.predict_rollouts(&self.codes, &self.windows, &self.condition)?;
        let frames = network.decode_frames(&codes.flatten(0, 1)?)?;
        Ok(frames.flatten_all()?.to_vec1()?)
    }
}

/// Pictures with edges that move.
fn frames(spec: &ModelSpec, windows: usize) -> Tensor {
    let width = spec.frame_width_px as usize;
    let mut values = Vec::new();
    for frame in 0..windows * spec.context {
        for pixel in 0..spec.pixels() {
            let (x, y, t) = ((pixel % width) as f32, (pixel / width) as f32, frame as f32);
            let wave = 0.5 + 0.3 * (0.3 * x + 0.2 * t).sin() * (0.2 * y - 0.1 * t).cos();
            values.push(if y > 40.0 + 8.0 * (0.1 * x).sin() { 0.8 } else { wave });
        }
    }
    Tensor::from_vec(values, (windows * spec.context, spec.pixels()), &Device::Cpu).unwrap()
}

fn condition(spec: &ModelSpec, windows: usize, rollouts: usize) -> ConditioningTensors {
    let wave = |count: usize, scale: f32| (0..count).map(move |at| scale * (1.7 * at as f32).sin());
    let tensor = |values: Vec<f32>, shape: &[usize]| Tensor::from_vec(values, shape, &Device::Cpu).unwrap();
    let (actions, states, earlier) = (spec.actions.len(), spec.states.len(), spec.context - 1);
    let means = |rows: usize| (0..rows).flat_map(|_| spec.states.iter().map(|channel| channel.mean));
    let of_window = |row: usize| (row / states.max(1) % windows) as f32 * 0.01;
    let state = means(rollouts).enumerate().map(|(at, mean)| mean + of_window(at));
    let past = means(rollouts * earlier).enumerate();
    let past = past.map(|(at, mean)| {
        mean + of_window(at / earlier.max(1)) - 0.02 * (earlier - at / states.max(1) % earlier) as f32
    });
    ConditioningTensors {
        actions: spec.action_inputs().map(|_| {
            let values = wave(rollouts * spec.horizon * actions, 0.3);
            tensor(values.collect(), &[rollouts, spec.horizon, actions])
        }),
        state: spec
            .state_inputs()
            .map(|_| tensor(state.collect(), &[rollouts, states])),
        past_states: spec
            .state_inputs()
            .map(|_| tensor(past.collect(), &[rollouts, earlier, states])),
        cameras: Vec::new(),
    }
}

fn least_time(mut run: impl FnMut()) -> Duration {
    run();
    let times = (0..ROUNDS).map(|_| {
        let start = Instant::now();
        run();
        start.elapsed()
    });
    times.min().unwrap()
}

fn main() {
    let arguments: Vec<String> = std::env::args()
        .skip(1)
        .filter(|argument| argument != "--bench")
        .collect();
    let name: DeviceName = arguments.first().map_or("cuda", String::as_str).parse().unwrap();
    let given: Vec<&str> = arguments.iter().skip(1).map(String::as_str).collect();
    let names = if given.is_empty() { MODELS.to_vec() } else { given };
    let load = |name: &&str| registry::load(&Path::new("models").join(name)).unwrap();
    let on_cpu: Vec<Model> = names.iter().map(load).collect();
    device::choose(name).unwrap_or_else(|error| {
        eprintln!("{error}");
        std::process::exit(1);
    });
    println!("| Model | Batch | Largest difference | Mean difference | CPU ms | {name} ms |");
    println!("| --- | --- | ---: | ---: | ---: | ---: |");
    for (model_name, cpu) in names.iter().zip(&on_cpu) {
        let moved = load(model_name);
        let batches = [
            ("1 window", Batch::new(cpu, 1, 1)),
            ("64 windows", Batch::new(cpu, WINDOWS, WINDOWS)),
            ("256 plans", Batch::new(cpu, 1, PLANS)),
        ];
        for (label, batch) in batches {
            let (expected, found) = match [cpu, &moved].map(|model| batch.predict(model)) {
                [Ok(expected), Ok(found)] => (expected, found),
                results => {
                    let error = results.into_iter().find_map(Result::err).unwrap();
                    println!("| {model_name} | {label} | {error:?} |");
                    continue;
                }
            };
            let differences = || expected.iter().zip(&found).map(|(a, b)| (a - b).abs());
            let most = differences().max_by(f32::total_cmp).unwrap_or(0.0);
            let mean = differences().map(f64::from).sum::<f64>() / expected.len() as f64;
            let [cpu_ms, device_ms] = [cpu, &moved].map(|model| least_time(|| drop(batch.predict(model).unwrap())));
            let [cpu_ms, device_ms] = [cpu_ms, device_ms].map(|time| time.as_secs_f64() * 1e3);
            println!("| {model_name} | {label} | {most:.1e} | {mean:.1e} | {cpu_ms:.2} | {device_ms:.2} |");
        }
    }
}
