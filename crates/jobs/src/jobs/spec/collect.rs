//! The specification of a collection.

use std::ops::Range;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{AvailableInputs, check_parts, default_parts, is_one};
use crate::jobs::JobError;
use foreframe_core::types::{DatasetName, Seed};
use foreframe_data::dataset::moving_mnist::MOVING_MNIST;
use foreframe_data::dataset::{self, CollectConfig, CollectionStatus, DEFAULT_TRIALS_PER_SHARD, DatasetError};
use foreframe_sim::{RoomSet, Scenario, SimError};

/// The maximum number of trials of one collection.
pub const MAX_TRIALS: u64 = 1_000_000;

/// A collection: writes the data set `name`. A cancelled collection continues where it stopped when it is resumed, or when
/// the same collection is submitted again.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CollectSpec {
    /// The data set's name: a to z, 0 to 9 and `-`, at most 64 characters.
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

impl CollectSpec {
    pub(super) fn check(&self, available: AvailableInputs<'_>) -> Result<(), JobError> {
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
    pub(in crate::jobs) fn shards_of(&self, part: usize) -> Range<usize> {
        let (shards, parts) = (self.shard_count(), self.parts.max(1));
        let start = |part: usize| shards * part.min(parts) / parts;
        start(part)..start(part + 1)
    }

    /// Its parts; none if it is collected as a whole. There are never more parts than shards.
    pub(super) fn parts(&self) -> Vec<Self> {
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
    pub(in crate::jobs) fn config(&self, datasets: &Path) -> Result<CollectConfig, JobError> {
        let scenario = self.scenario.parse();
        let scenario: Scenario = scenario.map_err(|error: SimError| {
            let reason = if self.scenario == MOVING_MNIST {
                format!(
                    "{MOVING_MNIST} is made of a file of digits, which a job does not have; collect it on the command line: foreframe \
                     collect --scenario {MOVING_MNIST} --digits FILE"
                )
            } else {
                error.to_string()
            };
            JobError::invalid("scenario", reason)
        })?;
        let mut config = CollectConfig::new(scenario, self.trials, Seed(self.seed), &datasets.join(&self.name));
        config.world.rooms = self.rooms;
        config.world.true_pose = self.true_pose;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn digits_are_collected_on_the_command_line_only() {
        let spec = serde_json::json!({"name": "a", "scenario": "moving-mnist", "trials": 1});
        let collect: CollectSpec = serde_json::from_value(spec).unwrap();
        let error = collect.config(Path::new("datasets")).unwrap_err().to_string();
        assert!(
            error.contains("foreframe collect --scenario moving-mnist --digits FILE"),
            "{error}"
        );
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
