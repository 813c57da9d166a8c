//! Moving digits as a data set: what it is made of, how it is continued, refusals, training and scores.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use flate2::Compression;
use flate2::write::GzEncoder;
use foreframe_core::frame::quality::ssim_even;
use foreframe_core::frame::{Frame, codec};
use foreframe_core::registry;
use foreframe_core::types::Seed;
use foreframe_data::dataset::moving_mnist::{MovingMnistConfig, collect_digits};
use foreframe_data::dataset::{Dataset, DatasetError, DatasetInfo, Split, Splits};
use foreframe_sim::moving_digits::moving_digits;
use foreframe_train::evaluation::method::Method;
use foreframe_train::evaluation::{self, EvaluateConfig, ScoredSplit};
use foreframe_train::training::{TrainConfig, Training, run};

use crate::process::{output, text};

const DIGIT_PIXELS: usize = 28 * 28;
const SIDE: usize = 64;
/// Pixels that a digit can move along a side.
const FREE_PX: f64 = 36.0;

/// An IDX file of even squares, one of each gray value.
fn idx(values: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    for word in [2051, values.len() as u32, 28, 28] {
        bytes.extend(word.to_be_bytes());
    }
    bytes.extend(values.iter().flat_map(|&value| [value; DIGIT_PIXELS]));
    bytes
}

/// A folder as MNIST's: 30 training digits with values from 1, compressed, and 5 test digits with values from 201.
fn digits(dir: &Path) -> PathBuf {
    let folder = dir.join("digits");
    fs::create_dir_all(&folder).unwrap();
    let train: Vec<u8> = (1..=30).collect();
    let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
    gzip.write_all(&idx(&train)).unwrap();
    fs::write(folder.join("train-images-idx3-ubyte.gz"), gzip.finish().unwrap()).unwrap();
    fs::write(folder.join("t10k-images-idx3-ubyte"), idx(&[201, 202, 203, 204, 205])).unwrap();
    folder
}

fn config(digits: &Path, out: &Path, trials: u64) -> MovingMnistConfig {
    MovingMnistConfig {
        digits: digits.to_owned(),
        trials,
        frames: 20,
        seed: Seed(5),
        out: out.to_owned(),
    }
}

fn collected(config: &MovingMnistConfig) -> DatasetInfo {
    collect_digits(config, &|_| {}, &AtomicBool::new(false)).unwrap()
}

fn refusal(config: &MovingMnistConfig) -> String {
    collect_digits(config, &|_| {}, &AtomicBool::new(false))
        .unwrap_err()
        .to_string()
}

/// The gray values of a split, without black.
fn values(dataset: &Dataset, splits: &Splits, split: Split) -> Vec<u8> {
    let episodes = splits
        .episodes(split)
        .iter()
        .map(|&episode| &dataset.episodes()[episode]);
    let frames = episodes.flat_map(|episode| episode.frames().map(|frame| dataset.pixels(frame).unwrap()));
    let mut values: Vec<u8> = frames.flat_map(std::borrow::Cow::into_owned).collect();
    values.retain(|&value| value > 0);
    values.sort_unstable();
    values.dedup();
    values
}

/// A digit that is one bright pixel in its upper left corner.
fn point() -> [u8; DIGIT_PIXELS] {
    let mut digit = [0; DIGIT_PIXELS];
    digit[0] = 255;
    digit
}

/// Column and row of that pixel in each frame of a trial.
fn path(seed: u64, frames: usize) -> Vec<[f64; 2]> {
    let frames = moving_digits(&[&point()], frames, &mut Seed(seed).rng());
    let place = |frame: &[u8]| frame.iter().position(|&pixel| pixel > 0).unwrap();
    let places = frames.chunks_exact(SIDE * SIDE).map(place);
    places.map(|at| [(at % SIDE) as f64, (at / SIDE) as f64]).collect()
}

#[test]
fn a_digit_keeps_its_speed_and_stays_inside() {
    for seed in 0..20 {
        let path = path(seed, 60);
        assert!(path.iter().flatten().all(|&place| place <= FREE_PX));
        let most = [0, 1].map(|side: usize| {
            let steps = path.windows(2).map(|pair| (pair[1][side] - pair[0][side]).abs());
            steps.fold(0.0, f64::max)
        });
        // 3.6 px a frame; cutting to whole pixels changes it by less than one along each side.
        let speed = most[0].hypot(most[1]);
        assert!((3.0..=5.1).contains(&speed), "seed {seed}: {speed}");
    }
}

#[test]
fn borders_turn_a_digit_round() {
    let path = path(3, 200);
    for side in 0..2 {
        let places: Vec<f64> = path.iter().map(|place| place[side]).collect();
        assert!(places.contains(&0.0) && places.contains(&FREE_PX), "{places:?}");
    }
}

#[test]
fn of_two_digits_the_brighter_pixel_stays() {
    let [bright, dark] = [200, 90].map(|value| [value; DIGIT_PIXELS]);
    let frames = |digits: &[&[u8; DIGIT_PIXELS]]| moving_digits(digits, 40, &mut Seed(1).rng());
    // The first digit's path does not depend on the second.
    let (alone, both) = (frames(&[&bright]), frames(&[&bright, &dark]));
    assert!(
        alone
            .iter()
            .zip(&both)
            .all(|(&alone, &both)| alone == 0 || both == alone)
    );
    let (alone, both) = (frames(&[&dark]), frames(&[&dark, &bright]));
    assert!(
        alone
            .iter()
            .zip(&both)
            .any(|(&alone, &both)| alone == 90 && both == 200)
    );
}

#[test]
fn even_ssim_agrees_with_scikit_image() {
    let wave = |step: f64, phase: f64| -> Vec<f32> {
        (0..12 * 14)
            .map(|i| (0.5 + 0.4 * (f64::from(i) * step + phase).sin()) as f32)
            .collect()
    };
    let (a, b) = (wave(0.37, 0.0), wave(0.41, 0.8));
    // structural_similarity(a, b, data_range=1.0) of scikit-image 0.26.0.
    let expected = -0.177_036_495_655_82;
    assert!(
        (ssim_even(&a, &b, 14) - expected).abs() < 1e-6,
        "{}",
        ssim_even(&a, &b, 14)
    );
    assert!((ssim_even(&a, &a, 14) - 1.0).abs() < 1e-9);
}

#[test]
fn no_digit_is_in_two_splits() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let info = collected(&config(&digits(dir.path()), &out, 60));
    assert_eq!((info.episode_count, info.frame_count), (60, 1200));
    let dataset = Dataset::open(&out).unwrap();
    let splits = Splits::new(&dataset, Seed(1));
    assert_eq!(splits.episodes(Split::Test).len(), 6);
    assert!(values(&dataset, &splits, Split::Test).iter().all(|&value| value > 200));
    let kept = |&value: &u8| value <= 30 && value % 10 == 1;
    assert!(values(&dataset, &splits, Split::Validation).iter().all(kept));
    assert!(
        values(&dataset, &splits, Split::Train)
            .iter()
            .all(|value| *value <= 30 && !kept(value))
    );
}

#[test]
fn a_stopped_collection_continues_to_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let folder = digits(dir.path());
    let whole = config(&folder, &dir.path().join("whole"), 60);
    let stopped = config(&folder, &dir.path().join("stopped"), 60);
    let cancelled = AtomicBool::new(false);
    let after_a_shard = collect_digits(
        &stopped,
        &|now| cancelled.store(now.done > 0, Ordering::Relaxed),
        &cancelled,
    );
    assert!(matches!(
        after_a_shard,
        Err(DatasetError::Cancelled { done: 50, total: 60 })
    ));
    assert_eq!(collected(&stopped).content_hash, collected(&whole).content_hash);
    let other = MovingMnistConfig { trials: 61, ..stopped };
    assert!(refusal(&other).contains("trials: 60 in the directory, 61 requested"));
}

#[test]
fn a_folder_of_png_images_gives_the_same_digits() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("png");
    fs::create_dir_all(folder.join("0")).unwrap();
    let values: Vec<u8> = (1..=20).collect();
    for value in &values {
        let frame = Frame::new(28, 28, vec![*value; DIGIT_PIXELS]).unwrap();
        let path = folder.join(format!("0/{value:03}.png"));
        fs::write(path, codec::encode_png(&frame).unwrap()).unwrap();
    }
    let file = dir.path().join("digits.idx");
    fs::write(&file, idx(&values)).unwrap();
    let hashes = [folder, file].map(|source| {
        let out = source.with_extension("set");
        collected(&config(&source, &out, 10)).content_hash
    });
    assert_eq!(hashes[0], hashes[1]);
}

#[test]
fn files_that_hold_no_digits_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("digits.idx");
    let refused = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        let text = refusal(&config(&path, &dir.path().join("set"), 10));
        assert!(text.contains("digits.idx cannot be used as digits: "), "{text}");
        text
    };
    let whole = idx(&[1; 20]);
    assert!(refused(&whole[..whole.len() - 1]).contains("states 20 images"));
    assert!(refused(b"P5 28 28").contains("ends within its header"));
    assert!(refused(&[0; 100]).contains("does not begin as an IDX file"));
    assert!(refused(&[0x1f, 0x8b, 8, 0, 1, 2]).contains("compression is damaged"));
    assert!(refused(&idx(&[1; 9])).contains("9 digits were found; at least 10"));
    let folder = dir.path().join("png");
    fs::create_dir(&folder).unwrap();
    let text = refusal(&config(&folder, &dir.path().join("set"), 10));
    assert!(text.contains("it holds no PNG images"), "{text}");
    let narrow = Frame::new(14, 56, vec![1; DIGIT_PIXELS]).unwrap();
    fs::write(folder.join("narrow.png"), codec::encode_png(&narrow).unwrap()).unwrap();
    let text = refusal(&config(&folder, &dir.path().join("set"), 10));
    assert!(text.contains("it has 14×56 px; a digit has 28×28 px"), "{text}");
    fs::write(&path, &whole).unwrap();
    let few = config(&path, &dir.path().join("set"), 9);
    assert!(refusal(&few).contains("9 trials are too few"));
    assert!(!few.out.exists(), "a refused collection leaves nothing");
}

#[test]
fn a_model_is_trained_and_scored_as_papers_do() {
    let dir = tempfile::tempdir().unwrap();
    let folder = digits(dir.path());
    let [seen, other] = ["seen", "other"].map(|name| {
        let out = dir.path().join(name);
        let (trials, seed) = if name == "seen" { (20, 5) } else { (12, 6) };
        collected(&MovingMnistConfig {
            seed: Seed(seed),
            ..config(&folder, &out, trials)
        });
        Dataset::open(&out).unwrap()
    });
    let small = [
        "model.sprites={ channels = 8, stem_channels = 6, encoder_blocks = 1, enlarged_channels = 2, fine_channels = 3, \
         content_channels = 4, motion_hidden = 8, motion_memory = 4 }",
        "data.validation_windows=2",
        "sequence.steps=2",
        "sequence.batch_size=2",
    ];
    let preset = TrainConfig::preset("moving-mnist").unwrap().model_spec(&seen, &[]);
    assert!((13_000_000..15_000_000).contains(&preset.multiply_adds_per_frame()));
    let train = TrainConfig::layered("moving-mnist", None, &small.map(str::to_owned)).unwrap();
    let training = Training {
        config: &train,
        dataset: &seen,
        run_dir: &dir.path().join("run"),
        command: "a test",
        start: None,
    };
    run(
        &training,
        &mut |_: foreframe_train::training::TrainingEvent| {},
        &AtomicBool::new(false),
    )
    .unwrap();
    let loaded = registry::load(&dir.path().join("run/model")).unwrap();
    let whole = EvaluateConfig {
        split: ScoredSplit::WholeSet,
        bootstrap_samples: 100,
        ..EvaluateConfig::default()
    };
    let report = evaluation::run(&loaded, &other, &whole, &|_| {}).unwrap();
    let figures = evaluation::draw_figures(&loaded, &other, &report).unwrap();
    assert!(figures.iter().any(|figure| figure.about.file == "prediction.gif"));
    let scores = report.scores("whole-set").unwrap();
    assert_eq!((scores.windows, scores.blocks), (12, Some(12)));
    for row in &scores.methods {
        let benchmark = row.benchmark.as_ref().unwrap();
        assert!((benchmark.squared_error.mean - 4096.0 * row.mse.mean).abs() < 1e-6);
        assert_eq!(benchmark.ssim.per_step.len(), 10);
    }
    let has = |method| scores.methods.iter().any(|row| row.method == method);
    assert!(has(Method::Black) && !has(Method::NearestWindows));
    let markdown = report.to_markdown();
    assert!(markdown.contains("Squared error, sum over a frame"));
    assert!(
        !markdown.contains(Method::CodecOnly.label()),
        "it draws no frame through a codec"
    );
    let error = evaluation::run(&loaded, &seen, &whole, &|_| {})
        .unwrap_err()
        .to_string();
    assert!(error.contains("score its test split"), "{error}");
}

#[test]
fn commands_name_what_is_missing_and_what_comes_next() {
    let dir = tempfile::tempdir().unwrap();
    digits(dir.path());
    let collect = |arguments: &str| {
        let common = "collect --scenario moving-mnist --out ";
        let arguments: Vec<&str> = common.split_whitespace().chain(arguments.split_whitespace()).collect();
        let output = output(dir.path(), &arguments);
        text(&output.stdout) + &text(&output.stderr)
    };
    assert!(collect("set").contains("needs --digits: a folder with train-images-idx3-ubyte.gz"));
    assert!(collect("set --digits nowhere").contains("could not read nowhere"));
    assert!(collect("short --digits digits --frames 15 --trials 10").contains("as with --frames 20"));
    let made = collect("set --digits digits --trials 10");
    assert!(made.contains("10 trials, 200 frames of 64×64 px"), "{made}");
    assert!(
        made.contains("next: foreframe train --preset moving-mnist --dataset set"),
        "{made}"
    );
    let simulated = output(dir.path(), &["collect", "--digits", "digits", "--out", "other"]);
    assert!(text(&simulated.stderr).contains("--digits is for --scenario moving-mnist"));
}

/// MNIST's files, if they lie beside the repository or where `FOREFRAME_TEST_MNIST` says.
fn mnist() -> Option<PathBuf> {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mnist");
    let path = std::env::var_os("FOREFRAME_TEST_MNIST").map_or_else(beside, PathBuf::from);
    path.join("train-images-idx3-ubyte.gz").is_file().then_some(path)
}

#[test]
fn copying_the_last_frame_scores_as_measured_elsewhere() {
    let Some(source) = mnist() else {
        eprintln!("skipped: no digits; set FOREFRAME_TEST_MNIST to a directory with MNIST's IDX files");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    collected(&config(&source, &out, 200));
    let dataset = Dataset::open(&out).unwrap();
    let squared_error = |a: usize, b: usize| -> f64 {
        let [a, b] = [a, b].map(|frame| dataset.pixels(frame).unwrap());
        a.iter()
            .zip(b.iter())
            .map(|(&a, &b)| ((f64::from(a) - f64::from(b)) / 255.0).powi(2))
            .sum()
    };
    let episodes = dataset.episodes().iter();
    let errors = episodes.flat_map(|episode| {
        let first = episode.first_frame;
        (first + 10..first + 20).map(move |frame| (first + 9, frame))
    });
    let errors: Vec<f64> = errors.map(|(last, frame)| squared_error(last, frame)).collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    // 285.9 by another program's generator.
    assert!((265.0..305.0).contains(&mean), "{mean}");
}
