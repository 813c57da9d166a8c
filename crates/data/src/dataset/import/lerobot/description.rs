//! `meta/info.json`: which features there are, and which of them are chosen.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;

use crate::dataset::import::files::read_file;
use crate::dataset::import::options::are_none;
use crate::dataset::import::skipped::listed;
use crate::dataset::import::{ImportError, ImportOptions};

/// The description, which every data set of `LeRobot` has.
pub(super) const INFO: &str = "meta/info.json";
/// The features that become the action and the state, if no others are named.
pub(super) const ACTION: &str = "action";
pub(super) const STATE: &str = "observation.state";
/// The greatest size of a vector feature.
const MAX_COMPONENTS: usize = 10_000;
/// Types whose values are read as numbers.
const NUMBERS: [&str; 11] = [
    "float32", "float64", "float16", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "bool",
];

#[derive(Deserialize)]
pub(super) struct InfoFile {
    codebase_version: String,
    pub(super) data_path: String,
    #[serde(default)]
    pub(super) video_path: Option<String>,
    #[serde(default)]
    pub(super) chunks_size: Option<usize>,
    features: BTreeMap<String, Feature>,
}

#[derive(Deserialize)]
struct Feature {
    dtype: String,
    #[serde(default)]
    shape: Vec<usize>,
    #[serde(default)]
    names: Value,
    /// Facts about a video; depth images are marked there.
    #[serde(default, alias = "video_info")]
    info: Value,
}

/// What a data set describes about itself.
pub(super) struct Description {
    pub(super) source: PathBuf,
    pub(super) info: InfoFile,
}

/// The feature with the images.
pub(super) struct ImageFeature {
    pub(super) name: String,
    pub(super) is_video: bool,
}

/// One component of a vector feature.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Component {
    pub(super) feature: String,
    pub(super) index: usize,
    pub(super) name: String,
}

impl Description {
    /// Errors: `Io`, `Record`, `Option` if it is of another version or has too large features.
    pub(super) fn read(source: &Path) -> Result<Self, ImportError> {
        let path = source.join(INFO);
        let text = read_file(&path)?;
        let info: InfoFile =
            serde_json::from_slice(&text).map_err(|error| ImportError::record(path.display(), error))?;
        let version = &info.codebase_version;
        if !version.starts_with("v2.") && !version.starts_with("v3.") {
            let source = source.display();
            return Err(ImportError::Option(format!(
                "{source} is a LeRobot data set of version {version}; versions v2.0, v2.1 and v3.0 are read"
            )));
        }
        let mut vectors = info.features.iter().filter(|(_, feature)| feature.is_vector());
        if let Some((name, feature)) = vectors.find(|(_, feature)| feature.size() > MAX_COMPONENTS) {
            let (path, size) = (path.display(), feature.size());
            return Err(ImportError::Option(format!(
                "{path}: feature \"{name}\" has {size} components; at most {MAX_COMPONENTS} are read"
            )));
        }
        Ok(Self {
            source: source.to_owned(),
            info,
        })
    }

    pub(super) fn is_version_2(&self) -> bool {
        self.info.codebase_version.starts_with("v2.")
    }

    /// The image feature that `--image` names, else the only one. Errors: `Option`.
    pub(super) fn image(&self, options: &ImportOptions) -> Result<ImageFeature, ImportError> {
        let is_image = |feature: &Feature| ["image", "video"].contains(&feature.dtype.as_str());
        let images: Vec<(&String, &Feature)> = self.info.features.iter().filter(|(_, f)| is_image(f)).collect();
        let names = || listed(images.iter().map(|(name, _)| name));
        let mut cameras = images.iter().filter(|(name, feature)| match &options.image {
            Some(wanted) => is_named(name, wanted),
            None => !feature.is_depth(),
        });
        let reason = match (cameras.next(), cameras.next(), &options.image) {
            (Some((name, feature)), None, _) | (Some((name, feature)), _, Some(_)) => {
                return Ok(ImageFeature {
                    name: (*name).clone(),
                    is_video: feature.dtype == "video",
                });
            }
            (None, _, Some(wanted)) => {
                format!(
                    "the data set has no images {wanted:?} (--image); its images are: {}",
                    names()
                )
            }
            (None, _, None) => "the data set has no images".to_owned(),
            (Some(_), Some(_), None) => {
                let names = names();
                format!("the data set has images of several cameras; choose one with --image: {names}")
            }
        };
        Err(ImportError::Option(reason))
    }

    /// The components of the features (or single components) that were named, else those of the default feature, if there is
    /// one. Errors: `Option`.
    pub(super) fn components(
        &self,
        wanted: &[String],
        default: &str,
        option: &str,
    ) -> Result<Vec<Component>, ImportError> {
        if are_none(wanted) {
            return Ok(Vec::new());
        }
        let vectors = || self.info.features.iter().filter(|(_, feature)| feature.is_vector());
        let all = |(name, feature): (&String, &Feature)| feature.components(name);
        if wanted.is_empty() {
            return Ok(vectors().filter(|(name, _)| *name == default).flat_map(all).collect());
        }
        let mut components = Vec::new();
        for one in wanted {
            let feature = vectors().find(|(name, _)| is_named(name, one)).map(all);
            let single = || vectors().flat_map(all).find(|component| component.name == *one);
            let found = feature.or_else(|| Some(vec![single()?]));
            components.extend(found.ok_or_else(|| {
                let known = listed(vectors().map(|(name, feature)| {
                    let names = feature.components(name).into_iter().map(|component| component.name);
                    format!("{name} ({})", listed(names))
                }));
                ImportError::Option(format!(
                    "the data set has no numbers {one:?} ({option}); its features and their components are: {known}"
                ))
            })?);
        }
        Ok(components)
    }

    /// What is said about action and state if they should have been found by name, but are no numbers.
    pub(super) fn notes(&self, options: &ImportOptions) -> Vec<String> {
        let found = [(ACTION, &options.actions), (STATE, &options.states)].into_iter();
        let unread = found.filter_map(|(name, wanted)| {
            let feature = self.info.features.get(name).filter(|feature| !feature.is_vector())?;
            let (kind, shape) = (&feature.dtype, &feature.shape);
            let note = format!("the feature {name:?} is no list of numbers (its type is {kind}, its shape {shape:?}), so it was not imported");
            wanted.is_empty().then_some(note)
        });
        unread.collect()
    }
}

impl Feature {
    fn is_vector(&self) -> bool {
        NUMBERS.contains(&self.dtype.as_str()) && self.shape.len() <= 1
    }

    fn is_depth(&self) -> bool {
        ["is_depth_map", "video.is_depth_map"]
            .iter()
            .any(|key| self.info[key] == Value::Bool(true))
    }

    fn size(&self) -> usize {
        self.shape.first().copied().unwrap_or(1)
    }

    /// Its components, with the names that the data set gives them, or numbers.
    fn components(&self, feature: &str) -> Vec<Component> {
        let size = self.size();
        let names = texts(&self.names);
        let short = feature.rsplit('.').next().unwrap_or(feature);
        let name = |index: usize| match names.get(index) {
            Some(&name) if names.len() == size && name != feature => name.to_owned(),
            _ if size == 1 => short.to_owned(),
            _ => format!("{short}_{index}"),
        };
        (0..size)
            .map(|index| Component {
                feature: feature.to_owned(),
                index,
                name: name(index),
            })
            .collect()
    }
}

/// All texts in lists and objects, in order: `["x", "y"]` or `{"motors": ["x", "y"]}`.
fn texts(value: &Value) -> Vec<&str> {
    match value {
        Value::String(text) => vec![text],
        Value::Array(items) => items.iter().flat_map(texts).collect(),
        Value::Object(fields) => fields.values().flat_map(texts).collect(),
        _ => Vec::new(),
    }
}

/// Whether this is the feature's name or its last part, as `front` of `observation.images.front`.
fn is_named(feature: &str, name: &str) -> bool {
    feature == name || feature.strip_suffix(name).is_some_and(|before| before.ends_with('.'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn components_have_the_names_of_the_data_set_or_numbers() {
        let feature = |names: Value| Feature {
            dtype: "float32".to_owned(),
            shape: vec![2],
            names,
            info: Value::Null,
        };
        let names = |names| {
            feature(names)
                .components("action")
                .into_iter()
                .map(|c| c.name)
                .collect::<Vec<_>>()
        };
        assert_eq!(names(serde_json::json!({"motors": ["pan", "tilt"]})), ["pan", "tilt"]);
        assert_eq!(names(Value::Null), ["action_0", "action_1"]);
    }

    #[test]
    fn a_feature_is_named_by_its_last_part() {
        assert!(is_named("observation.images.front", "front") && is_named("action", "action"));
        assert!(!is_named("observation.images.front", "ront"));
    }
}
