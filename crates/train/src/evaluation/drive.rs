//! The closed loop: robots that drive to a goal among others in the simulator, with several drivers, all in the same episodes.
//!
//! `error` → `settings` → `situation` (what is known at a frame) → `tracks` → `known`, `simulated` → `drivers` (what chooses the commands) → `episode`
//! → `scores`.

mod drivers;
mod episode;
mod error;
mod known;
mod scores;
mod settings;
mod simulated;
mod situation;
mod tracks;

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;

use foreframe_core::registry::Model;

pub use self::episode::{DriveStep, EpisodeResult};
pub use self::error::DriveError;
pub use self::scores::{DriveScore, DriverScores};
pub use self::settings::{DriveSettings, DriverKind};

/// Drives every episode with every driver, side by side on all cores. `model`: needed by those that see or plan with one.
/// `on_episode` is called after each episode of a driver, with how many are over. Once `is_stopped`, no episode begins: the scores
/// are then of those that are over, and drivers without one are left out. Errors: a driver without the model that it needs, a
/// scenario in which Tb1 does not drive, those of the simulator and of the predictions.
pub fn run(
    model: Option<&Model>,
    settings: &DriveSettings,
    is_stopped: &AtomicBool,
    on_episode: &(dyn Fn(DriverKind, usize) + Sync),
) -> Result<Vec<DriverScores>, DriveError> {
    settings.check(model)?;
    let mut scores = Vec::new();
    for &driver in &settings.drivers {
        let (next, over) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let drive = || {
            let mut results = Vec::new();
            loop {
                if is_stopped.load(Ordering::Relaxed) {
                    return Ok(results);
                }
                let episode = next.fetch_add(1, Ordering::Relaxed);
                if episode >= settings.episodes {
                    return Ok(results);
                }
                let result = episode::drive(driver, model, settings, episode, &mut |_| Ok(()))?;
                on_episode(driver, over.fetch_add(1, Ordering::Relaxed) + 1);
                results.push((episode, result));
            }
        };
        // Not rayon's threads: while one of those waits for a plan, it would drive another episode, and the plan's time would be wrong.
        let mut results = thread::scope(|scope| {
            let count = thread::available_parallelism()
                .map_or(1, usize::from)
                .min(settings.episodes);
            let threads: Vec<_> = (0..count).map(|_| scope.spawn(drive)).collect();
            let ended = threads
                .into_iter()
                .map(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
            ended.collect::<Result<Vec<_>, DriveError>>()
        })?
        .concat();
        results.sort_by_key(|(episode, _)| *episode);
        let results: Vec<EpisodeResult> = results.into_iter().map(|(_, result)| result).collect();
        if !results.is_empty() {
            scores.push(DriverScores::new(driver, results, settings.seed));
        }
    }
    Ok(scores)
}

/// Drives one episode once more. `on_step` is called after each step, with the plan that the driver follows from there on. Without
/// a budget for plans, what happens is the same as in [`run`]. Errors: as [`run`], and those of `on_step`.
pub fn replay(
    model: Option<&Model>,
    settings: &DriveSettings,
    driver: DriverKind,
    episode: usize,
    on_step: &mut dyn FnMut(&DriveStep<'_>) -> Result<(), DriveError>,
) -> Result<EpisodeResult, DriveError> {
    settings.check(model)?;
    episode::drive(driver, model, settings, episode, on_step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::types::Seed;
    use foreframe_sim::Scenario;

    fn settings(drivers: &[DriverKind]) -> DriveSettings {
        DriveSettings {
            scenario: Scenario::MovingObserver,
            episodes: 3,
            seed: Seed(5),
            drivers: drivers.to_vec(),
            duration_s: 20.0,
            ..DriveSettings::default()
        }
    }

    #[test]
    fn the_straight_driver_arrives_and_the_same_seed_gives_the_same_drive() {
        let run = || run(None, &settings(&[DriverKind::Pid]), &AtomicBool::new(false), &|_, _| {}).unwrap();
        let scores = run();
        let results = &scores[0].episodes;
        assert!(results.iter().any(|result| result.arrived), "{results:?}");
        for result in results {
            assert!(result.shortest_m >= 1.25 && result.way_m > 0.0);
            // The robot arrives beside the goal, not on it.
            assert!(!result.arrived || result.way_m > result.shortest_m - 0.05, "{result:?}");
        }
        assert_eq!(run()[0].episodes, scores[0].episodes);
    }

    #[test]
    fn with_the_simulator_as_model_fewer_episodes_end_in_a_collision() {
        let mut settings = settings(&[DriverKind::Pid, DriverKind::Simulator]);
        settings.scenario = Scenario::Crowded;
        settings.duration_s = 12.0;
        let scores = run(None, &settings, &AtomicBool::new(false), &|_, _| {}).unwrap();
        let collisions = |scores: &DriverScores| scores.episodes.iter().map(|result| result.collisions).sum::<usize>();
        assert!(collisions(&scores[1]) <= collisions(&scores[0]), "{scores:?}");
        let shortest = |scores: &DriverScores| scores.episodes.iter().map(|r| r.shortest_m).collect::<Vec<_>>();
        assert_eq!(shortest(&scores[0]), shortest(&scores[1]), "the episodes are the same");
    }

    #[test]
    fn a_stopped_drive_gives_the_scores_of_what_is_over() {
        // More than are begun at once.
        let count = 4 * thread::available_parallelism().map_or(1, usize::from);
        let settings = DriveSettings {
            episodes: count,
            ..settings(&[DriverKind::Pid, DriverKind::Simulator])
        };
        let is_stopped = AtomicBool::new(false);
        let scores = run(None, &settings, &is_stopped, &|_, over| {
            is_stopped.store(over >= 2, Ordering::Relaxed);
        })
        .unwrap();
        let episodes = scores[0].episodes.len();
        assert!(scores.len() == 1 && (2..count).contains(&episodes), "{episodes}");
        let whole = DriveSettings { episodes, ..settings };
        let again = run(None, &whole, &AtomicBool::new(false), &|_, _| {}).unwrap();
        assert_eq!(again[0].episodes, scores[0].episodes);
    }

    #[test]
    fn a_driver_without_its_model_is_refused() {
        let error = run(
            None,
            &settings(&[DriverKind::Plan]),
            &AtomicBool::new(false),
            &|_, _| {},
        )
        .unwrap_err();
        assert_eq!(error.to_string(), "driver plan needs a model; name one");
        let still = DriveSettings {
            scenario: Scenario::StaticObserver,
            ..settings(&[DriverKind::Pid])
        };
        let error = run(None, &still, &AtomicBool::new(false), &|_, _| {}).unwrap_err();
        assert!(error.to_string().contains("static-observer"), "{error}");
    }
}
