//! Pictures of a model's predictions: panels like the paper's figures 6–8, error by horizon, an animation; and of plans and driven
//! episodes.

pub mod animation;
mod canvas;
mod chart;
pub mod episode_animation;
pub mod fan;
pub mod montage;

use self::montage::{MontageRow, Style, montage, prediction_panel};
use super::EvaluationError;
use super::inference::{ActionSource, Inference};
use super::markdown::set_title;
use super::method::Method;
use super::report::{EvaluationReport, FigureFile, SampleWindow, SetScores};
use super::windows::window_shape;
use foreframe_core::frame::{Frame, codec};
use foreframe_core::registry::Model;
use foreframe_data::dataset::sampler::Split;
use foreframe_data::dataset::{Dataset, DatasetError};

/// Frames of the animation at most.
const MAX_MOMENTS: usize = 40;

/// A figure that is to be written.
pub struct Figure {
    /// Its file, and what it shows.
    pub about: FigureFile,
    pub(super) bytes: Vec<u8>,
}

impl Figure {
    fn new(file: String, caption: String, bytes: Vec<u8>) -> Self {
        let about = FigureFile { file, caption };
        Self { about, bytes }
    }
}

/// Draws the figures of a report: median, best and worst window and a chart of each set that was scored; reconstruction
/// and animation of the first. Errors: those of the network, `Chart`, `Frame`.
pub fn draw_figures(
    loaded: &Model,
    dataset: &Dataset,
    report: &EvaluationReport,
) -> Result<Vec<Figure>, EvaluationError> {
    let inference = Inference { loaded, dataset };
    let (mut predictions, mut reconstructions, mut charts, mut animation) = (vec![], vec![], vec![], None);
    for (&split, set) in report.stamp.split.splits().iter().zip(&report.sets) {
        let Some(scores) = set.outcome.scores() else {
            continue;
        };
        let is_first = charts.is_empty();
        for sample in &scores.samples {
            let name = if is_first {
                sample.rank.clone()
            } else {
                format!("{}-{split}", sample.rank)
            };
            let (prediction, reconstruction) = draw_window(inference, sample, &name)?;
            predictions.push(prediction);
            reconstructions.extend(reconstruction.filter(|_| is_first));
        }
        if is_first {
            animation = animate(inference, report, split, scores)?;
        }
        let title = set_title(&set.split, scores.blocks.is_some());
        charts.push(draw_chart(split, title, scores)?);
    }
    let figures = predictions.into_iter().chain(reconstructions).chain(charts);
    Ok(figures.chain(animation).collect())
}

/// The paper's figure 8 of a window, from the top: inputs, true frames, predicted frames and errors. Then its figures 6 and
/// 7, if the model reconstructs: the frames seen above their reconstruction.
fn draw_window(
    inference: Inference,
    sample: &SampleWindow,
    name: &str,
) -> Result<(Figure, Option<Figure>), EvaluationError> {
    let spec = inference.spec();
    let frames = sample.first_frame..sample.first_frame + spec.context + spec.horizon;
    let frames: Vec<Frame> = frames
        .map(|frame| inference.dataset.frame(frame))
        .collect::<Result<_, DatasetError>>()?;
    let (inputs, truth) = frames.split_at(spec.context);
    let predicted = inference.predict(&[sample.window()], ActionSource::Recorded)?;
    let title = format!("{} window by error: MSE {:.1}e-4", sample.rank, sample.mse * 1e4);
    let panel = prediction_panel(&title, inputs, &inference.camera_frames(&predicted.frames)?, truth)?;
    let prediction = Figure::new(
        format!("prediction-{name}.png"),
        format!("Inputs, truth, prediction and error (the paper's figure 8), {name} window"),
        codec::encode_png(&panel)?,
    );
    let reconstructed = inference.camera_frames(&inference.reconstruct(&predicted.seen)?)?;
    if reconstructed.is_empty() {
        return Ok((prediction, None));
    }
    let first = 1 - inputs.len() as i64;
    let rows = [
        MontageRow::in_time("ground truth of the inputs", inputs, first),
        MontageRow::in_time("reconstructed by the LSTM", &reconstructed, first),
    ];
    let panel = montage(&title, &rows, &Style::for_frames_of(spec.frame_width_px))?;
    let reconstruction = Figure::new(
        format!("reconstruction-{name}.png"),
        format!("Reconstruction of the inputs (the paper's figures 6 and 7), {name} window"),
        codec::encode_png(&panel)?,
    );
    Ok((prediction, Some(reconstruction)))
}

fn draw_chart(split: Split, title: &str, scores: &SetScores) -> Result<Figure, EvaluationError> {
    let file = match split {
        Split::Test | Split::Validation => "error-by-horizon.svg".to_owned(),
        other => format!("error-by-horizon-{other}.svg"),
    };
    let series = scores.methods.iter().map(|row| (row.method, row.mse.per_step.clone()));
    let svg = chart::draw(&series.collect::<Vec<_>>()).map_err(|error| EvaluationError::Chart {
        file: file.clone(),
        reason: error.to_string(),
    })?;
    let caption = format!("Error by horizon against the baselines: {title}");
    Ok(Figure::new(file, caption, svg.into_bytes()))
}

/// The trial of the median window from its start to its end, each frame predicted at the greatest horizon.
fn animate(
    inference: Inference,
    report: &EvaluationReport,
    split: Split,
    scores: &SetScores,
) -> Result<Option<Figure>, EvaluationError> {
    let (dataset, spec) = (inference.dataset, inference.spec());
    let Some(median) = scores.samples.first() else {
        return Ok(None);
    };
    let splits = report.stamp.split.divide(dataset, report.stamp.split_seed);
    let mut windows = splits.windows(dataset, split, window_shape(spec), 1)?;
    windows.retain(|window| window.episode == median.episode);
    windows.truncate(MAX_MOMENTS);
    let predicted = inference.predict(&windows, ActionSource::Recorded)?;
    let predicted = inference.camera_frames(&predicted.frames)?;
    let last_steps = predicted.into_iter().skip(spec.horizon - 1).step_by(spec.horizon);
    let title = format!("{} frames ahead", spec.horizon);
    let style = Style {
        grid_lines: 0,
        ..Style::for_frames_of(spec.frame_width_px)
    };
    let moments = windows.iter().zip(last_steps).map(|(window, predicted)| {
        let now = window.first_frame + spec.context - 1;
        let cells = [
            ("truth", dataset.frame(now + spec.horizon)?),
            ("predicted", predicted),
            ("last seen", dataset.frame(now)?),
        ];
        let row = MontageRow {
            label: String::new(),
            cells: cells.map(|(label, frame)| (label.to_owned(), frame)).to_vec(),
        };
        Ok(montage(&title, &[row], &style)?)
    });
    let moments: Vec<Frame> = moments.collect::<Result<_, EvaluationError>>()?;
    let caption = format!(
        "The trial of the median window, {} frames ({:.1} s) ahead: truth, prediction, {}",
        spec.horizon,
        spec.horizon as f64 * spec.frame_period_s,
        Method::CopyLast.label()
    );
    let gif = codec::encode_gif(&moments, spec.frame_period_s)?;
    Ok(Some(Figure::new("prediction.gif".to_owned(), caption, gif)))
}
