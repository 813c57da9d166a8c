//! The specification of a job, checked when it is submitted, so that mistakes are reported at once.

mod adapt;
mod evaluate;
mod import;
pub(super) mod train;

use std::collections::BTreeMap;
use std::ops::{Range, RangeInclusive};
use std::path::Path;
use std::str::FromStr;

use serde::de::{Error as _, IntoDeserializer as _};
use serde::{Deserialize, Deserializer, Serialize};

pub use self::adapt::AdaptSpec;
pub use self::evaluate::EvaluateSpec;
pub use self::import::ImportSpec;
pub use self::train::TrainSpec;
use super::JobError;
use crate::store::JobId;
use foreframe_core::types::{DatasetName, ModelName, Seed, ValueError};
use foreframe_data::dataset::{self, CollectConfig, CollectionStatus, DEFAULT_TRIALS_PER_SHARD, DatasetError};
use foreframe_sim::{RoomSet, Scenario, SimError};

/// The maximum number of trials of one collection.
pub const MAX_TRIALS: u64 = 1_000_000;

/// The maximum number of parts of one job.
pub const MAX_PARTS: usize = 64;

/// The maximum number of windows of each test set of an evaluation.
pub const MAX_WINDOWS: usize = 100_000;
/// The maximum number of bootstrap resamples of an evaluation.
pub const MAX_RESAMPLES: usize = 10_000;

/// What a job does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum JobSpec {
    /// Collect a data set from the simulator.
    Collect(CollectSpec),
    /// Turn a recording on the server into a data set.
    Import(ImportSpec),
    /// Train a model on a data set.
    Train(TrainSpec),
    /// Adapt a model to a robot that it never saw.
    Adapt(AdaptSpec),
    /// Measure a model on the held-out trials of a data set.
    Evaluate(EvaluateSpec),
}

/// A collection: writes the data set `name`. A cancelled collection continues where it stopped when it is resumed, or when
/// the same collection is submitted again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CollectSpec {
    /// The data set's name: a to z, 0 to 9 and `-`, at most 64 characters.
    #[serde(deserialize_with = "name")]
    #[schema(value_type = String, pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
    pub name: DatasetName,
    /// `static-observer`, `moving-observer`, `crowded` or `crossing`.
    pub scenario: String,
    /// Trials, 1 to 1,000,000.
    #[schema(minimum = 1, maximum = 1_000_000)]
    pub trials: u64,
    /// The random seed.
    #[serde(default = "default_seed")]
    #[schema(default = 1)]
    pub seed: u64,
    /// The set from which each trial draws a room, a camera and robots of its own. Absent: all trials are in the same room.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rooms: Option<RoomSet>,
    /// Whether the states hold the true pose instead of the odometry's.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub true_pose: bool,
    /// In how many parts workers may collect it, 1 to 64: each takes its share of the trials, in shards of 50. The data set has
    /// the same bytes however many there are.
    #[serde(default = "default_parts", skip_serializing_if = "is_one")]
    #[schema(minimum = 1, maximum = 64, default = 1)]
    pub parts: usize,
    /// Which of the parts this job collects, from 0. Only jobs that are parts have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(read_only)]
    pub part: Option<usize>,
}

fn default_seed() -> u64 {
    1
}

fn default_parts() -> usize {
    1
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it with a reference")]
fn is_one(parts: &usize) -> bool {
    *parts == 1
}

/// The data sets and models that jobs can use.
#[derive(Clone, Copy, Debug)]
pub struct AvailableInputs<'a> {
    /// The data directory.
    pub data_dir: &'a Path,
    /// The directory that imports may read; without one, they are off.
    pub import_dir: Option<&'a Path>,
    /// The finished data sets.
    pub datasets: &'a [DatasetName],
    /// The versions of each model.
    pub models: &'a BTreeMap<ModelName, Vec<u32>>,
}

impl JobSpec {
    /// All kinds.
    pub const KINDS: [&'static str; 5] = ["collect", "import", "train", "adapt", "evaluate"];

    /// Its kind.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Collect(_) => "collect",
            Self::Import(_) => "import",
            Self::Train(_) => "train",
            Self::Adapt(_) => "adapt",
            Self::Evaluate(_) => "evaluate",
        }
    }

    /// The data set that it makes, which only one job at a time can make. Versions and reports have unique names.
    #[must_use]
    pub fn made_dataset(&self) -> Option<&DatasetName> {
        match self {
            Self::Collect(spec) => Some(&spec.name),
            Self::Import(spec) => Some(&spec.name),
            Self::Train(_) | Self::Adapt(_) | Self::Evaluate(_) => None,
        }
    }

    /// The model of which it makes a version.
    #[must_use]
    pub fn made_model(&self) -> Option<&ModelName> {
        match self {
            Self::Train(spec) => Some(&spec.name),
            Self::Adapt(spec) => Some(&spec.name),
            Self::Collect(_) | Self::Import(_) | Self::Evaluate(_) => None,
        }
    }

    /// The job that must end before this one starts.
    #[must_use]
    pub fn after(&self) -> Option<JobId> {
        match self {
            Self::Train(spec) => spec.after,
            Self::Adapt(spec) => spec.after,
            Self::Evaluate(spec) => spec.after,
            Self::Collect(_) | Self::Import(_) => None,
        }
    }

    /// The data sets that it writes or reads.
    #[must_use]
    pub fn datasets(&self) -> Vec<&DatasetName> {
        match self {
            Self::Collect(spec) => vec![&spec.name],
            Self::Import(spec) => vec![&spec.name],
            Self::Train(spec) => spec.datasets().map(|(name, _)| name).collect(),
            Self::Adapt(spec) => vec![&spec.dataset],
            Self::Evaluate(spec) => vec![&spec.dataset],
        }
    }

    /// Its parts, which any worker can do; none if it is done as a whole.
    #[must_use]
    pub fn parts(&self) -> Vec<Self> {
        match self {
            Self::Train(spec) => spec.parts().into_iter().map(Self::Train).collect(),
            Self::Collect(spec) => spec.parts().into_iter().map(Self::Collect).collect(),
            Self::Evaluate(spec) => spec.parts().into_iter().map(Self::Evaluate).collect(),
            Self::Import(spec) => spec.parts().into_iter().map(Self::Import).collect(),
            Self::Adapt(_) => Vec::new(),
        }
    }

    /// The version of `from`, the model whose weights it starts from, where it names one.
    pub(super) fn starting_version(&self) -> Option<u32> {
        match self {
            Self::Train(spec) => spec.from_version,
            Self::Adapt(spec) => spec.from_version,
            Self::Collect(_) | Self::Import(_) | Self::Evaluate(_) => None,
        }
    }

    /// The same work from this version of `from`. It stays as it is if it starts from no model.
    pub(super) fn with_starting_version(&self, version: Option<u32>) -> Self {
        let mut spec = self.clone();
        match &mut spec {
            Self::Train(spec) if spec.from.is_some() => spec.from_version = version,
            Self::Adapt(spec) => spec.from_version = version,
            Self::Train(_) | Self::Collect(_) | Self::Import(_) | Self::Evaluate(_) => {}
        }
        spec
    }

    /// Whether this can be the specification of a job that was submitted as `submitted`. A job that has started names the
    /// version that it starts from, so a request without one also matches a job that was submitted with one.
    pub(super) fn matches_submitted(&self, submitted: &Self) -> bool {
        *self == submitted.with_starting_version(submitted.starting_version().or(self.starting_version()))
    }

    /// Checks everything that can be checked before the work starts. Errors: `Invalid` and `NotFound`, which name the field;
    /// `Taken`, `Dataset`.
    pub fn check(&self, available: AvailableInputs<'_>) -> Result<(), JobError> {
        match self {
            Self::Collect(spec) => spec.check(available),
            Self::Import(spec) => spec.check(available),
            Self::Train(spec) => spec.check(available),
            Self::Adapt(spec) => spec.check(available),
            Self::Evaluate(spec) => spec.check(available),
        }
    }
}

impl CollectSpec {
    fn check(&self, available: AvailableInputs<'_>) -> Result<(), JobError> {
        if !(1..=MAX_TRIALS).contains(&self.trials) {
            let reason = format!(
                "{} is out of range; 1 to {MAX_TRIALS} trials can be collected",
                self.trials
            );
            return Err(JobError::invalid("trials", reason));
        }
        check_parts(self.parts, self.part)?;
        let config = self.config(&available.data_dir.join("datasets"))?;
        let is_there = available.datasets.contains(&self.name);
        // With a shared object store, a data set that is complete only here was deleted elsewhere or not yet pushed.
        if !is_there && dataset::is_finished(&config.out) {
            return Ok(());
        }
        match CollectionStatus::of(&config) {
            Ok(CollectionStatus::New | CollectionStatus::Unfinished { .. }) if !is_there => Ok(()),
            Ok(_) => Err(JobError::taken(&self.name, "exists; choose another name")),
            Err(DatasetError::OutExists { .. }) => Err(JobError::taken(
                &self.name,
                "cannot be written because other files are in its directory; move them, or choose another name",
            )),
            Err(DatasetError::OtherArguments { differences, .. }) => {
                let why = format!(
                    "was started with other arguments ({differences}); use those to continue it, or choose another name"
                );
                Err(JobError::taken(&self.name, why))
            }
            Err(error) => Err(error.into()),
        }
    }

    /// The number of its shards.
    fn shard_count(&self) -> usize {
        let shards = self.trials.div_ceil(DEFAULT_TRIALS_PER_SHARD);
        usize::try_from(shards).unwrap_or(usize::MAX)
    }

    /// The shards of the part with this index: consecutive ones, in equal shares.
    pub(super) fn shards_of(&self, part: usize) -> Range<usize> {
        let (shards, parts) = (self.shard_count(), self.parts.max(1));
        let start = |part: usize| shards * part.min(parts) / parts;
        start(part)..start(part + 1)
    }

    /// Its parts; none if it is collected as a whole. There are never more parts than shards.
    fn parts(&self) -> Vec<Self> {
        let parts = self.parts.min(self.shard_count());
        if parts < 2 || self.part.is_some() {
            return Vec::new();
        }
        let part = |part| Self {
            parts,
            part: Some(part),
            ..self.clone()
        };
        (0..parts).map(part).collect()
    }

    /// The configuration of the collection, into a directory below `datasets`. Errors: `Invalid`, which names the scenarios.
    pub(super) fn config(&self, datasets: &Path) -> Result<CollectConfig, JobError> {
        let scenario = self.scenario.parse();
        let scenario: Scenario =
            scenario.map_err(|error: SimError| JobError::invalid("scenario", error.to_string()))?;
        let mut config = CollectConfig::new(scenario, self.trials, Seed(self.seed), &datasets.join(&self.name));
        config.world.rooms = self.rooms;
        config.world.true_pose = self.true_pose;
        Ok(config)
    }
}

/// A name in a field of a job. The error starts with the field, as those of [`JobError`] do.
fn named<'de, D: Deserializer<'de>, N: FromStr<Err = ValueError>>(field: &str, deserializer: D) -> Result<N, D::Error> {
    let text = String::deserialize(deserializer)?;
    text.parse()
        .map_err(|error| D::Error::custom(format!("{field}: {error}")))
}

fn name<'de, D: Deserializer<'de>, N: FromStr<Err = ValueError>>(deserializer: D) -> Result<N, D::Error> {
    named("name", deserializer)
}

fn dataset<'de, D: Deserializer<'de>>(deserializer: D) -> Result<DatasetName, D::Error> {
    named("dataset", deserializer)
}

fn from<'de, D: Deserializer<'de>>(deserializer: D) -> Result<ModelName, D::Error> {
    named("from", deserializer)
}

fn optional_from<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<ModelName>, D::Error> {
    optional("from", deserializer)
}

fn model<'de, D: Deserializer<'de>>(deserializer: D) -> Result<ModelName, D::Error> {
    named("model", deserializer)
}

fn twin<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<ModelName>, D::Error> {
    optional("twin", deserializer)
}

fn optional<'de, D: Deserializer<'de>>(field: &str, deserializer: D) -> Result<Option<ModelName>, D::Error> {
    let text = Option::<String>::deserialize(deserializer)?;
    text.map(|text| named(field, text.into_deserializer())).transpose()
}

fn check_dataset(name: &DatasetName, available: &[DatasetName]) -> Result<(), JobError> {
    check_known(("dataset", "data set"), name, available.iter())
}

/// Errors: `NotFound` if a field names what is not available.
fn check_known<'a, N: PartialEq + ToString + 'a>(
    (field, kind): (&'static str, &'static str),
    name: &N,
    available: impl Iterator<Item = &'a N> + Clone,
) -> Result<(), JobError> {
    if available.clone().any(|known| known == name) {
        return Ok(());
    }
    Err(JobError::NotFound {
        field,
        kind,
        name: name.to_string(),
        available: available.map(N::to_string).collect(),
    })
}

/// Errors: `Invalid` if a job has too many parts, or is submitted as a part.
fn check_parts(parts: usize, part: Option<usize>) -> Result<(), JobError> {
    check_range("parts", parts, 1..=MAX_PARTS)?;
    if part.is_some() {
        let reason = "only the server makes parts; leave it out, and say how many with parts";
        return Err(JobError::invalid("part", reason));
    }
    Ok(())
}

fn check_range(field: &'static str, value: usize, range: RangeInclusive<usize>) -> Result<(), JobError> {
    if range.contains(&value) {
        return Ok(());
    }
    let (least, most) = range.into_inner();
    let reason = format!("{value} is out of range; it must be {least} to {most}");
    Err(JobError::invalid(field, reason))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_invalid_name_is_refused_with_its_field() {
        let refused = |spec: serde_json::Value| serde_json::from_value::<JobSpec>(spec).unwrap_err().to_string();
        let wrong = |field: &str| format!("{field}: \"../x\" is not a valid name; a name has 1 to 64 characters");
        let collect = serde_json::json!({"kind": "collect", "name": "../x", "scenario": "crowded", "trials": 1});
        assert!(refused(collect).starts_with(&wrong("name")));
        for field in ["model", "dataset", "twin"] {
            let mut spec = serde_json::json!({"kind": "evaluate", "model": "m", "dataset": "d"});
            spec[field] = "../x".into();
            assert!(refused(spec).starts_with(&wrong(field)), "{field}");
        }
    }

    #[test]
    fn an_unknown_field_of_a_job_is_refused() {
        let text = r#"{"kind":"collect","name":"a","scenario":"crowded","trials":1,"colour":"red"}"#;
        let error = serde_json::from_str::<JobSpec>(text).unwrap_err().to_string();
        assert!(error.contains("unknown field `colour`"), "{error}");
    }

    #[test]
    fn a_job_that_names_its_version_matches_one_that_does_not() {
        for kind in ["adapt", "train"] {
            let spec = |more: serde_json::Value| -> JobSpec {
                let mut spec = serde_json::json!({"kind": kind, "name": "a", "dataset": "d", "from": "m"});
                spec.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
                serde_json::from_value(spec).unwrap()
            };
            let [any, first, second] = [
                serde_json::json!({}),
                serde_json::json!({"from_version": 1}),
                serde_json::json!({"from_version": 2}),
            ]
            .map(spec);
            assert!(first.matches_submitted(&any) && first.matches_submitted(&first));
            assert!(!first.matches_submitted(&second));
            assert!(!first.matches_submitted(&spec(serde_json::json!({"after": "job-1"}))));
        }
    }

    #[test]
    fn the_parts_of_a_collection_are_all_its_shards() {
        let spec = |trials: u64, parts: usize| -> CollectSpec {
            let spec = serde_json::json!({"name": "a", "scenario": "crowded", "trials": trials, "parts": parts});
            serde_json::from_value(spec).unwrap()
        };
        for (trials, parts) in [(501, 3), (501, 11), (501, 64), (1_000_000, 64)] {
            let made = spec(trials, parts).parts();
            let shards: Vec<usize> = made
                .iter()
                .flat_map(|made| made.shards_of(made.part.unwrap()))
                .collect();
            assert_eq!(shards, (0..trials.div_ceil(50) as usize).collect::<Vec<_>>());
            assert!(made.len() <= parts && made.iter().all(|made| !made.shards_of(made.part.unwrap()).is_empty()));
        }
        assert_eq!(spec(50, 8).parts(), []);
        assert_eq!(spec(500, 1).parts(), []);
    }

    #[test]
    fn a_collection_in_rooms_takes_a_known_set() {
        let spec = |set: &str| serde_json::json!({"name": "a", "scenario": "crowded", "trials": 1, "rooms": set, "true_pose": true});
        let collect: CollectSpec = serde_json::from_value(spec("new-cameras")).unwrap();
        let world = collect.config(Path::new("datasets")).unwrap().world;
        assert_eq!((world.rooms, world.true_pose), (Some(RoomSet::NewCameras), true));
        assert_eq!(serde_json::to_value(&collect).unwrap()["rooms"], "new-cameras");
        let error = serde_json::from_value::<CollectSpec>(spec("old"))
            .unwrap_err()
            .to_string();
        assert!(error.contains("varied"), "{error}");
    }
}
