//! `meta/info.json` and the list of episodes: which features there are, and in which file each episode is.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use arrow_array::RecordBatch;
use serde::Deserialize;
use serde_json::Value;

use super::super::images::inside;
use super::super::{ImportError, ImportOptions, listed, read_file, read_text};
use super::INFO;
use super::rows::column_numbers;
use crate::dataset::shard_reader::batches;

/// Episodes of version 2.
const EPISODE_LINES: &str = "meta/episodes.jsonl";
/// Tables of episodes of version 3.
const EPISODE_TABLES: &str = "meta/episodes";
/// Version 2 without this field puts so many episodes into a directory.
const CHUNK_EPISODES: usize = 1000;
/// The greatest size of a vector feature.
const MAX_COMPONENTS: usize = 10_000;
/// The most digits of a number in a path.
const MAX_DIGITS: usize = 20;
/// Types whose values are read as numbers.
const NUMBERS: [&str; 11] = [
    "float32", "float64", "float16", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "bool",
];

#[derive(Deserialize)]
struct InfoFile {
    codebase_version: String,
    data_path: String,
    #[serde(default)]
    video_path: Option<String>,
    #[serde(default)]
    chunks_size: Option<usize>,
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
    source: PathBuf,
    info: InfoFile,
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

/// One episode: its rows, and where they and its frames are.
pub(super) struct EpisodeEntry {
    pub(super) index: usize,
    pub(super) length: usize,
    /// Below the data set's directory.
    pub(super) table: PathBuf,
    pub(super) video: Option<VideoPart>,
}

/// The part of a video that belongs to an episode.
pub(super) struct VideoPart {
    /// Below the data set's directory.
    pub(super) path: PathBuf,
    /// Where the episode begins in the video, in seconds.
    pub(super) from_s: f64,
}

impl Description {
    /// Errors: `Io`, `Record`, `Option` if it is of another version or has too large features.
    pub(super) fn read(source: &Path) -> Result<Self, ImportError> {
        let path = source.join(INFO);
        let text = read_file(&path)?;
        let info: InfoFile = serde_json::from_slice(&text)
            .map_err(|error| ImportError::record(path.display().to_string(), error.to_string()))?;
        if !["v2.", "v3."]
            .iter()
            .any(|known| info.codebase_version.starts_with(known))
        {
            return Err(ImportError::Option(format!(
                "{} is a LeRobot data set of version {}; versions v2.0, v2.1 and v3.0 are read",
                source.display(),
                info.codebase_version
            )));
        }
        let mut vectors = info.features.iter().filter(|(_, feature)| feature.is_vector());
        if let Some((name, feature)) = vectors.find(|(_, feature)| feature.size() > MAX_COMPONENTS) {
            return Err(ImportError::Option(format!(
                "{}: feature \"{name}\" has {} components; at most {MAX_COMPONENTS} are read",
                path.display(),
                feature.size()
            )));
        }
        Ok(Self {
            source: source.to_owned(),
            info,
        })
    }

    fn is_version_2(&self) -> bool {
        self.info.codebase_version.starts_with("v2.")
    }

    /// The image feature that `--image` names, else the only one. Errors: `Option`.
    pub(super) fn image(&self, options: &ImportOptions) -> Result<ImageFeature, ImportError> {
        let is_image = |feature: &Feature| ["image", "video"].contains(&feature.dtype.as_str());
        let images: Vec<(&String, &Feature)> = self.info.features.iter().filter(|(_, f)| is_image(f)).collect();
        let names = || listed(images.iter().map(|(name, _)| name));
        let found = if let Some(wanted) = &options.image {
            images.iter().find(|(name, _)| is_named(name, wanted)).ok_or_else(|| {
                ImportError::Option(format!(
                    "the data set has no images {wanted:?} (--image); its images are: {}",
                    names()
                ))
            })?
        } else {
            let mut cameras = images.iter().filter(|(_, feature)| !feature.is_depth());
            match (cameras.next(), cameras.next()) {
                (None, _) => return Err(ImportError::Option("the data set has no images".to_owned())),
                (Some(one), None) => one,
                (Some(_), Some(_)) => {
                    return Err(ImportError::Option(format!(
                        "the data set has images of several cameras; choose one with --image: {}",
                        names()
                    )));
                }
            }
        };
        Ok(ImageFeature {
            name: found.0.clone(),
            is_video: found.1.dtype == "video",
        })
    }

    /// The components of the features (or single components) that were named, else those of the default feature, if there is
    /// one. Errors: `Option`.
    pub(super) fn components(
        &self,
        wanted: &[String],
        default: &str,
        option: &str,
    ) -> Result<Vec<Component>, ImportError> {
        let numbers = || self.info.features.iter().filter(|(_, feature)| feature.is_vector());
        let all = |name: &String, feature: &Feature| feature.components(name);
        if wanted.is_empty() {
            let found = numbers().find(|(name, _)| *name == default);
            return Ok(found.map_or_else(Vec::new, |(name, feature)| all(name, feature)));
        }
        let mut components = Vec::new();
        for one in wanted {
            let feature = numbers().find(|(name, _)| is_named(name, one));
            let single = || {
                numbers()
                    .flat_map(|(name, feature)| all(name, feature))
                    .find(|c| c.name == *one)
            };
            match (feature, single()) {
                (Some((name, feature)), _) => components.extend(all(name, feature)),
                (None, Some(component)) => components.push(component),
                (None, None) => {
                    let known = numbers().map(|(name, feature)| {
                        let components = all(name, feature).into_iter().map(|component| component.name);
                        format!("{name} ({})", listed(components))
                    });
                    return Err(ImportError::Option(format!(
                        "the data set has no numbers {one:?} ({option}); its features and their components are: {}",
                        listed(known)
                    )));
                }
            }
        }
        Ok(components)
    }

    /// Every episode, in order. Errors: `Io`, `Record`.
    pub(super) fn episodes(&self, image: &ImageFeature) -> Result<Vec<EpisodeEntry>, ImportError> {
        if self.is_version_2() {
            self.episodes_of_lines(image)
        } else {
            self.episodes_of_tables(image)
        }
    }

    fn episodes_of_lines(&self, image: &ImageFeature) -> Result<Vec<EpisodeEntry>, ImportError> {
        #[derive(Deserialize)]
        struct Line {
            episode_index: usize,
            length: usize,
        }
        let path = self.source.join(EPISODE_LINES);
        let text = read_text(&path)?;
        let entry = |(number, line): (usize, &str)| {
            let place = format!("{} line {}", path.display(), number + 1);
            let line: Line =
                serde_json::from_str(line).map_err(|error| ImportError::record(&place, error.to_string()))?;
            let index = line.episode_index;
            let chunk = index / self.info.chunks_size.unwrap_or(CHUNK_EPISODES).max(1);
            let fields = [("episode_chunk", chunk), ("episode_index", index)];
            Ok(EpisodeEntry {
                index,
                length: line.length,
                table: self.path(&self.info.data_path, &image.name, &fields, &place)?,
                video: self.video(image, &fields, 0.0, &place)?,
            })
        };
        let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        lines.map(entry).collect()
    }

    fn episodes_of_tables(&self, image: &ImageFeature) -> Result<Vec<EpisodeEntry>, ImportError> {
        let mut episodes = Vec::new();
        for path in parquet_files(&self.source.join(EPISODE_TABLES))? {
            for batch in batches(&path)? {
                self.entries(&batch, &path, image, &mut episodes)?;
            }
        }
        Ok(episodes)
    }

    fn entries(
        &self,
        batch: &RecordBatch,
        path: &Path,
        image: &ImageFeature,
        episodes: &mut Vec<EpisodeEntry>,
    ) -> Result<(), ImportError> {
        let numbers = |column: &str| {
            column_numbers(batch, column).ok_or_else(|| {
                ImportError::record(
                    path.display().to_string(),
                    format!("it has no column {column:?} of numbers"),
                )
            })
        };
        let of_video = |what: &str| numbers(&format!("videos/{}/{what}", image.name));
        let (indexes, lengths) = (numbers("episode_index")?, numbers("length")?);
        let (chunks, files) = (numbers("data/chunk_index")?, numbers("data/file_index")?);
        let videos = if image.is_video {
            Some((
                of_video("chunk_index")?,
                of_video("file_index")?,
                of_video("from_timestamp")?,
            ))
        } else {
            None
        };
        for row in 0..batch.num_rows() {
            let place = format!("{} row {row}", path.display());
            let fields = |chunk: f64, file: f64| [("chunk_index", chunk as usize), ("file_index", file as usize)];
            let video = match &videos {
                Some((chunks, files, starts)) => {
                    self.video(image, &fields(chunks[row], files[row]), starts[row], &place)?
                }
                None => None,
            };
            episodes.push(EpisodeEntry {
                index: indexes[row] as usize,
                length: lengths[row] as usize,
                table: self.path(
                    &self.info.data_path,
                    &image.name,
                    &fields(chunks[row], files[row]),
                    &place,
                )?,
                video,
            });
        }
        Ok(())
    }

    fn video(
        &self,
        image: &ImageFeature,
        fields: &[(&str, usize)],
        from_s: f64,
        place: &str,
    ) -> Result<Option<VideoPart>, ImportError> {
        if !image.is_video {
            return Ok(None);
        }
        let template = self.info.video_path.as_deref().ok_or_else(|| {
            ImportError::record(
                self.source.join(INFO).display().to_string(),
                format!("\"{}\" is a video, but \"video_path\" is missing", image.name),
            )
        })?;
        let path = self.path(template, &image.name, fields, place)?;
        Ok(Some(VideoPart { path, from_s }))
    }

    /// A path of the data set: the template with its fields filled in, below the data set's directory.
    fn path(&self, template: &str, image: &str, fields: &[(&str, usize)], place: &str) -> Result<PathBuf, ImportError> {
        let name = filled(template, image, fields);
        inside(&self.source, &name, place)?;
        Ok(PathBuf::from(name))
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
        let mut names = Vec::new();
        texts(&self.names, &mut names);
        let short = feature.rsplit('.').next().unwrap_or(feature);
        let name = |index: usize| match names.get(index) {
            Some(name) if names.len() == size && *name != feature => name.clone(),
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
fn texts(value: &Value, found: &mut Vec<String>) {
    match value {
        Value::String(text) => found.push(text.clone()),
        Value::Array(items) => items.iter().for_each(|item| texts(item, found)),
        Value::Object(fields) => fields.values().for_each(|item| texts(item, found)),
        _ => {}
    }
}

/// Whether this is the feature's name or its last part, as `front` of `observation.images.front`.
fn is_named(feature: &str, name: &str) -> bool {
    feature == name || feature.strip_suffix(name).is_some_and(|before| before.ends_with('.'))
}

/// The template with `{name}` and `{name:03d}` filled in.
fn filled(template: &str, image: &str, fields: &[(&str, usize)]) -> String {
    let mut text = template.replace("{video_key}", image).replace("{image_key}", image);
    for (name, value) in fields {
        while let Some(start) = text.find(&format!("{{{name}")) {
            let Some(length) = text[start..].find('}') else { break };
            let field = &text[start..=start + length];
            let width = field.trim_end_matches(['}', 'd']).rsplit(':').next();
            let width = width.and_then(|width| width.parse().ok()).unwrap_or(0).min(MAX_DIGITS);
            text = text.replace(field, &format!("{value:0width$}"));
        }
    }
    text
}

/// All Parquet files below a directory, in order of their paths.
fn parquet_files(dir: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let mut found = Vec::new();
    let mut open = vec![dir.to_owned()];
    while let Some(dir) = open.pop() {
        let entries = std::fs::read_dir(&dir).map_err(ImportError::io("list", &dir))?;
        for entry in entries {
            let path = entry.map_err(ImportError::io("list", &dir))?.path();
            if path.is_dir() {
                open.push(path);
            } else if path.is_file() && path.extension().is_some_and(|extension| extension == "parquet") {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn templates_of_both_versions_are_filled() {
        let fields = [("chunk_index", 0), ("file_index", 12)];
        let path = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4";
        assert_eq!(filled(path, "cam", &fields), "videos/cam/chunk-000/file-012.mp4");
        let fields = [("episode_chunk", 1), ("episode_index", 1234)];
        let path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet";
        assert_eq!(filled(path, "", &fields), "data/chunk-001/episode_001234.parquet");
        assert_eq!(filled("{episode_index:099999d}", "", &fields).len(), MAX_DIGITS);
    }

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
