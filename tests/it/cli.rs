//! The command line: what its commands write, exit codes and error messages.

use std::fs;
use std::path::Path;
use std::process::Command;

use foreframe_core::files::sha256_hex;
use foreframe_core::nn::Conditioning;
use serde_json::{Value, json};

use crate::process::{output, text};
use crate::service;

const PROGRAM: &str = env!("CARGO_BIN_EXE_foreframe");

/// Runs a command line in a directory; returns the exit code and standard error.
fn run(dir: &Path, line: &str) -> (i32, String) {
    exit_of(Command::new(PROGRAM).args(line.split_whitespace()).current_dir(dir))
}

fn exit_of(command: &mut Command) -> (i32, String) {
    let output = command.output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(!text.contains("panicked"), "{text}");
    (output.status.code().unwrap(), text)
}

fn succeed(dir: &Path, line: &str) -> String {
    let output = Command::new(PROGRAM)
        .args(line.split_whitespace())
        .current_dir(dir)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{line}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    String::from_utf8(output.stdout).unwrap()
}

/// A directory with a small data set under its default name, and models `plain` and `moving` of another frame size.
fn working_dir() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    succeed(dir.path(), "collect --trials 3 --frame-size 8");
    for (name, conditioning) in [("plain", Conditioning::None), ("moving", Conditioning::StateAction)] {
        service::model(&dir.path().join("models"), name, service::spec(conditioning));
    }
    dir
}

#[test]
fn the_help_of_a_command_explains_it() {
    let dir = tempfile::tempdir().unwrap();
    let help = succeed(dir.path(), "calibrate --help");
    assert!(
        help.contains("It replaces the calibration in the model's manifest"),
        "{help}"
    );
    let summary = "calibrate    Measure on the validation split which errors to expect of a model";
    assert!(succeed(dir.path(), "--help").contains(summary));
}

#[test]
fn usage_errors_exit_with_2_and_advice() {
    let dir = working_dir();
    fs::create_dir(dir.path().join("thesis")).unwrap();
    fs::write(dir.path().join("thesis/one.tex"), "precious").unwrap();
    for (line, expected) in [
        (
            "collect --scenario cloudy",
            "there are static-observer, moving-observer",
        ),
        ("collect --trials 0", "0 is not in 1..=1000000"),
        (
            "collect --frame-size 0 --out a",
            "a frame of 0×0 px is out of range; each side must be 1 to",
        ),
        (
            "collect --noise nan --out a",
            "noise_std is NaN; it must be a finite number from 0 to 1",
        ),
        (
            "collect --trials 2 --frame-size 8",
            "trials: 3 in the directory, 2 requested",
        ),
        (
            "collect --out thesis",
            "thesis exists and is not a collection; use a directory that does not exist",
        ),
        ("collect --out thesis/one.tex", "one.tex exists and is not a collection"),
        (
            "train --preset papper",
            "there is no preset \"papper\"; there are: paper, static, moving",
        ),
        ("train --set sequence.steps=many", "sequence.steps"),
        ("train --set sequence.steps=0", "sequence.steps is 0; it must be 1 to"),
        ("train --set model.context=0", "context is 0; it must be 1 to 256"),
        ("train --config none.toml", "could not read none.toml: No such file"),
        (
            "train --set sequence.stepz=1",
            "unknown field `stepz` in `sequence` (--set); `foreframe train --print-config` lists all settings",
        ),
        ("train --set sequence", "--set sequence is not KEY=VALUE"),
        (
            "collect --set max_streamz=1",
            "unknown field `max_streamz` (--set); `foreframe config` lists all settings",
        ),
        ("publish thesis", "thesis holds no model (manifest.json is missing)"),
        (
            "publish models/plain --name My_Model",
            "\"My_Model\" is not a valid model name; use 1 to 64 of",
        ),
        (
            "predict --model plain@2 --frames thesis --out p",
            "there is no version 2 of model \"plain\"; there are: 1",
        ),
        (
            "predict --model plain@new --frames thesis --out p",
            "\"plain@new\" is not NAME or NAME@VERSION",
        ),
        (
            "predict --model plain --frames thesis --out p --resize squeeze",
            "it must be crop, letterbox or stretch",
        ),
        (
            "train --dataset thesis",
            "thesis holds no data set (meta/info.json is missing)",
        ),
        ("train --dataset nowhere/data", "nowhere/data holds no data set"),
        (
            "train --dataset moving",
            "there is no data set \"moving\" in data/datasets; there are: static-observer",
        ),
        ("train --preset moving", "no data set \"moving-observer\""),
        ("train", "but the train split has only"),
        (
            "train --set model.context=90",
            "a window of 95 frames (context 90, horizon 5) is longer than every episode",
        ),
        (
            "train --set name=A",
            "name is \"A\" (--set); it must be a name of 1 to 64 characters",
        ),
        (
            "evaluate --model plane",
            "there is no model \"plane\" in models; there are: moving, plain",
        ),
        ("evaluate --model thesis", "there is no model \"thesis\""),
        (
            "evaluate --model nowhere/model",
            "nowhere/model holds no model (manifest.json is missing)",
        ),
        (
            "evaluate --model plain",
            "--dataset is missing; model \"plain\" was trained on \"none\"",
        ),
        (
            "evaluate --model plain --dataset static-observer",
            "has frames of 8×8 px; model \"plain\" takes 16×12",
        ),
        (
            "evaluate --model plain --dataset static-observer --out thesis",
            "thesis exists and is not an empty directory",
        ),
        (
            "evaluate --model plain --dataset static-observer --windows 0 --out r",
            "number of windows is 0; it must be at least 1",
        ),
        (
            "predict --model plain --frames none --out p",
            "could not read none: No such file",
        ),
        (
            "predict --model plain --frames thesis --out p",
            "thesis holds 0 PNG or JPEG frames; model \"plain\" takes 3",
        ),
        (
            "inspect paper",
            "there is no model or data set \"paper\"; in models there are: moving, plain; in data/datasets there are: static-observer",
        ),
        (
            "export --dataset static-observer --episode 3 --out e",
            "--episode is 3; data/datasets/static-observer has 3 episodes",
        ),
        (
            "export --dataset static-observer --first 900 --out e",
            "--first is 900; episode 0 has",
        ),
        ("export --dataset static-observer --count 0 --out e", "0 is not in 1.."),
        (
            "export --dataset static-observer --out thesis",
            "thesis exists and is not an empty directory",
        ),
    ] {
        let (code, text) = run(dir.path(), line);
        assert!(code == 2 && text.contains(expected), "{line} ended in {code}: {text}");
    }
    assert_eq!(fs::read_dir(dir.path().join("thesis")).unwrap().count(), 1);
    // Refused commands leave no files behind.
    assert!(!dir.path().join("runs").exists() && !dir.path().join("a").exists());
}

#[test]
fn predict_reports_invalid_frames_and_actions() {
    let dir = working_dir();
    let frames = dir.path().join("look");
    fs::create_dir(&frames).unwrap();
    let png = foreframe_core::frame::codec::encode_png(&service::frame(9)).unwrap();
    for index in 0..service::CONTEXT {
        fs::write(frames.join(format!("frame-{index}.png")), &png).unwrap();
    }
    let predict = |actions: &Value| {
        fs::write(
            frames.join("actions.json"),
            actions.to_string().replace("\"NaN\"", "NaN"),
        )
        .unwrap();
        run(
            dir.path(),
            "predict --model moving --frames look --actions look/actions.json --out seen",
        )
    };
    let state = [[0.0]; service::CONTEXT];
    let enough = service::CONTEXT - 1 + service::HORIZON;
    for (actions, expected) in [
        (
            json!({"states": state, "actions": [["NaN", 0.0]]}),
            "is not an actions file: expected value at line 1",
        ),
        (
            json!({"actions": [[1e39, 0.0]]}),
            "is not an actions file: number out of range",
        ),
        (json!([]), "it is JSON of finite numbers"),
        (
            json!({"states": state, "actions": vec![[0.0, 0.0]; enough - 1]}),
            "holds 3 actions; predicting 2 frames after frame 2 takes 4; add the planned actions",
        ),
        (
            json!({"states": [[0.0]], "actions": vec![[0.0, 0.0]; enough]}),
            "holds 1 states; the state at frame 2 takes 3",
        ),
        (
            json!({"states": state, "actions": vec![[0.0]; enough]}),
            "plan[0] holds 1 numbers; model \"moving\" takes 2: linear m/s, angular rad/s",
        ),
    ] {
        let (code, text) = predict(&actions);
        assert!(code == 2 && text.contains(expected), "{code}: {text}");
    }
    let (code, text) = run(dir.path(), "predict --model moving --frames look --out seen");
    assert!(
        code == 2 && text.contains("--actions is missing; model \"moving\" takes linear m/s, angular rad/s"),
        "{text}"
    );
    let (code, text) = predict(&json!({"states": state, "actions": vec![[0.0, 0.0]; enough]}));
    assert_eq!(code, 0, "{text}");
    let (code, text) = run(dir.path(), "predict --model plain --frames look --out seen");
    assert!(
        code == 2 && text.contains("seen exists and is not an empty directory"),
        "{text}"
    );
    fs::write(frames.join("frame-1.png"), &png[..40]).unwrap();
    let (code, text) = run(dir.path(), "predict --model plain --frames look --out other");
    assert!(
        code == 1 && text.contains("look/frame-1.png: not a readable PNG or JPEG image: "),
        "{text}"
    );
}

#[test]
fn damaged_files_exit_with_1_and_the_cause() {
    let dir = working_dir();
    let shard = dir
        .path()
        .join("data/datasets/static-observer/data/chunk-000/file-000.parquet");
    let bytes = fs::read(&shard).unwrap();
    fs::write(&shard, &bytes[..bytes.len() / 2]).unwrap();
    let (code, text) = run(dir.path(), "inspect static-observer");
    assert!(code == 1 && text.contains("file-000.parquet has the SHA-256"), "{text}");
    assert!(
        text.contains("restore the file or collect the data set again"),
        "{text}"
    );

    record_hash(
        &dir.path().join("data/datasets/static-observer"),
        &fs::read(&shard).unwrap(),
    );
    let (code, text) = run(dir.path(), "train --set data.windows=1");
    assert!(code == 1 && text.contains("file-000.parquet is damaged"), "{text}");
    assert!(text.contains("Parquet error"), "{text}");

    fs::write(dir.path().join("models/plain/model.safetensors"), b"short").unwrap();
    let (code, text) = run(dir.path(), "inspect plain");
    assert!(
        code == 1 && text.contains("download the model or train it again"),
        "{text}"
    );
    fs::write(dir.path().join("models/plain/manifest.json"), b"{").unwrap();
    let (code, text) = run(dir.path(), "evaluate --model plain");
    assert!(
        code == 1 && text.contains("manifest.json is not a valid model manifest: EOF"),
        "{text}"
    );
}

/// Changes the recorded hash so that the shard's bytes count as valid.
fn record_hash(dataset: &Path, shard: &[u8]) {
    let path = dataset.join("meta/foreframe.json");
    let mut stamp: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    let hash = sha256_hex(shard);
    stamp["content_hash"] = json!(sha256_hex(hash.as_bytes()));
    stamp["shards"][0]["sha256"] = json!(hash);
    fs::write(&path, stamp.to_string()).unwrap();
}

/// A limit on the file size simulates a full disk.
#[cfg(unix)]
#[test]
fn a_failed_write_leaves_no_data_set() {
    let dir = tempfile::tempdir().unwrap();
    let script = format!("trap '' XFSZ; ulimit -f 4; exec '{PROGRAM}' collect --trials 3");
    let (code, text) = exit_of(Command::new("sh").args(["-c", &script]).current_dir(dir.path()));
    assert_eq!(code, 1, "{text}");
    let written = "could not write data/datasets/static-observer/data/chunk-000/file-000.parquet: File too large";
    assert!(text.contains(written), "{text}");
    assert!(!dir.path().join("data/datasets/static-observer/meta/info.json").exists());
    let (code, text) = run(dir.path(), "inspect static-observer");
    assert!(
        code == 2 && text.contains("is unfinished; run the same `foreframe collect`"),
        "{text}"
    );
}

/// A file of one frame.
fn write_png(path: &Path, value: u8) {
    fs::write(
        path,
        foreframe_core::frame::codec::encode_png(&service::frame(value)).unwrap(),
    )
    .unwrap();
}

#[test]
fn a_prediction_follows_the_last_frames_in_natural_order() {
    let dir = working_dir();
    let mut names: Vec<String> = (1..=12).map(|index| format!("{index}.png")).collect();
    for part in ["all", "last", "middle"] {
        fs::create_dir(dir.path().join(part)).unwrap();
    }
    for (index, name) in names.iter().enumerate() {
        write_png(&dir.path().join("all").join(name), index as u8 * 20);
    }
    let copy = |names: &[String], part: &str| {
        for name in names {
            let from = dir.path().join("all").join(name);
            fs::copy(from, dir.path().join(part).join(name)).unwrap();
        }
    };
    copy(&names.split_off(9), "last");
    copy(&names[6..9], "middle");
    let predicted = |arguments: &str, out: &str| {
        succeed(dir.path(), &format!("predict --model plain {arguments} --out {out}"));
        fs::read(dir.path().join(out).join("predicted-1.png")).unwrap()
    };
    let last = predicted("--frames all", "a");
    assert_eq!(last, predicted("--frames last", "b"));
    let middle = predicted("--frames all --at 8", "c");
    assert_eq!(middle, predicted("--frames middle", "d"));
    assert_ne!(last, middle);
    let (code, text) = run(dir.path(), "predict --model plain --frames all --at 12 --out e");
    assert!(
        code == 2 && text.contains("--at is 12; it must be 2 to 11: model \"plain\" takes 3 frames, and all holds 12"),
        "{text}"
    );
    assert!(!dir.path().join("e").exists());
}

#[test]
fn images_of_another_size_are_resized_and_color_is_reported_once() {
    let dir = working_dir();
    let images = dir.path().join("photos");
    fs::create_dir(&images).unwrap();
    for index in 0..service::CONTEXT {
        let color = image::RgbImage::from_pixel(40, 20, image::Rgb([200, index as u8, 50]));
        color.save(images.join(format!("{index}.png"))).unwrap();
    }
    let (code, text) = run(dir.path(), "predict --model plain --frames photos --out seen");
    assert!(
        code == 2 && text.contains("photos/0.png is 40×20 px; model \"plain\" takes 16×12; add --resize crop"),
        "{text}"
    );
    for way in ["crop", "letterbox", "stretch"] {
        let line = format!("predict --model plain --frames photos --resize {way} --out {way}");
        let (code, text) = run(dir.path(), &line);
        assert_eq!((code, text.matches("converted to gray").count()), (0, 1), "{text}");
    }
}

/// The shipped models.
const MODELS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models");

#[test]
fn the_example_of_predict_works_on_every_exported_episode() {
    let dir = tempfile::tempdir().unwrap();
    succeed(dir.path(), "collect --scenario moving-observer --trials 4");
    for episode in 0..4 {
        succeed(
            dir.path(),
            &format!("export --dataset moving-observer --episode {episode} --out look{episode}"),
        );
        let look = format!("--frames look{episode} --models-dir {MODELS} --out");
        let moving = format!("--model moving --actions look{episode}/actions.json --at 9");
        succeed(dir.path(), &format!("predict {moving} {look} moving{episode}"));
        succeed(dir.path(), &format!("predict --model paper {look} paper{episode}"));
        for (out, gif) in [
            (format!("look{episode}"), "episode.gif"),
            (format!("moving{episode}"), "prediction.gif"),
        ] {
            let gif = fs::read(dir.path().join(out).join(gif)).unwrap();
            assert!(u16::from_le_bytes([gif[6], gif[7]]) >= 256);
        }
        assert!(dir.path().join(format!("paper{episode}/contact-sheet.png")).is_file());
    }
    let (code, text) = run(
        dir.path(),
        &format!("predict --model moving --actions look0/actions.json --frames look0 --models-dir {MODELS} --out none"),
    );
    assert!(
        code == 2 && text.contains("add the planned actions, or predict after an earlier frame with --at"),
        "{text}"
    );
    assert!(!dir.path().join("none").exists());
}

#[test]
fn the_next_step_of_a_small_collection_works() {
    let dir = tempfile::tempdir().unwrap();
    for (scenario, preset) in [("static-observer", "static"), ("moving-observer", "moving")] {
        let printed = succeed(
            dir.path(),
            &format!("collect --scenario {scenario} --trials 60 --frame-size 8"),
        );
        let next = printed
            .lines()
            .find_map(|line| line.strip_prefix("next: foreframe "))
            .unwrap();
        assert!(next.contains(&format!("--preset {preset} ")), "{next}");
        succeed(
            dir.path(),
            &format!("{next} --set sequence.steps=1 --set model.features=4 --set model.hidden=4"),
        );
    }
    let printed = succeed(dir.path(), "collect --trials 2 --frame-size 8 --out tiny");
    assert!(
        printed.contains("next: the same command with --trials 40, which adds trials"),
        "{printed}"
    );
}

#[test]
fn a_named_collection_grows() {
    let dir = tempfile::tempdir().unwrap();
    succeed(dir.path(), "collect --trials 2 --frame-size 8 --name small");
    let printed = succeed(dir.path(), "collect --trials 4 --frame-size 8 --name small");
    assert!(printed.starts_with("data/datasets/small: 4 trials, "), "{printed}");
    let (code, text) = run(dir.path(), "collect --name My_Set");
    assert!(
        code == 2 && text.contains("--name is \"My_Set\"; a name has 1 to 64 characters"),
        "{text}"
    );
}

#[test]
fn every_command_finds_what_is_in_the_data_directory() {
    let dir = tempfile::tempdir().unwrap();
    succeed(
        dir.path(),
        "collect --data-dir d --trials 40 --frame-size 8 --threads 1",
    );
    assert!(dir.path().join("d/datasets/static-observer/meta/info.json").is_file());
    let small = "--set data.windows=40 --set sequence.steps=2 --set model.features=4 --set model.hidden=4";
    succeed(dir.path(), &format!("train --data-dir d {small}"));
    let published = succeed(dir.path(), "publish runs/paper --name mine --data-dir d");
    assert_eq!(published, "published mine@1; it is the active version\n");
    succeed(
        dir.path(),
        "evaluate --model mine --data-dir d --resamples 100 --windows 5 --save-scores --out r",
    );
    succeed(
        dir.path(),
        "collect --data-dir d --trials 40 --frame-size 8 --seed 2 --name other",
    );
    let (code, text) = run(
        dir.path(),
        "evaluate --model mine --dataset other --data-dir d --save-scores --out r2",
    );
    assert!(
        code == 2 && text.contains("has scores \"test\" of another data set"),
        "{text}"
    );
    let described = succeed(dir.path(), "inspect mine@1 --data-dir d");
    assert!(
        described.starts_with("d/models/mine/1 (mine version 1)") && described.contains("skill"),
        "{described}"
    );
    assert!(succeed(dir.path(), "inspect static-observer --data-dir d").contains("episodes    40"));
    succeed(dir.path(), "export --dataset static-observer --data-dir d --out look");
    succeed(dir.path(), "predict --model mine --data-dir d --frames look --out seen");
    // The same through the environment and the file.
    let mut command = Command::new(PROGRAM);
    command
        .args(["inspect", "mine"])
        .env("FOREFRAME_DATA_DIR", "d")
        .current_dir(dir.path());
    assert_eq!(exit_of(&mut command).0, 0);
    fs::write(dir.path().join("foreframe.toml"), "data_dir = \"d\"\n").unwrap();
    succeed(dir.path(), "inspect mine");
}

#[test]
fn an_evaluation_s_numbers_have_limits() {
    let dir = working_dir();
    for (option, value, right) in [
        ("--resamples", "10001", "10001 is not in 100..=10000"),
        ("--resamples", "99", "99 is not in 100..=10000"),
        ("--min-skill", "nan", "a skill is a number of at most 1"),
        ("--min-skill", "5", "a skill is a number of at most 1"),
        ("--brightness", "0", "a brightness is a number from 0.1 to 3"),
        ("--brightness", "-1", "a brightness is a number from 0.1 to 3"),
        ("--brightness", "3.1", "a brightness is a number from 0.1 to 3"),
        ("--brightness", "nan", "a brightness is a number from 0.1 to 3"),
        ("--brightness", "dark", "a brightness is a number from 0.1 to 3"),
    ] {
        let refused = output(dir.path(), &["evaluate", "--model", "plain", option, value]);
        let error = text(&refused.stderr);
        assert!(refused.status.code() == Some(2) && error.contains(right), "{error}");
    }
}

#[test]
fn a_model_has_the_name_of_its_directory() {
    let dir = working_dir();
    let models = dir.path().join("models");
    fs::rename(models.join("plain"), models.join("my-robot")).unwrap();
    fs::rename(models.join("moving"), models.join("my_robot")).unwrap();
    assert!(succeed(dir.path(), "inspect my-robot").starts_with("models/my-robot (my-robot version 1)"));
    let (code, text) = run(dir.path(), "inspect my_robot");
    assert!(
        code == 2 && text.contains("\"my_robot\" is not a valid model name; use 1 to 64 of a–z, 0–9 and '-'"),
        "{text}"
    );
    assert!(succeed(dir.path(), "models list").contains("not used: models/my_robot: "));
    let listed: Value = serde_json::from_str(&succeed(dir.path(), "models list --json")).unwrap();
    let expected =
        json!([{"name": "my-robot", "version": 1, "active": true, "shipped": true, "directory": "models/my-robot"}]);
    assert_eq!(listed, expected);
}

#[test]
fn the_stream_example_says_that_no_server_answers() {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir(dir.path().join("look")).unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/stream.py");
    let mut command = Command::new("python3");
    // Port 1 is reserved, so nothing listens there.
    command.args([
        script,
        "--server",
        "http://127.0.0.1:1",
        "--frames",
        "look",
        "--out",
        "seen",
    ]);
    let Ok(output) = command.current_dir(dir.path()).output() else {
        // Without Python there is nothing to try.
        return;
    };
    let text = String::from_utf8(output.stderr).unwrap();
    let says_why = text.contains("no server answers at http://127.0.0.1:1") || text.contains("pip install websockets");
    assert!(
        !output.status.success() && says_why && !text.contains("Traceback"),
        "{text}"
    );
}

#[test]
fn collect_train_and_evaluate_share_default_directories() {
    let dir = tempfile::tempdir().unwrap();
    succeed(dir.path(), "collect --trials 40 --frame-size 8");
    let small = "--set data.windows=40 --set pretrain.steps=1 --set sequence.steps=2 --set model.features=4 \
                 --set model.hidden=4";
    fs::create_dir(dir.path().join("thesis")).unwrap();
    fs::write(dir.path().join("thesis/one.tex"), "precious").unwrap();
    let (code, text) = run(dir.path(), &format!("train {small} --out thesis"));
    assert!(
        code == 2 && text.contains("thesis exists and holds no training run; use a new directory"),
        "{text}"
    );
    succeed(dir.path(), &format!("train {small}"));
    let scores = succeed(
        dir.path(),
        "evaluate --model runs/paper/model --resamples 100 --windows 5",
    );
    assert!(
        scores.starts_with("set ") && scores.contains("\ntest: worse than the strongest baseline ("),
        "{scores}"
    );
    let printed = succeed(
        dir.path(),
        "evaluate --model runs/paper/model --resamples 100 --windows 5 --json --html --out again",
    );
    let printed: Value = serde_json::from_str(&printed).unwrap();
    assert!(printed["sets"]["test"]["skill"].as_f64().unwrap() < 0.0, "{printed}");
    assert_eq!(printed["report"], "again/report.json");
    assert_eq!(printed["brightness"], 1.0);
    let dark = "evaluate --model runs/paper/model --resamples 100 --windows 5 --brightness 0.5";
    let told = succeed(dir.path(), &format!("{dark} --out dark"));
    assert!(
        told.contains("\nbrightness: all frames were multiplied by 0.5"),
        "{told}"
    );
    let dark_scores: Value = serde_json::from_str(&succeed(dir.path(), &format!("{dark} --json --out dark2"))).unwrap();
    assert_eq!(dark_scores["brightness"], 0.5);
    assert_ne!(dark_scores["sets"]["test"]["mse"], printed["sets"]["test"]["mse"]);
    let (code, text) = run(dir.path(), &format!("{dark} --save-scores --out dark3"));
    assert!(code == 2 && text.contains("--save-scores"), "{text}");
    assert!(dir.path().join("again/report.html").is_file());
    assert!(scores.ends_with("report: reports/paper/report.md\n"), "{scores}");
    let described = succeed(dir.path(), "inspect runs/paper/model");
    for network in ["ConvLSTM (Shi et al. 2015)", "CDNA (Finn et al. 2016)"] {
        assert!(described.contains(network), "{described}");
    }
}
