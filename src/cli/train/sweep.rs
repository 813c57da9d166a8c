//! `foreframe train --sweep`: the trainings of a sweep, one after another, and a table of their errors.

use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::super::error::CliError;
use super::super::next_step::shell_path;
use super::super::process::print_line;
use super::super::sweep_table::{self, SweepRow};
use foreframe_core::registry::Manifest;
use foreframe_train::settings::SettingsLayer;
use foreframe_train::training::TrainConfig;
use foreframe_train::training::sweep::set_nested;

/// One training of a sweep.
pub(super) struct SweepRun {
    pub(super) settings: Map<String, Value>,
    pub(super) config: TrainConfig,
    pub(super) run_dir: PathBuf,
}

impl SweepRun {
    /// The directory has the values in its name, so that a longer sweep finds the trainings that are finished.
    pub(super) fn new(settings: Map<String, Value>, config: TrainConfig, sweep_dir: &Path) -> Self {
        let run_dir = sweep_dir.join(directory_name(&settings));
        Self {
            settings,
            config,
            run_dir,
        }
    }
}

/// The settings of a point, as those of `--set`.
pub(super) fn layer(settings: &Map<String, Value>) -> SettingsLayer {
    let mut nested = Map::new();
    for (key, value) in settings {
        set_nested(&mut nested, key, value.clone());
    }
    SettingsLayer::serialized("--sweep", &nested)
}

/// As in `model.hidden=64,seed=1`.
fn directory_name(settings: &Map<String, Value>) -> String {
    let name = sweep_table::settings_text(settings).replace(", ", ",");
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "._-=,".contains(c);
    name.chars().map(|c| if is_plain(c) { c } else { '_' }).collect()
}

/// Prints the table of the finished trainings, the lowest validation error first, and how to publish the best.
pub(super) fn print_table(finished: &[(SweepRun, Box<Manifest>)], flags: &str) -> Result<(), CliError> {
    let error = |manifest: &Manifest| manifest.metrics["validation"]["mse"].as_f64();
    let mut sorted: Vec<_> = finished.iter().collect();
    sorted.sort_by(|(_, a), (_, b)| {
        let [a, b] = [a, b].map(|manifest| error(manifest).unwrap_or(f64::INFINITY));
        a.total_cmp(&b)
    });
    let rows: Vec<SweepRow> = sorted
        .iter()
        .map(|(run, manifest)| SweepRow {
            validation_mse: error(manifest),
            step: manifest.metrics["validation"]["step"].as_u64(),
            settings: sweep_table::settings_text(&run.settings),
            made: run.run_dir.display().to_string(),
        })
        .collect();
    sweep_table::lines(&rows, "run").into_iter().try_for_each(print_line)?;
    sorted.first().map_or(Ok(()), |(best, _)| {
        print_line(format!("next: foreframe publish {}{flags}", shell_path(&best.run_dir)))
    })
}
