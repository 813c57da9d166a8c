//! The specification of an import. Recordings are read below one directory of the server only.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Component, Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{AvailableInputs, check_parts, default_parts, is_one};
use crate::jobs::JobError;
use crate::jobs::uploads::UploadedFile;
use foreframe_core::error_text;
use foreframe_core::frame::resize::Resize;
use foreframe_core::types::DatasetName;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, check_out, parse_size,
};
use foreframe_data::dataset::is_finished;

/// An import: turns a recording in the server's `import_dir`, or an uploaded file, into the data set `name`. The fields are the options of
/// `foreframe import`. A cancelled import continues where it stopped when it is resumed, or when the same import is submitted
/// again.
// Not `ImportOptions` flattened: serde would no longer list the known fields for one that it does not know, and the options of an
// import that has begun are stored under the names that they have there.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ImportSpec {
    /// The data set's name: a to z, 0 to 9 and `-`, at most 64 characters.
    #[schema(value_type = String, pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
    pub name: DatasetName,
    /// The recording: the path of a file or folder below the server's `import_dir`, or the `source` of an upload.
    #[schema(min_length = 1)]
    pub source: String,
    /// Width and height of the frames in pixels, as in `64x64`.
    #[serde(default = "default_size")]
    #[schema(default = "64x64", pattern = "^[0-9]{1,4}x[0-9]{1,4}$")]
    pub size: String,
    /// How images of another shape are resized.
    #[serde(default = "default_resize")]
    #[schema(default = "crop")]
    pub resize: Resize,
    /// Frames per second, 0.01 to 1000: of the data set or, where the source has no times, of the recording. By default, the
    /// recording's rate is kept.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.01, maximum = 1000)]
    pub rate: Option<f64>,
    /// Keeps every Nth frame, 1 to 1,000,000; actions in between are averaged.
    #[serde(default = "default_every")]
    #[schema(default = 1, minimum = 1, maximum = 1_000_000)]
    pub every: usize,
    /// The CSV file, below `import_dir`; by default the only one in the folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub csv: Option<String>,
    /// The column, input, camera, array or topic with the images; by default found by name or type.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image: Option<String>,
    /// The column or array with the times, found by name by default. For a bag, `header` or `log`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time: Option<String>,
    /// Components of the action, or topics of a bag; by default found by name or type.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub action: Vec<String>,
    /// Components of the state, or topics of a bag; by default found by name or type.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub state: Vec<String>,
    /// Units of actions and states, as in `speed=m/s`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unit: Vec<String>,
    /// For how long, in seconds, the last action and state of a bag hold, 0 to 3600.
    #[serde(default = "default_hold")]
    #[schema(default = 1.0, minimum = 0, maximum = 3600)]
    pub hold: f64,
    /// The angle between the left and the right edge of the recorded images, 5 to 170 degrees; by default, known from some bags.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 5, maximum = 170)]
    pub fov: Option<f64>,
    /// How far the camera looks down from the horizontal, -85 to 85 degrees; by default 0, if the field of view is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = -85, maximum = 85)]
    pub tilt: Option<f64>,
    /// Height of the camera above the floor, 0.01 to 10 metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(minimum = 0.01, maximum = 10)]
    pub camera_height: Option<f64>,
    /// Leaves out what is damaged and lists it in the job's log, instead of stopping there.
    #[serde(default)]
    pub skip_bad: bool,
    /// Imports the records of a Donkeycar tub that are marked as deleted, too.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub include_deleted: bool,
    /// In how many parts workers may import it, 1 to 64: each takes its share of the frames, in shards of about 2000. The data set
    /// has the same bytes however many there are. Parts without a shard have nothing to do.
    #[serde(default = "default_parts", skip_serializing_if = "is_one")]
    #[schema(minimum = 1, maximum = 64, default = 1)]
    pub parts: usize,
    /// Which of the parts this job imports, from 0. Only jobs that are parts have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(read_only)]
    pub part: Option<usize>,
}

fn default_size() -> String {
    let options = ImportOptions::default();
    format!("{}x{}", options.frame_width_px, options.frame_height_px)
}

fn default_resize() -> Resize {
    ImportOptions::default().resize
}

fn default_every() -> usize {
    ImportOptions::default().every
}

fn default_hold() -> f64 {
    ImportOptions::default().hold_s
}

impl ImportSpec {
    pub(super) fn check(&self, available: AvailableInputs<'_>) -> Result<(), JobError> {
        check_parts(self.parts, self.part)?;
        let config = self.config(available.data_dir, available.import_dir)?;
        if available.datasets.contains(&self.name) {
            return Err(JobError::taken(&self.name, "exists; choose another name"));
        }
        // With a shared object store, a data set that is complete only here was deleted elsewhere or not yet pushed.
        if is_finished(&config.out) {
            return Ok(());
        }
        check_out(&config).map_err(|error| match error {
            ImportError::OutExists { what, .. } => JobError::taken(
                &self.name,
                format!("cannot be written because its directory holds {what}, or choose another name"),
            ),
            other => JobError::invalid("source", error_text::with_causes(&other)),
        })
    }

    /// Its parts; none if it is imported as a whole. How many shards there are is known when the recording is read.
    pub(super) fn parts(&self) -> Vec<Self> {
        if self.parts < 2 || self.part.is_some() {
            return Vec::new();
        }
        let part = |part| Self {
            part: Some(part),
            ..self.clone()
        };
        (0..self.parts).map(part).collect()
    }

    /// The uploaded file that is the source, if it is one. Errors: `Invalid`.
    pub(in crate::jobs) fn upload(&self) -> Result<Option<UploadedFile>, JobError> {
        let upload = UploadedFile::of_source(&self.source).transpose();
        upload.map_err(|error| JobError::invalid("source", error.to_string()))
    }

    /// What to import, and where to. Errors: `Invalid` if imports are off, if a path leads out of `import_dir` or to nothing, if
    /// there is no such upload, or if an option is out of range.
    pub(in crate::jobs) fn config(&self, data_dir: &Path, import_dir: Option<&Path>) -> Result<ImportConfig, JobError> {
        let (source, csv) = match self.upload()? {
            Some(_) if self.csv.is_some() => {
                let why = "an uploaded recording brings its own CSV file; leave this out".to_owned();
                return Err(JobError::invalid("csv", why));
            }
            Some(upload) => (upload.existing(data_dir)?, None),
            None => self.paths(import_dir)?,
        };
        Ok(ImportConfig {
            source,
            out: data_dir.join("datasets").join(&self.name),
            options: self.options(csv)?,
            disk_mib: DEFAULT_DISK_MIB,
            max_files: DEFAULT_MAX_FILES,
        })
    }

    /// The recording and the CSV file. Errors: `Invalid`.
    fn paths(&self, import_dir: Option<&Path>) -> Result<(PathBuf, Option<PathBuf>), JobError> {
        let Some(import_dir) = import_dir else {
            let why = "imports are off on this server; set its setting import_dir to the directory with the recordings, or upload a \
                       file with POST /v1/uploads";
            return Err(JobError::invalid("source", why));
        };
        let root = import_dir.canonicalize().map_err(|error| {
            let why = format!("the server's import_dir cannot be read ({error}); create it, or correct the setting");
            JobError::invalid("source", why)
        })?;
        let source = existing(&root, &self.source, "source")?;
        check_links(&root, &source)?;
        let csv = self.csv.as_deref().map(|csv| existing(&root, csv, "csv")).transpose()?;
        Ok((source, csv))
    }

    /// The options. Errors: `Invalid`, which names the field.
    fn options(&self, csv: Option<PathBuf>) -> Result<ImportOptions, JobError> {
        let wrong =
            |option, value: &str, right: &str| JobError::invalid(option, format!("{value} is not valid; {right}"));
        let size = parse_size(&self.size)
            .map_err(|right| wrong("size", &format!("\"{}\"", self.size.escape_default()), right))?;
        let options = ImportOptions {
            frame_width_px: size.width,
            frame_height_px: size.height,
            resize: self.resize,
            rate_hz: self.rate,
            every: self.every,
            csv,
            image: self.image.clone(),
            time: self.time.clone(),
            actions: self.action.clone(),
            states: self.state.clone(),
            units: self.unit.clone(),
            hold_s: self.hold,
            fov_deg: self.fov,
            tilt_deg: self.tilt,
            camera_height_m: self.camera_height,
            skip_bad: self.skip_bad,
            include_deleted: self.include_deleted,
        };
        match options.validate() {
            Ok(()) => Ok(options),
            Err(ImportError::OptionValue { option, value, right }) => {
                let field = if option == "camera-height" {
                    "camera_height"
                } else {
                    option
                };
                Err(wrong(field, &value, &right))
            }
            Err(other) => Err(JobError::invalid("source", other.to_string())),
        }
    }
}

fn wrong_path(field: &'static str, path: &str, what: &str) -> JobError {
    let path = path.escape_default();
    let right = "give the path of a recording below the server's import_dir, as in mycar/data";
    JobError::invalid(field, format!("\"{path}\" {what}; {right}"))
}

/// The real path of a file or folder below `root`, which is a real path itself. Errors: `Invalid`.
fn existing(root: &Path, path: &str, field: &'static str) -> Result<PathBuf, JobError> {
    let mut parts = Path::new(path).components();
    let is_plain = parts.all(|part| matches!(part, Component::Normal(_)));
    if path.is_empty() || !is_plain || path.contains(['\0', '\\']) {
        return Err(wrong_path(field, path, "is not a relative path without .."));
    }
    match root.join(path).canonicalize() {
        Ok(real) if real.starts_with(root) => Ok(real),
        Ok(_) => Err(wrong_path(field, path, "is a link that leads out of import_dir")),
        Err(_) => Err(wrong_path(field, path, "does not exist")),
    }
}

/// Errors: `Invalid` if a link in the recording leads out of `root`, or to nothing.
fn check_links(root: &Path, source: &Path) -> Result<(), JobError> {
    let (mut folders, mut seen) = (vec![source.to_owned()], BTreeSet::new());
    while let Some(folder) = folders.pop() {
        if !folder.is_dir() || !seen.insert(folder.clone()) {
            continue;
        }
        let unreadable =
            |error: io::Error| JobError::invalid("source", format!("{} cannot be read: {error}", shown(root, &folder)));
        for entry in fs::read_dir(&folder).map_err(unreadable)? {
            let entry = entry.map_err(unreadable)?;
            let kind = entry.file_type().map_err(unreadable)?;
            if kind.is_dir() {
                folders.push(entry.path());
            }
            // A link to nothing is as good as a missing file, which the import reports.
            let Some(real) = kind.is_symlink().then(|| entry.path().canonicalize().ok()).flatten() else {
                continue;
            };
            if !real.starts_with(root) {
                let what = "is a link that leads out of import_dir";
                return Err(wrong_path("source", &shown(root, &entry.path()), what));
            }
            folders.push(real);
        }
    }
    Ok(())
}

/// A path below the directory as a caller knows it.
fn shown(root: &Path, path: &Path) -> String {
    path.strip_prefix(root).unwrap_or(path).display().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_paths_below_the_directory_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().canonicalize().unwrap().join("recordings");
        fs::create_dir_all(root.join("a/b")).unwrap();
        fs::write(dir.path().join("secret"), "").unwrap();
        assert_eq!(existing(&root, "a/b", "source").unwrap(), root.join("a/b"));
        for path in [
            "",
            "..",
            "../secret",
            "a/../../secret",
            "/etc/passwd",
            "none",
            "a\0",
            "./a",
        ] {
            assert!(existing(&root, path, "source").is_err(), "{path:?}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_that_lead_out_are_refused() {
        use std::os::unix::fs::symlink;
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().canonicalize().unwrap().join("recordings");
        for folder in ["a/b", "c"] {
            fs::create_dir_all(root.join(folder)).unwrap();
        }
        fs::write(dir.path().join("secret"), "").unwrap();
        symlink(dir.path(), root.join("out")).unwrap();
        let error = existing(&root, "out", "source").unwrap_err().to_string();
        assert!(error.contains("leads out of import_dir"), "{error}");
        assert!(existing(&root, "out/secret", "source").is_err());
        // Links inside are followed, circles included; what lies behind them is checked, too.
        symlink(root.join("c"), root.join("a/b/c")).unwrap();
        symlink(root.join("a"), root.join("c/a")).unwrap();
        symlink(root.join("none"), root.join("c/none")).unwrap();
        check_links(&root, &root.join("a")).unwrap();
        symlink(dir.path().join("secret"), root.join("c/1.png")).unwrap();
        let error = check_links(&root, &root.join("a")).unwrap_err().to_string();
        assert!(error.starts_with("source: \"c/1.png\" is a link"), "{error}");
    }
}
