//! Intervals by bootstrap over trials (Efron 1979, percentiles). Windows overlap, so they are not independent; trials are.
//! A recording has few episodes, so it is divided into blocks of time instead (Künsch 1989).

use rand::Rng;
use serde::{Deserialize, Serialize};

use foreframe_core::types::Seed;
use foreframe_data::dataset::{Dataset, Window};

/// Length of a recording's block, in windows.
const BLOCK_WINDOWS: usize = 5;

/// Intervals from fewer trials or blocks than these are too narrow to be trusted.
pub(super) const FEWEST_GROUPS: usize = 10;

/// Share of the resampled values that an [`Interval`] holds.
pub(super) const CONFIDENCE: f64 = 0.95;

/// The range of the middle 95 % of the values computed from resampled trials or blocks of time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Interval {
    /// Whether this whole interval lies below the other one.
    #[must_use]
    pub fn is_below(&self, other: &Self) -> bool {
        self.high < other.low
    }
}

/// Whether windows are resampled in blocks of time: the episodes are no trials.
pub(super) fn is_recording(dataset: &Dataset) -> bool {
    dataset.episodes().iter().all(|episode| episode.trial.is_none())
}

/// What a window is resampled with, windows having this number of frames: its trial, or in a recording the block of frames in
/// which it starts, by the block's first frame.
pub(super) fn resampled_with(dataset: &Dataset, window: Window, frames: usize) -> usize {
    let episode = &dataset.episodes()[window.episode];
    if episode.trial.is_some() {
        return window.episode;
    }
    let block = (BLOCK_WINDOWS * frames).max(1);
    let within = window.first_frame - episode.first_frame;
    episode.first_frame + within / block * block
}

/// How often to resample, from which seed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bootstrap {
    /// Number of resamples.
    pub(super) samples: usize,
    /// The same seed draws the same trials, so values computed separately are resampled in the same way.
    pub(super) seed: Seed,
}

/// Sums of the windows' values for each trial: all that resampling of trials needs.
#[derive(Clone, Debug)]
pub(super) struct TrialSums {
    windows: Vec<f64>,
    sums: Vec<Vec<f64>>,
}

impl TrialSums {
    /// Groups windows by their trial. `values` holds one row of equal length for every window, in the order of `trial_of`.
    pub(super) fn group<R: AsRef<[f64]>>(trial_of: &[usize], values: impl Iterator<Item = R>) -> Self {
        let mut known: Vec<usize> = trial_of.to_vec();
        known.sort_unstable();
        known.dedup();
        let mut trials = Self {
            windows: vec![0.0; known.len()],
            sums: vec![Vec::new(); known.len()],
        };
        for (trial, row) in trial_of.iter().zip(values) {
            let Ok(group) = known.binary_search(trial) else {
                continue;
            };
            let sums = &mut trials.sums[group];
            sums.resize(row.as_ref().len(), 0.0);
            trials.windows[group] += 1.0;
            for (sum, value) in sums.iter_mut().zip(row.as_ref()) {
                *sum += value;
            }
        }
        trials
    }

    /// Number of trials.
    pub(super) fn count(&self) -> usize {
        self.windows.len()
    }

    /// Mean over all windows, of each value.
    pub(super) fn means(&self) -> Vec<f64> {
        self.means_of(0..self.count())
    }

    fn means_of(&self, trials: impl Iterator<Item = usize>) -> Vec<f64> {
        let mut means = vec![0.0; self.sums.first().map_or(0, Vec::len)];
        let mut windows = 0.0;
        for trial in trials {
            windows += self.windows[trial];
            for (mean, sum) in means.iter_mut().zip(&self.sums[trial]) {
                *mean += sum;
            }
        }
        for mean in &mut means {
            *mean /= windows;
        }
        means
    }

    /// The interval of each value of `statistic`, a function of the means; none with fewer than two trials.
    pub(super) fn intervals(
        &self,
        bootstrap: &Bootstrap,
        statistic: impl Fn(&[f64]) -> Vec<f64>,
    ) -> Option<Vec<Interval>> {
        let count = self.count();
        if count < 2 || bootstrap.samples == 0 {
            return None;
        }
        let mut rng = bootstrap.seed.derive("bootstrap", 0).rng();
        let mut draws: Vec<Vec<f64>> = Vec::new();
        for _ in 0..bootstrap.samples {
            let drawn: Vec<usize> = (0..count).map(|_| rng.random_range(0..count)).collect();
            let values = statistic(&self.means_of(drawn.into_iter()));
            draws.resize(values.len(), Vec::with_capacity(bootstrap.samples));
            for (draws, value) in draws.iter_mut().zip(values) {
                draws.push(value);
            }
        }
        Some(draws.into_iter().map(middle).collect())
    }
}

fn middle(mut values: Vec<f64>) -> Interval {
    values.sort_by(f64::total_cmp);
    let tail = (1.0 - CONFIDENCE) / 2.0;
    let at = |quantile: f64| values[(quantile * (values.len() - 1) as f64).round() as usize];
    Interval {
        low: at(tail),
        high: at(1.0 - tail),
    }
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, Normal};

    use super::*;

    fn means_only(means: &[f64]) -> Vec<f64> {
        means.to_vec()
    }

    #[test]
    fn a_recording_is_resampled_in_blocks_of_time() {
        let info = foreframe_data::dataset::DatasetInfo {
            frame_width_px: 1,
            frame_height_px: 1,
            frame_period_s: 0.1,
            ..Default::default()
        };
        let episode = |frames: usize| foreframe_data::dataset::EpisodeData {
            timestamps_s: (0..frames).map(|frame| 0.1 * frame as f64).collect(),
            pixels: vec![0; frames],
            ..Default::default()
        };
        let dataset = Dataset::from_episodes(info, vec![episode(30), episode(45)]).unwrap();
        let group = |episode, first_frame| resampled_with(&dataset, Window { episode, first_frame }, 4);
        assert_eq!([group(0, 0), group(0, 19), group(0, 20)], [0, 0, 20]);
        assert_eq!([group(1, 30), group(1, 49), group(1, 50)], [30, 30, 50]);
    }

    #[test]
    fn a_known_mean_is_covered_about_as_often_as_promised() {
        let normal = Normal::new(2.0, 1.0).unwrap();
        let trial_of: Vec<usize> = (0..40).collect();
        let covered = (0..200)
            .filter(|&round| {
                let mut rng = Seed(round).rng();
                let rows: Vec<[f64; 1]> = trial_of.iter().map(|_| [normal.sample(&mut rng)]).collect();
                let bootstrap = Bootstrap {
                    samples: 300,
                    seed: Seed(round),
                };
                let trials = TrialSums::group(&trial_of, rows.iter());
                let interval = trials.intervals(&bootstrap, means_only).unwrap()[0];
                (interval.low..=interval.high).contains(&2.0)
            })
            .count();
        assert!((178..=198).contains(&covered), "{covered} of 200");
    }

    #[test]
    fn windows_of_one_trial_do_not_narrow_the_interval() {
        let values = [0.0, 1.0, 3.0, 7.0];
        let bootstrap = Bootstrap {
            samples: 500,
            seed: Seed(1),
        };
        let once = TrialSums::group(&[0, 1, 2, 3], values.iter().map(|&v| [v]));
        let trial_of: Vec<usize> = (0..400).map(|i| i / 100).collect();
        let often = TrialSums::group(&trial_of, trial_of.iter().map(|&trial| [values[trial]]));
        assert_eq!(
            once.intervals(&bootstrap, means_only),
            often.intervals(&bootstrap, means_only)
        );
    }

    #[test]
    fn the_seed_decides_and_one_trial_has_no_interval() {
        let trial_of: Vec<usize> = (0..60).map(|i| i / 2).collect();
        let trials = TrialSums::group(&trial_of, (0..60).map(|i| [f64::from(i).sin()]));
        let with = |seed| trials.intervals(&Bootstrap { samples: 50, seed }, means_only);
        assert_eq!(with(Seed(1)), with(Seed(1)));
        assert_ne!(with(Seed(1)), with(Seed(2)));
        let uneven = TrialSums::group(&[4, 9, 9, 2], [[1.0], [2.0], [4.0], [8.0]].iter());
        assert_eq!(uneven.means(), [3.75]);
        let alone = TrialSums::group(&[4, 4], [[1.0], [2.0]].iter());
        let bootstrap = Bootstrap {
            samples: 50,
            seed: Seed(1),
        };
        assert!(alone.intervals(&bootstrap, means_only).is_none());
    }
}
