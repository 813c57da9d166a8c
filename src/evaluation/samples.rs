//! What the figures show: frames of the chosen windows, the curves of the tables, an animation over a trial.

use super::EvaluationError;
use super::baselines::Method;
use super::figures::animation::{Animation, AnimationFrame};
use super::figures::{Chart, FigureInputs, SampleFigure};
use super::inference::{ActionSource, predict, reconstruct};
use super::report::{EvaluationReport, SampleWindow, SetScores};
use crate::dataset::sampler::{Split, Splits, WindowShape};
use crate::dataset::{Dataset, Window};
use crate::frame::Frame;
use crate::registry::LoadedModel;

/// Moments of the animation at most.
const MAX_MOMENTS: usize = 80;

/// The figures' content: windows and animation of the first test set that was scored, a chart of each.
/// Errors: those of the network.
pub fn figure_inputs(
    loaded: &LoadedModel,
    dataset: &Dataset,
    report: &EvaluationReport,
) -> Result<FigureInputs, EvaluationError> {
    let mut inputs = FigureInputs::default();
    for split in [Split::Test, Split::TestUnseen] {
        let Some(scores) = report.scores(split.name()) else {
            continue;
        };
        if inputs.charts.is_empty() {
            for sample in &scores.samples {
                inputs.samples.push(show(loaded, dataset, sample)?);
            }
            inputs.animation = animate(loaded, dataset, (report, split), scores)?;
        }
        inputs.charts.push(chart(split, scores));
    }
    Ok(inputs)
}

fn show(loaded: &LoadedModel, dataset: &Dataset, sample: &SampleWindow) -> Result<SampleFigure, EvaluationError> {
    let spec = loaded.model.spec();
    let window = [Window {
        episode: sample.episode,
        first_frame: sample.first_frame,
    }];
    let seen = sample.first_frame..sample.first_frame + spec.context;
    Ok(SampleFigure {
        name: sample.rank.clone(),
        note: format!(
            "{} window of {} by error: MSE {:.1}e-4",
            sample.rank,
            dataset.info().name,
            sample.mse * 1e4
        ),
        reconstructed: frames(loaded, &reconstruct(loaded, dataset, &window)?)?,
        predicted: frames(loaded, &predict(loaded, dataset, &window, ActionSource::TargetFrame)?)?,
        truth: camera_frames(dataset, seen.end..seen.end + spec.horizon)?,
        inputs: camera_frames(dataset, seen)?,
    })
}

fn frames(loaded: &LoadedModel, values: &[f32]) -> Result<Vec<Frame>, EvaluationError> {
    let spec = loaded.model.spec();
    let frame = |values| {
        spec.preprocess
            .frame_from(values, spec.frame_width_px, spec.frame_height_px)
    };
    let frames = values.chunks_exact(spec.pixels()).map(frame);
    Ok(frames.collect::<Result<_, _>>()?)
}

fn camera_frames(dataset: &Dataset, frames: std::ops::Range<usize>) -> Result<Vec<Frame>, EvaluationError> {
    let info = dataset.info();
    let frame = |frame| {
        Frame::new(
            info.frame_width_px,
            info.frame_height_px,
            dataset.pixels(frame).to_vec(),
        )
    };
    Ok(frames.map(frame).collect::<Result<_, _>>()?)
}

fn chart(split: Split, scores: &SetScores) -> Chart {
    let (file, what) = match split {
        Split::TestUnseen => ("error-by-horizon-unseen.svg", "start/goal pairs and gains never seen"),
        _ => ("error-by-horizon.svg", "trials never seen"),
    };
    let series = scores.methods.iter().map(|row| (row.method, row.mse.per_step.clone()));
    Chart {
        file: file.to_owned(),
        caption: format!("Error by horizon against the baselines, {what}"),
        series: series.collect(),
    }
}

/// The trial of the median window from its start to its end, as far ahead as the model sees.
fn animate(
    loaded: &LoadedModel,
    dataset: &Dataset,
    (report, split): (&EvaluationReport, Split),
    scores: &SetScores,
) -> Result<Option<Animation>, EvaluationError> {
    let spec = loaded.model.spec();
    let Some(median) = scores.samples.first() else {
        return Ok(None);
    };
    let shape = WindowShape {
        context: spec.context,
        horizon: spec.horizon,
    };
    let splits = Splits::new(dataset, report.stamp.split_seed);
    let mut windows = splits.windows(dataset, split, shape, 1)?;
    windows.retain(|window| window.episode == median.episode);
    windows.truncate(MAX_MOMENTS);
    let predicted = frames(loaded, &predict(loaded, dataset, &windows, ActionSource::TargetFrame)?)?;
    let last_steps = predicted.into_iter().skip(spec.horizon - 1).step_by(spec.horizon);
    let moments = windows.iter().zip(last_steps).map(|(window, predicted)| {
        let now = window.first_frame + spec.context - 1;
        let mut camera = camera_frames(dataset, now..now + 1)?;
        camera.extend(camera_frames(dataset, now + spec.horizon..now + spec.horizon + 1)?);
        let [copied, truth]: [Frame; 2] = camera.try_into().map_err(|_| EvaluationError::Setting {
            setting: "the horizon",
            value: 0,
            least: 1,
        })?;
        Ok(AnimationFrame {
            truth,
            predicted,
            copied,
        })
    });
    Ok(Some(Animation {
        steps_ahead: spec.horizon,
        period_s: spec.frame_period_s,
        baseline: Method::CopyLast.label(),
        moments: moments.collect::<Result<_, EvaluationError>>()?,
    }))
}
