//! The images of a directory, in natural order.

use std::ops::Range;
use std::path::{Path, PathBuf};

use tracing::info;

use crate::cli::error::CliError;
use foreframe_core::error_text;
use foreframe_core::files::natural_order;
use foreframe_core::frame::resize::{Resize, resize};
use foreframe_core::frame::{Frame, codec};
use foreframe_core::nn::ModelSpec;
use foreframe_core::types::ModelName;

/// The endings of the files that are read.
const ENDINGS: [&str; 3] = ["png", "jpg", "jpeg"];

/// Which images a model sees.
#[derive(clap::Args)]
pub(in crate::cli) struct SeenFrames {
    /// A directory of PNG or JPEG images; color images are converted to gray
    #[arg(long, value_name = "DIR")]
    frames: PathBuf,
    /// The number of the last frame that the model sees, counted from 0 [default: the last frame]
    #[arg(long, value_name = "N")]
    at: Option<usize>,
    /// What to do with images of another size than the model's: crop, letterbox or stretch [default: refuse them]
    #[arg(long, value_name = "RESIZE")]
    resize: Option<Resize>,
}

/// The image files of a directory.
pub(in crate::cli) struct ImagePaths {
    dir: PathBuf,
    paths: Vec<PathBuf>,
    /// The number of the last frame that the model sees.
    at: Option<usize>,
    resize: Option<Resize>,
    /// Whether it was said that color images are converted.
    has_reported_color: bool,
}

impl ImagePaths {
    /// Lists the images of a directory.
    pub(in crate::cli) fn list(seen: &SeenFrames) -> Result<Self, CliError> {
        let dir = seen.frames.as_path();
        let unreadable = |error| CliError::io("read", dir, &error);
        let mut paths = std::fs::read_dir(dir)
            .map_err(unreadable)?
            .map(|entry| entry.map(|entry| entry.path()))
            .collect::<Result<Vec<_>, _>>()
            .map_err(unreadable)?;
        paths.retain(|path| {
            let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
            ENDINGS.iter().any(|known| ending == *known)
        });
        paths.sort_by(|a, b| natural_order(&file_name(a), &file_name(b)));
        Ok(Self {
            dir: dir.to_owned(),
            paths,
            at: seen.at,
            resize: seen.resize,
            has_reported_color: false,
        })
    }

    pub(in crate::cli) fn count(&self) -> usize {
        self.paths.len()
    }

    /// The number of the last frame that the model sees. Errors: `Usage` if there are not enough before it.
    pub(in crate::cli) fn last_of_context(&self, model: &ModelName, spec: &ModelSpec) -> Result<usize, CliError> {
        let (count, dir) = (self.count(), self.dir.display());
        if count < spec.context {
            return Err(CliError::Usage(format!(
                "{dir} holds {count} PNG or JPEG frames; model {model:?} takes {}",
                spec.context
            )));
        }
        let last = self.at.unwrap_or(count - 1);
        if (spec.context - 1..count).contains(&last) {
            return Ok(last);
        }
        Err(CliError::Usage(format!(
            "--at is {last}; it must be {} to {}: model {model:?} takes {} frames, and {dir} holds {count}",
            spec.context - 1,
            count - 1,
            spec.context
        )))
    }

    /// Reads some of the images as frames of the model's size. Errors: `Usage` for an image of another size that is not to
    /// be resized.
    pub(in crate::cli) fn read(
        &mut self,
        range: Range<usize>,
        model: &ModelName,
        spec: &ModelSpec,
    ) -> Result<Vec<Frame>, CliError> {
        let paths: Vec<PathBuf> = self.paths.get(range).unwrap_or_default().to_vec();
        paths.iter().map(|path| self.read_one(path, model, spec)).collect()
    }

    /// Reads one image.
    pub(in crate::cli) fn read_one(
        &mut self,
        path: &Path,
        model: &ModelName,
        spec: &ModelSpec,
    ) -> Result<Frame, CliError> {
        let bytes = std::fs::read(path).map_err(|error| CliError::io("read", path, &error))?;
        let unreadable = |error| CliError::Failed(format!("{}: {}", path.display(), error_text::with_causes(&error)));
        let frame = codec::decode(&bytes).map_err(unreadable)?;
        if !self.has_reported_color && codec::is_color(&bytes).map_err(unreadable)? {
            info!(image = %path.display(), "color images are converted to gray");
            self.has_reported_color = true;
        }
        let (width, height) = (spec.frame_width_px, spec.frame_height_px);
        match self.resize {
            Some(way) => resize(&frame, width, height, way).map_err(unreadable),
            None if (frame.width(), frame.height()) != (width, height) => Err(CliError::Usage(format!(
                "{} is {}×{} px; model {model:?} takes {width}×{height}; add --resize crop, --resize letterbox or --resize stretch",
                path.display(),
                frame.width(),
                frame.height()
            ))),
            None => Ok(frame),
        }
    }
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}
