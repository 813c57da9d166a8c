//! How a predicted frame is compared with a goal image: a measurement in the simulator. `cargo test --release --test it -- --ignored
//! --nocapture goal_image` prints how often each distance picks the plan that leads to the goal image.

use std::path::Path;

use candle_core::{Device, Tensor};
use foreframe_core::frame::Frame;
use foreframe_core::frame::preprocess::Preprocess;
use foreframe_core::frame::quality::mse;
use foreframe_core::registry::{self, Model};
use foreframe_core::serving::{PredictionInput, predict};
use foreframe_core::types::{Action, Seed};
use foreframe_sim::{Scenario, World, WorldConfig};
use rand::Rng as _;

const CONTEXTS: usize = 60;
const PLANS: usize = 8;

fn load(name: &str) -> Model {
    registry::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("models").join(name)).unwrap()
}

fn blurred(frame: &Frame, sigma_px: f32) -> Vec<f32> {
    let blur = Preprocess {
        blur_sigma_px: sigma_px,
        invert: false,
    };
    blur.inverse(&blur.forward(frame))
}

fn features(model: &Model, frame: &Frame) -> Vec<f32> {
    let values = model.spec().preprocess.forward(frame);
    let values = Tensor::from_vec(values, (1, model.spec().pixels()), &Device::Cpu).unwrap();
    let codes = model.network.encode_frames(&values).unwrap();
    codes.flatten_all().unwrap().to_vec1().unwrap()
}

/// What of a frame is compared.
type Numbers = Box<dyn Fn(&Frame) -> Vec<f32>>;

/// The predicted and the true last frame of each of several plans from one moment of a trial.
fn futures(model: &Model, trial: u64) -> Vec<[Frame; 2]> {
    let spec = model.spec();
    let world = || World::new(Scenario::MovingObserver, &WorldConfig::default(), Seed(77), trial).unwrap();
    let mut random = Seed(78).derive("plans", trial).rng();
    let before = 8 + random.random_range(0..12);
    let mut plan = || -> Vec<Action> {
        let [linear, angular] = [random.random_range(0.0..0.5f32), random.random_range(-0.8..0.8f32)];
        vec![Action::try_from(vec![linear, angular]).unwrap(); spec.horizon]
    };
    let plans: Vec<Vec<Action>> = (0..PLANS).map(|_| plan()).collect();
    let mut futures = Vec::new();
    for plan in plans {
        let mut world = world();
        let mut input = PredictionInput::default();
        for step in 0..before {
            if step >= before - spec.context {
                input.frames.push(world.observe().frame);
                input.state = Some(world.observe().state);
            }
            if step + 1 < before {
                world.step(&world.policy_action()).unwrap();
            }
        }
        input.plan = Some(plan.clone());
        for action in &plan {
            world.step(action).unwrap();
        }
        let predicted = predict(model, &[&input]).unwrap().remove(0).frames.pop().unwrap();
        futures.push([predicted, world.observe().frame]);
    }
    futures
}

#[test]
#[ignore = "a measurement of a minute"]
fn goal_images_are_compared_by_their_pixels() {
    let (model, dense) = (load("moving-flow"), load("moving"));
    let distances: [(&str, Numbers); 6] = [
        ("pixels", Box::new(|frame| blurred(frame, 0.0))),
        ("blur 1 px", Box::new(|frame| blurred(frame, 1.0))),
        ("blur 2 px", Box::new(|frame| blurred(frame, 2.0))),
        ("blur 3 px", Box::new(|frame| blurred(frame, 3.0))),
        ("blur 4 px", Box::new(|frame| blurred(frame, 4.0))),
        (
            "features of the dense codec",
            Box::new(move |frame| features(&dense, frame)),
        ),
    ];
    let contexts: Vec<Vec<[Frame; 2]>> = (0..CONTEXTS as u64).map(|trial| futures(&model, trial)).collect();
    for (name, of) in &distances {
        let mut picked = 0;
        for futures in &contexts {
            let predicted: Vec<Vec<f32>> = futures.iter().map(|[predicted, _]| of(predicted)).collect();
            for (own, [_, truth]) in futures.iter().enumerate() {
                let goal = of(truth);
                let nearest =
                    (0..PLANS).min_by(|&one, &two| mse(&predicted[one], &goal).total_cmp(&mse(&predicted[two], &goal)));
                picked += usize::from(nearest == Some(own));
            }
        }
        let share = picked as f64 / (CONTEXTS * PLANS) as f64;
        println!("{name}: {share:.3} of the goals pick their own plan, of {PLANS}");
        assert!(share > 0.4, "{name} {share}");
    }
}
