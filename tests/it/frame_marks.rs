//! Frames of a training in another data set: what the manifest keeps of them, and what an evaluation says of them.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use foreframe_core::nn::Conditioning;
use foreframe_core::registry::{self, DatasetStamp, Model};
use foreframe_data::dataset::{Dataset, Split, Splits};
use foreframe_train::evaluation::report::EvaluationReport;
use foreframe_train::evaluation::{self, EvaluateConfig, ScoredSplit};
use foreframe_train::training::{TrainConfig, Training, TrainingEvent, run};
use serde_json::json;

use crate::evaluation::{SIDE, config, spec};
use crate::fixtures::{self, frame_marks, moving_squares};

/// A model that was trained on other data; these are the frames that it says it was trained on.
fn trained_elsewhere(frame_marks: Vec<u64>) -> Model {
    let trained_on = DatasetStamp {
        frame_marks,
        ..fixtures::stamp(&moving_squares(20, SIDE, 0.2))
    };
    let dir = tempfile::tempdir().unwrap();
    fixtures::model(dir.path(), "still", spec(Conditioning::None), trained_on)
}

fn evaluate(model: &Model, dataset: &Dataset, split: ScoredSplit) -> Result<EvaluationReport, String> {
    let config = EvaluateConfig { split, ..config() };
    evaluation::run(model, dataset, &config, &|_| {}).map_err(|error| error.to_string())
}

fn verdict(report: &EvaluationReport) -> String {
    report.verdict(&report.sets[0]).unwrap()
}

#[test]
fn a_manifest_keeps_marks_of_the_training_frames_and_of_those_of_its_base() {
    let (dataset, dir) = (moving_squares(20, 12, 0.2), tempfile::tempdir().unwrap());
    let settings = [
        "name=square",
        "model.features=8",
        "model.hidden=12",
        "data.windows=all",
        "pretrain.steps=1",
        "sequence.steps=1",
    ];
    let config = TrainConfig::layered("paper", None, &settings.map(str::to_owned)).unwrap();
    let trained = |name: &str, start| {
        let training = Training {
            config: &config,
            dataset: &dataset,
            run_dir: &dir.path().join(name),
            command: "test",
            start,
        };
        run(&training, &mut |_: TrainingEvent| (), &AtomicBool::new(false)).unwrap();
        registry::load_weights(&dir.path().join(name).join("model")).unwrap()
    };
    let mut base = trained("base", None);
    let splits = Splits::new(&dataset, config.data.split_seed);
    let windows = splits
        .windows(&dataset, Split::Train, config.window_shape(), 1)
        .unwrap();
    let frames = |start| start..start + config.window_shape().frames();
    let expected = frame_marks(&dataset, windows.iter().flat_map(|window| frames(window.first_frame)));
    assert_eq!(base.manifest.dataset.frame_marks, expected);

    base.manifest.dataset.frame_marks = vec![1, 2];
    let tuned = trained("tuned", Some(&base)).manifest.dataset.frame_marks;
    assert_eq!(tuned, [&[1, 2], &expected[..]].concat());
}

#[test]
fn frames_of_the_training_do_not_test_the_model() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let model = trained_elsewhere(frame_marks(&dataset, 0..dataset.info().frame_count));
    let told = evaluate(&model, &dataset, ScoredSplit::WholeSet).unwrap_err();
    assert!(
        told.contains(" sampled frames of data set \"squares\" were in the training of model \"still\""),
        "{told}"
    );
    let report = evaluate(&model, &dataset, ScoredSplit::Test).unwrap();
    let scores = report.scores("test").unwrap();
    let frames = scores.frames_of_training.unwrap();
    assert!(frames.sampled > 2 && frames.seen == frames.sampled, "{frames:?}");
    assert_eq!(scores.skill_against_unfitted, None);
    assert_eq!(report.headline()["test"]["frames_of_training"], json!(frames));
    let told = verdict(&report);
    let seen = format!("; {0} of {0} sampled frames were in the model's training", frames.seen);
    assert!(told.contains(&seen), "{told}");
    let markdown = report.to_markdown();
    assert!(
        markdown.contains(&told) && markdown.contains("\nFrames of this data set were in the model's training."),
        "{markdown}"
    );
    assert!(!markdown.contains("was not trained on"), "{markdown}");
    // Marks are of the frames as they are stored.
    let darker = evaluate(&model, &dataset.with_brightness(0.5), ScoredSplit::Test).unwrap();
    assert_eq!(darker.scores("test").unwrap().frames_of_training, Some(frames));
}

#[test]
fn frames_are_new_where_the_marks_say_so() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let others = dataset.clone().with_brightness(0.5);
    let model = trained_elsewhere(frame_marks(&others, 0..others.info().frame_count));
    let report = evaluate(&model, &dataset, ScoredSplit::Test).unwrap();
    let scores = report.scores("test").unwrap();
    let frames = scores.frames_of_training.unwrap();
    assert!(frames.sampled > 2 && frames.seen == 0 && scores.skill_against_unfitted.is_some());
    let markdown = report.to_markdown();
    let sampled = format!(
        "- Test part: of {} sampled frames, the training had 0.\n",
        frames.sampled
    );
    assert!(
        markdown.contains("\nThe model was not trained on this data set.\n\n- Test") && markdown.contains(&sampled),
        "{markdown}"
    );
    // A model of an earlier program has no marks.
    let report = evaluate(&trained_elsewhere(Vec::new()), &dataset, ScoredSplit::Test).unwrap();
    assert_eq!(report.scores("test").unwrap().frames_of_training, None);
    let markdown = report.to_markdown();
    assert!(
        markdown.contains("Whether the training had some of its frames is not known.") && !markdown.contains("sampled"),
        "{markdown}"
    );
}

#[test]
fn the_report_on_a_whole_data_set_does_not_speak_of_its_training_part() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let report = evaluate(&trained_elsewhere(Vec::new()), &dataset, ScoredSplit::WholeSet).unwrap();
    let told = verdict(&report);
    assert!(
        told.ends_with("; there is no baseline of nearest training windows here, so the skill may be too high"),
        "{told}"
    );
    let markdown = report.to_markdown();
    assert!(markdown.contains("| Whole data set (`whole-set`) |"), "{markdown}");
    for text in [
        "training split",
        "training part",
        "Unseen trials",
        "of the 8 nearest training windows",
    ] {
        assert!(!markdown.contains(text), "{text}: {markdown}");
    }
}

#[test]
fn a_baseline_that_knows_few_windows_is_told() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let with_windows = |windows| {
        let mut model = trained_elsewhere(Vec::new());
        Arc::make_mut(&mut model.manifest).dataset.windows = windows;
        evaluate(&model, &dataset, ScoredSplit::Test).unwrap()
    };
    let report = with_windows(40_469);
    let known = report.nearest_windows.unwrap().available;
    let told = verdict(&report);
    let expected = format!(
        "; the baseline of nearest training windows knows {known}, and the model was trained on 40 469, so the skill may be too high"
    );
    assert!(told.ends_with(&expected), "{told}");
    assert!(!verdict(&with_windows(10 * known)).contains("too high"));
}

#[test]
fn scores_of_another_data_set_are_not_replaced() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let mut model = trained_elsewhere(Vec::new());
    let check =
        |model: &Model, split| evaluation::check_saving(model, &dataset, split).map_err(|error| error.to_string());
    for split in [ScoredSplit::Test, ScoredSplit::WholeSet] {
        assert_eq!(check(&model, split), Ok(()), "a model without scores");
    }
    Arc::make_mut(&mut model.manifest).metrics =
        json!({"test": {"dataset_content_hash": "0"}, "validation": {"mse": 1.0}});
    let told = check(&model, ScoredSplit::Test).unwrap_err();
    assert!(
        told.starts_with("model \"still\" has scores \"test\" of another data set"),
        "{told}"
    );
    assert!(check(&model, ScoredSplit::Validation).is_err());
    assert_eq!(check(&model, ScoredSplit::WholeSet), Ok(()));
    let hash = &dataset.info().content_hash;
    Arc::make_mut(&mut model.manifest).metrics["test"]["dataset_content_hash"] = json!(hash);
    assert_eq!(check(&model, ScoredSplit::Test), Ok(()), "the same data set");
    Arc::make_mut(&mut model.manifest).metrics["test"]["dataset_content_hash"] = json!("0");
    Arc::make_mut(&mut model.manifest).dataset = fixtures::stamp(&dataset);
    assert_eq!(check(&model, ScoredSplit::Test), Ok(()), "the data set of the training");
}
