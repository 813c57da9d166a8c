//! An evaluation in parts: what costs is divided, the passes over windows. Each part computes its share of the batches of every
//! pass, and saves the results as they are, not rounded. The evaluation then reads them instead of computing them. A batch is
//! never divided, since the last digits of a network's output can depend on how many windows are computed together.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::EvaluationError;
use super::config::EvaluateConfig;
use super::inference::Inference;
use foreframe_core::files::{sha256_hex, write_atomically};
use foreframe_core::nn::precision;
use foreframe_core::registry::{Model, ProgramStamp};
use foreframe_core::types::Seed;

/// A part of an evaluation.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EvaluationPart {
    /// The directory in which it saves its results.
    pub dir: PathBuf,
    /// Which of the parts, from 0.
    pub index: usize,
    /// How many parts there are, at least 1.
    pub count: usize,
}

/// Which batches are computed here, and which were computed before.
#[derive(Default)]
pub(super) struct Division<'a> {
    /// Hash of all that decides the results. Results of other inputs are not read.
    inputs: String,
    /// The directories of the parts that were computed before.
    saved: &'a [PathBuf],
    /// The part that is computed here; all batches without one.
    part: Option<&'a EvaluationPart>,
}

/// The results of consecutive batches of a pass.
#[derive(Serialize, Deserialize)]
struct SavedBatches<B> {
    inputs: String,
    first: usize,
    batches: B,
}

impl<'a> Division<'a> {
    /// All batches, but for those that parts computed before.
    pub(super) fn joined(inputs: String, saved: &'a [PathBuf]) -> Self {
        Self {
            inputs,
            saved,
            part: None,
        }
    }

    /// The batches of a part, but for those that an earlier attempt saved.
    pub(super) fn of_part(inputs: String, part: &'a EvaluationPart) -> Self {
        Self {
            inputs,
            saved: std::slice::from_ref(&part.dir),
            part: Some(part),
        }
    }

    /// Which of the batches are computed here.
    pub(super) fn share(&self, batches: usize) -> Range<usize> {
        let (index, count) = self.part.map_or((0, 1), |part| (part.index, part.count.max(1)));
        let start = |part: usize| batches * part.min(count) / count;
        start(index)..start(index + 1)
    }

    /// The saved results of a pass, by the position of their batch. What is missing, damaged or of other inputs is left out.
    pub(super) fn saved<T: DeserializeOwned>(&self, pass: &str) -> BTreeMap<usize, Vec<T>> {
        let files = self.saved.iter().filter_map(|dir| read::<T>(&path(dir, pass)));
        let files = files.filter(|file| file.inputs == self.inputs);
        files.flat_map(|file| (file.first..).zip(file.batches)).collect()
    }

    /// Saves the results of a part's share of a pass, from the batch `first` on. Errors: `Io`.
    pub(super) fn save<T: Serialize>(
        &self,
        pass: &str,
        first: usize,
        batches: &[Vec<T>],
    ) -> Result<(), EvaluationError> {
        let Some(part) = self.part else { return Ok(()) };
        let saved = SavedBatches {
            inputs: self.inputs.clone(),
            first,
            batches,
        };
        let bytes = rmp_serde::to_vec(&saved).expect("a number that MessagePack cannot hold is a bug");
        let path = path(&part.dir, pass);
        write_atomically(&path, &bytes).map_err(|source| EvaluationError::Io { path, source })
    }
}

fn path(dir: &Path, pass: &str) -> PathBuf {
    dir.join(format!("{pass}.msgpack"))
}

fn read<T: DeserializeOwned>(path: &Path) -> Option<SavedBatches<Vec<Vec<T>>>> {
    rmp_serde::from_slice(&std::fs::read(path).ok()?).ok()
}

/// The hash of all that decides the results of an evaluation's passes.
pub(super) fn inputs(inference: Inference, config: &EvaluateConfig, split_seed: Seed) -> String {
    let of_model = |model: &Model| {
        let manifest = &model.manifest;
        json!({
            "weights": manifest.weights_sha256, "spec": model.spec(), "calibration": manifest.calibration, "trained_on": manifest.dataset,
            "mirrored": manifest.training["data"]["mirror"],
        })
    };
    let inputs = json!({
        "program": ProgramStamp::current(),
        "model": of_model(inference.loaded),
        "twins": config.twins.iter().map(|twin| of_model(twin)).collect::<Vec<_>>(),
        "dataset": inference.dataset.info(),
        "brightness": inference.dataset.brightness(),
        "split": config.split,
        "split_seed": split_seed,
        "stride": config.stride,
        "max_windows": config.max_windows,
        "nearest_windows": config.nearest_windows,
        "seed": config.seed,
        "batch": config.batch,
        "precision": precision::current(),
    });
    sha256_hex(inputs.to_string().as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(dir: &Path, index: usize, count: usize) -> EvaluationPart {
        EvaluationPart {
            dir: dir.to_owned(),
            index,
            count,
        }
    }

    #[test]
    fn every_batch_is_in_one_part() {
        for (batches, count) in [(0, 3), (1, 4), (7, 3), (32, 64)] {
            let parts = (0..count).map(|index| part(Path::new(""), index, count));
            let shares = parts.flat_map(|part| Division::of_part(String::new(), &part).share(batches));
            assert_eq!(shares.collect::<Vec<_>>(), (0..batches).collect::<Vec<_>>());
        }
    }

    #[test]
    fn results_of_the_same_inputs_are_read_bit_by_bit() {
        let dir = tempfile::tempdir().unwrap();
        let part = part(dir.path(), 1, 2);
        let batches = [
            vec![0.1 + 0.2, -0.0, f64::MIN_POSITIVE / 3.0],
            vec![f64::NAN, f64::INFINITY],
        ];
        Division::of_part("a".to_owned(), &part)
            .save("scores", 2, &batches)
            .unwrap();
        let dirs = [dir.path().to_owned(), dir.path().join("none")];
        let read = |inputs: &str| Division::joined(inputs.to_owned(), &dirs).saved::<f64>("scores");
        let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        let found = read("a");
        assert_eq!(found.keys().copied().collect::<Vec<_>>(), [2, 3]);
        assert!(
            found
                .values()
                .zip(&batches)
                .all(|(found, saved)| bits(found) == bits(saved))
        );
        assert!(read("b").is_empty());
        let file = path(dir.path(), "scores");
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() - 1]).unwrap();
        assert!(read("a").is_empty(), "a damaged file");
    }
}
