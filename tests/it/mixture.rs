//! Training on several data sets at once.

use serde_json::Value;

use super::fixtures::moving_squares;
use super::process::output;
use foreframe_core::types::{Channel, Seed};
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData, Lacking, Split, Splits, WindowShape};

/// A data set of another name, whose episodes are those of the moving squares from `first` on, with changed description.
fn part(name: &str, episodes: usize, change: impl FnOnce(&mut DatasetInfo)) -> Dataset {
    let squares = moving_squares(episodes, 12, 0.2);
    let data = squares.episodes().iter().map(|episode| {
        let frames: Vec<usize> = episode.frames().collect();
        let each = |values: &dyn Fn(usize) -> Vec<f32>| frames.iter().flat_map(|&frame| values(frame)).collect();
        EpisodeData {
            timestamps_s: frames.iter().map(|&frame| squares.timestamp_s(frame)).collect(),
            pixels: frames
                .iter()
                .flat_map(|&frame| squares.pixels(frame).unwrap().into_owned())
                .collect(),
            // A second channel before that of the squares.
            actions: each(&|frame| vec![9.0, squares.action(frame)[0]]),
            states: each(&|frame| squares.state(frame).to_vec()),
            ..EpisodeData::default()
        }
    });
    let mut info = DatasetInfo {
        name: name.to_owned(),
        action_channels: vec![Channel::new("horn", ""), Channel::new("speed", "px/frame")],
        has_masks: false,
        content_hash: String::new(),
        ..squares.info().clone()
    };
    change(&mut info);
    Dataset::from_episodes(info, data.collect()).unwrap()
}

#[test]
fn the_frames_of_joined_data_sets_can_be_darker() {
    let (first, second) = (moving_squares(12, 12, 0.2), part("second", 20, |_| {}));
    let half = |pixels: &[u8]| -> Vec<u8> { pixels.iter().map(|&pixel| pixel.div_ceil(2)).collect() };
    let join = |first: Dataset| Dataset::join(vec![(first, 1.0), (second.clone(), 1.0)], Lacking::NotKnown).unwrap();
    let (one_darker, all_darker) = (
        join(first.clone().with_brightness(0.5)),
        join(first.clone()).with_brightness(0.5),
    );
    let offset = first.info().frame_count;
    assert_eq!(*one_darker.pixels(5).unwrap(), half(&first.pixels(5).unwrap()));
    assert_eq!(one_darker.pixels(offset + 5).unwrap(), second.pixels(5).unwrap());
    assert_eq!(
        *all_darker.pixels(offset + 5).unwrap(),
        half(&second.pixels(5).unwrap())
    );
    for darker in [one_darker, all_darker] {
        assert_eq!(darker.mask(5).unwrap(), first.mask(5).unwrap());
        assert_eq!(darker.mask(offset + 5).unwrap(), None);
    }
}

#[test]
fn joined_data_sets_keep_their_frames_and_splits() {
    let (first, second) = (moving_squares(12, 12, 0.2), part("second", 20, |_| {}));
    let joined = Dataset::join(vec![(first.clone(), 1.0), (second.clone(), 3.0)], Lacking::Refused).unwrap();
    assert_eq!(joined.info().name, "squares+second");
    assert_eq!(
        joined.parts().iter().map(|part| part.share).collect::<Vec<_>>(),
        [0.25, 0.75]
    );
    let offset = first.info().frame_count;
    for frame in [0, 30, second.info().frame_count - 1] {
        assert_eq!(joined.pixels(offset + frame).unwrap(), second.pixels(frame).unwrap());
        // The channel "horn", which the first data set does not have, is left out.
        assert_eq!(joined.action(offset + frame), &second.action(frame)[1..]);
        assert_eq!(joined.timestamp_s(offset + frame), second.timestamp_s(frame));
    }
    assert_eq!(joined.pixels(offset - 1).unwrap(), first.pixels(offset - 1).unwrap());
    // Each data set is split as if it were alone.
    let shape = WindowShape { context: 3, horizon: 2 };
    let windows = |dataset: &Dataset, split| {
        let windows = Splits::new(dataset, Seed(3)).windows(dataset, split, shape, 1).unwrap();
        windows.into_iter().map(|window| window.first_frame).collect::<Vec<_>>()
    };
    for split in [Split::Train, Split::Validation, Split::Test] {
        let moved = windows(&second, split).into_iter().map(|frame| frame + offset);
        let expected: Vec<usize> = windows(&first, split).into_iter().chain(moved).collect();
        assert_eq!(windows(&joined, split), expected, "{split}");
    }
}

#[test]
fn data_sets_that_do_not_fit_are_refused() {
    let refused = |other: Dataset, weight| {
        let joined = Dataset::join(
            vec![(moving_squares(3, 12, 0.2), 1.0), (other, weight)],
            Lacking::Refused,
        );
        joined.unwrap_err().to_string()
    };
    let error = refused(moving_squares(3, 16, 0.2), 1.0);
    assert!(error.contains("12×12 px") && error.contains("16×16 px"), "{error}");
    let error = refused(part("slow", 3, |info| info.frame_period_s = 0.5), 1.0);
    assert!(
        error.contains("every 0.2 s") && error.contains("every 0.5 s"),
        "{error}"
    );
    let error = refused(
        part("other", 3, |info| {
            info.action_channels[1] = Channel::new("speed", "m/s");
        }),
        1.0,
    );
    assert!(
        error.contains("lacks the action channel") && error.contains("px/frame"),
        "{error}"
    );
    let error = refused(moving_squares(3, 12, 0.2), 1.0);
    assert!(error.contains("have the same content"), "{error}");
    let error = refused(part("light", 3, |_| {}), 0.0);
    assert!(error.contains("must be above 0"), "{error}");
    assert!(Dataset::join(Vec::new(), Lacking::Refused).is_err());
}

/// The settings of a training that takes a second.
const SMALL: [&str; 7] = [
    "model.features=8",
    "model.hidden=12",
    "data.validation_windows=4",
    "pretrain.steps=4",
    "sequence.steps=6",
    "sequence.batch_size=4",
    "data.windows=all",
];

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

#[test]
fn a_training_on_two_data_sets_reports_both() {
    let dir = tempfile::tempdir().unwrap();
    for (name, seed) in [("a", "1"), ("b", "2")] {
        let made = output(
            dir.path(),
            &[
                "collect",
                "--scenario",
                "static-observer",
                "--trials",
                "20",
                "--seed",
                seed,
                "--out",
                name,
            ],
        );
        assert!(made.status.success(), "{}", text(&made.stderr));
    }
    let settings: Vec<&str> = SMALL.iter().flat_map(|setting| ["--set", setting]).collect();
    let train = |datasets: &[&str]| output(dir.path(), &[&["train", "--out", "run"], datasets, &settings].concat());
    let refused = train(&["--dataset", "a", "--dataset", "b=none"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        text(&refused.stderr).contains("write NAME=WEIGHT"),
        "{}",
        text(&refused.stderr)
    );
    let trained = train(&["--dataset", "a", "--dataset", "b=0.25"]);
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    let said = text(&trained.stdout);
    assert!(
        said.contains("--dataset a\n") && said.contains("--dataset b\n"),
        "{said}"
    );
    let manifest: Value =
        serde_json::from_slice(&std::fs::read(dir.path().join("run/model/manifest.json")).unwrap()).unwrap();
    let parts = manifest["dataset"]["parts"].as_array().unwrap();
    assert_eq!(
        parts
            .iter()
            .map(|part| part["share"].as_f64().unwrap())
            .collect::<Vec<_>>(),
        [0.8, 0.2]
    );
    let validation = &manifest["metrics"]["validation"];
    let mse = |part: usize| validation["datasets"][part]["mse"].as_f64().unwrap();
    let mean = 0.8 * mse(0) + 0.2 * mse(1);
    assert!(
        (validation["mse"].as_f64().unwrap() - mean).abs() < 1e-9,
        "{validation}"
    );
    // The run is of both: with one of them, it cannot be continued.
    let other = train(&["--dataset", "a"]);
    assert!(text(&other.stderr).contains("data set"), "{}", text(&other.stderr));
}
