//! The list of episodes: in which file each one is.

use std::path::{Path, PathBuf};

use arrow_array::RecordBatch;
use serde::Deserialize;

use super::description::{Description, INFO, ImageFeature};
use super::rows::column_numbers;
use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::{inside, read_text};
use crate::dataset::store::shard_reader::batches;
use foreframe_core::files::files_below;

/// Episodes of version 2.
const EPISODE_LINES: &str = "meta/episodes.jsonl";
/// Tables of episodes of version 3.
const EPISODE_TABLES: &str = "meta/episodes";
/// Number of episodes in a directory of version 2, if the description has no `chunks_size`.
const CHUNK_EPISODES: usize = 1000;
/// The most digits of a number in a path.
const MAX_DIGITS: usize = 20;

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
            let line: Line = serde_json::from_str(line).map_err(|error| ImportError::record(&place, error))?;
            let index = line.episode_index;
            let chunk = index / self.info.chunks_size.unwrap_or(CHUNK_EPISODES).max(1);
            let fields = [("episode_chunk", chunk), ("episode_index", index)];
            let video = image.is_video.then(|| self.video(image, &fields, 0.0, &place));
            Ok(EpisodeEntry {
                index,
                length: line.length,
                table: self.path(&self.info.data_path, image, &fields, &place)?,
                video: video.transpose()?,
            })
        };
        let lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        lines.map(entry).collect()
    }

    fn episodes_of_tables(&self, image: &ImageFeature) -> Result<Vec<EpisodeEntry>, ImportError> {
        let dir = self.source.join(EPISODE_TABLES);
        let mut files = files_below(&dir).map_err(ImportError::io("list", &dir))?;
        files.retain(|path| path.is_file() && path.extension().is_some_and(|extension| extension == "parquet"));
        let mut episodes = Vec::new();
        for path in files {
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
            let wrong = || ImportError::record(path.display(), format!("it has no column {column:?} of numbers"));
            column_numbers(batch, column).ok_or_else(wrong)
        };
        let of_video = |what: &str| numbers(&format!("videos/{}/{what}", image.name));
        let (indexes, lengths) = (numbers("episode_index")?, numbers("length")?);
        let (chunks, files) = (numbers("data/chunk_index")?, numbers("data/file_index")?);
        let videos = if image.is_video {
            let (chunks, files) = (of_video("chunk_index")?, of_video("file_index")?);
            Some((chunks, files, of_video("from_timestamp")?))
        } else {
            None
        };
        let fields = |chunk: f64, file: f64| [("chunk_index", chunk as usize), ("file_index", file as usize)];
        for row in 0..batch.num_rows() {
            let place = format!("{} row {row}", path.display());
            let video = videos.as_ref().map(|(chunks, files, starts)| {
                self.video(image, &fields(chunks[row], files[row]), starts[row], &place)
            });
            episodes.push(EpisodeEntry {
                index: indexes[row] as usize,
                length: lengths[row] as usize,
                table: self.path(&self.info.data_path, image, &fields(chunks[row], files[row]), &place)?,
                video: video.transpose()?,
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
    ) -> Result<VideoPart, ImportError> {
        let template = self.info.video_path.as_deref().ok_or_else(|| {
            let reason = format!("\"{}\" is a video, but \"video_path\" is missing", image.name);
            ImportError::record(self.source.join(INFO).display(), reason)
        })?;
        let path = self.path(template, image, fields, place)?;
        Ok(VideoPart { path, from_s })
    }

    /// A path of the data set: the template with its fields filled in, below the data set's directory.
    fn path(
        &self,
        template: &str,
        image: &ImageFeature,
        fields: &[(&str, usize)],
        place: &str,
    ) -> Result<PathBuf, ImportError> {
        let name = filled(template, &image.name, fields);
        inside(&self.source, &name, place)?;
        Ok(PathBuf::from(name))
    }
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
}
