//! A model's scores, as its manifest keeps them, in a small table.

use serde_json::Value;

use super::error::CliError;
use super::process::print_line;
use super::table::aligned;
use foreframe_train::evaluation::method::Method;

const HEADER: [&str; 7] = [
    "set",
    "skill",
    "95 % interval",
    "MSE ×10⁻⁴",
    "SSIM",
    "windows",
    "strongest baseline",
];

/// Prints a line for each set that was scored, and one for each set of which only the error is known. `indent` stands before
/// each line.
pub(super) fn print_scores(metrics: &Value, indent: &str) -> Result<(), CliError> {
    let sets = metrics.as_object().into_iter().flatten();
    let rows: Vec<[String; 7]> = sets.map(|(set, scores)| row(set, scores)).collect();
    if rows.is_empty() {
        return print_line(format!("{indent}no scores; foreframe evaluate --save-scores adds them"));
    }
    let mut lines = aligned(HEADER, &rows).into_iter();
    lines.try_for_each(|line| print_line(format!("{indent}{line}")))
}

fn row(set: &str, scores: &Value) -> [String; 7] {
    let number = |value: &Value, digits: usize| {
        value
            .as_f64()
            .map_or_else(|| "–".to_owned(), |value| format!("{value:.digits$}"))
    };
    let interval = &scores["skill_interval_95"];
    let interval = match interval.as_array().map(Vec::as_slice) {
        Some([low, high]) => format!("{} … {}", number(low, 2), number(high, 2)),
        _ => "–".to_owned(),
    };
    let doubt = if scores["skill_interval_is_reliable"] == false {
        " (too few to trust)"
    } else {
        ""
    };
    let mse = scores["mse"].as_f64().map(|mse| Value::from(mse * 1e4));
    let groups = ["trials", "blocks"]
        .iter()
        .find_map(|unit| scores[unit].as_u64().map(|count| format!(" of {count} {unit}")));
    let windows = scores["windows"].as_u64().map_or_else(
        || "–".to_owned(),
        |windows| format!("{windows}{}", groups.unwrap_or_default()),
    );
    let baseline: Option<Method> = serde_json::from_value(scores["strongest_baseline"].clone()).ok();
    [
        set.to_owned(),
        number(&scores["skill"], 3),
        interval + doubt,
        number(&mse.unwrap_or_default(), 2),
        number(&scores["ssim"], 3),
        windows,
        baseline.map_or("–", Method::label).to_owned(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_row_has_what_is_known() {
        let known = json!({"skill": 0.0373, "skill_interval_95": [-0.18, 0.28], "skill_interval_is_reliable": false,
            "mse": 0.002_195, "ssim": 0.79, "blocks": 4, "windows": 179, "strongest_baseline": "ego-motion"});
        let expected = [
            "test",
            "0.037",
            "-0.18 … 0.28 (too few to trust)",
            "21.95",
            "0.790",
            "179 of 4 blocks",
            "commanded ego-motion",
        ];
        assert_eq!(row("test", &known), expected.map(str::to_owned));
        let little = row("validation", &json!({"mse": 0.001, "step": 3}));
        assert_eq!(
            little,
            ["validation", "–", "–", "10.00", "–", "–", "–"].map(str::to_owned)
        );
    }
}
