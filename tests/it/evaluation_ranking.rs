//! Which plan a planner would choose on a recording.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use foreframe_core::registry;
use foreframe_core::types::Seed;
use foreframe_data::dataset::{CollectConfig, Dataset, DatasetInfo, Episode, EpisodeData, collect};
use foreframe_sim::{Scenario, WorldConfig};
use foreframe_train::evaluation::ranking::PlanRanking;
use foreframe_train::evaluation::{self, EvaluateConfig};

use crate::evaluation::config;

/// A simulated data set as if a real robot had recorded it.
fn as_recording(dataset: &Dataset) -> Dataset {
    let episode = |episode: &Episode| {
        let frames = || episode.frames();
        EpisodeData {
            pixels: frames()
                .flat_map(|frame| dataset.pixels(frame).unwrap().into_owned())
                .collect(),
            actions: frames().flat_map(|frame| dataset.action(frame)).copied().collect(),
            states: frames().flat_map(|frame| dataset.state(frame)).copied().collect(),
            timestamps_s: (0..episode.frame_count)
                .map(|nth| nth as f64 * dataset.info().frame_period_s)
                .collect(),
            ..EpisodeData::default()
        }
    };
    let info = DatasetInfo {
        world: None,
        ..dataset.info().clone()
    };
    Dataset::from_episodes(info, dataset.episodes().iter().map(episode).collect()).unwrap()
}

fn ranking(dataset: &Dataset) -> Option<PlanRanking> {
    let model = registry::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("models/moving-flow")).unwrap();
    let config = EvaluateConfig {
        max_windows: 90,
        batch: 32,
        ..config()
    };
    let report = evaluation::run(&model, dataset, &config, &|_| {}).unwrap();
    report.sets[0].outcome.scores().unwrap().ranking.clone()
}

#[test]
fn a_good_model_ranks_the_driven_plan_first() {
    let dir = tempfile::tempdir().unwrap();
    let collection = CollectConfig {
        world: WorldConfig {
            max_duration_s: 5.0,
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::MovingObserver, 70, Seed(31), &dir.path().join("set"))
    };
    collect(&collection, &|_| {}, &AtomicBool::new(false)).unwrap();
    let simulated = Dataset::open(&collection.out).unwrap();
    let found = ranking(&as_recording(&simulated)).unwrap();
    assert!(found.has_mirrored && found.moments >= 20, "{found:?}");
    for rate in &found.rates {
        assert!(rate.rate > 0.6 && rate.chance < 0.13, "{found:?}");
    }
}
