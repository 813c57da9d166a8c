//! The cards of the shipped models state what their manifests state.

use std::fs;
use std::path::Path;

use serde_json::Value;

const SETS: [(&str, &str); 6] = [
    ("test", "unseen trials"),
    ("unseen-pairs", "unseen pairs"),
    ("unseen-gains", "unseen gains"),
    ("new-materials", "new materials"),
    ("new-cameras", "new cameras"),
    ("validation", "validation"),
];

fn three_digits(value: f64) -> String {
    match value.abs() {
        100.0.. => format!("{value:.0}"),
        10.0.. => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}

/// The row of a card for the scores of one set; `None` where it was not scored by `evaluate`.
fn row(label: &str, scores: &Value) -> Option<String> {
    let number = |name: &str| scores[name].as_f64();
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".to_owned());
    let interval = |side: usize| scores["skill_interval_95"][side].as_f64();
    Some(format!(
        "| {label} | {:.2} ({:.2} … {:.2}) | {} | {} | {:.3} | {:.1} dB | {} | {} |",
        number("skill")?,
        interval(0)?,
        interval(1)?,
        three_digits(number("mse")? * 1e4),
        or_dash(number("mover_mse").map(|mse| three_digits(mse * 1e4))),
        number("ssim")?,
        number("psnr_db")?,
        or_dash(number("plan_identification").map(|share| format!("{:.0} %", share * 100.0))),
        scores["strongest_baseline"].as_str()?,
    ))
}

#[test]
fn cards_state_the_scores_of_the_manifests() {
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    let mut rows = 0;
    for entry in fs::read_dir(models).unwrap() {
        let directory = entry.unwrap().path();
        let Ok(manifest) = fs::read(directory.join("manifest.json")) else {
            continue;
        };
        let manifest: Value = serde_json::from_slice(&manifest).unwrap();
        let card = fs::read_to_string(directory.join("README.md")).unwrap();
        let mega = manifest["multiply_adds_per_frame"].as_f64().unwrap() / 1e6;
        let cost = format!("{mega:.1} million multiply–adds per predicted frame");
        assert!(card.contains(&cost), "{}: {cost}", directory.display());
        for (set, label) in SETS {
            let label = if manifest["dataset"]["scenario"].is_null() {
                "last tenth"
            } else {
                label
            };
            if let Some(row) = row(label, &manifest["metrics"][set]) {
                assert!(card.contains(&row), "{}: {row}", directory.display());
                rows += 1;
            }
        }
    }
    assert!(rows > 6, "{rows} rows");
}
