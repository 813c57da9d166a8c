//! The specification of a job, checked when it is submitted, so that mistakes are reported at once.

mod adapt;
mod collect;
mod evaluate;
mod import;
pub(super) mod train;

use std::collections::BTreeMap;
use std::fmt;
use std::ops::RangeInclusive;
use std::path::Path;

use serde::de::{DeserializeOwned, Error as _, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};

pub use self::adapt::AdaptSpec;
pub use self::collect::{CollectSpec, MAX_TRIALS};
pub use self::evaluate::EvaluateSpec;
pub use self::import::ImportSpec;
pub use self::train::TrainSpec;
use super::JobError;
use crate::store::JobId;
use foreframe_core::types::{DatasetName, ModelName};

/// The maximum number of parts of one job.
pub const MAX_PARTS: usize = 64;

/// The maximum number of windows of each test set of an evaluation.
pub const MAX_WINDOWS: usize = 100_000;
/// The maximum number of bootstrap resamples of an evaluation.
pub const MAX_RESAMPLES: usize = 10_000;

/// What a job does.
#[derive(Clone, Debug, PartialEq, Serialize, utoipa::ToSchema)]
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

/// Errors name the path of the field that is wrong. Those of serde for an enum with a tag do not.
impl<'de> Deserialize<'de> for JobSpec {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(JobVisitor)
    }
}

struct JobVisitor;

impl<'de> Visitor<'de> for JobVisitor {
    type Value = JobSpec;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a job")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<JobSpec, A::Error> {
        let mut fields = Map::new();
        while let Some((field, value)) = map.next_entry::<String, Value>()? {
            if fields.contains_key(&field) {
                return Err(A::Error::custom(format!("duplicate field `{field}`")));
            }
            fields.insert(field, value);
        }
        let kind = fields.remove("kind").ok_or_else(|| A::Error::missing_field("kind"))?;
        let fields = Value::Object(fields);
        let spec = match kind.as_str() {
            Some("collect") => of_fields(fields).map(JobSpec::Collect),
            Some("import") => of_fields(fields).map(JobSpec::Import),
            Some("train") => of_fields(fields).map(JobSpec::Train),
            Some("adapt") => of_fields(fields).map(JobSpec::Adapt),
            Some("evaluate") => of_fields(fields).map(JobSpec::Evaluate),
            _ => {
                let known = JobSpec::KINDS.join(", ");
                Err(format!("kind: there is no kind {kind}; there are: {known}"))
            }
        };
        spec.map_err(A::Error::custom)
    }
}

/// Errors: a sentence that starts with the path of the field.
fn of_fields<T: DeserializeOwned>(fields: Value) -> Result<T, String> {
    serde_path_to_error::deserialize(fields).map_err(|error| error.to_string())
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

    /// The model that it starts from, or evaluates.
    pub(super) fn used_model(&self) -> Option<&ModelName> {
        match self {
            Self::Train(spec) => spec.from.as_ref(),
            Self::Adapt(spec) => Some(&spec.from),
            Self::Evaluate(spec) => Some(&spec.model),
            Self::Collect(_) | Self::Import(_) => None,
        }
    }

    /// The version of that model, where it names one.
    pub(super) fn used_version(&self) -> Option<u32> {
        match self {
            Self::Train(spec) => spec.from_version,
            Self::Adapt(spec) => spec.from_version,
            Self::Evaluate(spec) => spec.version,
            Self::Collect(_) | Self::Import(_) => None,
        }
    }

    /// The same work with this version of that model. It stays as it is if it uses none.
    pub(super) fn with_used_version(&self, version: Option<u32>) -> Self {
        let mut spec = self.clone();
        match &mut spec {
            Self::Train(spec) if spec.from.is_some() => spec.from_version = version,
            Self::Adapt(spec) => spec.from_version = version,
            Self::Evaluate(spec) => spec.version = version,
            Self::Train(_) | Self::Collect(_) | Self::Import(_) => {}
        }
        spec
    }

    /// Whether this can be the specification of a job that was submitted as `submitted`. A job that has started or has parts names
    /// the version that it uses, so a request without one also matches a job that was submitted with one.
    pub(super) fn matches_submitted(&self, submitted: &Self) -> bool {
        *self == submitted.with_used_version(submitted.used_version().or(self.used_version()))
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

/// Errors: `NotFound` if there is no such version of a model; `Invalid` if a job before it may make that version, which has no number
/// before it is there.
fn check_version(
    field: &'static str,
    version: Option<u32>,
    after: Option<JobId>,
    available: Option<&Vec<u32>>,
) -> Result<(), JobError> {
    let Some(version) = version else { return Ok(()) };
    let known = available.into_iter().flatten();
    match after {
        Some(after) if known.clone().all(|known| *known != version) => {
            let reason = format!(
                "there is no version \"{version}\" yet; if {after} makes it, leave out {field}: then this job uses what {after} made"
            );
            Err(JobError::invalid(field, reason))
        }
        _ => check_known((field, "version"), &version, known),
    }
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
    fn a_value_of_the_wrong_type_is_refused_with_its_field() {
        let refused = |text: &str| serde_json::from_str::<JobSpec>(text).unwrap_err().to_string();
        for (fields, expected) in [
            (
                r#""kind": "train", "name": "a", "dataset": "d", "from_version": "x""#,
                "from_version: invalid type: string \"x\"",
            ),
            (
                r#""kind": "adapt", "name": "a", "dataset": "d", "steps": "many""#,
                "steps: invalid type: string \"many\"",
            ),
            (
                r#""kind": "train", "name": "a", "dataset": "d", "mixture": {"b": true}"#,
                "mixture.b: invalid type: boolean",
            ),
            (
                r#""kind": "train", "name": "a", "dataset": "d", "sweep": {"seed": 1}"#,
                "sweep.seed: invalid type: integer",
            ),
            (
                r#""kind": "import", "name": "a", "source": "s", "action": ["x", 1]"#,
                "action[1]: invalid type: integer",
            ),
            (
                r#""kind": "trian", "name": "a""#,
                "kind: there is no kind \"trian\"; there are: collect, import, train, adapt, evaluate",
            ),
            (r#""name": "a""#, "missing field `kind`"),
            (r#""kind": "train", "name": "a", "name": "b""#, "duplicate field `name`"),
            (r#""kind": "train", "dataset": "d""#, "missing field `name`"),
        ] {
            let error = refused(&format!("{{{fields}}}"));
            assert!(error.starts_with(expected), "{fields}: {error}");
        }
    }

    #[test]
    fn a_job_that_names_its_version_matches_one_that_does_not() {
        for (kind, version) in [
            ("adapt", "from_version"),
            ("train", "from_version"),
            ("evaluate", "version"),
        ] {
            let spec = |more: serde_json::Value| -> JobSpec {
                let mut spec = match kind {
                    "evaluate" => serde_json::json!({"kind": kind, "model": "m", "dataset": "d"}),
                    _ => serde_json::json!({"kind": kind, "name": "a", "dataset": "d", "from": "m"}),
                };
                spec.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
                serde_json::from_value(spec).unwrap()
            };
            let [any, first, second] = [
                serde_json::json!({}),
                serde_json::json!({version: 1}),
                serde_json::json!({version: 2}),
            ]
            .map(spec);
            assert!(first.matches_submitted(&any) && first.matches_submitted(&first));
            assert!(!first.matches_submitted(&second));
            assert!(!first.matches_submitted(&spec(serde_json::json!({"after": "job-1"}))));
        }
    }
}
