//! Streams the episodes of a data set through a session, and prints how often the true errors were inside the 90 % bands that were
//! predicted before: by the calibration alone, and as the session scales it by its own errors so far.
//!
//! `cargo run --release --example bands -- MODEL_DIR DATASET_DIR validation|test|all [frames-only]`

use std::error::Error;
use std::path::Path;
use std::sync::Arc;

use foreframe::dataset::{Dataset, Split, Splits, Window, WindowShape};
use foreframe::images::mse;
use foreframe::{Action, ExpectedError, Frame, Model, RobotState, Rollout, Session, load};

const USAGE: &str = "usage: bands MODEL_DIR DATASET_DIR validation|test|all [frames-only]";

/// How many of the errors of each predicted step were inside.
#[derive(Default)]
struct Inside {
    counts: Vec<usize>,
}

impl Inside {
    fn add(&mut self, step: usize, band: ExpectedError, error: f32) {
        self.counts.resize(self.counts.len().max(step + 1), 0);
        self.counts[step] += usize::from((band.low..=band.high).contains(&error));
    }

    fn print(&self, name: &str, windows: usize) {
        let percent: Vec<f64> = self
            .counts
            .iter()
            .map(|&count| 100.0 * count as f64 / windows as f64)
            .collect();
        let mean = percent.iter().sum::<f64>() / percent.len() as f64;
        println!("{name}: {mean:.1} % of the errors inside; by step: {percent:.1?}");
    }
}

/// The data set as a robot would send it.
struct Source {
    model: Arc<Model>,
    dataset: Dataset,
    knows_actions: bool,
}

impl Source {
    /// The next step of a session.
    fn step(&self, session: &mut Session, frame: usize) -> Result<Option<Rollout>, Box<dyn Error>> {
        let image = self.dataset.frame(frame)?;
        if !self.knows_actions {
            return Ok(session.step(image, None, None)?);
        }
        let frames = frame..frame + self.model.spec().horizon;
        let plan = frames.map(|frame| Action::try_from(self.dataset.action(frame).to_vec()));
        let state = RobotState::try_from(self.dataset.state(frame).to_vec()).ok();
        Ok(session.step(image, state.as_ref(), Some(&plan.collect::<Result<Vec<_>, _>>()?))?)
    }

    /// A session that knows the frames of a window, and what it predicts.
    fn begin(&self, window: &Window) -> Result<(Session, Rollout), Box<dyn Error>> {
        let mut session = Session::new(Arc::clone(&self.model));
        if let Some(camera) = self.dataset.camera(window.episode) {
            session.set_camera(camera);
        }
        let mut rollout = None;
        for frame in window.first_frame..window.first_frame + self.model.spec().context {
            rollout = self.step(&mut session, frame)?;
        }
        Ok((session, rollout.ok_or("the context is too short")?))
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, dataset, part, rest @ ..] = arguments.as_slice() else {
        return Err(USAGE.into());
    };
    let (model, dataset) = (load(Path::new(model))?, Dataset::open(Path::new(dataset))?);
    let (split, splits) = match part.as_str() {
        "validation" => (
            Split::Validation,
            Splits::new(&dataset, model.manifest.dataset.split_seed),
        ),
        "test" => (Split::Test, Splits::new(&dataset, model.manifest.dataset.split_seed)),
        "all" => (Split::Test, Splits::all_for_test(&dataset)),
        _ => return Err(USAGE.into()),
    };
    let knows_actions = match rest {
        [] => true,
        [only] if only == "frames-only" => false,
        _ => return Err(USAGE.into()),
    };
    let shape = WindowShape {
        context: model.spec().context,
        horizon: model.spec().horizon,
    };
    let windows = splits.windows(&dataset, split, shape, 1)?;
    let source = Source {
        knows_actions,
        model: Arc::new(model),
        dataset,
    };
    let (mut calibrated, mut followed) = (Inside::default(), Inside::default());
    let mut stream: Option<(Window, Session)> = None;
    for window in &windows {
        let last = window.first_frame + shape.context - 1;
        let (begun, alone) = source.begin(window)?;
        let goes_on =
            |before: &Window| before.episode == window.episode && before.first_frame + 1 == window.first_frame;
        let (session, rollout) = match stream.take().filter(|(before, _)| goes_on(before)) {
            Some((_, mut session)) => {
                let rollout = source.step(&mut session, last)?.ok_or("a session forgot its context")?;
                (session, rollout)
            }
            None => (begun, alone.clone()),
        };
        for (step, predicted) in rollout.frames.iter().enumerate() {
            let truth = source.dataset.frame(last + 1 + step)?;
            let error = mse(&intensities(predicted), &intensities(&truth)) as f32;
            for (inside, errors) in [(&mut calibrated, &alone.errors), (&mut followed, &rollout.errors)] {
                inside.add(step, *errors.get(step).ok_or("the model is not calibrated")?, error);
            }
        }
        stream = Some((*window, session));
    }
    println!("{} windows", windows.len());
    calibrated.print("calibration alone", windows.len());
    followed.print("scaled by the errors so far", windows.len());
    Ok(())
}

/// 0 (black) to 1 (white).
fn intensities(frame: &Frame) -> Vec<f32> {
    frame.pixels().iter().map(|&pixel| f32::from(pixel) / 255.0).collect()
}
