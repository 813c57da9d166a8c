//! The table of a sweep, as `train` and `jobs show` print it.

use serde_json::{Map, Value};

use super::table::aligned;

/// One training.
pub(super) struct SweepRow {
    pub(super) validation_mse: Option<f64>,
    pub(super) step: Option<u64>,
    pub(super) settings: String,
    /// The run or the version that it made, or why it made none.
    pub(super) made: String,
}

/// The lines of the table; `made` is the name of the last column.
pub(super) fn lines(rows: &[SweepRow], made: &'static str) -> Vec<String> {
    let cells: Vec<[String; 4]> = rows
        .iter()
        .map(|row| {
            [
                row.validation_mse
                    .map_or_else(|| "–".to_owned(), |mse| format!("{mse:.6}")),
                row.step.map_or_else(|| "–".to_owned(), |step| step.to_string()),
                row.settings.clone(),
                row.made.clone(),
            ]
        })
        .collect();
    aligned(["validation MSE", "step", "settings", made], &cells)
}

/// The rows of the result of a job; none if it is no sweep.
pub(super) fn rows_of(result: &Value) -> Option<Vec<SweepRow>> {
    let points = result["sweep"].as_array()?.iter();
    let row = |point: &Value| SweepRow {
        validation_mse: point["validation_mse"].as_f64(),
        step: point["step"].as_u64(),
        settings: point["settings"].as_object().map(settings_text).unwrap_or_default(),
        made: match (point["version"].as_u64(), point["error"].as_str()) {
            (Some(version), _) => version.to_string(),
            (None, Some(error)) => format!("failed: {error}"),
            (None, None) => point["state"].as_str().unwrap_or_default().to_owned(),
        },
    };
    Some(points.map(row).collect())
}

/// As in `model.hidden=64, seed=1`.
pub(super) fn settings_text(settings: &Map<String, Value>) -> String {
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let settings = settings.iter().map(|(key, value)| format!("{key}={}", text(value)));
    settings.collect::<Vec<_>>().join(", ")
}
