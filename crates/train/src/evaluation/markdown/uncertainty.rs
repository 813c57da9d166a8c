//! The report's sections on expected errors and novelty.

use std::fmt::{Result, Write};

use super::{header, in_mse_units, row};
use crate::evaluation::uncertainty::{NoveltyScores, UncertaintyScores};

/// How well the expected errors of a set fit.
pub(super) fn section(out: &mut String, scores: &UncertaintyScores) -> Result {
    let percent = |value: f64| format!("{:.1} %", 100.0 * value);
    writeln!(out, "\n### Expected errors\n")?;
    writeln!(
        out,
        "The error lies in its 90 % band for **{}** of the predicted frames. The mean band is {} ×10⁻⁴ wide; one constant \
         band would need {} ×10⁻⁴. The mean novelty is {:.2}.\n",
        percent(scores.coverage.mean),
        in_mse_units(scores.width.mean),
        in_mse_units(scores.constant_width.mean),
        scores.novelty
    )?;
    header(out, "Expected error", scores.coverage.per_step.len())?;
    row(out, "coverage of the 90 % band", &scores.coverage, percent)?;
    row(out, "width of the band, ×10⁻⁴", &scores.width, in_mse_units)?;
    row(
        out,
        "width of a constant band, ×10⁻⁴",
        &scores.constant_width,
        in_mse_units,
    )?;
    row(
        out,
        "correlation with the true error (logarithms)",
        &scores.correlation,
        |value| format!("{value:.3}"),
    )
}

/// How well novelty tells other data sets apart.
pub(super) fn novelty_section(out: &mut String, novelty: &[NoveltyScores]) -> Result {
    if novelty.is_empty() {
        return Ok(());
    }
    writeln!(out, "\n## Novelty\n")?;
    writeln!(
        out,
        "AUROC: how often a window of the other data set has a greater novelty than one of the first set above. 1 tells all \
         apart, 0.5 is guessing.\n"
    )?;
    writeln!(
        out,
        "| Data set | Windows | AUROC | Mean novelty |\n| --- | ---: | ---: | ---: |"
    )?;
    for other in novelty {
        writeln!(
            out,
            "| {} | {} | {:.3} | {:.3} |",
            other.dataset, other.windows, other.auroc, other.novelty
        )?;
    }
    Ok(())
}
