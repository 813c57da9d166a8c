//! From records to episodes at one frame rate.
//!
//! The rule: records of one session follow each other until time jumps by more than 3 median periods; that ends an
//! episode. Without a rate, every Nth record becomes a frame. With a rate, frame k of an episode is the record nearest to
//! its start + k / rate, if one lies within half a period; if none does, the episode ends. The action of a frame is the mean
//! of the records' actions from this frame up to the next one. Its state is that of its record.

use super::recording::{Record, Recording};
use super::{ImportError, ImportOptions};

/// A jump of time by more than this many median periods ends an episode.
const GAP_PERIODS: f64 = 3.0;
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

/// Cuts a recording into episodes. Errors: `Record` if time does not grow, `Empty`.
pub(super) fn plan(mut recording: Recording, options: &ImportOptions) -> Result<ImportPlan, ImportError> {
    drop_backward_times(&mut recording, options)?;
    let records = &recording.records;
    let Some(period_s) = median_period(records) else {
        return Err(ImportError::Empty(
            options.csv.clone().unwrap_or_else(|| recording.name.clone().into()),
        ));
    };
    let (frame_period_s, resampled) = match options.rate_hz {
        Some(rate) if (rate * period_s - 1.0).abs() > RATE_TOLERANCE => (1.0 / rate, true),
        Some(rate) => (1.0 / rate, false),
        None => (whole_rate(period_s), false),
    };
    let mut episodes = Vec::new();
    for segment in segments(records, GAP_PERIODS * period_s) {
        let picked = if resampled {
            nearest(records, segment, frame_period_s)
        } else {
            vec![segment.collect()]
        };
        for chosen in picked {
            let kept: Vec<usize> = chosen.into_iter().step_by(options.every).collect();
            if kept.len() > 1 {
                episodes.push(with_actions(records, &kept));
            }
        }
    }
    if episodes.is_empty() {
        return Err(ImportError::Empty(recording.name.clone().into()));
    }
    Ok(ImportPlan {
        recording,
        frame_period_s: frame_period_s * options.every as f64,
        episodes,
    })
}

/// Refuses records whose time is not after the one before in their session, or leaves them out.
fn drop_backward_times(recording: &mut Recording, options: &ImportOptions) -> Result<(), ImportError> {
    let mut kept: Vec<Record> = Vec::with_capacity(recording.records.len());
    for record in std::mem::take(&mut recording.records) {
        match kept.last() {
            Some(last) if last.session == record.session && record.timestamp_s <= last.timestamp_s => {
                let error = ImportError::record(
                    record.place.clone(),
                    format!(
                        "its time {} s is not after the one before, {} s; times must grow",
                        record.timestamp_s, last.timestamp_s
                    ),
                );
                match error.skippable().filter(|_| options.skip_bad) {
                    Some(item) => recording.skipped.push(item),
                    None => return Err(error),
                }
            }
            _ => kept.push(record),
        }
    }
    recording.records = kept;
    Ok(())
}

fn median_period(records: &[Record]) -> Option<f64> {
    let pairs = records.windows(2).filter(|pair| pair[0].session == pair[1].session);
    let mut steps: Vec<f64> = pairs.map(|pair| pair[1].timestamp_s - pair[0].timestamp_s).collect();
    if steps.is_empty() {
        return None;
    }
    let middle = steps.len() / 2;
    Some(*steps.select_nth_unstable_by(middle, f64::total_cmp).1)
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
fn segments(records: &[Record], max_step_s: f64) -> Vec<std::ops::Range<usize>> {
    let mut segments = Vec::new();
    let mut start = 0;
    for index in 1..=records.len() {
        let ends = index == records.len() || {
            let (before, now) = (&records[index - 1], &records[index]);
            before.session != now.session || now.timestamp_s - before.timestamp_s > max_step_s
        };
        if ends {
            segments.push(start..index);
            start = index;
        }
    }
    segments
}

/// The records nearest to a regular grid of times; a grid time without a record near it starts a new list.
fn nearest(records: &[Record], segment: std::ops::Range<usize>, period_s: f64) -> Vec<Vec<usize>> {
    let start_s = records[segment.start].timestamp_s;
    let end_s = records[segment.end - 1].timestamp_s;
    let (mut lists, mut list, mut index) = (Vec::new(), Vec::new(), segment.start);
    for step in 0..=((end_s - start_s) / period_s) as usize {
        let wanted_s = start_s + step as f64 * period_s;
        let distance = |record: usize| (records[record].timestamp_s - wanted_s).abs();
        while index + 1 < segment.end && distance(index + 1) <= distance(index) {
            index += 1;
        }
        if distance(index) <= period_s / 2.0 && list.last() != Some(&index) {
            list.push(index);
        } else {
            lists.push(std::mem::take(&mut list));
        }
    }
    lists.push(list);
    lists
}

fn with_actions(records: &[Record], kept: &[usize]) -> Vec<PlannedFrame> {
    let frame = |(place, &record): (usize, &usize)| {
        let next = kept.get(place + 1).copied().unwrap_or(record + 1);
        PlannedFrame {
            record,
            action: mean_action(&records[record..next]),
        }
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
    use super::super::recording::Images;
    use super::*;
    use crate::types::Channel;

    fn recording(times_s: &[f64]) -> Recording {
        let record = |(index, &timestamp_s): (usize, &f64)| Record {
            timestamp_s,
            session: String::new(),
            action: vec![index as f32],
            state: Vec::new(),
            image: index,
            place: format!("line {}", index + 1),
        };
        Recording {
            name: "test".to_owned(),
            action_channels: vec![Channel::new("turn", "")],
            state_channels: Vec::new(),
            camera: None,
            records: times_s.iter().enumerate().map(record).collect(),
            images: Images::Files(Vec::new()),
            skipped: Vec::new(),
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
        assert_eq!((plan.recording.skipped.len(), plan.episodes[0].len()), (1, 4));
    }
}
