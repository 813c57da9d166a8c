//! The report in Markdown.

mod uncertainty;

use std::fmt::Write;

use super::actions::ActionTable;
use super::bootstrap::{CONFIDENCE, Interval};
use super::config::ScoredSplit;
use super::method::Method;
use super::metrics::{MethodScores, PSNR_CAP_DB, StepCurve};
use super::plans::PlanOutcome;
use super::report::{EvaluationReport, ModelSummary, ReportStamp, SetOutcome, SetReport, SetScores};

/// Squared errors are shown in this unit.
const MSE_UNIT: f64 = 1e-4;

impl EvaluationReport {
    /// The report as Markdown, with its figures in the same directory.
    #[must_use]
    pub fn to_markdown(&self) -> String {
        let mut text = String::new();
        // Writing to a string cannot fail.
        let _ = write_report(&mut text, self);
        text
    }
}

fn write_report(out: &mut String, report: &EvaluationReport) -> std::fmt::Result {
    writeln!(
        out,
        "# Model `{}` on data set `{}`\n",
        report.stamp.model, report.stamp.dataset
    )?;
    headline(out, report)?;
    for set in &report.sets {
        if let Some(scores) = set.outcome.scores() {
            writeln!(out, "\n## {}\n", set_title(&set.split))?;
            set_section(out, scores)?;
        }
    }
    uncertainty::novelty_section(out, &report.novelty)?;
    figures(out, report)?;
    how(out, report.stamp.nearest_windows)?;
    model(out, &report.model)?;
    stamp(out, &report.stamp)
}

/// What a set holds, as a heading.
pub(super) fn set_title(split: &str) -> &'static str {
    match split {
        "validation" => "Validation",
        "unseen-pairs" => "Unseen start/goal pairs",
        "unseen-gains" => "Unseen gains",
        _ => "Unseen trials",
    }
}

fn headline(out: &mut String, report: &EvaluationReport) -> std::fmt::Result {
    writeln!(
        out,
        "Skill is 1 − MSE / MSE of the strongest baseline at each step: 1 is perfect, 0 is no better than that baseline. All \
         numbers are means over t+1…t+{}; MSE is in units of 10⁻⁴.\n",
        report.model.horizon
    )?;
    if report.stamp.split == ScoredSplit::Validation {
        writeln!(
            out,
            "These are validation scores, for choosing between models and settings. Publish test scores.\n"
        )?;
    }
    if report.stamp.split == ScoredSplit::WholeSet {
        writeln!(
            out,
            "All of the data set is for testing. The mean frame and the background of the baselines are its own, and there is \
             no nearest training window.\n"
        )?;
    }
    writeln!(
        out,
        "| Set | Windows | Trials | Skill | 95 % interval | MSE | MSE on moving robots | SSIM | Strongest baseline (MSE) |"
    )?;
    writeln!(out, "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")?;
    for SetReport { split, outcome } in &report.sets {
        write!(out, "| {} (`{split}`) | ", set_title(split))?;
        match outcome {
            SetOutcome::Scored(scores) => {
                let interval = interval(scores.skill.mean_interval.as_ref(), |value| format!("{value:.3}"));
                let (windows, trials, skill) = (scores.windows, scores.trials, scores.skill.skill.mean);
                write!(out, "{windows} | {trials} | **{skill:.3}** | {interval} |")?;
                headline_errors(out, scores)?;
            }
            SetOutcome::Skipped { reason } => writeln!(out, "– | – | skipped: {reason} | – | – | – | – | – |")?,
        }
    }
    Ok(())
}

fn headline_errors(out: &mut String, scores: &SetScores) -> std::fmt::Result {
    let row = |wanted| scores.methods.iter().find(|row| row.method == wanted);
    let best = scores.skill.best_mean_baseline;
    if let (Some(model), Some(baseline)) = (row(Method::Model), row(best)) {
        let mover = model.mover_mse.as_ref();
        write!(
            out,
            " {} | {} | {:.3} | {} ({}) |",
            in_mse_units(model.mse.mean),
            mover.map_or_else(|| "–".to_owned(), |mse| in_mse_units(mse.mean)),
            model.ssim.mean,
            best.label(),
            in_mse_units(baseline.mse.mean)
        )?;
    }
    writeln!(out)
}

fn interval(interval: Option<&Interval>, format: impl Fn(f64) -> String) -> String {
    interval.map_or_else(
        || "– (one trial)".to_owned(),
        |interval| format!("{} … {}", format(interval.low), format(interval.high)),
    )
}

fn in_mse_units(value: f64) -> String {
    let scaled = value / MSE_UNIT;
    match scaled.abs() {
        size if size >= 100.0 => format!("{scaled:.0}"),
        size if size >= 10.0 => format!("{scaled:.1}"),
        size if size >= 0.1 || size == 0.0 => format!("{scaled:.2}"),
        _ => format!("{scaled:.4}"),
    }
}

fn set_section(out: &mut String, scores: &SetScores) -> std::fmt::Result {
    if scores.windows < scores.windows_available {
        writeln!(
            out,
            "{} of {} windows, evenly spread over {} trials.\n",
            scores.windows, scores.windows_available, scores.trials
        )?;
    }
    skill_table(out, scores)?;
    let methods = &scores.methods;
    table(out, "MSE per pixel, ×10⁻⁴", methods, |row| Some(&row.mse), in_mse_units)?;
    table(
        out,
        "PSNR, dB",
        methods,
        |row| Some(&row.psnr_db),
        |value| format!("{value:.2}"),
    )?;
    table(
        out,
        "SSIM",
        methods,
        |row| Some(&row.ssim),
        |value| format!("{value:.4}"),
    )?;
    benchmark_tables(out, methods)?;
    if methods.iter().any(|row| row.mover_mse.is_some()) {
        let name = "MSE on the pixels of moving robots, ×10⁻⁴";
        table(out, name, methods, |row| row.mover_mse.as_ref(), in_mse_units)?;
    } else {
        writeln!(
            out,
            "There is no error on moving robots: the data set has no masks, or no robot is in view.\n"
        )?;
    }
    if !scores.reconstruction_mse.per_step.is_empty() {
        writeln!(
            out,
            "The reconstruction of the frames seen has an MSE of {} ×10⁻⁴.\n",
            in_mse_units(scores.reconstruction_mse.mean)
        )?;
    }
    writeln!(
        out,
        "In the model's own space (smoothed, and inverted if the model inverts) the MSE is {} ×10⁻⁴. Do not compare this \
         number between models that preprocess differently.",
        in_mse_units(scores.model_space_mse.mean)
    )?;
    match &scores.actions {
        Some(table) => action_table(out, table)?,
        None => writeln!(out, "\nThe model takes no actions, so there is no action table.")?,
    }
    scores.plans.as_ref().map_or(Ok(()), |plans| plan_section(out, plans))?;
    let uncertainty = scores.uncertainty.as_ref();
    uncertainty.map_or(Ok(()), |scores| uncertainty::section(out, scores))
}

/// The scores that papers on Moving MNIST print, where they were computed.
fn benchmark_tables(out: &mut String, methods: &[MethodScores]) -> std::fmt::Result {
    if methods.iter().all(|row| row.benchmark.is_none()) {
        return Ok(());
    }
    writeln!(
        out,
        "As papers on Moving MNIST print them: squared errors summed over the pixels of a frame, and SSIM with scikit-image's \
         even windows of 7×7 px for a data range of 1.\n"
    )?;
    table(
        out,
        "Squared error, sum over a frame",
        methods,
        |row| row.benchmark.as_ref().map(|scores| &scores.squared_error),
        |value| format!("{value:.1}"),
    )?;
    table(
        out,
        "SSIM, even 7×7 windows",
        methods,
        |row| row.benchmark.as_ref().map(|scores| &scores.ssim),
        |value| format!("{value:.4}"),
    )
}

fn plan_section(out: &mut String, plans: &PlanOutcome) -> std::fmt::Result {
    writeln!(out, "\n### Plan identification\n")?;
    let percent = |value: f64| format!("{:.1} %", 100.0 * value);
    match plans {
        PlanOutcome::Measured(plans) => writeln!(
            out,
            "The simulator carried out {} plans from each of {} contexts. The true future of a plan is nearest to the \
             model's prediction for that plan in **{}** of the cases (95 % interval: {}; guessing gives {}).",
            plans.plans,
            plans.contexts,
            percent(plans.rate),
            interval(plans.interval.as_ref(), percent),
            percent(plans.chance)
        ),
        PlanOutcome::Skipped { reason } => writeln!(out, "Not measured: {reason}."),
    }
}

fn header(out: &mut String, first: &str, steps: usize) -> std::fmt::Result {
    write!(out, "| {first} |")?;
    for step in 1..=steps {
        write!(out, " t+{step} |")?;
    }
    writeln!(out, " mean |")?;
    writeln!(out, "| --- |{}", " ---: |".repeat(steps + 1))
}

fn skill_table(out: &mut String, scores: &SetScores) -> std::fmt::Result {
    let skill = &scores.skill;
    header(out, "Skill", skill.skill.per_step.len())?;
    row(out, "**skill**", &skill.skill, |value| format!("**{value:.3}**"))?;
    write!(out, "| 95 % interval |")?;
    let intervals = skill.per_step_interval.iter().map(Some);
    let none = std::iter::repeat_n(None, skill.skill.per_step.len() - skill.per_step_interval.len());
    for step in intervals.chain(none).chain([skill.mean_interval.as_ref()]) {
        write!(out, " {} |", interval(step, |value| format!("{value:.3}")))?;
    }
    write!(out, "\n| against |")?;
    for method in &skill.best_baseline {
        write!(out, " {} |", method.label())?;
    }
    writeln!(out, " |\n")
}

fn table<'a>(
    out: &mut String,
    name: &str,
    methods: &'a [MethodScores],
    curve: impl Fn(&'a MethodScores) -> Option<&'a StepCurve>,
    format: impl Fn(f64) -> String,
) -> std::fmt::Result {
    let steps = methods.first().map_or(0, |method| method.mse.per_step.len());
    header(out, name, steps)?;
    for method in methods {
        let Some(curve) = curve(method) else { continue };
        if method.method == Method::Model {
            row(out, "**model**", curve, |value| format!("**{}**", format(value)))?;
        } else {
            row(out, method.method.label(), curve, &format)?;
        }
    }
    writeln!(out)
}

fn row(out: &mut String, label: &str, curve: &StepCurve, format: impl Fn(f64) -> String) -> std::fmt::Result {
    write!(out, "| {label} |")?;
    for &value in curve.per_step.iter().chain([&curve.mean]) {
        write!(out, " {} |", format(value))?;
    }
    writeln!(out)
}

fn action_table(out: &mut String, table: &ActionTable) -> std::fmt::Result {
    writeln!(out, "\n### Does the action matter?\n")?;
    writeln!(out, "{}\n", table.finding)?;
    writeln!(
        out,
        "| Actions or model | MSE, ×10⁻⁴ | 95 % interval | True actions lower it by | 95 % interval |"
    )?;
    writeln!(out, "| --- | ---: | ---: | ---: | ---: |")?;
    let percent = |value: f64| format!("{:.1} %", 100.0 * value);
    for (place, row) in table.rows.iter().enumerate() {
        let mse = in_mse_units(row.mse.mean);
        let mse_interval = interval(row.interval.as_ref(), in_mse_units);
        let (reduction, reduction_interval) = if place == 0 {
            ("–".to_owned(), "–".to_owned())
        } else {
            (
                percent(row.reduction),
                interval(row.reduction_interval.as_ref(), percent),
            )
        };
        writeln!(
            out,
            "| {} | {mse} | {mse_interval} | {reduction} | {reduction_interval} |",
            row.variant.label()
        )?;
    }
    Ok(())
}

fn figures(out: &mut String, report: &EvaluationReport) -> std::fmt::Result {
    if report.figures.is_empty() {
        return Ok(());
    }
    writeln!(out, "\n## Pictures\n")?;
    writeln!(
        out,
        "The windows are those with the median, the least and the greatest error of the model in each set."
    )?;
    for figure in &report.figures {
        writeln!(out, "\n![{0}]({1})\n\n{0}.", figure.caption, figure.file)?;
    }
    Ok(())
}

fn how(out: &mut String, nearest_windows: usize) -> std::fmt::Result {
    writeln!(out, "\n## How this was measured\n")?;
    writeln!(
        out,
        "Frames are compared as the camera saw them: intensities 0…1, neither inverted nor smoothed. PSNR is the mean of the \
         frames' PSNR, each at most {PSNR_CAP_DB:.0} dB (the error of rounding to 8 bits). SSIM uses an 11-tap Gaussian \
         window, sigma 1.5. Intervals hold {:.0} % of the bootstrap resamples of whole trials, in a recording of \
         blocks of time as long as five windows. The strongest baseline is \
         chosen at each step, and again in each resample.\n",
        100.0 * CONFIDENCE
    )?;
    for (method, how) in [
        (Method::CopyLast, "the last input frame, repeated"),
        (Method::MeanOfInputs, "the mean of the input frames"),
        (Method::MeanTrainingFrame, "the mean frame of the training split"),
        (
            Method::LinearExtrapolation,
            "the least-squares line through each pixel's inputs, continued",
        ),
        (
            Method::ConstantShift,
            "the last frame moved on by the shift between the last two inputs (phase correlation)",
        ),
        (
            Method::EgoMotion,
            "the last frame warped by the commanded rotation of the camera, through the data set's camera model; without \
             a camera model, by an affine motion that depends linearly on the actions, fitted to the training split",
        ),
        (
            Method::MovingCutOut,
            "the largest connected group of pixels that differ from the background, moved on at constant velocity over \
             the background; the background is the temporal median of the training split, or of the inputs where the \
             camera looks elsewhere; the true mask is not used",
        ),
        (
            Method::NearestWindow,
            &format!(
                "the future of the training window (one of at most {}) whose inputs have the least MSE",
                grouped(nearest_windows as u64)
            ),
        ),
        (
            Method::CodecOnly,
            "the true future frame through the model's frame encoder and decoder; this is no prediction",
        ),
    ] {
        writeln!(out, "- {}: {how}.", method.label())?;
    }
    Ok(())
}

fn model(out: &mut String, model: &ModelSummary) -> std::fmt::Result {
    writeln!(out, "\n## Model\n")?;
    writeln!(out, "| | |\n| --- | --- |")?;
    writeln!(
        out,
        "| frames | {}×{} px every {} s, {} seen, {} predicted |",
        model.frame_width_px, model.frame_height_px, model.frame_period_s, model.context, model.horizon
    )?;
    writeln!(out, "| conditioning | {} |", model.conditioning)?;
    writeln!(
        out,
        "| intensities | {} |",
        if model.inverted { "inverted" } else { "as they are" }
    )?;
    writeln!(out, "| parameters | {} |", grouped(model.parameters))?;
    writeln!(
        out,
        "| multiply–adds per predicted frame | {} |",
        grouped(model.multiply_adds_per_frame)
    )?;
    writeln!(
        out,
        "| trained on | {} windows of `{}` (`{}`) |",
        model.trained_on.windows, model.trained_on.name, model.trained_on.content_hash
    )
}

/// 1234567 as 1 234 567.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

fn stamp(out: &mut String, stamp: &ReportStamp) -> std::fmt::Result {
    let commit = stamp.program.git_commit.as_deref().unwrap_or("unknown");
    writeln!(out, "\n## Stamp\n")?;
    writeln!(out, "| | |\n| --- | --- |")?;
    writeln!(
        out,
        "| data set | `{}`, content `{}` |",
        stamp.dataset, stamp.dataset_content_hash
    )?;
    writeln!(out, "| split seed | {} |", stamp.split_seed.0)?;
    writeln!(out, "| model | `{}`, weights `{}` |", stamp.model, stamp.model_sha256)?;
    for (name, hash) in &stamp.twins {
        writeln!(out, "| twin | `{name}`, weights `{hash}` |")?;
    }
    writeln!(
        out,
        "| program | foreframe {}, commit {commit} |",
        stamp.program.version
    )?;
    writeln!(out, "| command | `{}` |", stamp.command)?;
    writeln!(
        out,
        "| windows | {}; {} resamples, seed {} |",
        match stamp.stride {
            1 => "one starts at every frame".to_owned(),
            stride => format!("one starts every {stride} frames"),
        },
        stamp.bootstrap_samples,
        stamp.seed.0
    )?;
    writeln!(
        out,
        "| time | {:.1} s on {}, {} threads |",
        stamp.wall_time_s, stamp.cpu, stamp.threads
    )
}
