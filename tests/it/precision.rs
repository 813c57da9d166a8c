//! The precision of predictions, as a user chooses it: what a report says of it, and what a processor refuses.

use std::path::Path;

use foreframe_core::nn::precision::Precision;
use serde_json::Value;

use crate::process::{foreframe, output, text};

/// The stamp of an evaluation of `paper` with that precision in the environment.
fn stamp(dir: &Path, precision: &str) -> Value {
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/paper");
    let mut evaluate = foreframe(dir);
    evaluate
        .env("FOREFRAME_PRECISION", precision)
        .args([
            "evaluate",
            "--dataset",
            "set",
            "--windows",
            "4",
            "--resamples",
            "100",
            "--out",
            precision,
            "--model",
        ])
        .arg(model);
    let evaluated = evaluate.output().unwrap();
    assert!(evaluated.status.success(), "{}", text(&evaluated.stderr));
    let report = std::fs::read_to_string(dir.join(precision).join("report.json")).unwrap();
    serde_json::from_str::<Value>(&report).unwrap()["stamp"].clone()
}

#[test]
fn a_report_names_a_precision_of_fewer_bits() {
    let dir = tempfile::tempdir().unwrap();
    let collect = [
        "collect",
        "--scenario",
        "static-observer",
        "--trials",
        "20",
        "--out",
        "set",
    ];
    assert!(output(dir.path(), &collect).status.success());
    assert_eq!(stamp(dir.path(), "f32").get("precision"), None);
    if Precision::Int8.is_supported() {
        assert_eq!(stamp(dir.path(), "int8")["precision"], "int8");
        let page = std::fs::read_to_string(dir.path().join("int8/report.md")).unwrap();
        assert!(page.contains("\n| precision | `int8` |\n"), "{page}");
    } else {
        eprintln!("skipped in part: this processor has no instructions for int8");
    }
}

#[test]
fn a_precision_without_instructions_is_refused_with_those_that_work() {
    let dir = tempfile::tempdir().unwrap();
    for precision in Precision::ALL.into_iter().filter(|precision| !precision.is_supported()) {
        for command in ["serve", "config"] {
            let refused = output(dir.path(), &[command, "--set", &format!("precision={precision}")]);
            let error = text(&refused.stderr);
            assert_eq!(refused.status.code(), Some(2), "{error}");
            assert!(
                error.contains("this processor has no ") && error.contains("it predicts in \"f32\""),
                "{error}"
            );
        }
    }
}

#[test]
fn a_device_that_serve_refuses_is_not_printed_as_a_setting() {
    let dir = tempfile::tempdir().unwrap();
    // No machine has so many graphics cards.
    let refused = ["serve", "config"].map(|command| output(dir.path(), &[command, "--set", "device=cuda:999"]));
    for refused in &refused {
        let error = text(&refused.stderr);
        assert_eq!(refused.status.code(), Some(2), "{error}");
        assert!(error.contains("device is \"cuda:999\" (--set): "), "{error}");
    }
}
