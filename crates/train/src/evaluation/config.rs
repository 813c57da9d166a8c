//! What an evaluation scores, on what, and how closely.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use serde::{Deserialize, Serialize};

use super::EvaluationError;
use super::bootstrap::Bootstrap;
use foreframe_core::registry::Model;
use foreframe_core::types::Seed;
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::sampler::{Split, Splits};
use foreframe_sim::RoomSet;

/// The name of the set that is a whole data set.
const WHOLE_SET: &str = "whole-set";

/// What a model is scored on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScoredSplit {
    /// To choose between models and settings: the validation split.
    Validation,
    /// To publish: the three held-out test sets. Choosing by them would make their scores too good.
    #[default]
    Test,
    /// To publish: all of a data set that holds nothing but test data, as the files of published benchmarks and rooms that
    /// are only for tests do.
    WholeSet,
}

impl ScoredSplit {
    /// The splits that are scored, in the order of the report. Of a recording, only the first is.
    #[must_use]
    pub fn splits(self) -> &'static [Split] {
        match self {
            Self::Validation => &[Split::Validation],
            Self::Test => &[Split::Test, Split::UnseenPairs, Split::UnseenGains],
            Self::WholeSet => &[Split::Test],
        }
    }

    /// The name of the set that one of the splits is: of a whole data set, that of its rooms if they are only for tests.
    pub(super) fn set_name(self, dataset: &Dataset, split: Split) -> &'static str {
        match self {
            Self::WholeSet => test_rooms(dataset).map_or(WHOLE_SET, RoomSet::name),
            Self::Validation | Self::Test => split.name(),
        }
    }

    /// What is scored where this is asked for: all of a data set whose rooms are only for tests, unless the model was
    /// trained in them.
    pub(super) fn of(self, loaded: &Model, dataset: &Dataset) -> Self {
        let was_seen = loaded.manifest.dataset.includes(&dataset.info().content_hash);
        match self {
            Self::Test if test_rooms(dataset).is_some() && !was_seen => Self::WholeSet,
            split => split,
        }
    }

    /// How the data set is split for it.
    pub(super) fn divide(self, dataset: &Dataset, seed: Seed) -> Splits {
        match self {
            Self::WholeSet => Splits::all_for_test(dataset),
            Self::Validation | Self::Test => Splits::new(dataset, seed),
        }
    }
}

/// The rooms of the data set, if they are only for tests.
pub(super) fn test_rooms(dataset: &Dataset) -> Option<RoomSet> {
    let world = dataset.info().world.as_ref()?;
    world.rooms.filter(|rooms| rooms.is_only_for_tests())
}

/// Training windows among which the baseline looks for the nearest ones at most, unless another number is asked for: all of
/// most data sets. Each takes up to 256 bytes of memory for each input frame; where all are searched, they share their frames.
pub const NEAREST_WINDOWS: usize = 200_000;

/// Fewer resamples give no 95 % interval.
#[doc(hidden)]
pub const MIN_RESAMPLES: usize = 100;

/// What to test on, and how closely.
#[derive(Clone)]
pub struct EvaluateConfig<'a> {
    /// Which part of the data set.
    pub split: ScoredSplit,
    /// Seed of the split; that of the model's training if none is given.
    pub split_seed: Option<Seed>,
    /// Frames from the start of one window to that of the next.
    pub stride: usize,
    /// Windows of each set at most, evenly spread over its trials or blocks of time.
    pub max_windows: usize,
    /// Training windows among which the baseline looks for the nearest ones, at most, evenly spread.
    pub nearest_windows: usize,
    /// Resamples for the intervals.
    pub bootstrap_samples: usize,
    /// Seed of the resamples and of the shuffled actions.
    pub seed: Seed,
    /// Windows that go through the model at once.
    pub batch: usize,
    /// Models trained with the same budget without the action, without the state or without both, for the action table.
    pub twins: Vec<&'a Model>,
    /// Other data sets, which the model's novelty must tell from the scored windows.
    pub novel: Vec<&'a Dataset>,
    /// Directories in which parts of this evaluation saved their results, which are then not computed again.
    #[doc(hidden)]
    pub saved: Vec<PathBuf>,
    /// The command line, for the stamp.
    pub command: String,
    /// Set by another thread to stop the evaluation.
    pub cancelled: Option<&'a AtomicBool>,
}

impl Default for EvaluateConfig<'_> {
    fn default() -> Self {
        Self {
            split: ScoredSplit::default(),
            split_seed: None,
            stride: 1,
            max_windows: 2000,
            nearest_windows: NEAREST_WINDOWS,
            bootstrap_samples: 1000,
            seed: Seed(0),
            batch: 64,
            twins: Vec::new(),
            novel: Vec::new(),
            saved: Vec::new(),
            command: String::new(),
            cancelled: None,
        }
    }
}

impl EvaluateConfig<'_> {
    /// Errors: `Setting` where a number is too small.
    pub fn validate(&self) -> Result<(), EvaluationError> {
        for (setting, value, least) in [
            ("the stride of windows", self.stride, 1),
            ("the number of windows", self.max_windows, 1),
            ("the number of training windows to search", self.nearest_windows, 1),
            (
                "the number of bootstrap resamples",
                self.bootstrap_samples,
                MIN_RESAMPLES,
            ),
            ("the batch size", self.batch, 1),
        ] {
            if value < least {
                return Err(EvaluationError::Setting { setting, value, least });
            }
        }
        Ok(())
    }

    /// How intervals are resampled.
    pub(super) fn bootstrap(&self) -> Bootstrap {
        Bootstrap {
            samples: self.bootstrap_samples,
            seed: self.seed,
        }
    }
}
