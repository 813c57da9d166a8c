//! The command line: exit codes and error messages.

use std::fs;
use std::path::Path;
use std::process::Command;

use foreframe::files::sha256_hex;
use foreframe::nn::Conditioning;
use serde_json::{Value, json};

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
        ("collect --trials 4 --frame-size 8", "trials: 3 there, 4 asked"),
        (
            "collect --out thesis",
            "thesis exists and is not a collection; use a directory that does not exist",
        ),
        ("collect --out thesis/one.tex", "one.tex exists and is not a collection"),
        (
            "train --preset papper",
            "there is no preset \"papper\"; there are: paper, static, moving",
        ),
        ("train --set fit.steps=many", "fit.steps"),
        ("train --set fit.steps=0", "fit.steps is 0; it must be 1 to"),
        ("train --set model.context=0", "the context is 0; it must be at least 1"),
        ("train --config none.toml", "could not read none.toml: No such file"),
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
        ("train --set name=A", "\"A\" is not a valid model name"),
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
    let png = foreframe::frame::codec::encode_png(&service::frame(9)).unwrap();
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
            "is no actions file: expected value at line 1",
        ),
        (
            json!({"actions": [[1e39, 0.0]]}),
            "is no actions file: number out of range",
        ),
        (json!([]), "it is JSON of finite numbers"),
        (
            json!({"states": state, "actions": vec![[0.0, 0.0]; enough - 1]}),
            "holds 3 actions; model \"moving\" sees 3 frames and predicts 2, which takes 4",
        ),
        (
            json!({"states": [[0.0]], "actions": vec![[0.0, 0.0]; enough]}),
            "holds 1 states; model \"moving\" sees 3 frames",
        ),
        (
            json!({"states": state, "actions": vec![[0.0]; enough]}),
            "future_actions[0] holds 1 numbers; model \"moving\" takes 2: linear m/s, angular rad/s",
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
        code == 2 && text.contains("is unfinished; run `foreframe collect` with the same arguments"),
        "{text}"
    );
}

#[test]
fn collect_train_and_evaluate_share_default_directories() {
    let dir = tempfile::tempdir().unwrap();
    succeed(dir.path(), "collect --trials 40 --frame-size 8");
    let small = "--set data.windows=40 --set pretrain.steps=1 --set fit.steps=2 --set model.features=4 \
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
    assert!(scores.ends_with("reports/paper/report.md\n"), "{scores}");
    let described = succeed(dir.path(), "inspect runs/paper/model");
    for network in ["ConvLSTM (Shi et al. 2015)", "CDNA (Finn et al. 2016)"] {
        assert!(described.contains(network), "{described}");
    }
}
