//! The content of the figures: frames of the chosen windows, the curves of the tables, an animation of a trial.

use super::EvaluationError;
use super::figures::animation::{Animation, AnimationFrame};
use super::figures::{Chart, FigureInputs, SampleFigure};
use super::inference::{ActionSource, predict, reconstruct};
use super::markdown::set_title;
use super::method::Method;
use super::report::{EvaluationReport, SampleWindow, SetScores};
use foreframe_core::frame::Frame;
use foreframe_core::registry::Model;
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::sampler::{Split, WindowShape};

/// Frames of the animation at most.
const MAX_MOMENTS: usize = 40;

/// The figures' content: median, best and worst window and a chart of each set that was scored; reconstruction and
/// animation of the first. Errors: those of the network.
pub fn figure_inputs(
    loaded: &Model,
    dataset: &Dataset,
    report: &EvaluationReport,
) -> Result<FigureInputs, EvaluationError> {
    let mut inputs = FigureInputs::default();
    for &split in report.stamp.split.splits() {
        let Some(scores) = report.scores(split.name()) else {
            continue;
        };
        let is_first = inputs.charts.is_empty();
        for sample in &scores.samples {
            let mut figure = show(loaded, dataset, sample)?;
            if is_first {
                let window = [sample.window()];
                figure.reconstructed = frames(loaded, &reconstruct(loaded, dataset, &window)?)?;
            } else {
                figure.name = format!("{}-{split}", figure.name);
            }
            inputs.samples.push(figure);
        }
        if is_first {
            inputs.animation = animate(loaded, dataset, report, split, scores)?;
        }
        inputs.charts.push(chart(split, scores));
    }
    Ok(inputs)
}

fn show(loaded: &Model, dataset: &Dataset, sample: &SampleWindow) -> Result<SampleFigure, EvaluationError> {
    let spec = loaded.spec();
    let window = [sample.window()];
    let seen = sample.first_frame..sample.first_frame + spec.context;
    Ok(SampleFigure {
        name: sample.rank.clone(),
        note: format!("{} window by error: MSE {:.1}e-4", sample.rank, sample.mse * 1e4),
        reconstructed: Vec::new(),
        predicted: frames(loaded, &predict(loaded, dataset, &window, ActionSource::Recorded)?)?,
        truth: camera_frames(dataset, seen.end..seen.end + spec.horizon)?,
        inputs: camera_frames(dataset, seen)?,
    })
}

fn frames(loaded: &Model, values: &[f32]) -> Result<Vec<Frame>, EvaluationError> {
    let spec = loaded.spec();
    let frame = |values| {
        spec.preprocess
            .frame_from(values, spec.frame_width_px, spec.frame_height_px)
    };
    let frames = values.chunks_exact(spec.pixels()).map(frame);
    Ok(frames.collect::<Result<_, _>>()?)
}

fn camera_frames(dataset: &Dataset, frames: std::ops::Range<usize>) -> Result<Vec<Frame>, EvaluationError> {
    Ok(frames.map(|frame| dataset.frame(frame)).collect::<Result<_, _>>()?)
}

fn chart(split: Split, scores: &SetScores) -> Chart {
    let file = match split {
        Split::Test | Split::Validation => "error-by-horizon.svg".to_owned(),
        other => format!("error-by-horizon-{other}.svg"),
    };
    let series = scores.methods.iter().map(|row| (row.method, row.mse.per_step.clone()));
    Chart {
        file,
        caption: format!("Error by horizon against the baselines: {}", set_title(split.name())),
        series: series.collect(),
    }
}

/// The trial of the median window from its start to its end, each frame predicted at the greatest horizon.
fn animate(
    loaded: &Model,
    dataset: &Dataset,
    report: &EvaluationReport,
    split: Split,
    scores: &SetScores,
) -> Result<Option<Animation>, EvaluationError> {
    let spec = loaded.spec();
    let Some(median) = scores.samples.first() else {
        return Ok(None);
    };
    let shape = WindowShape {
        context: spec.context,
        horizon: spec.horizon,
    };
    let splits = report.stamp.split.divide(dataset, report.stamp.split_seed);
    let mut windows = splits.windows(dataset, split, shape, 1)?;
    windows.retain(|window| window.episode == median.episode);
    windows.truncate(MAX_MOMENTS);
    let predicted = frames(loaded, &predict(loaded, dataset, &windows, ActionSource::Recorded)?)?;
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
