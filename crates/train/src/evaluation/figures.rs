//! Pictures of a model's predictions: panels like the paper's figures 6–8, error by horizon, an animation.

pub mod animation;
pub mod chart;
pub mod lettering;
pub mod montage;

use std::path::Path;

use serde::{Deserialize, Serialize};

use self::animation::Animation;
use self::montage::{MontageRow, Style};
use super::EvaluationError;
use super::file::save;
use super::method::Method;
use foreframe_core::frame::{Frame, FrameError, codec};

/// A file that was written, and what it shows.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FigureFile {
    /// Its name in the directory.
    pub file: String,
    /// What it shows, in a phrase.
    pub caption: String,
}

/// One window in pictures, as the camera would see them.
#[derive(Clone, Debug, Default)]
pub struct SampleFigure {
    /// The end of the files' names.
    pub name: String,
    /// The title above the pictures; may be empty.
    pub note: String,
    /// The frames seen, t−4…t.
    pub inputs: Vec<Frame>,
    /// The frames seen as the model reconstructs them; may be empty.
    pub reconstructed: Vec<Frame>,
    /// The frames predicted, t+1…
    pub predicted: Vec<Frame>,
    /// The true future frames; empty where they are not known.
    pub truth: Vec<Frame>,
}

/// Mean squared error of each method by step ahead.
#[derive(Clone, Debug)]
pub struct Chart {
    /// The file's name.
    pub file: String,
    /// What it shows.
    pub caption: String,
    /// Values at t+1, t+2, …
    pub series: Vec<(Method, Vec<f64>)>,
}

/// All that is drawn for a report.
#[derive(Clone, Debug, Default)]
pub struct FigureInputs {
    /// Windows; each gives a panel of reconstruction and one of prediction.
    pub samples: Vec<SampleFigure>,
    /// Charts.
    pub charts: Vec<Chart>,
    /// The animation, if any.
    pub animation: Option<Animation>,
}

/// Draws everything into the directory, file by file. Errors: `Io`, `Chart`, `Frame`.
pub fn write(dir: &Path, inputs: &FigureInputs) -> Result<Vec<FigureFile>, EvaluationError> {
    let mut files = Vec::new();
    let mut put = |file: String, caption: String, bytes: &[u8]| {
        save(&dir.join(&file), bytes)?;
        files.push(FigureFile { file, caption });
        Ok::<(), EvaluationError>(())
    };
    for sample in &inputs.samples {
        let panel = codec::encode_png(&prediction_panel(sample)?)?;
        let caption = format!(
            "Inputs, truth, prediction and error (the paper's figure 8), {} window",
            sample.name
        );
        put(format!("prediction-{}.png", sample.name), caption, &panel)?;
    }
    for sample in inputs.samples.iter().filter(|sample| !sample.reconstructed.is_empty()) {
        let panel = codec::encode_png(&reconstruction_panel(sample)?)?;
        let caption = format!(
            "Reconstruction of the inputs (the paper's figures 6 and 7), {} window",
            sample.name
        );
        put(format!("reconstruction-{}.png", sample.name), caption, &panel)?;
    }
    for chart in &inputs.charts {
        put(
            chart.file.clone(),
            chart.caption.clone(),
            chart::draw(chart)?.as_bytes(),
        )?;
    }
    if let Some(animation) = inputs
        .animation
        .as_ref()
        .filter(|animation| !animation.moments.is_empty())
    {
        put("prediction.gif".to_owned(), animation.caption(), &animation.encode()?)?;
    }
    Ok(files)
}

/// The paper's figure 8, from the top: inputs, true frames and errors (where the truth is known), predicted frames.
pub fn prediction_panel(sample: &SampleFigure) -> Result<Frame, FrameError> {
    montage::prediction_panel(&sample.note, &sample.inputs, &sample.predicted, &sample.truth)
}

/// The paper's figures 6 and 7: the frames seen above their reconstruction.
pub fn reconstruction_panel(sample: &SampleFigure) -> Result<Frame, FrameError> {
    let first = 1 - sample.inputs.len() as i64;
    let rows = [
        MontageRow::in_time("ground truth of the inputs", &sample.inputs, first),
        MontageRow::in_time("reconstructed by the LSTM", &sample.reconstructed, first),
    ];
    let width = sample.inputs.first().map_or(1, Frame::width);
    montage::montage(&sample.note, &rows, &Style::for_frames_of(width))
}
