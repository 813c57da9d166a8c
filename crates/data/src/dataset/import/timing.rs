//! From records to episodes at one frame rate.
//!
//! The rule: records of one session follow each other until time jumps by more than 3.5 median periods or one was left
//! out; that ends an episode. Without a rate, every Nth record becomes a frame. With a rate, frame k of an episode is the record
//! nearest to its start + k / rate, if one lies within half a period; if none does, the episode ends. At a rate near to the
//! recorded one every record becomes a frame, and the episode ends where one is missing. The action of a frame is the mean
//! of the records' actions from this frame up to the next one. Its state is that of its record. Very long episodes are cut.

use std::cmp::Ordering;
use std::ops::{Range, RangeInclusive};
use std::path::Path;

use super::recording::{Record, Recording, is_next};
use super::{ImportError, ImportOptions, SkippedItem};
use crate::dataset::sampler::GAP_PERIODS;

/// A jump of time by more than this many periods ends an episode whose rate was given.
const MISSING_FRAME_PERIODS: f64 = 1.5;
/// Seconds since 1970 stay below it for 3,000 years; milliseconds do not.
const MAX_TIME_S: f64 = 1e11;
/// The median time from one record to the next: the reach of `--rate`.
const PERIODS_S: RangeInclusive<f64> = 0.001..=100.0;
/// Longer episodes are cut, if their frames are more than `MIN_LONGEST_FRAMES`.
const MAX_EPISODE_BYTES: usize = 256 << 20;
const MIN_LONGEST_FRAMES: usize = 1000;
/// Rates this near to a whole number of frames per second are taken for it.
const RATE_TOLERANCE: f64 = 0.03;

/// What is to be written: episodes as positions of records.
pub(super) struct ImportPlan {
    pub(super) recording: Recording,
    pub(super) frame_period_s: f64,
    pub(super) episodes: Vec<Vec<PlannedFrame>>,
}

/// A frame of an episode.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct PlannedFrame {
    /// Position of its record.
    pub(super) record: usize,
    /// The mean action until the next frame.
    pub(super) action: Vec<f32>,
}

/// Cuts a recording into episodes. Errors: `Record` if time does not grow, `Option` if its steps are out of range, `Empty`.
pub(super) fn plan(mut recording: Recording, options: &ImportOptions) -> Result<ImportPlan, ImportError> {
    drop_backward_times(&mut recording, options)?;
    let records = &recording.records;
    let empty = |path: &Path| nothing_left(path, &recording);
    let name = Path::new(&recording.name);
    let period_s = median_period(records).ok_or_else(|| empty(options.csv.as_deref().unwrap_or(name)))?;
    check_unit(&recording, period_s)?;
    let (frame_period_s, resampled, gap_periods) = match options.rate_hz {
        Some(rate) if rate * period_s > 1.0 + RATE_TOLERANCE => {
            return Err(ImportError::Option(format!(
                "--rate is {rate}, but {:?} has only {} frames per second (median); give this rate or a lower one",
                recording.name,
                (1e3 / period_s).round() / 1e3
            )));
        }
        Some(rate) if rate * period_s < 1.0 - RATE_TOLERANCE => (1.0 / rate, true, GAP_PERIODS),
        Some(rate) => (1.0 / rate, false, MISSING_FRAME_PERIODS),
        None => (whole_rate(period_s), false, GAP_PERIODS),
    };
    let longest = longest_episode(options);
    let mut episodes = Vec::new();
    for segment in segments(records, gap_periods * period_s) {
        let picked = if resampled {
            nearest(records, segment, frame_period_s)
        } else {
            vec![segment.collect()]
        };
        for chosen in picked {
            let kept: Vec<usize> = chosen.into_iter().step_by(options.every).collect();
            if kept.len() > 1 {
                let frames = with_actions(records, &kept);
                let parts = frames.len().div_ceil(longest);
                for part in frames.chunks(frames.len().div_ceil(parts)) {
                    check_stored_times(records, part)?;
                    episodes.push(part.to_vec());
                }
            }
        }
    }
    if episodes.is_empty() {
        return Err(empty(name));
    }
    Ok(ImportPlan {
        recording,
        frame_period_s: frame_period_s * options.every as f64,
        episodes,
    })
}

/// Why no two frames follow each other.
fn nothing_left(path: &Path, recording: &Recording) -> ImportError {
    let path = path.to_owned();
    match recording.skipped.first() {
        Some(SkippedItem { place, reason, .. }) => ImportError::Scattered {
            path,
            left_out: recording.skipped.count(),
            first: format!("{place}: {reason}"),
        },
        _ => ImportError::Empty(path),
    }
}

/// Errors: `Option` if the times cannot be in seconds.
fn check_unit(recording: &Recording, period_s: f64) -> Result<(), ImportError> {
    let name = &recording.name;
    let wrong = if PERIODS_S.contains(&period_s) {
        let mut times = recording.records.iter().map(|record| record.timestamp_s);
        match times.find(|time_s| time_s.abs() > MAX_TIME_S) {
            Some(time_s) => format!("a time of {name:?} is {time_s} s; at most {MAX_TIME_S} s are possible"),
            None => return Ok(()),
        }
    } else {
        let (least, most) = (PERIODS_S.start(), PERIODS_S.end());
        format!("the times of {name:?} are {period_s} s apart (median); {least} to {most} s are possible")
    };
    Err(ImportError::Option(format!(
        "{wrong}. Times are in seconds unless their name ends with _ms, _us or _ns"
    )))
}

/// Data sets store the times since the episode's start with 24 bits. Errors: `Option` if two of them would be the same.
fn check_stored_times(records: &[Record], frames: &[PlannedFrame]) -> Result<(), ImportError> {
    let time_s = |frame: &PlannedFrame| records[frame.record].timestamp_s;
    let since_start = |frame: &PlannedFrame| (time_s(frame) - time_s(&frames[0])) as f32;
    let mut pairs = frames.windows(2);
    match pairs.find(|pair| since_start(&pair[1]) <= since_start(&pair[0])) {
        None => Ok(()),
        Some(pair) => Err(ImportError::Option(format!(
            "{}: its time is too near to the one before, {} s after the start of its episode; use fewer frames per second",
            records[pair[1].record].place,
            since_start(&pair[0])
        ))),
    }
}

/// The frames of the longest episode. One episode is in memory while it is written, and an import continues after a whole one.
fn longest_episode(options: &ImportOptions) -> usize {
    let pixels = options.frame_width_px as usize * options.frame_height_px as usize;
    (MAX_EPISODE_BYTES / pixels).max(MIN_LONGEST_FRAMES)
}

/// Refuses records whose time is not after the one before in their session, or leaves them out. A single time that is too late is
/// left out itself, not those after it. What follows begins an episode.
fn drop_backward_times(recording: &mut Recording, options: &ImportOptions) -> Result<(), ImportError> {
    let mut kept: Vec<Record> = Vec::with_capacity(recording.records.len());
    let mut left_out = false;
    for mut record in std::mem::take(&mut recording.records) {
        record.begins_episode |= std::mem::take(&mut left_out);
        let last = kept.last().filter(|last| last.session == record.session);
        let Some(last) = last.filter(|last| record.timestamp_s <= last.timestamp_s) else {
            kept.push(record);
            continue;
        };
        if options.skip_bad && record.timestamp_s < last.timestamp_s && fits_after(kept.iter().rev().nth(1), &record) {
            let reason = format!(
                "its time {} s is not before the one after, {} s",
                last.timestamp_s, record.timestamp_s
            );
            recording.skipped.push(SkippedItem::new(&last.place, &reason));
            kept.pop();
            record.begins_episode = true;
            kept.push(record);
            continue;
        }
        left_out = true;
        let reason = format!(
            "its time {} s is not after the one before, {} s; times must grow",
            record.timestamp_s, last.timestamp_s
        );
        ImportError::record(record.place, reason).leave_out(options.skip_bad, &mut recording.skipped)?;
    }
    recording.records = kept;
    Ok(())
}

/// Whether the record's time may follow that of `before`.
fn fits_after(before: Option<&Record>, record: &Record) -> bool {
    before.is_none_or(|before| before.session != record.session || before.timestamp_s < record.timestamp_s)
}

fn median_period(records: &[Record]) -> Option<f64> {
    let pairs = records.windows(2).filter(|pair| is_next(&pair[0], &pair[1]));
    let steps = pairs.map(|pair| pair[1].timestamp_s - pair[0].timestamp_s);
    median(steps.collect(), f64::total_cmp)
}

/// The median; of an even number of values, the upper one of the two in the middle.
pub(super) fn median<T: Copy>(mut values: Vec<T>, order: impl Fn(&T, &T) -> Ordering) -> Option<T> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, order).1)
}

/// The period of the nearest whole rate where it is near, else the period itself.
fn whole_rate(period_s: f64) -> f64 {
    let rate = 1.0 / period_s;
    let whole = rate.round();
    if whole >= 1.0 && (rate - whole).abs() <= RATE_TOLERANCE * whole {
        1.0 / whole
    } else {
        period_s
    }
}

/// Ranges of records without a gap.
fn segments(records: &[Record], max_step_s: f64) -> impl Iterator<Item = Range<usize>> {
    let follows =
        move |before: &Record, now: &Record| is_next(before, now) && now.timestamp_s - before.timestamp_s <= max_step_s;
    let mut start = 0;
    records.chunk_by(follows).map(move |segment| {
        let range = start..start + segment.len();
        start = range.end;
        range
    })
}

/// The records nearest to a regular grid of times; a grid time without a record near it starts a new list.
fn nearest(records: &[Record], segment: Range<usize>, period_s: f64) -> Vec<Vec<usize>> {
    let start_s = records[segment.start].timestamp_s;
    let end_s = records[segment.end - 1].timestamp_s;
    let (mut lists, mut list, mut index) = (Vec::new(), Vec::new(), segment.start);
    let (mut step, last_step) = (0.0, ((end_s - start_s) / period_s).floor());
    while step <= last_step {
        let wanted_s = start_s + step * period_s;
        let distance = |record: usize| (records[record].timestamp_s - wanted_s).abs();
        while index + 1 < segment.end && distance(index + 1) <= distance(index) {
            index += 1;
        }
        step += 1.0;
        if distance(index) <= period_s / 2.0 && list.last() != Some(&index) {
            list.push(index);
        } else {
            lists.push(std::mem::take(&mut list));
            // No grid time has a record near it until the next record.
            if let Some(next) = records[..segment.end].get(index + 1) {
                step = ((next.timestamp_s - start_s) / period_s - 0.5).ceil().max(step);
            } else {
                break;
            }
        }
    }
    lists.push(list);
    lists
}

fn with_actions(records: &[Record], kept: &[usize]) -> Vec<PlannedFrame> {
    let frame = |(place, &record): (usize, &usize)| {
        let next = kept.get(place + 1).copied().unwrap_or(record + 1);
        let action = mean_action(&records[record..next]);
        PlannedFrame { record, action }
    };
    kept.iter().enumerate().map(frame).collect()
}

fn mean_action(records: &[Record]) -> Vec<f32> {
    let mut sum = vec![0.0f64; records[0].action.len()];
    for record in records {
        for (sum, value) in sum.iter_mut().zip(&record.action) {
            *sum += f64::from(*value);
        }
    }
    sum.into_iter().map(|sum| (sum / records.len() as f64) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::super::image_files::ImageFiles;
    use super::*;
    use foreframe_core::types::Channel;

    fn recording(times_s: &[f64]) -> Recording {
        let record = |(index, &timestamp_s): (usize, &f64)| Record {
            timestamp_s,
            action: vec![index as f32],
            place: format!("line {}", index + 1),
            ..Record::default()
        };
        let records = times_s.iter().enumerate().map(record).collect();
        Recording {
            action_channels: vec![Channel::new("turn", "")],
            ..Recording::new("test".to_owned(), records, ImageFiles(Vec::new()))
        }
    }

    fn planned(times_s: &[f64], options: &ImportOptions) -> Vec<Vec<(usize, f32)>> {
        let plan = plan(recording(times_s), options).unwrap();
        let of = |frame: &PlannedFrame| (frame.record, frame.action[0]);
        plan.episodes
            .iter()
            .map(|episode| episode.iter().map(of).collect())
            .collect()
    }

    #[test]
    fn a_gap_in_time_splits_episodes() {
        let episodes = planned(&[0.0, 0.05, 0.1, 1.0, 1.05, 9.0], &ImportOptions::default());
        assert_eq!(episodes, [vec![(0, 0.0), (1, 1.0), (2, 2.0)], vec![(3, 3.0), (4, 4.0)]]);
    }

    #[test]
    fn every_second_frame_averages_the_actions_between() {
        let options = ImportOptions {
            every: 2,
            ..ImportOptions::default()
        };
        let episodes = planned(&[0.0, 0.1, 0.2, 0.3, 0.4], &options);
        assert_eq!(episodes, [vec![(0, 0.5), (2, 2.5), (4, 4.0)]]);
    }

    #[test]
    fn a_rate_picks_the_nearest_records() {
        let options = ImportOptions {
            rate_hz: Some(10.0),
            ..ImportOptions::default()
        };
        let times: Vec<f64> = (0..9).map(|index| f64::from(index) * 0.033).collect();
        let episodes = planned(&times, &options);
        let chosen: Vec<usize> = episodes[0].iter().map(|(record, _)| *record).collect();
        assert_eq!((episodes.len(), chosen), (1, vec![0, 3, 6]));
    }

    #[test]
    fn time_that_does_not_grow_is_refused_or_skipped() {
        let times = [0.0, 0.1, 0.05, 0.2, 0.3];
        let error = plan(recording(&times), &ImportOptions::default())
            .err()
            .unwrap()
            .to_string();
        assert!(error.starts_with("line 3: its time 0.05 s is not after"), "{error}");
        let options = ImportOptions {
            skip_bad: true,
            ..ImportOptions::default()
        };
        let plan = plan(recording(&times), &options).unwrap();
        // The time 0.1 s is too late, since 0.05 s follows 0 s. The episode ends there.
        let kept: Vec<usize> = plan.episodes[0].iter().map(|frame| frame.record).collect();
        assert_eq!((plan.recording.skipped.items(9).len(), kept), (1, vec![1, 2, 3]));
        assert_eq!(plan.recording.records[1].timestamp_s, 0.05);
    }

    #[test]
    fn an_episode_ends_where_a_time_is_repeated_and_left_out() {
        let options = ImportOptions {
            skip_bad: true,
            ..ImportOptions::default()
        };
        let episodes = planned(&[0.0, 0.1, 0.2, 0.2, 0.4, 0.5], &options);
        let actions: Vec<Vec<f32>> = episodes
            .iter()
            .map(|frames| frames.iter().map(|frame| frame.1).collect())
            .collect();
        assert_eq!(actions, [vec![0.0, 1.0, 2.0], vec![4.0, 5.0]]);
    }

    #[test]
    fn an_episode_of_a_given_rate_ends_where_a_frame_is_missing() {
        let times = [0.0, 0.1, 0.21, 0.3, 0.5, 0.6, 0.7];
        let lengths = |rate_hz| {
            let options = ImportOptions {
                rate_hz,
                ..ImportOptions::default()
            };
            planned(&times, &options).iter().map(Vec::len).collect::<Vec<_>>()
        };
        assert_eq!((lengths(None), lengths(Some(10.0))), (vec![7], vec![4, 3]));
    }

    #[test]
    fn a_rate_above_the_recorded_one_is_refused() {
        let options = ImportOptions {
            rate_hz: Some(50.0),
            ..ImportOptions::default()
        };
        let error = plan(recording(&[0.0, 0.05, 0.1, 0.15]), &options).err().unwrap();
        assert_eq!(
            error.to_string(),
            "--rate is 50, but \"test\" has only 20 frames per second (median); give this rate or a lower one"
        );
    }

    #[test]
    fn three_periods_are_no_gap_wherever_the_clock_starts() {
        for start_s in [0.0, 0.7, 1_700_000_000.0] {
            let times = [0.0, 0.1, 0.2, 0.3, 0.6, 0.7, 0.8, 1.2, 1.3].map(|time_s| start_s + time_s);
            let lengths: Vec<usize> = planned(&times, &ImportOptions::default())
                .iter()
                .map(Vec::len)
                .collect();
            assert_eq!(lengths, [7, 2], "{start_s}");
        }
    }

    #[test]
    fn milliseconds_since_1970_are_not_taken_for_seconds() {
        let times: Vec<f64> = (0..5).map(|index| 1.7e12 + f64::from(index) * 50.0).collect();
        let error = plan(recording(&times), &ImportOptions::default())
            .err()
            .unwrap()
            .to_string();
        assert!(error.starts_with("a time of \"test\" is 1700000000000 s"), "{error}");
        assert!(error.contains("_ms"), "{error}");
    }

    #[test]
    fn a_very_long_episode_is_cut_into_equal_parts() {
        let times_s: Vec<f64> = (0..2500).map(|index| f64::from(index) * 0.1).collect();
        let options = ImportOptions {
            frame_width_px: 1024,
            frame_height_px: 1024,
            ..ImportOptions::default()
        };
        let episodes = planned(&times_s, &options);
        let lengths: Vec<usize> = episodes.iter().map(Vec::len).collect();
        assert_eq!(lengths, [834, 834, 832]);
        assert_eq!(episodes[1][0], (834, 834.0));
    }
}
