//! The report in Markdown: the template `report.md.jinja`, filled in.

use minijinja::value::ViaDeserialize;
use minijinja::{Environment, Value, context};

use super::actions::Variant;
use super::bootstrap::{CONFIDENCE, FEWEST_GROUPS};
use super::method::Method;
use super::metrics::PSNR_CAP_DB;
use super::pixel_class::PixelClass;
use super::report::{EvaluationReport, SetReport};

/// Squared errors are shown in this unit.
const MSE_UNIT: f64 = 1e-4;

impl EvaluationReport {
    /// The report as Markdown, with its figures in the same directory.
    #[must_use]
    pub fn to_markdown(&self) -> String {
        let mut environment = Environment::new();
        environment.set_trim_blocks(true);
        environment.set_lstrip_blocks(true);
        environment.set_keep_trailing_newline(true);
        environment.add_filter("number", number);
        environment.add_filter("grouped", grouped);
        environment.add_filter("set_title", set_title);
        environment.add_filter("method", |method: ViaDeserialize<Method>| method.label());
        environment.add_filter("pixel_class", |class: ViaDeserialize<PixelClass>| class.name());
        environment.add_filter("variant", |variant: ViaDeserialize<Variant>| variant.label());
        let verdicts = self.sets.iter().map(|set| self.verdict(set));
        let second = |set: &SetReport| set.outcome.scores()?.verdict_against_unfitted();
        let report = Value::from_serialize(self);
        let context = context! {
            psnr_cap_db => PSNR_CAP_DB,
            confidence => CONFIDENCE,
            fewest_groups => FEWEST_GROUPS,
            verdicts => verdicts.collect::<Vec<_>>(),
            has_frames_of_training => self.has_frames_of_training(),
            has_codec => self.has_row(Method::CodecOnly),
            verdicts_against_unfitted => self.sets.iter().map(second).collect::<Vec<_>>(),
            ..report
        };
        environment
            .render_str(include_str!("report.md.jinja"), context)
            .expect("a report that does not fit its template is a bug")
    }

    fn has_row(&self, method: Method) -> bool {
        let mut scored = self.sets.iter().filter_map(|set| set.outcome.scores());
        scored.any(|scores| scores.methods.iter().any(|row| row.method == method))
    }
}

/// What a set holds, as a heading.
pub(super) fn set_title(split: &str, is_recording: bool) -> &'static str {
    match split {
        "validation" => "Validation",
        "unseen-pairs" => "Unseen start/goal pairs",
        "unseen-gains" => "Unseen gains",
        "whole-set" => "Whole data set",
        "new-materials" => "New materials",
        "new-cameras" => "New cameras",
        _ if is_recording => "Test part",
        _ => "Unseen trials",
    }
}

/// A number as the template's patterns ask for.
fn number(value: f64, format: &str) -> String {
    match format {
        "mse" => {
            let scaled = value / MSE_UNIT;
            let digits = match scaled.abs() {
                100.0.. => 0,
                10.0.. => 1,
                0.0 | 0.1.. => 2,
                _ => 4,
            };
            format!("{scaled:.digits$}")
        }
        "percent" => format!("{:.1} %", 100.0 * value),
        "shortest" => value.to_string(),
        zeros => format!("{value:.*}", zeros.len().saturating_sub("0.".len())),
    }
}

/// 1234567 as 1 234 567.
pub(super) fn grouped(number: u64) -> String {
    match number {
        0..1000 => number.to_string(),
        _ => format!("{} {:03}", grouped(number / 1000), number % 1000),
    }
}
