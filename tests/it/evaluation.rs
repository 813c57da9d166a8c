//! Evaluation: a whole run on a small scene, its files, and refusals.

use std::collections::BTreeSet;
use std::sync::atomic::AtomicBool;

use foreframe_core::nn::{ChannelScale, Conditioning, ModelSpec};
use foreframe_core::registry::Model;
use foreframe_core::types::{Channel, Seed};
use foreframe_data::dataset::{CollectConfig, Dataset, Split, Splits, collect};
use foreframe_sim::{RoomSet, Scenario, WorldConfig};
use foreframe_train::evaluation::actions::Variant;
use foreframe_train::evaluation::method::Method;
use foreframe_train::evaluation::plans::PlanOutcome;
use foreframe_train::evaluation::report::{EvaluationReport, SetOutcome};
use foreframe_train::evaluation::{self, EvaluateConfig, EvaluationError, ScoredSplit};
use serde_json::{Value, json};

use crate::fixtures::{self, moving_squares};

pub(crate) const SIDE: u32 = 16;

pub(crate) fn spec(conditioning: Conditioning) -> ModelSpec {
    ModelSpec {
        context: 4,
        horizon: 3,
        conditioning,
        ..fixtures::squares_spec(SIDE)
    }
}

/// An untrained model whose manifest names this data set as its training data.
pub(crate) fn untrained(name: &str, spec: ModelSpec, dataset: &Dataset) -> Model {
    fixtures::model(
        tempfile::tempdir().unwrap().path(),
        name,
        spec,
        fixtures::stamp(dataset),
    )
}

pub(crate) fn config() -> EvaluateConfig<'static> {
    EvaluateConfig {
        max_windows: 15,
        bootstrap_samples: 100,
        batch: 4,
        command: "foreframe evaluate".to_owned(),
        ..EvaluateConfig::default()
    }
}

fn evaluate(loaded: &Model, dataset: &Dataset, config: &EvaluateConfig) -> Result<EvaluationReport, EvaluationError> {
    evaluation::run(loaded, dataset, config, &|_| {})
}

fn refusal(loaded: &Model, dataset: &Dataset, config: &EvaluateConfig) -> String {
    evaluate(loaded, dataset, config).unwrap_err().to_string()
}

#[test]
fn every_method_is_scored_on_the_one_set_of_a_recording() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::StateAction), &dataset);
    let twin = untrained("twin", spec(Conditioning::None), &dataset);
    let with_twin = EvaluateConfig {
        twins: vec![&twin],
        ..config()
    };
    let report = evaluate(&model, &dataset, &with_twin).unwrap();
    let scores = report.scores("test").unwrap();
    assert_eq!((scores.windows, scores.methods.len()), (15, 10));
    assert!(
        scores.blocks.is_some_and(|blocks| blocks >= 2) && scores.trials.is_none() && scores.windows_available > 15
    );
    assert!(scores.skill.skill.mean <= 0.0, "an untrained model has no skill");
    for row in &scores.methods {
        assert_eq!(row.mse.per_step.len(), 3);
        assert!(row.mover_mse.is_some() && row.ssim.mean <= 1.0);
    }
    let variants = &scores.actions.as_ref().unwrap().rows;
    assert_eq!(variants.len(), 5);
    assert!((variants[0].mse.mean - scores.methods[0].mse.mean).abs() < 1e-9);
    assert_eq!(report.sets.len(), 1, "a recording has no starts, goals or gains");
    assert!(matches!(&scores.plans, Some(PlanOutcome::Skipped { reason }) if reason.contains("recording")));
    assert_eq!(report.stamp.split_seed, Seed(7), "the split is that of the training");
}

#[test]
fn scores_do_not_depend_on_the_batch_size() {
    let dataset = moving_squares(30, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::None), &dataset);
    let first = evaluate(&model, &dataset, &config()).unwrap();
    let larger = EvaluateConfig { batch: 7, ..config() };
    let second = evaluate(&model, &dataset, &larger).unwrap();
    let (first, second) = (first.scores("test").unwrap(), second.scores("test").unwrap());
    assert_eq!(first.samples[0].first_frame, second.samples[0].first_frame);
    assert!((first.skill.skill.mean - second.skill.skill.mean).abs() < 1e-5);
    assert!(first.actions.is_none());
}

#[test]
fn the_nearest_windows_are_among_as_many_as_asked_for() {
    let dataset = moving_squares(30, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::None), &dataset);
    let few = EvaluateConfig {
        nearest_windows: 1,
        ..config()
    };
    let [many, few] = [config(), few].map(|config| evaluate(&model, &dataset, &config).unwrap());
    let [all, one] = [&many, &few].map(|report| report.nearest_windows.unwrap());
    assert_eq!((all.searched, one.searched), (all.available, 1));
    assert!(all.validation_windows > 0 && one.available == all.available);
    assert!(
        few.to_markdown()
            .contains(&format!("1 of {} training windows were searched", one.available))
    );
    let errors = |report: &EvaluationReport| -> Vec<(Method, f64)> {
        let rows = &report.scores("test").unwrap().methods;
        rows.iter().map(|row| (row.method, row.mse.mean)).collect()
    };
    for ((method, with_many), (_, with_few)) in errors(&many).into_iter().zip(errors(&few)) {
        if method == Method::NearestWindows {
            assert!(with_few > 2.0 * with_many, "{with_few} {with_many}");
        } else {
            assert_eq!(with_few, with_many, "{method:?}");
        }
    }
    let none = EvaluateConfig {
        nearest_windows: 0,
        ..config()
    };
    assert!(refusal(&model, &dataset, &none).contains("training windows to search"));
}

#[test]
fn validation_scores_are_of_the_validation_split_alone() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::None), &dataset);
    let validation = EvaluateConfig {
        split: ScoredSplit::Validation,
        ..config()
    };
    let report = evaluate(&model, &dataset, &validation).unwrap();
    let sets: Vec<&str> = report.sets.iter().map(|set| set.split.as_str()).collect();
    assert_eq!(sets, ["validation"]);
    let splits = Splits::new(&dataset, Seed(7));
    let samples = &report.scores("validation").unwrap().samples;
    assert!(
        samples
            .iter()
            .all(|sample| splits.episodes(Split::Validation).contains(&sample.episode))
    );
    assert!(report.to_markdown().contains("Publish test scores"));
}

#[test]
fn each_twin_is_named_by_what_it_lacks() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let model = untrained("both", spec(Conditioning::StateAction), &dataset);
    let twins = [Conditioning::State, Conditioning::Action, Conditioning::None]
        .map(|conditioning| untrained("twin", spec(conditioning), &dataset));
    let with_twins = EvaluateConfig {
        twins: twins.iter().collect(),
        ..config()
    };
    let report = evaluate(&model, &dataset, &with_twins).unwrap();
    let rows = &report.scores("test").unwrap().actions.as_ref().unwrap().rows;
    let variants: Vec<Variant> = rows.iter().skip(4).map(|row| row.variant).collect();
    assert_eq!(
        variants,
        [
            Variant::TwinWithoutAction,
            Variant::TwinWithoutState,
            Variant::UnconditionedTwin
        ]
    );
}

#[test]
fn on_simulated_data_trials_and_gains_are_scored_and_plans_are_compared() {
    let dir = tempfile::tempdir().unwrap();
    let collection = CollectConfig {
        world: WorldConfig {
            frame_width_px: SIDE,
            frame_height_px: SIDE,
            max_duration_s: 3.0,
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::MovingObserver, 100, Seed(2), &dir.path().join("set"))
    };
    collect(&collection, &|_| {}, &AtomicBool::new(false)).unwrap();
    let dataset = Dataset::open(&collection.out).unwrap();
    let scale = |channel: &Channel| ChannelScale {
        name: channel.name.clone(),
        unit: channel.unit.clone(),
        mean: 0.0,
        std: 1.0,
    };
    let spec = ModelSpec {
        actions: dataset.info().action_channels.iter().map(scale).collect(),
        states: dataset.info().state_channels.iter().map(scale).collect(),
        ..spec(Conditioning::StateAction)
    };
    let model = untrained("driving", spec, &dataset);
    let report = evaluate(&model, &dataset, &config()).unwrap();
    // Robots drive on to other goals.
    assert!(matches!(&report.sets[1].outcome, SetOutcome::Skipped { reason } if reason.contains("drive on")));
    for set in report.sets.iter().filter(|set| set.split != "unseen-pairs") {
        let scores = set.outcome.scores().unwrap();
        let ego_motion = scores
            .methods
            .iter()
            .find(|row| row.method == Method::EgoMotion)
            .unwrap();
        assert!(
            ego_motion.mse.mean < scores.methods[1].mse.mean,
            "{}: copying is worse",
            set.split
        );
        let Some(PlanOutcome::Measured(plans)) = &scores.plans else {
            panic!("plans of {}: {:?}", set.split, scores.plans)
        };
        assert_eq!((plans.contexts, plans.plans), (15, 8));
        // Random weights answer to actions at random.
        assert!(plans.rate < 0.8, "{}", plans.rate);
    }
    // The frames of the simulator are changed as those of the data set.
    let brighter = evaluate(&model, &dataset.clone().with_brightness(1.7), &config()).unwrap();
    let brighter = brighter.scores("test").unwrap();
    assert!(
        matches!(&brighter.plans, Some(PlanOutcome::Measured(_))),
        "{:?}",
        brighter.plans
    );
    assert!(brighter.visibility.is_some());
    let figures = evaluation::draw_figures(&model, &dataset, &report).unwrap();
    let files = figures.iter().map(|figure| figure.about.file.as_str());
    let predictions: Vec<&str> = files.filter(|file| file.starts_with("prediction-")).collect();
    assert_eq!(predictions.len(), 6);
    assert_eq!(predictions[3], "prediction-median-unseen-gains.png");
}

#[test]
fn rooms_that_are_only_for_tests_are_scored_as_a_whole() {
    let dir = tempfile::tempdir().unwrap();
    let collection = CollectConfig {
        world: WorldConfig {
            frame_width_px: SIDE,
            frame_height_px: SIDE,
            max_duration_s: 3.0,
            rooms: Some(RoomSet::NewCameras),
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::MovingObserver, 12, Seed(2), &dir.path().join("set"))
    };
    collect(&collection, &|_| {}, &AtomicBool::new(false)).unwrap();
    let dataset = Dataset::open(&collection.out).unwrap();
    let other = moving_squares(40, SIDE, 0.2);
    let every_window = EvaluateConfig {
        max_windows: 1000,
        ..config()
    };
    let report = evaluate(
        &untrained("new", spec(Conditioning::None), &other),
        &dataset,
        &every_window,
    )
    .unwrap();
    assert_eq!(report.stamp.split, ScoredSplit::WholeSet);
    let sets: Vec<&str> = report.sets.iter().map(|set| set.split.as_str()).collect();
    assert_eq!(sets, ["new-cameras"]);
    let scores = report.scores("new-cameras").unwrap();
    assert_eq!((scores.trials, scores.intervals_are_reliable), (Some(12), true));
    let methods: Vec<Method> = scores.methods.iter().map(|row| row.method).collect();
    assert!(methods.contains(&Method::GroundAndWall) && methods.contains(&Method::PlaneSweep));
    assert!(report.headline()["new-cameras"]["skill"].is_number());
    // Of a model that was trained in these rooms, the test split is scored.
    let report = evaluate(
        &untrained("own", spec(Conditioning::None), &dataset),
        &dataset,
        &config(),
    )
    .unwrap();
    assert_eq!(report.stamp.split, ScoredSplit::Test);
}

#[test]
fn all_frames_can_be_darker() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::None), &dataset);
    let darker = dataset.clone().with_brightness(0.5);
    assert_eq!(darker.mask(3).unwrap(), dataset.mask(3).unwrap());
    let [usual, dark] = [&dataset, &darker].map(|dataset| evaluate(&model, dataset, &config()).unwrap());
    let mse = |report: &EvaluationReport, method| {
        let rows = &report.scores("test").unwrap().methods;
        rows.iter().find(|row| row.method == method).unwrap().mse.mean
    };
    // Half the differences are a quarter of the squares, but for rounding.
    for method in [Method::CopyLast, Method::MeanTrainingFrame, Method::EgoMotion] {
        let ratio = mse(&dark, method) / mse(&usual, method);
        assert!((ratio - 0.25).abs() < 0.02, "{method:?} {ratio}");
    }
    let [own, own_dark] = [&usual, &dark].map(|report| mse(report, Method::Model));
    assert!((own - own_dark).abs() > 0.1 * own, "{own} {own_dark}");
    assert_eq!((usual.stamp.brightness, dark.stamp.brightness), (None, Some(0.5)));
    assert!(!usual.to_markdown().contains("brightness"));
    let markdown = dark.to_markdown();
    assert!(
        markdown.contains("inputs and truth, were multiplied by 0.5") && markdown.contains("| brightness |"),
        "{markdown}"
    );
    let json = serde_json::to_value(&dark).unwrap();
    assert_eq!(json["stamp"]["brightness"], 0.5);
    assert_eq!(serde_json::from_value::<EvaluationReport>(json).unwrap(), dark);
    // It is still the data set of the training.
    assert_eq!(dark.stamp.dataset_content_hash, usual.stamp.dataset_content_hash);
    let whole = EvaluateConfig {
        split: ScoredSplit::WholeSet,
        ..config()
    };
    assert!(refusal(&model, &darker, &whole).contains("was trained on data set"));
}

#[test]
fn a_model_trained_elsewhere_has_a_second_skill() {
    let dataset = moving_squares(40, SIDE, 0.2);
    let own = untrained("own", spec(Conditioning::None), &dataset);
    let stranger = untrained("other", spec(Conditioning::None), &moving_squares(20, SIDE, 0.2));
    let [own, other] = [&own, &stranger].map(|model| evaluate(model, &dataset, &config()).unwrap());
    let scores = own.scores("test").unwrap();
    assert_eq!(scores.skill_against_unfitted, None);
    assert!(!own.to_markdown().contains("know nothing") && own.headline()["test"]["skill_against_unfitted"].is_null());

    let scores = other.scores("test").unwrap();
    let second = scores.skill_against_unfitted.as_ref().unwrap();
    assert_eq!(scores.skill.best_mean_baseline, Method::NearestWindows);
    let unfitted = [
        Method::CopyLast,
        Method::MeanOfInputs,
        Method::LinearExtrapolation,
        Method::ConstantShift,
    ];
    let errors = scores.methods.iter().filter(|row| unfitted.contains(&row.method));
    let strongest = errors
        .min_by(|one, other| one.mse.mean.total_cmp(&other.mse.mean))
        .unwrap();
    assert_eq!(second.best_mean_baseline, strongest.method);
    let expected = 1.0 - scores.methods[0].mse.mean / strongest.mse.mean;
    assert!((second.against_best_mean - expected).abs() < 1e-9);
    assert!(second.best_baseline.iter().all(|method| unfitted.contains(method)));
    let steps = second.skill.per_step.iter().zip(&scores.skill.skill.per_step);
    assert!(steps.into_iter().all(|(second, first)| second >= first));
    assert!(second.skill.mean > scores.skill.skill.mean);
    let interval = second.mean_interval.unwrap();
    assert!(interval.low <= second.skill.mean && second.skill.mean <= interval.high);
    let markdown = other.to_markdown();
    let line = format!(
        "- Test part: against baselines that know nothing of this data set, the skill is {:.3} (95 % interval: ",
        second.skill.mean
    );
    assert!(
        markdown.contains(&line) && markdown.contains("This data set is not the one that the model was trained on."),
        "{markdown}"
    );
    let headline = &other.headline()["test"];
    assert_eq!(headline["skill_against_unfitted"], second.skill.mean);
    assert_eq!(headline["strongest_unfitted_baseline"], json!(strongest.method));
}

#[test]
fn an_interval_of_few_blocks_is_marked() {
    let dataset = moving_squares(12, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::None), &dataset);
    let report = evaluate(&model, &dataset, &config()).unwrap();
    let scores = report.scores("test").unwrap();
    let blocks = scores.blocks.unwrap();
    assert!((2..10).contains(&blocks) && !scores.intervals_are_reliable);
    let markdown = report.to_markdown();
    let expected =
        format!("Do not trust the intervals of this set: they rest on {blocks} blocks, and at least 10 are needed.");
    assert!(
        markdown.contains(&expected) && markdown.contains("(do not trust it)"),
        "{markdown}"
    );
    let headline = &report.headline()["test"];
    assert_eq!(
        (&headline["blocks"], &headline["trials"]),
        (&json!(blocks), &Value::Null)
    );
    assert_eq!(headline["skill_interval_is_reliable"], false);
}

#[test]
fn report_and_figures_are_written_and_read_back() {
    let dataset = moving_squares(30, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::Action), &dataset);
    let mut report = evaluate(&model, &dataset, &config()).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("report");
    evaluation::prepare(&out).unwrap();
    let figures = evaluation::draw_figures(&model, &dataset, &report).unwrap();
    evaluation::write(&out, &mut report, &figures).unwrap();
    let written: BTreeSet<String> = std::fs::read_dir(&out)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    let expected = [
        "error-by-horizon.svg",
        "prediction-best.png",
        "prediction-median.png",
        "prediction-worst.png",
        "prediction.gif",
        "reconstruction-best.png",
        "reconstruction-median.png",
        "reconstruction-worst.png",
        "report.json",
        "report.md",
    ];
    assert_eq!(written, expected.map(str::to_owned).into());
    let page = evaluation::html_page(&report, &figures);
    assert!(page.contains("<h1>Model <code>still</code>") && page.contains("<td>copy last frame</td>"));
    for image in ["svg+xml", "png", "gif"] {
        assert!(
            page.contains(&format!("<img src=\"data:image/{image};base64,")),
            "{image}"
        );
    }
    assert!(!page.contains("src=\"prediction"), "every figure is in the page");
    let count = |text: &str| page.matches(text).count();
    assert_eq!((count("<details open>"), count("<details")), (1, count("<h2>")));
    assert_eq!(count("</details>"), count("<h2>"), "each section can be folded");
    let read: EvaluationReport = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(
        read.to_markdown(),
        std::fs::read_to_string(out.join("report.md")).unwrap()
    );
    let again = evaluation::prepare(&out).unwrap_err().to_string();
    assert!(
        again.ends_with("exists and is not an empty directory; name a new one"),
        "{again}"
    );
}

#[test]
fn a_mismatched_data_set_is_refused() {
    let dataset = moving_squares(30, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::StateAction), &dataset);
    assert_eq!(
        refusal(&model, &moving_squares(30, 20, 0.2), &config()),
        "data set \"squares\" has frames of 20×20 px; model \"still\" takes 16×16"
    );
    assert_eq!(
        refusal(&model, &moving_squares(30, SIDE, 0.1), &config()),
        "data set \"squares\" has a frame every 0.1 s; model \"still\" predicts one every 0.2 s"
    );
    let mut turned = spec(Conditioning::StateAction);
    turned.actions[0].unit = "rad/s".to_owned();
    assert_eq!(
        refusal(&untrained("turning", turned, &dataset), &dataset, &config()),
        "data set \"squares\" has the action [speed px/frame]; model \"turning\" takes [speed rad/s]"
    );
    let other_split = EvaluateConfig {
        split_seed: Some(Seed(8)),
        ..config()
    };
    assert!(refusal(&model, &dataset, &other_split).contains("split seed 8 would test it on frames it was trained on"));
    let twin = EvaluateConfig {
        twins: vec![&model],
        ..config()
    };
    assert!(refusal(&model, &dataset, &twin).contains("needs conditioning \"none\""));
    let mut elsewhere = untrained("twin", spec(Conditioning::None), &dataset);
    std::sync::Arc::make_mut(&mut elsewhere.manifest).dataset.content_hash = "0".repeat(64);
    let twin = EvaluateConfig {
        twins: vec![&elsewhere],
        ..config()
    };
    assert!(refusal(&model, &dataset, &twin).contains("it needs the same training data"));
    let none = EvaluateConfig {
        max_windows: 0,
        ..config()
    };
    assert_eq!(
        refusal(&model, &dataset, &none),
        "the number of windows is 0; it must be at least 1"
    );
}

#[test]
fn the_markdown_report_matches_its_snapshot() {
    let dataset = moving_squares(30, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::Action), &dataset);
    let mut report = evaluate(&model, &dataset, &config()).unwrap();
    report.stamp.wall_time_s = 1.5;
    "a processor".clone_into(&mut report.stamp.cpu);
    report.stamp.threads = 2;
    report.stamp.program.git_commit = Some("0123abc".to_owned());
    // The last digits depend on the processor, so numbers are masked.
    let markdown = report.to_markdown();
    let masked: String = markdown.lines().map(|line| mask_numbers(line) + "\n").collect();
    insta::assert_snapshot!(masked);
}

/// Replaces numbers of three or more characters and hashes by `#`.
fn mask_numbers(line: &str) -> String {
    let is_measured = |word: &str| {
        let digits = word.trim_matches(|c: char| !c.is_ascii_alphanumeric());
        let number = digits.chars().all(|c| c.is_ascii_digit() || c == '.');
        (number && digits.len() >= 3) || digits.len() == 64
    };
    let words = line.split(' ').map(|word| if is_measured(word) { "#" } else { word });
    words.collect::<Vec<_>>().join(" ")
}
