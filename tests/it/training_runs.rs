//! What the directory of a run belongs to: a configuration, the content of a data set, and its description.

use std::fs;

use foreframe_core::frame::warp::CameraModel;
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData};
use foreframe_train::training::TrainError;

use crate::process::output;
use crate::training::{small_config, squares, train, train_until};

const CAMERA: CameraModel = CameraModel {
    horizontal_fov_rad: 1.2,
    tilt_down_rad: 0.1,
    height_m: None,
};

#[test]
fn a_run_is_not_resumed_with_another_camera() {
    let (dataset, config) = (squares(20), small_config(&[]));
    let dir = tempfile::tempdir().unwrap();
    let (killed, complete) = (dir.path().join("killed"), dir.path().join("complete"));
    train_until(&config, &dataset, &killed, 9).unwrap();
    train(&config, &dataset, &complete).unwrap();
    let other = squares(20).with_camera(CAMERA);
    assert_eq!(other.info().content_hash, dataset.info().content_hash);
    for run in [&killed, &complete] {
        let error = train(&config, &other, run).unwrap_err();
        assert!(matches!(error, TrainError::OtherDescription { .. }), "{error}");
        train(&config, &dataset, run).unwrap();
    }
}

#[test]
fn a_run_without_a_description_is_resumed() {
    let (dataset, config) = (squares(20), small_config(&[]));
    let dir = tempfile::tempdir().unwrap();
    train_until(&config, &dataset, dir.path(), 9).unwrap();
    // As an earlier program wrote it.
    fs::write(dir.path().join("dataset.sha256"), &dataset.info().content_hash).unwrap();
    train(&config, &dataset, dir.path()).unwrap();
    let error = train(&config, &squares(21), dir.path()).unwrap_err();
    assert!(
        matches!(error, TrainError::OtherRun { what: "data set", .. }),
        "{error}"
    );
}

#[test]
fn a_damaged_model_is_made_again_from_the_checkpoint() {
    let (dataset, config) = (squares(20), small_config(&[]));
    let dir = tempfile::tempdir().unwrap();
    train(&config, &dataset, dir.path()).unwrap();
    let model = dir.path().join("model");
    let weights = model.join("model.safetensors");
    let before = fs::read(&weights).unwrap();
    let damages: [fn(&std::path::Path); 2] = [
        |path| fs::write(path, b"no weights").unwrap(),
        |path| fs::remove_file(path).unwrap(),
    ];
    for damage in damages {
        damage(&weights);
        let error = train(&config, &dataset, dir.path()).unwrap_err();
        let advice = format!("delete {}, and the same command", model.display());
        assert!(error.to_string().contains(&advice), "{error}");
        fs::remove_dir_all(&model).unwrap();
        train(&config, &dataset, dir.path()).unwrap();
        assert!(fs::read(&weights).unwrap() == before, "the weights differ");
    }
}

/// The squares with all actions multiplied.
fn with_actions(factor: f32) -> Dataset {
    let squares = squares(20);
    let episodes = squares.episodes().iter().map(|episode| EpisodeData {
        timestamps_s: episode.frames().map(|frame| squares.timestamp_s(frame)).collect(),
        pixels: (episode.frames())
            .flat_map(|frame| squares.pixels(frame).unwrap().into_owned())
            .collect(),
        actions: (episode.frames())
            .flat_map(|frame| {
                squares
                    .action(frame)
                    .iter()
                    .map(|value| value * factor)
                    .collect::<Vec<_>>()
            })
            .collect(),
        states: episode
            .frames()
            .flat_map(|frame| squares.state(frame).to_vec())
            .collect(),
        ..EpisodeData::default()
    });
    let info = DatasetInfo {
        has_masks: false,
        content_hash: String::new(),
        ..squares.info().clone()
    };
    Dataset::from_episodes(info, episodes.collect()).unwrap()
}

#[test]
fn small_actions_that_change_are_not_refused() {
    let config = small_config(&["sequence.steps=2"]);
    let dir = tempfile::tempdir().unwrap();
    train(&config, &with_actions(1e-5), &dir.path().join("small")).unwrap();
    let error = train(&config, &with_actions(0.0), &dir.path().join("none")).unwrap_err();
    assert!(matches!(error, TrainError::ConstantActions { .. }), "{error}");
}

#[test]
fn an_impossible_point_of_a_sweep_is_refused_before_the_first_training() {
    let dir = tempfile::tempdir().unwrap();
    crate::recordings::images_with_csv(&dir.path().join("walk"), 300);
    let imported = output(dir.path(), &["import", "walk", "--size", "16x16"]);
    assert!(imported.status.success());
    let sweep =
        "train --preset paper --dataset walk --sweep model.hidden=16,0 --set model.conditioning=none --out swept";
    let refused = output(dir.path(), &sweep.split(' ').collect::<Vec<_>>());
    let error = String::from_utf8(refused.stderr).unwrap();
    assert!(!refused.status.success() && error.contains("hidden"), "{error}");
    assert!(!dir.path().join("swept").exists());
}

#[test]
fn differing_cameras_and_frame_periods_of_joined_data_sets_are_told() {
    let dir = tempfile::tempdir().unwrap();
    for (name, step_ms) in [("walk", 50), ("slow", 53)] {
        let folder = dir.path().join(name);
        crate::recordings::images_with_csv(&folder, 300);
        let lines = (0..300).map(|index| format!("{},{index}.png,0.{}\n", index * step_ms, index % 10));
        let csv = format!("timestamp_ms,file,action.steering\n{}", lines.collect::<String>());
        fs::write(folder.join("log.csv"), csv).unwrap();
    }
    let run = |command: &str| {
        let done = output(dir.path(), &command.split(' ').collect::<Vec<_>>());
        let printed = format!(
            "{}{}",
            String::from_utf8_lossy(&done.stdout),
            String::from_utf8_lossy(&done.stderr)
        );
        assert!(done.status.success(), "{command}: {printed}");
        printed
    };
    run("import walk --size 16x16 --fov 60");
    run("import slow --size 16x16");
    let printed = run(
        "train --preset recording --dataset walk --dataset slow --set sequence.steps=1 --set data.validation_windows=4 --set \
         sequence.batch_size=2 --out run",
    );
    for part in [
        "do not have the same camera (\"walk\" 42.1° wide, tilted down 0.0°; \"slow\" not known)",
        "note: the model cannot be evaluated on one of its data sets: data set \"slow\"",
        "datasets/walk\n",
    ] {
        assert!(printed.contains(part), "{printed}");
    }
    assert!(!printed.contains("datasets/slow\n"), "{printed}");
}
