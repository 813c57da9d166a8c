//! Writes an evaluation's directory: the figures, then the report. Each file is complete or absent.

use std::path::{Path, PathBuf};

use super::figures::Figure;
use super::{EvaluationError, EvaluationReport};
use foreframe_core::files::write_atomically;

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
/// the report. Errors: `Io`.
pub fn write(dir: &Path, report: &mut EvaluationReport, figures: &[Figure]) -> Result<[PathBuf; 2], EvaluationError> {
    for figure in figures {
        save(&dir.join(&figure.about.file), &figure.bytes)?;
    }
    report.figures = figures.iter().map(|figure| figure.about.clone()).collect();
    let [markdown, json] = ["report.md", "report.json"].map(|name| dir.join(name));
    save(&markdown, report.to_markdown().as_bytes())?;
    let bytes = serde_json::to_vec_pretty(report).map_err(std::io::Error::from);
    let bytes = bytes.map_err(|source| EvaluationError::Io {
        path: json.clone(),
        source,
    })?;
    save(&json, &[&bytes[..], b"\n"].concat())?;
    Ok([markdown, json])
}

/// Writes the file: it is complete or absent. Errors: `Io`.
fn save(path: &Path, bytes: &[u8]) -> Result<(), EvaluationError> {
    write_atomically(path, bytes).map_err(|source| EvaluationError::Io {
        path: path.to_owned(),
        source,
    })
}
