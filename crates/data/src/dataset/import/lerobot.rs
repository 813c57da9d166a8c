//! `LeRobot` data sets, versions 2 and 3, as their own tools write them: Parquet tables with numbers and images, or videos.

mod description;
mod episodes;
mod images;
mod rows;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use self::description::{Component, Description, INFO};
use self::episodes::{EpisodeEntry, VideoPart};
use self::images::ImageTable;
use self::rows::{Row, read_rows};
use super::files::folder_name;
use super::recording::{ImageSource, Record, Recording};
use super::skipped::SkippedList;
use super::video::{ListedFrames, VideoFrames, frames_of};
use super::{ImportError, ImportOptions};
use foreframe_core::types::Channel;

/// Whether a directory holds a data set of `LeRobot`.
pub(super) fn is_lerobot(source: &Path) -> bool {
    source.join(INFO).is_file()
}

/// Reads the records of a data set. Errors: `Option`, `Io`, `Record`, `Program`, `Stopped`.
pub(super) fn open(source: &Path, options: &ImportOptions, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let description = Description::read(source)?;
    let image = description.image(options)?;
    let actions = description.components(&options.actions, "action", "--action")?;
    let states = description.components(&options.states, "observation.state", "--state")?;
    let columns: Vec<_> = actions.iter().chain(&states).cloned().collect();
    let episodes = description.episodes(&image)?;
    let mut reader = EpisodeReader {
        source,
        skip_bad: options.skip_bad,
        is_video: image.is_video,
        action_count: actions.len(),
        records: Vec::new(),
        skipped: SkippedList::default(),
        places: Vec::new(),
        videos: VideoTimes::default(),
        cancelled,
    };
    let mut tables: Vec<PathBuf> = Vec::new();
    for of_table in episodes.chunk_by(|a, b| a.table == b.table) {
        let Some(first) = of_table.first() else { continue };
        let path = source.join(&first.table);
        let rows = read_rows(&path, &first.table, &columns)?;
        reader.take(tables.len(), &rows, of_table)?;
        tables.push(path);
    }
    let channel = |component: &Component| Channel::new(&component.name, &options.unit(&component.name));
    let images: Box<dyn ImageSource> = if image.is_video {
        Box::new(VideoFrames::new(reader.videos.paths(), reader.places))
    } else {
        Box::new(ImageTable::new(source, &image.name, tables, reader.places))
    };
    Ok(Recording {
        name: folder_name(source, "lerobot"),
        action_channels: actions.iter().map(channel).collect(),
        state_channels: states.iter().map(channel).collect(),
        camera: None,
        records: reader.records,
        images,
        skipped: reader.skipped,
    })
}

/// The presentation times of the videos' frames, each video probed once.
#[derive(Default)]
struct VideoTimes {
    files: Vec<(PathBuf, Vec<f64>)>,
    by_path: BTreeMap<PathBuf, usize>,
}

impl VideoTimes {
    /// The video's number and, when it is probed, what is wrong with it.
    fn probe(&mut self, path: &Path, cancelled: &AtomicBool) -> Result<(usize, Option<ImportError>), ImportError> {
        if let Some(&number) = self.by_path.get(path) {
            return Ok((number, None));
        }
        if !path.is_file() {
            return Err(ImportError::record(path.display().to_string(), "the video is missing"));
        }
        let ListedFrames { times_s, damage } = frames_of(path, cancelled)?;
        if !times_s.is_sorted() {
            return Err(ImportError::record(
                path.display().to_string(),
                "its frames are not in the order of their times",
            ));
        }
        self.files.push((path.to_owned(), times_s));
        self.by_path.insert(path.to_owned(), self.files.len() - 1);
        Ok((self.files.len() - 1, damage))
    }

    /// The frame nearest to a time, if one is within half a frame.
    fn frame_at(&self, number: usize, time_s: f64) -> Option<usize> {
        let (_, times_s) = self.files.get(number)?;
        let last = times_s.len().checked_sub(1)?;
        let period_s = (times_s.last()? - times_s.first()?) / last.max(1) as f64;
        let after = times_s.partition_point(|&frame_s| frame_s < time_s);
        let distance = |frame: &usize| {
            times_s
                .get(*frame)
                .map_or(f64::INFINITY, |frame_s| (frame_s - time_s).abs())
        };
        let nearest = [after.saturating_sub(1), after]
            .into_iter()
            .min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
        // Times of the table are 32-bit floats.
        (distance(&nearest) <= 0.5 * period_s + 1e-3).then_some(nearest)
    }

    fn end_s(&self, number: usize) -> f64 {
        let last = self.files.get(number).and_then(|(_, times_s)| times_s.last());
        last.copied().unwrap_or_default()
    }

    fn paths(&self) -> Vec<(PathBuf, usize)> {
        self.files
            .iter()
            .map(|(path, times_s)| (path.clone(), times_s.len()))
            .collect()
    }
}

/// Collects the records of all tables.
struct EpisodeReader<'a> {
    source: &'a Path,
    skip_bad: bool,
    is_video: bool,
    action_count: usize,
    records: Vec<Record>,
    skipped: SkippedList,
    /// Where each image is: table or video, and row or frame.
    places: Vec<(usize, usize)>,
    videos: VideoTimes,
    cancelled: &'a AtomicBool,
}

impl EpisodeReader<'_> {
    /// Takes the episodes of a table.
    fn take(&mut self, table: usize, rows: &[Row], episodes: &[EpisodeEntry]) -> Result<(), ImportError> {
        let mut by_episode: BTreeMap<usize, Vec<(usize, &Row)>> = BTreeMap::new();
        for (index, row) in rows.iter().enumerate() {
            by_episode.entry(row.episode).or_default().push((index, row));
        }
        for episode in episodes {
            let own = by_episode.remove(&episode.index).unwrap_or_default();
            if own.len() != episode.length {
                let error = ImportError::record(
                    format!(
                        "{} episode {}",
                        self.source.join(&episode.table).display(),
                        episode.index
                    ),
                    format!(
                        "the table has {} rows of this episode; the metadata states {}",
                        own.len(),
                        episode.length
                    ),
                );
                self.leave_out(error)?;
            }
            if let Err(error) = self.take_episode(table, &own, episode) {
                self.leave_out(error)?;
            }
        }
        Ok(())
    }

    /// Takes the rows of an episode, up to the first one that is damaged or has no frame.
    fn take_episode(
        &mut self,
        table: usize,
        rows: &[(usize, &Row)],
        episode: &EpisodeEntry,
    ) -> Result<(), ImportError> {
        let video = match &episode.video {
            Some(part) if self.is_video => {
                let (number, damage) = self.videos.probe(&self.source.join(&part.path), self.cancelled)?;
                damage.map_or(Ok(()), |damage| self.leave_out(damage))?;
                Some((number, part))
            }
            _ => None,
        };
        for &(index, row) in rows {
            let place = format!("{} row {index}", self.source.join(&episode.table).display());
            if let Some(column) = &row.bad {
                return Err(ImportError::record(
                    place,
                    format!("{column} is not a finite number in every component"),
                ));
            }
            let image = match video {
                Some((number, part)) => (number, self.frame_of(number, part, row, &place)?),
                None => (table, index),
            };
            let (action, state) = row.values.split_at(self.action_count.min(row.values.len()));
            self.records.push(Record {
                timestamp_s: row.timestamp_s,
                session: episode.index.to_string(),
                action: action.to_vec(),
                state: state.to_vec(),
                image: self.places.len(),
                place,
            });
            self.places.push(image);
        }
        Ok(())
    }

    fn frame_of(&self, video: usize, part: &VideoPart, row: &Row, place: &str) -> Result<usize, ImportError> {
        let time_s = part.from_s + row.timestamp_s;
        self.videos.frame_at(video, time_s).ok_or_else(|| {
            ImportError::record(
                place,
                format!(
                    "{} has no frame at {time_s:.3} s, it ends at {:.3} s: the video is shorter than its table",
                    part.path.display(),
                    self.videos.end_s(video)
                ),
            )
        })
    }

    /// Lists what is damaged, if it may be left out.
    fn leave_out(&mut self, error: ImportError) -> Result<(), ImportError> {
        error.leave_out(self.skip_bad, &mut self.skipped)
    }
}
