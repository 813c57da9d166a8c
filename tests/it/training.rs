//! Training: both stages on a small moving scene, resuming, refusals, and divergence.

use std::cell::Cell;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use foreframe_core::frame::warp::CameraModel;
use foreframe_core::registry::{self, StoredWeights};
use foreframe_core::types::{Channel, Seed};
use foreframe_data::dataset::{CollectConfig, Dataset, DatasetInfo, EpisodeData, Split, Splits, collect};
use foreframe_sim::{Scenario, TrialParameters, WorldConfig};
use foreframe_train::settings::SettingsLayer;
use foreframe_train::training::{TrainConfig, TrainError, Training, TrainingEvent, TrainingOutcome, run};

use crate::fixtures::moving_squares;

pub(crate) fn squares(episodes: usize) -> Dataset {
    moving_squares(episodes, 12, 0.2)
}

#[test]
fn a_resumed_flow_training_ends_with_the_same_bits() {
    let small = [
        "name=square",
        "data.windows=40",
        "data.validation_windows=4",
        "sequence.steps=12",
        "sequence.batch_size=4",
        "model.flow={ channels = 8, stem_channels = 6, enlarged_channels = 3, fine_channels = 5, scene_hidden = 8 }",
        "run.validate_every_steps=5",
        "run.checkpoint_every_steps=4",
        "run.warmup_steps=3",
    ];
    let camera_stands = [
        "model.conditioning=none",
        "model.flow.recurrent=true",
        "data.mirror=movers",
        "data.reverse=true",
        "sequence.short_share=0.5",
        "sequence.short_horizon=2",
        "run.optimizer=muon",
    ];
    let dataset = squares(20);
    for other in [&[][..], &camera_stands] {
        let settings: Vec<String> = small.iter().chain(other).map(|&setting| setting.to_owned()).collect();
        let config = TrainConfig::layered("moving-flow", None, &settings).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let (unbroken, broken) = (dir.path().join("unbroken"), dir.path().join("broken"));
        train(&config, &dataset, &unbroken).unwrap();
        for updates in [2, 5] {
            train_until(&config, &dataset, &broken, updates).unwrap();
        }
        train(&config, &dataset, &broken).unwrap();
        assert_eq!(weights(&broken), weights(&unbroken), "the last checkpoints differ");
        // Each of the settings changes what is learned.
        let changes = [
            "data.mirror=off",
            "data.reverse=false",
            "sequence.short_share=0",
            "run.optimizer=adam",
        ];
        for without in changes {
            if other.is_empty() {
                continue;
            }
            let settings: Vec<String> = settings.iter().cloned().chain([without.to_owned()]).collect();
            let config = TrainConfig::layered("moving-flow", None, &settings).unwrap();
            let changed = dir.path().join(without);
            train(&config, &dataset, &changed).unwrap();
            assert!(weights(&changed) != weights(&unbroken), "{without} changes nothing");
        }
    }
}

#[test]
fn settings_that_do_not_fit_the_network_or_the_camera_are_refused() {
    for (preset, setting, expected) in [
        (
            "paper",
            "run.optimizer=muon",
            "run.optimizer is for the flow and sprite networks only; it must be adam where model.architecture is dense",
        ),
        (
            "paper",
            "sequence.short_share=0.5",
            "sequence.short_share is for the flow network only; it must be 0 where model.architecture is dense",
        ),
        (
            "moving-flow",
            "pretrain.start=principal",
            "pretrain.start is for the dense network only; it must be random where model.architecture is flow",
        ),
        (
            "moving-flow",
            "sequence.feedback=teacher-forcing",
            "sequence.feedback is for the dense network only; it must be prediction where model.architecture is flow",
        ),
        (
            "moving-mnist",
            "sequence={ short_share = 0.5, short_horizon = 6 }",
            "sequence.short_share is for the flow network only; it must be 0 where model.architecture is sprites",
        ),
        (
            "moving-mnist",
            "sequence.movers_weight=0.5",
            "sequence.movers_weight is for the flow network only; it must be 0 where model.architecture is sprites",
        ),
        (
            "moving-mnist",
            "sequence.reconstruction_weight=0",
            "sequence.reconstruction_weight is 0, but the sprite network learns what the sprites look like from the frames that it sees; \
             it must be above 0 where model.architecture is sprites",
        ),
        (
            "static-flow",
            "sequence={ short_share = 0.5, short_horizon = 6 }",
            "sequence.short_horizon is 6; it must be 1 to model.horizon, 5",
        ),
        (
            "moving-flow",
            "data.mirror=movers",
            "data.mirror is \"movers\", which is for a camera that stands and takes no actions and no state; \
             model.conditioning is state-action: set it to none, or data.mirror to off",
        ),
        (
            "moving",
            "data.reverse=true",
            "data.reverse is true, but actions and states do not fit a window that is played backwards; \
             model.conditioning is state-action: set it to none, or data.reverse to false",
        ),
    ] {
        let error = TrainConfig::layered(preset, None, &[setting.to_owned()]).unwrap_err();
        assert_eq!(error.to_string(), expected);
    }
    let error = TrainConfig::layered("static-flow", None, &["data.mirror=movrs".to_owned()]).unwrap_err();
    assert!(
        error.to_string().contains("\"movers\" (for a camera that stands)"),
        "{error}"
    );
    let (noise, dir) = (standing(None), tempfile::tempdir().unwrap());
    let config = small_config(&["model.conditioning=none", "data.mirror=movers"]);
    let error = train(&config, &noise, dir.path()).unwrap_err().to_string();
    assert!(
        error.contains("and at most 40 % may: probably the camera moves"),
        "{error}"
    );
}

pub(crate) fn small_config(extra: &[&str]) -> TrainConfig {
    let small = [
        "name=square",
        "model.features=8",
        "model.hidden=12",
        "model.conditioning=state-action",
        "data.windows=40",
        "data.validation_windows=4",
        "pretrain.steps=30",
        "pretrain.batch_size=8",
        "sequence.steps=30",
        "sequence.batch_size=4",
        "run.validate_every_steps=10",
        "run.checkpoint_every_steps=7",
        "run.warmup_steps=5",
    ];
    let settings: Vec<String> = small.iter().chain(extra).map(|&setting| setting.to_owned()).collect();
    TrainConfig::layered("paper", None, &settings).unwrap()
}

pub(crate) fn train(config: &TrainConfig, dataset: &Dataset, dir: &Path) -> Result<TrainingOutcome, TrainError> {
    train_until(config, dataset, dir, usize::MAX)
}

/// Trains until this call has made `updates` updates.
pub(crate) fn train_until(
    config: &TrainConfig,
    dataset: &Dataset,
    dir: &Path,
    updates: usize,
) -> Result<TrainingOutcome, TrainError> {
    let cancelled = AtomicBool::new(false);
    let made = Cell::new(0);
    let training = Training {
        config,
        dataset,
        run_dir: dir,
        command: "test",
        start: None,
    };
    let mut observer = |event: TrainingEvent| {
        if let TrainingEvent::Step { .. } = event {
            made.set(made.get() + 1);
            cancelled.store(made.get() >= updates, Ordering::Relaxed);
        }
    };
    run(&training, &mut observer, &cancelled)
}

fn weights(dir: &Path) -> Vec<u8> {
    std::fs::read(dir.join("checkpoint.safetensors")).unwrap()
}

#[test]
fn a_stopped_and_resumed_run_has_the_same_bits() {
    let (dataset, config) = (squares(20), small_config(&[]));
    let dir = tempfile::tempdir().unwrap();
    let uninterrupted = dir.path().join("uninterrupted");
    train(&config, &dataset, &uninterrupted).unwrap();
    for (name, stops) in [
        ("early", vec![1, 12]),
        ("codec", vec![30]),
        ("late", vec![25, 20, 14]),
        ("often", vec![9; 5]),
    ] {
        let resumed = dir.path().join(name);
        for updates in stops {
            let outcome = train_until(&config, &dataset, &resumed, updates).unwrap();
            assert!(
                matches!(outcome, TrainingOutcome::Interrupted { .. }),
                "{name}: {outcome:?}"
            );
        }
        train(&config, &dataset, &resumed).unwrap();
        assert_eq!(
            weights(&resumed),
            weights(&uninterrupted),
            "{name}: the last checkpoints differ"
        );
        let model = |run: &Path| std::fs::read(run.join("model").join(registry::WEIGHTS_FILE)).unwrap();
        assert_eq!(
            model(&resumed),
            model(&uninterrupted),
            "{name}: the published weights differ"
        );
    }
}

#[test]
fn training_lowers_the_loss_and_publishes_a_model() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    let config = small_config(&[
        "pretrain.steps=300",
        "sequence.steps=300",
        "pretrain.start=random",
        "pretrain.learning_rate=1e-2",
        "model.features=16",
        "model.hidden=24",
    ]);
    let first = Cell::new(None);
    let last = Cell::new(0.0);
    let training = Training {
        config: &config,
        dataset: &dataset,
        run_dir: dir.path(),
        command: "test",
        start: None,
    };
    let mut observer = |event: TrainingEvent| {
        if let TrainingEvent::Step { loss, .. } = event {
            first.set(first.get().or(Some(loss)));
            last.set(loss);
        }
    };
    let outcome = run(&training, &mut observer, &AtomicBool::new(false)).unwrap();
    assert!(
        last.get() < 0.5 * first.get().unwrap(),
        "loss went from {:?} to {}",
        first.get(),
        last.get()
    );
    let TrainingOutcome::Finished { model_dir, manifest } = outcome else {
        panic!("{outcome:?}")
    };
    let loaded = registry::load(&model_dir).unwrap();
    assert_eq!(loaded.manifest.weights_sha256, manifest.weights_sha256);
    assert_eq!(loaded.manifest.spec.actions[0].name, "speed");
}

/// The validation loss of the first step, from new weights or from those of a model.
fn first_loss(config: &TrainConfig, dataset: &Dataset, start: Option<&StoredWeights>) -> Result<f64, TrainError> {
    let dir = tempfile::tempdir().unwrap();
    let training = Training {
        config,
        dataset,
        run_dir: dir.path(),
        command: "test",
        start,
    };
    let mut first = None;
    let mut observer = |event: TrainingEvent| {
        if let TrainingEvent::Step { loss, .. } = event {
            first.get_or_insert(loss);
        }
    };
    run(&training, &mut observer, &AtomicBool::new(false))?;
    Ok(first.unwrap())
}

#[test]
fn a_training_can_start_from_a_model() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    train(&small_config(&["sequence.steps=200"]), &dataset, dir.path()).unwrap();
    let start = registry::load_weights(&dir.path().join("model")).unwrap();
    let layers = ["sequence.steps=2", "seed=7"].map(|setting| SettingsLayer::assignment(setting).unwrap());
    let config = TrainConfig::of_model(&start.manifest, layers).unwrap();
    assert_eq!((config.pretrain.steps, config.sequence.steps), (0, 2));
    let (tuned, new) = (
        first_loss(&config, &dataset, Some(&start)).unwrap(),
        first_loss(&config, &dataset, None).unwrap(),
    );
    assert!(tuned < 0.7 * new, "{tuned} {new}");
}

#[test]
fn a_fine_tuned_model_names_its_origin_and_can_be_tuned_again() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    train(&small_config(&[]), &dataset, &dir.path().join("first")).unwrap();
    let mut start = registry::load_weights(&dir.path().join("first/model")).unwrap();
    for name in ["second", "third"] {
        let config = TrainConfig::of_model(
            &start.manifest,
            [SettingsLayer::assignment("sequence.steps=3").unwrap()],
        )
        .unwrap();
        let run_dir = dir.path().join(name);
        let training = Training {
            config: &config,
            dataset: &dataset,
            run_dir: &run_dir,
            command: "test",
            start: Some(&start),
        };
        run(&training, &mut |_: TrainingEvent| (), &AtomicBool::new(false)).unwrap();
        let tuned = registry::load_weights(&run_dir.join("model")).unwrap();
        let origin = &tuned.manifest.training["from"]["weights_sha256"];
        assert_eq!(origin.as_str(), Some(start.manifest.weights_sha256.as_str()));
        start = tuned;
    }
}

#[test]
fn weights_for_other_units_are_refused() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    train(&small_config(&["sequence.steps=2"]), &dataset, dir.path()).unwrap();
    let mut start = registry::load_weights(&dir.path().join("model")).unwrap();
    start.manifest.spec.actions[0].unit = "km/h".to_owned();
    let message = first_loss(&small_config(&[]), &dataset, Some(&start))
        .unwrap_err()
        .to_string();
    assert!(
        message.contains("takes the action [speed km/h], and the data set has [speed px/frame]"),
        "{message}"
    );
    // A refused training leaves no files, so that the next one can have the directory.
    let config = small_config(&[]);
    let run_dir = dir.path().join("next");
    let training = Training {
        config: &config,
        dataset: &dataset,
        run_dir: &run_dir,
        command: "test",
        start: Some(&start),
    };
    run(&training, &mut |_: TrainingEvent| (), &AtomicBool::new(false)).unwrap_err();
    assert!(!run_dir.join("config.toml").exists());
}

#[test]
fn weights_of_another_network_are_refused() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    train(&small_config(&[]), &dataset, dir.path()).unwrap();
    let start = registry::load_weights(&dir.path().join("model")).unwrap();
    let error = first_loss(&small_config(&["model.hidden=16"]), &dataset, Some(&start)).unwrap_err();
    let message = error.to_string();
    assert!(
        message.starts_with("the training cannot start from the model \"square\": "),
        "{message}"
    );
    assert!(
        message.ends_with("it needs the same frame size, layers and numbers of channels"),
        "{message}"
    );
}

#[test]
fn a_mirror_needs_channels_that_exist() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    train(
        &small_config(&["data.mirror=[\"speed\"]", "data.brightness=0.2"]),
        &dataset,
        dir.path(),
    )
    .unwrap();
    let other = tempfile::tempdir().unwrap();
    let error = train(&small_config(&["data.mirror=[\"sped\"]"]), &dataset, other.path()).unwrap_err();
    let message = error.to_string();
    assert!(
        message.starts_with("data.mirror names \"sped\", which is no channel of this data set; there are: speed"),
        "{message}"
    );
}

#[test]
fn windows_can_be_cut_out_where_no_camera_model_is_known() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    let (whole, cut, refused) = (dir.path().join("whole"), dir.path().join("cut"), dir.path().join("no"));
    train(&small_config(&[]), &dataset, &whole).unwrap();
    let config = small_config(&["data.crop=0.2"]);
    train(&config, &dataset, &cut).unwrap();
    assert!(weights(&whole) != weights(&cut));
    let config = small_config(&["data.crop=0.2", "model.conditioning=none"]);
    let error = train(&config, &standing(CameraModel::new(1.0, 0.2).ok()), &refused).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("it must be 0 for a data set with a camera model"),
        "{error}"
    );
    let error = TrainConfig::layered("recording", None, &["data.crop=0.6".to_owned()]).unwrap_err();
    assert_eq!(error.to_string(), "data.crop is 0.6; it must be 0 to 0.5");
}

#[test]
fn a_finished_run_is_not_trained_again() {
    let (dataset, config, dir) = (squares(20), small_config(&[]), tempfile::tempdir().unwrap());
    train(&config, &dataset, dir.path()).unwrap();
    let outcome = train_until(&config, &dataset, dir.path(), 1).unwrap();
    assert!(matches!(outcome, TrainingOutcome::Finished { .. }));
}

#[test]
fn a_diverging_run_keeps_its_last_good_checkpoint() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    let config = small_config(&[
        "sequence.learning_rate=1",
        "sequence.codec=fine-tuned",
        "run.clip_norm=1e6",
        "run.warmup_steps=0",
        "sequence.steps=500",
    ]);
    let error = train(&config, &dataset, dir.path()).unwrap_err();
    let TrainError::Diverged {
        stage,
        step,
        checkpoint_step,
        ..
    } = &error
    else {
        panic!("{error}")
    };
    assert_eq!(stage.to_string(), "sequence");
    assert!(checkpoint_step < step && step - checkpoint_step <= 7, "{error}");
    assert!(dir.path().join("checkpoint.safetensors").is_file());
    assert!(!dir.path().join("model").exists());
    let again = train(&config, &dataset, dir.path()).unwrap_err();
    assert_eq!(
        again.to_string(),
        error.to_string(),
        "the same checkpoint leads to the same error"
    );
}

#[test]
fn a_validation_error_that_is_no_number_ends_the_training() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    let settings = [
        "name=square",
        "data.windows=40",
        "data.validation_windows=4",
        "sequence.steps=1",
        "sequence.batch_size=4",
        "sequence.learning_rate=1",
        "model.flow={ channels = 8, stem_channels = 6, enlarged_channels = 3, fine_channels = 5, scene_hidden = 8 }",
        "run.clip_norm=1e6",
        "run.warmup_steps=0",
    ];
    let config = TrainConfig::layered("moving-flow", None, &settings.map(str::to_owned)).unwrap();
    let error = train(&config, &dataset, dir.path()).unwrap_err().to_string();
    assert!(error.contains("at step 1: the validation loss is"), "{error}");
    assert!(!dir.path().join("model").exists());
}

#[test]
fn a_run_with_other_settings_or_data_is_not_resumed() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    train_until(&small_config(&[]), &dataset, dir.path(), 3).unwrap();
    let error = train(&small_config(&["seed=2"]), &dataset, dir.path())
        .unwrap_err()
        .to_string();
    assert!(error.contains("holds a run with another configuration"), "{error}");
    let error = train(&small_config(&[]), &squares(22), dir.path())
        .unwrap_err()
        .to_string();
    assert!(error.contains("holds a run with another data set"), "{error}");
}

#[test]
fn two_runs_cannot_share_a_directory() {
    let (dataset, dir) = (squares(20), tempfile::tempdir().unwrap());
    train_until(&small_config(&[]), &dataset, dir.path(), 3).unwrap();
    let config = std::fs::File::open(dir.path().join("config.toml")).unwrap();
    config.lock().unwrap();
    let error = train(&small_config(&[]), &dataset, dir.path()).unwrap_err();
    assert!(error.to_string().contains("another training is running"), "{error}");
    drop(config);
    train(&small_config(&[]), &dataset, dir.path()).unwrap();
}

#[test]
fn a_foreign_directory_is_refused_and_unchanged() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("thesis.tex"), "precious").unwrap();
    let error = train(&small_config(&[]), &squares(20), dir.path()).unwrap_err();
    assert!(matches!(error, TrainError::NotARun(_)), "{error}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn files_of_a_killed_start_are_replaced() {
    let (dataset, config) = (squares(20), small_config(&[]));
    for left in ["dataset.sha256.partial", "dataset.sha256", "config.toml.partial"] {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(left), "ha").unwrap();
        train_until(&config, &dataset, dir.path(), 1).unwrap();
    }
}

#[test]
fn a_truncated_checkpoint_is_not_used() {
    let (dataset, config) = (squares(20), small_config(&[]));
    let (whole, resumed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    train(&config, &dataset, whole.path()).unwrap();
    train_until(&config, &dataset, resumed.path(), 10).unwrap();
    let path = resumed.path().join("checkpoint.safetensors");
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    // The training starts again, or resumes from the checkpoint before, and ends with the same weights.
    train(&config, &dataset, resumed.path()).unwrap();
    let weights = |dir: &Path| std::fs::read(dir.join("model/model.safetensors")).unwrap();
    assert!(weights(whole.path()) == weights(resumed.path()));
}

/// Recordings of a camera that stands still: the actions are always 0.
fn standing(camera: Option<CameraModel>) -> Dataset {
    let data = |episode: usize| EpisodeData {
        pixels: (0..14 * 144).map(|at| ((at * 7 + episode * 13) % 251) as u8).collect(),
        actions: vec![0.0; 14],
        timestamps_s: (0..14).map(|frame| f64::from(frame) * 0.2).collect(),
        ..EpisodeData::default()
    };
    let info = DatasetInfo {
        name: "standing".to_owned(),
        frame_width_px: 12,
        frame_height_px: 12,
        frame_period_s: 0.2,
        action_channels: vec![Channel::new("speed", "m/s")],
        camera,
        ..DatasetInfo::default()
    };
    Dataset::from_episodes(info, (0..20).map(data).collect()).unwrap()
}

#[test]
fn actions_that_never_change_are_refused_unless_allowed() {
    let dir = tempfile::tempdir().unwrap();
    let refused = train(
        &small_config(&["model.conditioning=action"]),
        &standing(None),
        dir.path(),
    )
    .unwrap_err();
    assert_eq!(
        refused.to_string(),
        "data set \"standing\" has actions that never change (its camera stands still); a model with conditioning \"action\" \
         learns nothing from them: use a preset or a model for a standing camera, or model.conditioning=none, or allow it with \
         data.constant_actions=true"
    );
    let allowed = small_config(&[
        "model.conditioning=action",
        "data.constant_actions=true",
        "sequence.steps=2",
    ]);
    train(&allowed, &standing(None), dir.path()).unwrap();
}

#[test]
fn an_impossible_camera_model_is_refused() {
    let info = DatasetInfo {
        frame_width_px: 12,
        frame_height_px: 12,
        frame_period_s: 0.2,
        camera: Some(CameraModel {
            horizontal_fov_rad: 4.0,
            tilt_down_rad: 0.0,
            height_m: None,
        }),
        ..DatasetInfo::default()
    };
    let error = Dataset::from_episodes(info, Vec::new()).unwrap_err().to_string();
    assert!(error.contains("a field of view of 4 rad"), "{error}");
}

#[test]
fn a_data_set_without_training_windows_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("two-trials");
    let is_usual =
        |seed: &Seed| (0..2).all(|trial| !TrialParameters::draw(Scenario::MovingObserver, *seed, trial).is_held_out());
    let seed = (0..100).map(Seed).find(is_usual).unwrap();
    let mut two_trials = CollectConfig::new(Scenario::MovingObserver, 2, seed, &out);
    two_trials.world = WorldConfig {
        frame_width_px: 12,
        frame_height_px: 12,
        max_duration_s: 4.0,
        ..WorldConfig::default()
    };
    collect(&two_trials, &|_| {}, &AtomicBool::new(false)).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    // Find a split that puts one trial into validation and none into training.
    let split_seed = (0..10_000)
        .find(|&seed| {
            let splits = Splits::new(&dataset, Seed(seed));
            splits.episodes(Split::Train).is_empty() && !splits.episodes(Split::Validation).is_empty()
        })
        .unwrap();
    let config = small_config(&["data.windows=all", &format!("data.split_seed={split_seed}")]);
    let run_dir = dir.path().join("run");
    let error = train(&config, &dataset, &run_dir).unwrap_err();
    assert!(
        matches!(error, TrainError::NoWindows { train: 0, validation, .. } if validation > 0),
        "{error}"
    );
    assert!(
        error.to_string().contains("has 0 training windows and")
            && error.to_string().contains("training needs at least 1 of each"),
        "{error}"
    );
    assert!(!run_dir.exists());
}

#[test]
fn too_many_windows_are_refused_with_their_number() {
    let dir = tempfile::tempdir().unwrap();
    let error = train(&small_config(&["data.windows=100000"]), &squares(20), dir.path())
        .unwrap_err()
        .to_string();
    assert!(error.contains("100000"), "{error}");
}

#[test]
fn a_window_longer_than_every_episode_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let error = train(&small_config(&["model.context=10"]), &squares(20), dir.path())
        .unwrap_err()
        .to_string();
    assert!(error.contains("15 frames") && error.contains("14 frames"), "{error}");
}
