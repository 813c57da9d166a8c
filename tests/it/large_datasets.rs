//! Data sets whose frames are read from a file of decoded frames: the same results, and what can go wrong.

use std::borrow::Cow;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use foreframe_core::error_text::with_causes;
use foreframe_core::registry;
use foreframe_data::dataset::export::to_lerobot_images;
use foreframe_data::dataset::{Dataset, DatasetError};
use foreframe_data::inspection::{inspect, page};
use foreframe_train::evaluation::{self, EvaluateConfig};
use foreframe_train::training::{TrainConfig, Training, run};
use serde_json::Value;
use tempfile::TempDir;

use crate::fixtures::moving_squares;
use crate::process::{foreframe, text};
use crate::service::TIMEOUT;

/// A data set on disk, with masks.
struct Stored {
    dir: TempDir,
}

impl Stored {
    fn squares(episodes: usize, side: u32) -> Self {
        let dir = tempfile::tempdir().unwrap();
        to_lerobot_images(&moving_squares(episodes, side, 0.2), &dir.path().join("set"), None).unwrap();
        Self { dir }
    }

    fn path(&self) -> PathBuf {
        self.dir.path().join("set")
    }

    fn in_memory(&self) -> Dataset {
        Dataset::open(&self.path()).unwrap()
    }

    fn in_a_file(&self) -> Dataset {
        Dataset::open_within(&self.path(), 0).unwrap()
    }

    /// The names of the files in the directory of decoded frames.
    fn cached(&self) -> Vec<String> {
        let entries = fs::read_dir(self.path().join(".cache")).unwrap();
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    /// The file of decoded frames.
    fn frame_file(&self) -> PathBuf {
        let names = self.cached();
        assert_eq!(names.len(), 2, "one file and the lock: {names:?}");
        self.path().join(".cache").join(&names[0])
    }

    /// `foreframe inspect` with the frames in a file.
    fn inspect_command(&self) -> Command {
        let mut command = foreframe(self.dir.path());
        command
            .args(["inspect", "./set"])
            .env("FOREFRAME_DATASET_MEMORY_MIB", "0");
        command
    }
}

fn same_frames(a: &Dataset, b: &Dataset) -> bool {
    a.info() == b.info()
        && (0..a.info().frame_count).all(|frame| {
            a.pixels(frame).unwrap() == b.pixels(frame).unwrap()
                && a.mask(frame).unwrap() == b.mask(frame).unwrap()
                && (a.action(frame), a.state(frame)) == (b.action(frame), b.state(frame))
                && a.timestamp_s(frame).to_bits() == b.timestamp_s(frame).to_bits()
        })
}

#[test]
fn frames_from_a_file_equal_those_in_memory() {
    let stored = Stored::squares(30, 9);
    let (memory, file) = (stored.in_memory(), stored.in_a_file());
    assert!(same_frames(&memory, &file) && memory.mask(0).unwrap().is_some());
    let again = stored.in_a_file();
    assert!(same_frames(&memory, &again) && again == file);
}

#[test]
fn only_frames_within_the_limit_are_held_in_memory() {
    // 840 frames and masks of 32×32 px: 1.64 MiB.
    let stored = Stored::squares(60, 32);
    let held = |memory_mib| {
        let dataset = Dataset::open_within(&stored.path(), memory_mib).unwrap();
        let is_borrowed = matches!(dataset.pixels(0).unwrap(), Cow::Borrowed(_));
        (dataset.frame_bytes_in_memory(), is_borrowed)
    };
    assert_eq!(held(2), (840 * 2 * 32 * 32, true));
    assert!(!stored.path().join(".cache").exists(), "a small set needs no file");
    assert_eq!(held(1), (0, false));
    let length = stored.frame_file().metadata().unwrap().len();
    assert_eq!(length, 840 * 2 * (32 * 32 + 4), "the pixels and a checksum for each");
}

fn train(dataset: &Dataset, run_dir: &Path) -> PathBuf {
    let settings = [
        "name=square",
        "model.features=8",
        "model.hidden=12",
        "model.conditioning=state-action",
        "data.windows=all",
        "data.validation_windows=4",
        "pretrain.steps=20",
        "pretrain.batch_size=8",
        "sequence.steps=20",
        "sequence.batch_size=4",
        "run.validate_every_steps=10",
        "run.warmup_steps=5",
    ];
    let config = TrainConfig::layered("paper", None, &settings.map(str::to_owned)).unwrap();
    let training = Training {
        config: &config,
        dataset,
        run_dir,
        command: "test",
        start: None,
    };
    run(&training, &mut |_| {}, &AtomicBool::new(false)).unwrap();
    let model_dir = run_dir.join("model");
    evaluation::calibrate_trained(&model_dir, dataset, &AtomicBool::new(false)).unwrap();
    model_dir
}

#[test]
fn training_from_a_file_ends_with_the_same_bits() {
    let stored = Stored::squares(20, 12);
    let trained = |dataset: &Dataset, name: &str| {
        let model_dir = train(dataset, &stored.dir.path().join(name));
        let history = fs::read(stored.dir.path().join(name).join("history.json")).unwrap();
        let weights = fs::read(model_dir.join(registry::WEIGHTS_FILE)).unwrap();
        (
            history,
            weights,
            registry::load(&model_dir).unwrap().manifest.calibration.clone(),
        )
    };
    let (memory, file) = (
        trained(&stored.in_memory(), "memory"),
        trained(&stored.in_a_file(), "file"),
    );
    assert_eq!(memory, file, "losses, weights and calibration");
}

#[test]
fn an_evaluation_from_a_file_gives_the_same_report() {
    let stored = Stored::squares(20, 12);
    let model = registry::load(&train(&stored.in_memory(), &stored.dir.path().join("run"))).unwrap();
    let config = EvaluateConfig {
        bootstrap_samples: 100,
        ..EvaluateConfig::default()
    };
    let report = |dataset: &Dataset| -> Value {
        // With one thread, sums are added in the same order.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let report = pool
            .install(|| evaluation::run(&model, dataset, &config, &|_| {}))
            .unwrap();
        let mut report = serde_json::to_value(report).unwrap();
        let stamp = report["stamp"].as_object_mut().unwrap();
        stamp.retain(|key, _| !key.ends_with("_s") && !key.contains("time"));
        report
    };
    assert_eq!(report(&stored.in_memory()), report(&stored.in_a_file()));
}

#[test]
fn an_inspection_of_a_file_gives_the_same_page() {
    let stored = Stored::squares(12, 16);
    let inspected = |dataset: &Dataset| {
        let found = inspect(dataset).unwrap();
        (page(&found, dataset).unwrap(), found)
    };
    assert_eq!(inspected(&stored.in_memory()), inspected(&stored.in_a_file()));
}

#[test]
fn a_killed_decoding_is_started_again() {
    let stored = Stored::squares(100, 48);
    let cache = stored.path().join(".cache");
    let has_partial = || {
        let entries = fs::read_dir(&cache).into_iter().flatten().flatten();
        entries.into_iter().any(|entry| {
            let path = entry.path();
            path.extension().is_some_and(|extension| extension == "partial")
                && entry.metadata().is_ok_and(|metadata| metadata.len() > 0)
        })
    };
    let mut program = stored.inspect_command().stdout(Stdio::null()).spawn().unwrap();
    let start = Instant::now();
    while !has_partial() && program.try_wait().unwrap().is_none() {
        assert!(start.elapsed() < TIMEOUT, "nothing was decoded");
    }
    program.kill().unwrap();
    program.wait().unwrap();
    assert!(has_partial(), "it was killed while it wrote");
    assert!(same_frames(&stored.in_a_file(), &stored.in_memory()));
    stored.frame_file();
}

#[test]
fn a_file_of_a_wrong_length_is_written_again() {
    let stored = Stored::squares(5, 9);
    stored.in_a_file();
    fs::write(stored.frame_file(), "cut off").unwrap();
    assert!(same_frames(&stored.in_a_file(), &stored.in_memory()));
}

#[test]
fn another_data_set_in_the_directory_gets_another_file() {
    let (stored, other) = (Stored::squares(5, 9), Stored::squares(6, 9));
    stored.in_a_file();
    let before = stored.frame_file();
    for part in ["data", "meta"] {
        fs::remove_dir_all(stored.path().join(part)).unwrap();
        fs::rename(other.path().join(part), stored.path().join(part)).unwrap();
    }
    assert_eq!(stored.in_a_file().info().episode_count, 6);
    assert!(same_frames(&stored.in_a_file(), &stored.in_memory()));
    assert_ne!(stored.frame_file(), before, "the file of the other data is deleted");
}

#[test]
fn a_changed_shard_is_refused_although_its_frames_are_decoded() {
    let stored = Stored::squares(5, 9);
    stored.in_a_file();
    let shard = stored.path().join("data/chunk-000/file-000.parquet");
    let mut bytes = fs::read(&shard).unwrap();
    bytes[100] ^= 1;
    fs::write(&shard, bytes).unwrap();
    let error = Dataset::open_within(&stored.path(), 0).unwrap_err();
    assert!(matches!(error, DatasetError::HashDiffers { .. }), "{error}");
}

#[test]
fn a_changed_frame_in_the_file_is_refused() {
    let stored = Stored::squares(5, 9);
    stored.in_a_file();
    let path = stored.frame_file();
    let mut bytes = fs::read(&path).unwrap();
    bytes[3 * (81 + 4) + 7] ^= 4;
    fs::write(&path, bytes).unwrap();
    let dataset = stored.in_a_file();
    assert!(dataset.pixels(2).is_ok() && dataset.pixels(4).is_ok());
    let error = dataset.pixels(3).unwrap_err().to_string();
    assert!(
        error.contains(path.to_str().unwrap()) && error.contains("frame 3") && error.contains("delete this file"),
        "{error}"
    );
}

#[test]
fn a_directory_that_cannot_be_written_is_named_with_what_to_do() {
    let stored = Stored::squares(5, 9);
    fs::write(stored.path().join(".cache"), "a file").unwrap();
    let error = with_causes(&Dataset::open_within(&stored.path(), 0).unwrap_err());
    assert!(
        error.starts_with("could not write the decoded frames of the data set (1 MiB) to")
            && error.contains("dataset_memory_mib=1"),
        "{error}"
    );
}

/// Runs a command whose files may have at most 8 KiB, as on a full disk.
#[cfg(unix)]
fn with_small_files(stored: &Stored) -> Output {
    let inspect = stored.inspect_command();
    let mut shell = Command::new("sh");
    shell.args(["-c", "trap '' XFSZ; ulimit -f 16; exec \"$0\" \"$@\""]);
    shell.arg(inspect.get_program()).args(inspect.get_args());
    for (name, value) in inspect.get_envs() {
        match value {
            Some(value) => shell.env(name, value),
            None => shell.env_remove(name),
        };
    }
    shell.current_dir(stored.dir.path()).output().unwrap()
}

#[cfg(unix)]
#[test]
fn a_full_disk_leaves_nothing_behind() {
    let stored = Stored::squares(30, 32);
    let refused = with_small_files(&stored);
    let error = text(&refused.stderr);
    assert!(
        !refused.status.success()
            && error.contains("could not write the decoded frames")
            && error.contains("free disk space"),
        "{error}"
    );
    assert_eq!(stored.cached(), ["lock"]);
    assert!(same_frames(&stored.in_a_file(), &stored.in_memory()));
}

#[test]
fn programs_that_start_at_once_share_one_file() {
    let stored = Stored::squares(40, 24);
    let programs: Vec<_> = (0..3)
        .map(|_| stored.inspect_command().stdout(Stdio::piped()).spawn().unwrap())
        .collect();
    let outputs: Vec<Output> = programs
        .into_iter()
        .map(|program| program.wait_with_output().unwrap())
        .collect();
    assert!(
        outputs
            .iter()
            .all(|output| output.status.success() && output.stdout == outputs[0].stdout)
    );
    stored.frame_file();
    assert!(same_frames(&stored.in_a_file(), &stored.in_memory()));
}
