//! Time of the shipped flow networks: a window, a step of a stream, 8 windows together, and rollouts of many plans. The cases take
//! turns, and the least of each is printed, since other programs run too.
//!
//! `cargo bench --bench flow [-- ROUNDS MODEL...]`; with `taskset -c 0` and `RAYON_NUM_THREADS=1` before it, on one core; with
//! `FOREFRAME_PRECISION=int8`, in that precision.
#![allow(clippy::unwrap_used, missing_docs)]

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use foreframe_core::frame::Frame;
use foreframe_core::nn::precision;
use foreframe_core::registry;
use foreframe_core::registry::Model;
use foreframe_core::serving::{PredictionInput, Session, predict};
use foreframe_core::types::{Action, RobotState};

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const ROUNDS: usize = 7;
/// Of a window and of a step, in each round.
const REPEATS: u32 = 20;
const PLANS: [usize; 2] = [64, 256];
const WINDOWS: usize = 8;

/// A model with an input and a stream that has seen it.
struct Bench {
    model: Arc<Model>,
    input: PredictionInput,
    session: Session,
    plans: Vec<Vec<Action>>,
}

impl Bench {
    fn new(name: &str) -> Self {
        let model = Arc::new(registry::load(&Path::new("models").join(name)).unwrap());
        let spec = model.spec().clone();
        let frame = |at: usize| {
            let pixel = |pixel: usize| ((pixel * 7 + at * 40) ^ (pixel / 64 * 5)) as u8;
            Frame::new(64, 64, (0..spec.pixels()).map(pixel).collect()).unwrap()
        };
        let action = |plan: usize, step: usize| {
            let values = (0..spec.actions.len()).map(|channel| (plan * 3 + step * 5 + channel) as f32 % 11.0 * 0.05);
            Action::try_from(values.collect::<Vec<f32>>()).ok()
        };
        let plan = |plan: usize| (0..spec.horizon).filter_map(|step| action(plan, step)).collect();
        let plans: Vec<Vec<Action>> = (0..256).map(plan).collect();
        let state: Vec<f32> = spec.states.iter().map(|channel| channel.mean).collect();
        let input = PredictionInput {
            frames: (0..spec.context).map(frame).collect(),
            state: RobotState::try_from(state).ok(),
            plan: spec.action_inputs().is_some().then(|| plans[0].clone()),
            ..PredictionInput::default()
        };
        let mut session = Session::new(Arc::clone(&model));
        for frame in &input.frames {
            let plan = input.plan.as_deref();
            session.step(frame.clone(), input.state.as_ref(), plan).unwrap();
        }
        Self {
            model,
            input,
            session,
            plans,
        }
    }

    fn window(&self) {
        predict(&self.model, &[&self.input]).unwrap();
    }

    fn windows(&self) {
        predict(&self.model, &[&self.input; WINDOWS]).unwrap();
    }

    fn step(&mut self) {
        let (frame, plan) = (self.input.frames[0].clone(), self.input.plan.as_deref());
        self.session.step(frame, self.input.state.as_ref(), plan).unwrap();
    }

    fn rollouts(&self, plans: usize) {
        self.session.rollouts(self.plans[..plans].to_vec()).unwrap();
    }
}

/// What one call takes, of `repeats`.
fn timed(repeats: u32, mut call: impl FnMut()) -> Duration {
    let started = Instant::now();
    for _ in 0..repeats {
        call();
    }
    started.elapsed() / repeats
}

fn main() {
    if let Ok(name) = std::env::var("FOREFRAME_PRECISION") {
        precision::choose(name.parse().unwrap()).unwrap();
    }
    let arguments: Vec<String> = std::env::args().collect();
    let is_test = arguments.iter().any(|argument| argument == "--test");
    let rounds = arguments.iter().find_map(|argument| argument.parse().ok());
    let (rounds, repeats) = if is_test {
        (1, 1)
    } else {
        (rounds.unwrap_or(ROUNDS), REPEATS)
    };
    let mut names = vec!["moving-flow", "rooms", "static-flow"];
    let is_option = |argument: &&String| argument.starts_with('-') || argument.parse::<usize>().is_ok();
    let asked: Vec<&String> = arguments[1..].iter().filter(|argument| !is_option(argument)).collect();
    let unknown = asked.iter().find(|name| !names.contains(&name.as_str()));
    assert!(
        unknown.is_none(),
        "there is no {unknown:?}; there are: {}",
        names.join(", ")
    );
    names.retain(|name| asked.is_empty() || asked.iter().any(|asked| asked == name));
    let mut benches: Vec<Bench> = names.iter().map(|name| Bench::new(name)).collect();
    let mut least = vec![[Duration::MAX; 5]; names.len()];
    for _ in 0..rounds {
        for (bench, least) in benches.iter_mut().zip(&mut least) {
            let mut note = |case: usize, taken: Duration| least[case] = least[case].min(taken);
            note(0, timed(repeats, || bench.window()));
            note(1, timed(repeats, || bench.step()));
            note(2, timed(repeats.div_ceil(4), || bench.windows()));
            if bench.input.plan.is_some() {
                for (index, plans) in PLANS.into_iter().enumerate() {
                    note(3 + index, timed(1, || bench.rollouts(plans)));
                }
            }
        }
    }
    for (name, least) in names.iter().zip(least) {
        let ms = least.map(|taken| taken.as_secs_f64() * 1e3);
        println!(
            "{name}: window {:.2} ms, step of a stream {:.2} ms, {WINDOWS} windows {:.2} ms",
            ms[0], ms[1], ms[2]
        );
        if least[3] < Duration::MAX {
            println!(
                "{name}: rollouts of 64 plans {:.0} ms, of 256 plans {:.0} ms",
                ms[3], ms[4]
            );
        }
    }
}
