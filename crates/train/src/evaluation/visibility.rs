//! The errors of model and baselines by what a pixel of a future frame shows.

use rayon::prelude::*;

use super::EvaluationError;
use super::baselines::{BaselineInput, Baselines};
use super::inference::{ActionSource, Inference};
use super::method::Method;
use super::pixel_class::{ClassSums, PixelClass, classes};
use super::progress::{EvaluationContext, EvaluationStage, Pass};
use super::replay::{has_size_of, replayed_views};
use super::windows::{evenly, true_frame, window_shape};
use foreframe_data::dataset::{DatasetError, Window};
use foreframe_sim::WorldConfig;

/// Windows at most whose pixels are classified, evenly spread.
const MAX_WINDOWS: usize = 200;
/// Windows that are computed together.
const BATCH: usize = 8;

/// Classifies the pixels of some of the windows; nothing for a recording. `None` for a window that the simulator cannot replay.
/// Errors: those of the network and the simulator, `Cancelled`, `Io`.
pub(super) fn measure(
    evaluation: &EvaluationContext,
    windows: &[Window],
    baselines: &Baselines,
) -> Result<Vec<Option<ClassSums>>, EvaluationError> {
    let inference = evaluation.inference;
    let (info, spec) = (inference.dataset.info(), inference.spec());
    let Some(world) = info.world.as_ref().filter(|_| has_size_of(info, spec)) else {
        return Ok(Vec::new());
    };
    let pass = Pass {
        batch: BATCH,
        ..evaluation.pass(EvaluationStage::Visibility)
    };
    evaluation.in_divided_batches(pass, &evenly(windows, MAX_WINDOWS), |batch| {
        let predicted = inference.predict(batch, ActionSource::Recorded)?.frames;
        let numbered = batch.par_iter().enumerate();
        let sums = numbered.map(|(place, &window)| {
            let predicted = &predicted[place * spec.horizon * spec.pixels()..][..spec.horizon * spec.pixels()];
            class_sums(inference, world, window, (predicted, baselines))
        });
        sums.collect()
    })
}

fn class_sums(
    inference: Inference,
    world: &WorldConfig,
    window: Window,
    (predicted, baselines): (&[f32], &Baselines),
) -> Result<Option<ClassSums>, EvaluationError> {
    let (dataset, spec) = (inference.dataset, inference.spec());
    let shape = window_shape(spec);
    let Some(views) = replayed_views(dataset, world, window, shape.frames())? else {
        return Ok(None);
    };
    let frames = (0..shape.frames()).map(|step| true_frame(dataset, window.first_frame + step));
    let frames = frames.collect::<Result<Vec<_>, DatasetError>>()?;
    let (inputs, truth) = frames.split_at(shape.context);
    let (seen, coming) = views.split_at(shape.context);
    let classes: Vec<Vec<PixelClass>> = coming.iter().map(|view| classes(view, seen)).collect();
    let input = BaselineInput::of_window(dataset, window, shape, inputs);
    let sums = |&method: &Method| -> Result<[f64; PixelClass::ALL.len()], EvaluationError> {
        let own = |frames: &[f32]| -> Vec<Vec<f32>> {
            let frames = frames.chunks_exact(spec.pixels());
            frames.map(|frame| spec.preprocess.inverse(frame)).collect()
        };
        let frames = match method {
            Method::Model => own(predicted),
            Method::CodecOnly => {
                own(&inference.through_codec(&inference.frames(&[window], shape.context..shape.frames())?)?)
            }
            baseline => baselines.predict(dataset, baseline, &input, shape.horizon)?,
        };
        let mut sums = [0.0; PixelClass::ALL.len()];
        let steps = frames.iter().zip(truth).zip(&classes);
        for ((frame, truth), classes) in steps {
            for ((value, truth), &class) in frame.iter().zip(truth).zip(classes) {
                sums[class as usize] += f64::from(value - truth).powi(2);
            }
        }
        Ok(sums)
    };
    let mut pixels = [0; PixelClass::ALL.len()];
    for &class in classes.iter().flatten() {
        pixels[class as usize] += 1;
    }
    Ok(Some(ClassSums {
        pixels,
        errors: baselines.methods().iter().map(sums).collect::<Result<_, _>>()?,
    }))
}
