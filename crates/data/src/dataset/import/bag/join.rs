//! Gives every image its action and its state.
//!
//! The rule: a topic's times are those in its messages' headers if half of them lie within 1 s of the time at which they
//! were recorded, else the latter. A value holds until the next one, at most for `hold_s`. The state of an image is the one
//! that holds at its time. Its action is the mean of what holds from its time until the next image, each value weighted by
//! how long it holds. An image without an action or a state is left out. What follows such an image, or a damaged one, begins an
//! episode.

use std::ops::Range;

use super::choice::{ChosenTopics, ChosenValues};
use super::index::{BagIndex, MessageTime, Position};
use crate::dataset::import::recording::{Record, any_follow};
use crate::dataset::import::skipped::{SkippedItem, SkippedList};
use crate::dataset::import::timing::median;
use crate::dataset::import::{ImportError, ImportOptions};
use crate::dataset::sampler::GAP_PERIODS;

/// Headers that differ more from the time of recording, in the median, are of another clock.
const SAME_CLOCK_NS: u64 = 1_000_000_000;

/// Which of a message's times counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Clock {
    Header,
    Log,
}

impl Clock {
    /// The clock of a topic: the one given as `--time`, else by the rule above. Errors: `Option` for another word.
    fn of(times: impl Iterator<Item = MessageTime>, options: &ImportOptions) -> Result<Self, ImportError> {
        match options.time.as_deref() {
            Some("header") => return Ok(Self::Header),
            Some("log") => return Ok(Self::Log),
            Some(other) => {
                return Err(ImportError::Option(format!(
                    "--time is {other:?}; for a bag it must be header (the time in the messages) or log (the time of recording)"
                )));
            }
            None => {}
        }
        let difference = |time: MessageTime| time.stamp_ns.map_or(u64::MAX, |stamp| time.log_ns.abs_diff(stamp));
        let median = median(times.map(difference).collect(), u64::cmp);
        let is_same = median.is_some_and(|median| median <= SAME_CLOCK_NS);
        Ok(if is_same { Self::Header } else { Self::Log })
    }

    fn time(self, time: MessageTime) -> i64 {
        match self {
            Self::Header => time.stamp_ns.unwrap_or(time.log_ns),
            Self::Log => time.log_ns,
        }
    }
}

/// The chosen values of a topic at the times of its messages.
struct HeldValues<'a> {
    topic: &'a str,
    times_ns: Vec<i64>,
    /// One row per message; NaN before a field had its first value.
    rows: Vec<f32>,
    width: usize,
    hold_ns: i64,
}

impl<'a> HeldValues<'a> {
    /// Errors: `Record` if time goes back, unless damage is left out.
    fn new(index: &BagIndex<'_>, chosen: &ChosenValues<'a>, skipped: &mut SkippedList) -> Result<Self, ImportError> {
        let (topic, options) = (&chosen.topic.name, index.options);
        let clock = Clock::of(chosen.stream.messages().map(|(message, _)| message.time), options)?;
        let mut held = Self {
            topic,
            times_ns: Vec::new(),
            rows: Vec::new(),
            width: chosen.fields.len(),
            hold_ns: (options.hold_s * 1e9) as i64,
        };
        let mut row = vec![f32::NAN; held.width];
        for (message, values) in chosen.stream.messages() {
            let time_ns = clock.time(message.time);
            if let Some(&before) = held.times_ns.last().filter(|&&before| time_ns < before) {
                let place = format!("{} message {} of {topic}", index.source.display(), message.number);
                let reason = format!(
                    "its time {} s is before that of the message before, {} s; times must grow",
                    seconds(time_ns),
                    seconds(before)
                );
                ImportError::record(place, reason).leave_out(options.skip_bad, skipped)?;
                continue;
            }
            let mut changed = false;
            for &(field, value) in values {
                if let Some(column) = chosen.fields.iter().position(|&of| of == field as usize) {
                    (row[column], changed) = (value, true);
                }
            }
            if changed {
                held.times_ns.push(time_ns);
                held.rows.extend_from_slice(&row);
            }
        }
        Ok(held)
    }

    /// For images of which no two consecutive ones have a value. Errors: `Option` if the values come too seldom for that.
    fn check_period(&self, image: &str, option: &str) -> Result<(), ImportError> {
        let steps = self.times_ns.windows(2).map(|pair| pair[1] - pair[0]);
        let period_ns = median(steps.collect(), i64::cmp).filter(|period_ns| *period_ns > self.hold_ns);
        period_ns.map_or(Ok(()), |period_ns| {
            let (topic, hold_s) = (self.topic, seconds(self.hold_ns));
            Err(ImportError::Option(format!(
                "no two consecutive images of {image} have a value of {topic}: its values come every {:.3} s (median) and hold for \
                 {hold_s} s; let them hold longer with --hold, or leave the topic out with {option} none",
                seconds(period_ns)
            )))
        })
    }

    /// The message that holds at a time.
    fn at(&self, time_ns: i64) -> Option<usize> {
        let message = self.times_ns.partition_point(|&time| time <= time_ns).checked_sub(1)?;
        let is_fresh = time_ns.saturating_sub(self.times_ns[message]) <= self.hold_ns;
        let row = self.row(message);
        (is_fresh && row.iter().all(|value| value.is_finite())).then_some(message)
    }

    fn row(&self, message: usize) -> &[f32] {
        &self.rows[message * self.width..(message + 1) * self.width]
    }

    /// Mean of what holds from `start_ns`, when message `first` holds, to `end_ns`.
    fn mean(&self, first: usize, start_ns: i64, end_ns: i64) -> Vec<f32> {
        let mut sums = vec![0.0f64; self.width];
        let (mut message, mut from_ns) = (first, start_ns);
        while from_ns < end_ns {
            let next_ns = self.times_ns.get(message + 1).copied().unwrap_or(i64::MAX);
            let until_ns = next_ns.clamp(from_ns, end_ns);
            for (sum, value) in sums.iter_mut().zip(self.row(message)) {
                *sum += f64::from(*value) * (until_ns - from_ns) as f64;
            }
            (message, from_ns) = (message + 1, until_ns);
        }
        let duration = end_ns.saturating_sub(start_ns).max(1) as f64;
        sums.into_iter().map(|sum| (sum / duration) as f32).collect()
    }
}

fn seconds(time_ns: i64) -> f64 {
    time_ns as f64 / 1e9
}

/// The images with what belongs to them.
#[derive(Default)]
pub(super) struct JoinedImages {
    pub(super) records: Vec<Record>,
    /// File and position of each record's image.
    pub(super) positions: Vec<(usize, Position)>,
    pub(super) skipped: SkippedList,
}

/// Joins the chosen topics. Errors: `Option`, `Record`.
pub(super) fn join(index: &BagIndex<'_>, chosen: &ChosenTopics<'_>) -> Result<JoinedImages, ImportError> {
    let images = chosen.images;
    let clock = Clock::of(images.iter().map(|image| image.time), index.options)?;
    let times_ns: Vec<i64> = images.iter().map(|image| clock.time(image.time)).collect();
    let steps = times_ns.windows(2).map(|pair| pair[1].saturating_sub(pair[0]));
    let period_ns = median(steps.collect(), i64::cmp).map_or(1, |period| period.max(1));
    let mut joined = JoinedImages::default();
    let mut held = |chosen| HeldValues::new(index, chosen, &mut joined.skipped);
    let actions = chosen.actions.iter().map(&mut held).collect::<Result<Vec<_>, _>>()?;
    let states = chosen.states.iter().map(&mut held).collect::<Result<Vec<_>, _>>()?;
    // Runs of images without an action or a state, with the topic that has no value.
    let mut left_out: Vec<(&str, Range<u64>)> = Vec::new();
    let mut next_number = 0;
    for (image, entry) in images.iter().enumerate() {
        let start_ns = times_ns[image];
        let next_ns = times_ns.get(image + 1).copied().unwrap_or(i64::MAX);
        let longest_ns = (period_ns as f64 * GAP_PERIODS) as i64;
        let is_next = next_ns > start_ns && next_ns.saturating_sub(start_ns) <= longest_ns;
        let end_ns = if is_next {
            next_ns
        } else {
            start_ns.saturating_add(period_ns)
        };
        let values = actions.iter().chain(&states);
        let messages = values.map(|held| held.at(start_ns).ok_or(held.topic));
        let messages = match messages.collect::<Result<Vec<usize>, &str>>() {
            Ok(messages) => messages,
            Err(missing) => {
                match left_out.last_mut() {
                    Some((topic, run)) if *topic == missing && run.end == entry.number => run.end += 1,
                    _ => left_out.push((missing, entry.number..entry.number + 1)),
                }
                continue;
            }
        };
        let (of_actions, of_states) = messages.split_at(actions.len());
        let action = actions.iter().zip(of_actions);
        let state = states.iter().zip(of_states);
        joined.records.push(Record {
            timestamp_s: seconds(start_ns),
            action: action
                .flat_map(|(held, &first)| held.mean(first, start_ns, end_ns))
                .collect(),
            state: state.flat_map(|(held, &at)| held.row(at).iter().copied()).collect(),
            begins_episode: entry.number != next_number,
            place: index.place(chosen.image, entry),
            ..Record::default()
        });
        joined.positions.push((entry.file, entry.position));
        next_number = entry.number + 1;
    }
    if !any_follow(&joined.records) {
        for (option, held) in [("--action", &actions), ("--state", &states)] {
            let mut seldom = held
                .iter()
                .filter(|held| left_out.iter().any(|(topic, _)| *topic == held.topic));
            seldom.try_for_each(|held| held.check_period(&chosen.image.name, option))?;
        }
    }
    let (source, hold_s) = (index.source.display(), index.options.hold_s);
    for (topic, run) in left_out {
        let (first, last) = (run.start, run.end - 1);
        joined.skipped.push(SkippedItem::new(
            &format!("{source} messages {first} to {last} of {}", chosen.image.name),
            &format!("{topic} has no value in the {hold_s} s before them (--hold)"),
        ));
    }
    Ok(joined)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn held(messages: &[(i64, f32)]) -> HeldValues<'static> {
        HeldValues {
            topic: "/cmd_vel",
            times_ns: messages.iter().map(|(time, _)| *time).collect(),
            rows: messages.iter().map(|(_, value)| *value).collect(),
            width: 1,
            hold_ns: 100,
        }
    }

    #[test]
    fn an_action_is_weighted_by_how_long_it_holds() {
        let held = held(&[(0, 1.0), (30, 5.0), (90, 7.0)]);
        assert_eq!(held.mean(0, 10, 50), [3.0]);
        assert_eq!(held.mean(2, 95, 200), [7.0]);
    }

    #[test]
    fn a_value_holds_for_a_while_only() {
        let held = held(&[(10, 1.0), (30, f32::NAN), (90, 7.0)]);
        assert_eq!(
            [5, 10, 29, 30, 190, 191].map(|time| held.at(time)),
            [None, Some(0), Some(0), None, Some(2), None]
        );
    }

    #[test]
    fn headers_of_another_clock_do_not_count() {
        let times = |offset: i64| {
            let at = move |index: i64| MessageTime {
                log_ns: index * 100_000_000,
                stamp_ns: Some(index * 100_000_000 + offset),
            };
            (0..9).map(at)
        };
        let options = ImportOptions::default();
        assert_eq!(Clock::of(times(40_000_000), &options).unwrap(), Clock::Header);
        assert_eq!(Clock::of(times(7_000_000_000), &options).unwrap(), Clock::Log);
        let forced = ImportOptions {
            time: Some("header".to_owned()),
            ..options
        };
        assert_eq!(Clock::of(times(7_000_000_000), &forced).unwrap(), Clock::Header);
    }
}
