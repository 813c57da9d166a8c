//! What an inspection finds: faults planted in simulated data, and a real recording.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use foreframe_core::types::Seed;
use foreframe_data::dataset::import::{DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportOptions, import};
use foreframe_data::dataset::{CollectConfig, Dataset, DatasetInfo, EpisodeData, collect};
use foreframe_data::inspection::{FramePlace, FrozenSpan, Inspection, MotionSignal, inspect, page};
use foreframe_sim::{Scenario, WorldConfig};

/// Episodes of a driving camera, so that every action moves the image.
fn driving() -> (DatasetInfo, Vec<EpisodeData>) {
    let dir = tempfile::tempdir().unwrap();
    let config = CollectConfig {
        world: WorldConfig {
            frame_width_px: 32,
            frame_height_px: 32,
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::MovingObserver, 24, Seed(3), &dir.path().join("set"))
    };
    collect(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
    let dataset = Dataset::open(&config.out).unwrap();
    let episodes = dataset.episodes().iter().map(|episode| EpisodeData {
        timestamps_s: episode.frames().map(|frame| dataset.timestamp_s(frame)).collect(),
        pixels: episode
            .frames()
            .flat_map(|frame| dataset.pixels(frame).unwrap().into_owned())
            .collect(),
        actions: episode
            .frames()
            .flat_map(|frame| dataset.action(frame).to_vec())
            .collect(),
        states: episode
            .frames()
            .flat_map(|frame| dataset.state(frame).to_vec())
            .collect(),
        ..EpisodeData::default()
    });
    (dataset.info().clone(), episodes.collect())
}

fn inspected(info: &DatasetInfo, episodes: Vec<EpisodeData>) -> (Inspection, Dataset) {
    let info = DatasetInfo {
        content_hash: String::new(),
        ..info.clone()
    };
    let dataset = Dataset::from_episodes(info, episodes).unwrap();
    (inspect(&dataset).unwrap(), dataset)
}

/// Delay and motion of the turning speed.
fn turning(inspection: &Inspection) -> (f64, MotionSignal) {
    let delay = inspection
        .delays
        .iter()
        .find(|delay| delay.action == "angular")
        .unwrap();
    (delay.delay_frames.unwrap(), delay.motion)
}

#[test]
fn planted_faults_are_found_and_nothing_else() {
    let (info, mut episodes) = driving();
    let (clean, _) = inspected(&info, episodes.clone());
    let (delay, motion) = turning(&clean);
    assert!(delay.abs() < 1.0 && motion == MotionSignal::Sideways, "{delay}");
    assert_eq!((clean.images.frozen.len(), clean.images.exposure_jumps.len()), (0, 0));
    assert_eq!(clean.warnings, Vec::<String>::new());

    let size = info.frame_pixels();
    for episode in &mut episodes {
        // Actions are recorded two frames before they act.
        let last = episode.actions[episode.actions.len() - 2..].repeat(2);
        episode.actions.drain(..4);
        episode.actions.extend(last);
    }
    let still = episodes[3].pixels[10 * size..11 * size].repeat(5);
    episodes[3].pixels[11 * size..16 * size].copy_from_slice(&still);
    for pixel in &mut episodes[5].pixels[20 * size..] {
        *pixel /= 2;
    }
    episodes[7]
        .timestamps_s
        .iter_mut()
        .skip(8)
        .for_each(|time_s| *time_s += 5.0);
    let (faulty, dataset) = inspected(&info, episodes);
    let (delay, _) = turning(&faulty);
    assert!((delay - 2.0).abs() < 0.6, "{delay}");
    let first = FramePlace { episode: 3, frame: 10 };
    assert_eq!(faulty.images.frozen, [FrozenSpan { first, frames: 6 }]);
    let jumps: Vec<FramePlace> = faulty.images.exposure_jumps.iter().map(|jump| jump.place).collect();
    assert_eq!(jumps, [FramePlace { episode: 5, frame: 20 }]);
    assert_eq!(faulty.timing.gaps.len(), 1);
    for expected in [
        "1 gap is within an episode, after episode 7 frame 7",
        "The image is frozen in 1 place, from episode 3 frame 10; the longest has 6 equal frames (1.2 s)",
        "The exposure jumps 1 time, at episode 5 frame 20",
        "The image follows the action \"angular\" 2.",
    ] {
        assert!(
            faulty.warnings.iter().any(|text| text.starts_with(expected)),
            "{:#?}",
            faulty.warnings
        );
    }
    let page = page(&faulty, &dataset).unwrap();
    // 24 pictures of the contact sheet, and two of each place.
    assert_eq!(page.matches("<img").count(), 24 + 2 + 2);
    assert!(!page.contains("http") && !page.contains("NaN"));
}

#[test]
fn a_recording_without_actions_is_inspected() {
    let (info, mut episodes) = driving();
    for episode in &mut episodes {
        (episode.actions, episode.states) = (Vec::new(), Vec::new());
    }
    let info = DatasetInfo {
        action_channels: Vec::new(),
        state_channels: Vec::new(),
        ..info
    };
    let (inspection, dataset) = inspected(&info, episodes);
    assert!(inspection.channels.is_empty() && inspection.warnings.is_empty());
    assert!(
        page(&inspection, &dataset)
            .unwrap()
            .contains("only images were recorded")
    );
}

/// The real recording, if it lies beside the repository or where `FOREFRAME_TEST_DONKEYCAR` says.
fn donkeycar() -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/donkeycar");
    let path = std::env::var_os("FOREFRAME_TEST_DONKEYCAR").map_or_else(beside, PathBuf::from);
    path.join("manifest.json").is_file().then_some(path)
}

#[test]
fn steering_of_a_real_car_moves_the_image_later() {
    let Some(source) = donkeycar() else {
        eprintln!("skipped: no recording; set FOREFRAME_TEST_DONKEYCAR to the directory of a Donkeycar tub");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("car");
    let config = ImportConfig {
        source,
        out: out.clone(),
        options: ImportOptions::default(),
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    };
    import(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
    let inspection = inspect(&Dataset::open(&out).unwrap()).unwrap();
    assert_eq!((inspection.frame_count, inspection.timing.frame_period_s), (5854, 0.05));
    let steering = &inspection.delays[0];
    assert!(
        steering.delay_frames.is_some_and(|frames| (1.0..6.0).contains(&frames)),
        "{steering:?}"
    );
    assert!(
        steering.is_long() && steering.motion == MotionSignal::Sideways,
        "{steering:?}"
    );
    assert!(inspection.images.frozen.is_empty() && inspection.images.exposure_jumps.is_empty());
}
