//! The scores of a driver, with intervals over episodes.

use serde::Serialize;

use super::episode::EpisodeResult;
use super::settings::DriverKind;
use crate::evaluation::bootstrap::{Bootstrap, FEWEST_GROUPS, Interval, TrialSums};
use foreframe_core::types::Seed;

/// Resamples of the episodes.
const RESAMPLES: usize = 2000;

/// A mean over episodes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DriveScore {
    /// The mean.
    pub mean: f64,
    /// Its 95 % bootstrap interval; absent with fewer than two episodes.
    pub interval: Option<Interval>,
}

/// What a driver achieved.
#[derive(Clone, Debug, Serialize)]
pub struct DriverScores {
    /// The driver.
    pub driver: DriverKind,
    /// Share of the episodes in which the robot arrived without a collision.
    pub success: DriveScore,
    /// Share of the episodes in which it arrived.
    pub arrived: DriveScore,
    /// Collisions of an episode.
    pub collisions: DriveScore,
    /// Collisions per kilometre: all collisions divided by the total distance.
    pub collisions_per_km: DriveScore,
    /// Collisions in which the robot did not drive forward.
    pub while_standing: DriveScore,
    /// Collisions with a robot that the camera had not shown in the two seconds before.
    pub unseen: DriveScore,
    /// Time of an episode, in seconds; all of it if the robot did not arrive.
    pub time_s: DriveScore,
    /// Success, weighted by the straight way over the way driven (Anderson et al. 2018).
    pub spl: DriveScore,
    /// The least distance to anything in an episode, in metres.
    pub closest_m: DriveScore,
    /// Stops of an episode.
    pub stops: DriveScore,
    /// Median and 95 % quantile of the time of a choice, in milliseconds.
    pub planning_ms: [f64; 2],
    /// Whether there are enough episodes to trust the intervals.
    pub intervals_are_reliable: bool,
    /// The episodes.
    pub episodes: Vec<EpisodeResult>,
}

impl DriverScores {
    /// The best, the median and the worst episode, each with its name and number: those with a success come first, then those with
    /// fewer collisions, then the shorter ones. Empty without episodes.
    #[must_use]
    pub fn examples(&self) -> Vec<(&'static str, usize)> {
        let mut order: Vec<(usize, &EpisodeResult)> = self.episodes.iter().enumerate().collect();
        order.sort_by(|(_, one), (_, two)| {
            let rank = |result: &EpisodeResult| (!result.is_success(), result.collisions);
            rank(one).cmp(&rank(two)).then(one.time_s.total_cmp(&two.time_s))
        });
        let places = [
            ("best", 0),
            ("median", order.len() / 2),
            ("worst", order.len().saturating_sub(1)),
        ];
        let example = |(name, place): (&'static str, usize)| Some((name, order.get(place)?.0));
        places.into_iter().filter_map(example).collect()
    }

    pub(super) fn new(driver: DriverKind, episodes: Vec<EpisodeResult>, seed: Seed) -> Self {
        let row = |result: &EpisodeResult| {
            let success = f64::from(u8::from(result.is_success()));
            [
                success,
                f64::from(u8::from(result.arrived)),
                result.collisions as f64,
                result.time_s,
                success * result.shortest_m / result.way_m.max(result.shortest_m),
                result.closest_m,
                result.stops as f64,
                result.while_standing as f64,
                result.unseen as f64,
                result.way_m,
            ]
        };
        let own: Vec<usize> = (0..episodes.len()).collect();
        let sums = TrialSums::group(&own, episodes.iter().map(row));
        let bootstrap = Bootstrap {
            samples: RESAMPLES,
            seed,
        };
        let with_rate = |means: &[f64]| {
            let mut values = means.to_vec();
            // A robot that never moved counts as if it had gone a millimetre.
            values.extend(means.get(9).map(|way_m| 1000.0 * means[2] / way_m.max(0.001)));
            values
        };
        let (means, intervals) = (with_rate(&sums.means()), sums.intervals(&bootstrap, with_rate));
        let score = |index: usize| DriveScore {
            mean: means.get(index).copied().unwrap_or(f64::NAN),
            interval: intervals.as_ref().map(|all| all[index]),
        };
        let mut times: Vec<f64> = episodes
            .iter()
            .flat_map(|result| result.planning_ms.0.iter().copied())
            .collect();
        times.sort_by(f64::total_cmp);
        let quantile = |share: f64| {
            let index = (share * times.len().saturating_sub(1) as f64).round() as usize;
            times.get(index).copied().unwrap_or(0.0)
        };
        Self {
            driver,
            success: score(0),
            arrived: score(1),
            collisions: score(2),
            collisions_per_km: score(10),
            while_standing: score(7),
            unseen: score(8),
            time_s: score(3),
            spl: score(4),
            closest_m: score(5),
            stops: score(6),
            planning_ms: [quantile(0.5), quantile(0.95)],
            intervals_are_reliable: episodes.len() >= FEWEST_GROUPS,
            episodes,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::drive::episode::PlanningTimes;

    #[test]
    fn only_an_arrival_without_a_collision_is_a_success() {
        let result = |arrived, collisions| EpisodeResult {
            arrived,
            collisions,
            while_standing: collisions,
            unseen: collisions / 2,
            time_s: 4.0,
            way_m: 4.0,
            shortest_m: 2.0,
            closest_m: 0.1,
            stops: 0,
            planning_ms: PlanningTimes::default(),
        };
        let results = vec![result(true, 0), result(true, 2), result(false, 0), result(true, 0)];
        let scores = DriverScores::new(DriverKind::Pid, results, Seed(1));
        assert_eq!(
            (scores.success.mean, scores.arrived.mean, scores.collisions.mean),
            (0.5, 0.75, 0.5)
        );
        assert_eq!(scores.spl.mean, 0.25);
        assert_eq!((scores.while_standing.mean, scores.unseen.mean), (0.5, 0.25));
        // Two collisions on 16 m.
        assert_eq!(scores.collisions_per_km.mean, 125.0);
        let interval = scores.success.interval.unwrap();
        assert!(interval.low < 0.5 && interval.high > 0.5);
        assert!(!scores.intervals_are_reliable);
    }
}
