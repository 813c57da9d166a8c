//! Writes an evaluation's directory: the figures, then the report. Each file is complete or absent.

use std::path::{Path, PathBuf};

use super::figures::{self, FigureInputs};
use super::file::save;
use super::{EvaluationError, EvaluationReport};

/// Creates the output directory. Call it before the evaluation, so that a wrong path is refused at once.
/// Errors: `OutputExists` if there is something in it or it is no directory, `Io`.
pub fn prepare(dir: &Path) -> Result<(), EvaluationError> {
    let failed = |source| EvaluationError::Io {
        path: dir.to_owned(),
        source,
    };
    if dir.exists() && !dir.is_dir() {
        return Err(EvaluationError::OutputExists(dir.to_owned()));
    }
    std::fs::create_dir_all(dir).map_err(failed)?;
    match std::fs::read_dir(dir).map_err(failed)?.next() {
        Some(_) => Err(EvaluationError::OutputExists(dir.to_owned())),
        None => Ok(()),
    }
}

/// Writes the figures, `report.md` and, last, `report.json`; returns the paths of both reports. The figures' names go into
/// the report. Errors: `Io`, `Chart`, `Frame`.
pub fn write(
    dir: &Path,
    report: &mut EvaluationReport,
    inputs: &FigureInputs,
) -> Result<[PathBuf; 2], EvaluationError> {
    report.figures = figures::write(dir, inputs)?;
    let markdown = dir.join("report.md");
    save(&markdown, report.to_markdown().as_bytes())?;
    let json = dir.join("report.json");
    let mut bytes = serde_json::to_vec_pretty(report).map_err(|error| EvaluationError::Io {
        path: json.clone(),
        source: error.into(),
    })?;
    bytes.push(b'\n');
    save(&json, &bytes)?;
    Ok([markdown, json])
}
