//! `LeRobot` data sets, versions 2 and 3, as their own tools write them: Parquet tables with numbers and images, or videos.

mod description;
mod episodes;
mod images;
mod rows;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use indexmap::IndexMap;

use self::description::{ACTION, Component, Description, INFO, STATE};
use self::episodes::{EpisodeEntry, VideoPart};
use self::images::ImageTable;
use self::rows::{Row, read_rows};
use super::files::folder_name;
use super::recording::{Record, Recording};
use super::skipped::SkippedList;
use super::video::{ListedFrames, VideoFrames, frames_of};
use super::{ImportError, ImportOptions};

/// Whether a directory holds a data set of `LeRobot`.
pub(super) fn is_lerobot(source: &Path) -> bool {
    source.join(INFO).is_file()
}

/// Reads the records of a data set. Errors: `Option`, `Io`, `Record`, `Program`, `Stopped`.
pub(super) fn open(source: &Path, options: &ImportOptions, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let description = Description::read(source)?;
    let image = description.image(options)?;
    let actions = description.components(&options.actions, ACTION, "--action")?;
    let states = description.components(&options.states, STATE, "--state")?;
    let columns: Vec<_> = actions.iter().chain(&states).cloned().collect();
    let episodes = description.episodes(&image)?;
    let mut reader = EpisodeReader {
        source,
        skip_bad: options.skip_bad,
        action_count: actions.len(),
        records: Vec::new(),
        skipped: SkippedList::default(),
        places: Vec::new(),
        videos: IndexMap::new(),
        cancelled,
    };
    let mut tables: Vec<PathBuf> = Vec::new();
    for of_table in episodes.chunk_by(|a, b| a.table == b.table) {
        let table = &of_table[0].table;
        let path = source.join(table);
        let rows = read_rows(&path, table, &columns)?;
        reader.take(tables.len(), &rows, of_table)?;
        tables.push(path);
    }
    let name = folder_name(source, "lerobot");
    let EpisodeReader {
        records,
        places,
        videos,
        ..
    } = reader;
    let recording = if image.is_video {
        let videos = videos.into_iter().map(|(path, times_s)| (path, times_s.len()));
        Recording::new(name, records, VideoFrames::new(videos.collect(), places))
    } else {
        Recording::new(name, records, ImageTable::new(source, &image.name, tables, places))
    };
    let channel = |component: &Component| options.channel(&component.name, "");
    Ok(Recording {
        action_channels: actions.iter().map(channel).collect(),
        state_channels: states.iter().map(channel).collect(),
        skipped: reader.skipped,
        notes: description.notes(options),
        ..recording
    })
}

/// Collects the records of all tables.
struct EpisodeReader<'a> {
    source: &'a Path,
    skip_bad: bool,
    action_count: usize,
    records: Vec<Record>,
    skipped: SkippedList,
    /// Where each image is: table or video, and row or frame.
    places: Vec<(usize, usize)>,
    /// The presentation times of the videos' frames.
    videos: IndexMap<PathBuf, Vec<f64>>,
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
            let (found, stated) = (own.len(), episode.length);
            if found != stated {
                let place = format!(
                    "{} episode {}",
                    self.source.join(&episode.table).display(),
                    episode.index
                );
                let reason = format!("the table has {found} rows of this episode; the metadata states {stated}");
                self.leave_out(ImportError::record(place, reason))?;
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
            Some(part) => Some((self.probe(self.source.join(&part.path))?, part)),
            None => None,
        };
        for &(index, row) in rows {
            let place = format!("{} row {index}", self.source.join(&episode.table).display());
            if let Some(column) = &row.bad {
                let reason = format!("{column} is not a finite number in every component");
                return Err(ImportError::record(place, reason));
            }
            self.places.push(match video {
                Some((number, part)) => (number, frame_at(&self.videos[number], part, row, &place)?),
                None => (table, index),
            });
            let (action, state) = row.values.split_at(self.action_count);
            self.records.push(Record {
                timestamp_s: row.timestamp_s,
                session: episode.index.to_string(),
                action: action.to_vec(),
                state: state.to_vec(),
                place,
                ..Record::default()
            });
        }
        Ok(())
    }

    /// The number of a video, whose frames are listed when it is needed first.
    fn probe(&mut self, path: PathBuf) -> Result<usize, ImportError> {
        if let Some(number) = self.videos.get_index_of(&path) {
            return Ok(number);
        }
        let wrong = |reason: &str| Err(ImportError::record(path.display(), reason));
        if !path.is_file() {
            return wrong("the video is missing");
        }
        let ListedFrames { times_s, damage } = frames_of(&path, self.cancelled)?;
        if !times_s.is_sorted() {
            return wrong("its frames are not in the order of their times");
        }
        damage.map_or(Ok(()), |damage| self.leave_out(damage))?;
        Ok(self.videos.insert_full(path, times_s).0)
    }

    /// Lists what is damaged, if it may be left out.
    fn leave_out(&mut self, error: ImportError) -> Result<(), ImportError> {
        error.leave_out(self.skip_bad, &mut self.skipped)
    }
}

/// The frame nearest to a row's time. Errors: `Record` if none is within half a frame.
fn frame_at(times_s: &[f64], part: &VideoPart, row: &Row, place: &str) -> Result<usize, ImportError> {
    let time_s = part.from_s + row.timestamp_s;
    let (start_s, end_s) = (times_s[0], times_s[times_s.len() - 1]);
    let period_s = (end_s - start_s) / (times_s.len() - 1).max(1) as f64;
    let distance = |frame: usize| {
        times_s
            .get(frame)
            .map_or(f64::INFINITY, |frame_s| (frame_s - time_s).abs())
    };
    let after = times_s.partition_point(|&frame_s| frame_s < time_s);
    let before = after.saturating_sub(1);
    let nearest = if distance(before) <= distance(after) {
        before
    } else {
        after
    };
    // Times of the table are 32-bit floats.
    if distance(nearest) <= 0.5 * period_s + 1e-3 {
        return Ok(nearest);
    }
    let path = part.path.display();
    let reason =
        format!("{path} has no frame at {time_s:.3} s, it ends at {end_s:.3} s: the video is shorter than its table");
    Err(ImportError::record(place, reason))
}
