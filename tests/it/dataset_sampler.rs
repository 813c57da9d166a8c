//! Splits and windows of data sets in memory.

use std::collections::BTreeSet;

use foreframe_core::types::{Channel, Seed};
use foreframe_data::dataset::{Dataset, DatasetError, DatasetInfo, EpisodeData, Split, Splits, Window, WindowShape};
use foreframe_sim::{Scenario, TrialParameters};
use proptest::prelude::*;

const PERIOD_S: f64 = 0.2;

fn info() -> DatasetInfo {
    DatasetInfo {
        name: "made-up".to_owned(),
        frame_width_px: 1,
        frame_height_px: 1,
        frame_period_s: PERIOD_S,
        action_channels: vec![Channel::new("linear", "m/s")],
        ..DatasetInfo::default()
    }
}

/// An episode of `frames` frames. The clock jumps by 10 s before each frame in `jumps`.
fn episode(frames: usize, jumps: &[usize], trial: Option<TrialParameters>) -> EpisodeData {
    let mut time_s = 0.0;
    let timestamps_s = (0..frames)
        .map(|frame| {
            time_s += if jumps.contains(&frame) { 10.0 } else { PERIOD_S };
            time_s
        })
        .collect();
    EpisodeData {
        timestamps_s,
        pixels: vec![7; frames],
        actions: vec![0.5; frames],
        trial,
        ..EpisodeData::default()
    }
}

fn simulated(trials: u64, frames: usize) -> Dataset {
    let draw = |trial| TrialParameters::draw(Scenario::StaticObserver, Seed(5), trial);
    let episodes = (0..trials)
        .map(|trial| episode(frames, &[], Some(draw(trial))))
        .collect();
    Dataset::from_episodes(info(), episodes).unwrap()
}

fn recorded(lengths: &[usize], jumps: &[usize]) -> Dataset {
    let episodes = lengths.iter().map(|&length| episode(length, jumps, None)).collect();
    Dataset::from_episodes(info(), episodes).unwrap()
}

fn frames_of(windows: &[Window], shape: WindowShape) -> BTreeSet<usize> {
    windows
        .iter()
        .flat_map(|window| window.first_frame..window.first_frame + shape.frames())
        .collect()
}

proptest! {
    #[test]
    fn windows_cross_no_gap_and_splits_share_no_frame(
        lengths in proptest::collection::vec(12usize..80, 1..14),
        jump in 1usize..80,
        seed in any::<u64>(),
        context in 1usize..4,
        horizon in 1usize..4,
        stride in 1usize..5,
    ) {
        let dataset = recorded(&lengths, &[jump]);
        let splits = Splits::new(&dataset, Seed(seed));
        let shape = WindowShape { context, horizon };
        let mut taken = BTreeSet::new();
        for split in Split::ALL {
            // A split can be too short for a window; the others are still checked.
            let Ok(windows) = splits.windows(&dataset, split, shape, stride) else { continue };
            for window in &windows {
                let frames = dataset.episodes()[window.episode].frames();
                let last = window.first_frame + shape.frames() - 1;
                prop_assert!(frames.contains(&window.first_frame) && frames.contains(&last));
                let spans_s = dataset.timestamp_s(last) - dataset.timestamp_s(window.first_frame);
                prop_assert!(spans_s < PERIOD_S * shape.frames() as f64);
                prop_assert!(splits.episodes(split).contains(&window.episode));
            }
            let frames = frames_of(&windows, shape);
            prop_assert!(taken.is_disjoint(&frames));
            taken.extend(frames);
        }
    }

    #[test]
    fn adding_trials_keeps_the_split_of_earlier_ones(seed in any::<u64>(), few in 1u64..60, more in 1u64..60) {
        let (small, large) = (simulated(few, 1), simulated(few + more, 1));
        let (of_small, of_large) = (Splits::new(&small, Seed(seed)), Splits::new(&large, Seed(seed)));
        for split in Split::ALL {
            let kept: Vec<_> = of_large.episodes(split).iter().copied().filter(|&e| e < few as usize).collect();
            prop_assert_eq!(of_small.episodes(split), kept);
        }
    }

    #[test]
    fn every_trial_is_in_exactly_one_split(seed in any::<u64>()) {
        let dataset = simulated(100, 1);
        let splits = Splits::new(&dataset, Seed(seed));
        let mut all: Vec<_> = Split::ALL.iter().flat_map(|&split| splits.episodes(split).to_vec()).collect();
        all.sort_unstable();
        prop_assert_eq!(all, (0..100).collect::<Vec<_>>());
        for episode in dataset.episodes() {
            let trial = episode.trial.as_ref().unwrap();
            let (pair, held_out) = (trial.has_held_out_pair(), trial.is_held_out());
            let is_in = |split| splits.episodes(split).contains(&episode.index);
            prop_assert_eq!(is_in(Split::UnseenPairs), pair);
            prop_assert_eq!(is_in(Split::UnseenGains), held_out && !pair);
        }
    }
}

#[test]
fn recordings_are_split_80_10_10() {
    let dataset = recorded(&[12; 100], &[]);
    let splits = Splits::new(&dataset, Seed(3));
    let counts = Split::ALL.map(|split| splits.episodes(split).len());
    assert_eq!(counts, [80, 10, 10, 0, 0]);
}

#[test]
fn recordings_of_unequal_length_are_split_by_time() {
    let mut lengths = [10; 12];
    (lengths[3], lengths[11]) = (200, 90);
    let dataset = recorded(&lengths, &[]);
    let splits = Splits::new(&dataset, Seed(3));
    // A tenth of the 390 frames is 39: the last recording tests, the four before it validate.
    assert_eq!(splits.episodes(Split::Test), [11]);
    assert_eq!(splits.episodes(Split::Validation), [7, 8, 9, 10]);
    assert_eq!(splits.episodes(Split::Train), [0, 1, 2, 3, 4, 5, 6]);
}

#[test]
fn a_long_episode_does_not_take_the_frames_for_training() {
    let shape = WindowShape { context: 5, horizon: 5 };
    let first = [vec![1560], vec![9; 15], vec![5]].concat();
    let middle = [vec![9; 20], vec![1200, 40]].concat();
    for lengths in [first, middle] {
        let dataset = recorded(&lengths, &[]);
        let splits = Splits::new(&dataset, Seed(3));
        let windows = |split| splits.windows(&dataset, split, shape, 1).unwrap().len();
        let all = dataset.info().frame_count;
        assert!(windows(Split::Train) > all / 2, "{lengths:?}");
        assert!((1..all / 5).contains(&windows(Split::Validation)), "{lengths:?}");
        assert!((1..all / 5).contains(&windows(Split::Test)), "{lengths:?}");
    }
}

#[test]
fn a_test_part_of_episodes_too_short_for_a_window_takes_a_longer_one() {
    let dataset = recorded(&[vec![400; 5], vec![9; 30]].concat(), &[]);
    let splits = Splits::new(&dataset, Seed(3));
    assert_eq!(splits.episodes(Split::Train), [0, 1, 2]);
    assert_eq!(splits.episodes(Split::Validation), [3]);
    assert_eq!(splits.episodes(Split::Test)[..2], [4, 5]);
}

#[test]
fn three_periods_are_no_gap_whatever_the_last_bits_of_the_times_are() {
    let dataset = recorded(&[40], &[]);
    let mut late = episode(40, &[], None);
    late.timestamps_s
        .iter_mut()
        .skip(20)
        .for_each(|time_s| *time_s += 2.0 * PERIOD_S);
    let with_step = Dataset::from_episodes(info(), vec![late]).unwrap();
    let shape = WindowShape { context: 2, horizon: 1 };
    let windows = |dataset| {
        Splits::new(dataset, Seed(0))
            .windows(dataset, Split::Train, shape, 1)
            .unwrap()
    };
    assert_eq!(windows(&with_step), windows(&dataset));
}

#[test]
fn a_single_recording_is_split_by_time() {
    let dataset = recorded(&[100], &[]);
    let splits = Splits::new(&dataset, Seed(0));
    let shape = WindowShape { context: 2, horizon: 1 };
    let first_and_last = |split| {
        let windows = splits.windows(&dataset, split, shape, 1).unwrap();
        (windows[0].first_frame, windows[windows.len() - 1].first_frame)
    };
    assert_eq!(first_and_last(Split::Train), (0, 77));
    assert_eq!(first_and_last(Split::Validation), (83, 87));
    assert_eq!(first_and_last(Split::Test), (93, 97));
}

#[test]
fn windows_start_at_every_stride() {
    let dataset = recorded(&[20], &[]);
    let windows = Splits::new(&dataset, Seed(0))
        .windows(&dataset, Split::Train, WindowShape { context: 5, horizon: 5 }, 3)
        .unwrap();
    let starts: Vec<_> = windows.iter().map(|window| window.first_frame).collect();
    assert_eq!(starts, [0, 3, 6]);
}

#[test]
fn a_window_longer_than_every_episode_is_refused() {
    let dataset = simulated(20, 9);
    let shape = WindowShape { context: 5, horizon: 5 };
    let error = Splits::new(&dataset, Seed(0))
        .windows(&dataset, Split::Train, shape, 1)
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "a window of 10 frames (context 5, horizon 5) is longer than every episode of the train split; the longest has \
         9 frames without a gap. Record longer, or train with a smaller context or horizon"
    );
}

#[test]
fn sampling_is_reproducible_and_without_repetition() {
    let dataset = simulated(20, 30);
    let splits = Splits::new(&dataset, Seed(0));
    let shape = WindowShape { context: 5, horizon: 5 };
    let draw = |seed| splits.sample(&dataset, Split::Train, shape, 100, Seed(seed)).unwrap();
    assert_eq!(draw(1), draw(1));
    assert_ne!(draw(1), draw(2));
    assert_eq!(draw(1).iter().collect::<BTreeSet<_>>().len(), 100);
}

#[test]
fn sampling_too_many_windows_is_refused_with_their_number() {
    let dataset = recorded(&[100], &[]);
    let splits = Splits::new(&dataset, Seed(0));
    let shape = WindowShape { context: 5, horizon: 5 };
    let error = splits.sample(&dataset, Split::Train, shape, 1000, Seed(0)).unwrap_err();
    assert_eq!(
        error.to_string(),
        "data.windows is 1000, but the train split has only 71 windows; use a smaller number, use data.windows=all, or \
         collect more trials"
    );
}

#[test]
fn a_non_finite_action_is_refused_with_episode_and_frame() {
    let mut data = episode(5, &[], None);
    data.actions[3] = f32::NAN;
    let error = Dataset::from_episodes(info(), vec![episode(5, &[], None), data]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "episode 1, frame 3: action is NaN; every number must be finite"
    );
}

#[test]
fn columns_of_different_lengths_are_refused() {
    let mut data = episode(5, &[], None);
    data.actions.pop();
    let error = Dataset::from_episodes(info(), vec![data]).unwrap_err();
    assert_eq!(error.to_string(), "episode 0: action has 4 values; 5 frames need 5");
}

#[test]
fn timestamps_that_do_not_increase_are_refused() {
    let mut data = episode(5, &[], None);
    data.timestamps_s[2] = data.timestamps_s[1];
    let error = Dataset::from_episodes(info(), vec![data]).unwrap_err();
    assert!(matches!(error, DatasetError::TimeOrder { episode: 0, frame: 2 }));
}
