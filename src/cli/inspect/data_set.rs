//! A data set: text, JSON and an HTML page.

use std::path::Path;

use crate::cli::error::CliError;
use crate::cli::process::print_line;
use foreframe_core::error_text::comma_separated;
use foreframe_core::files::write_atomically;
use foreframe_data::dataset::{Dataset, DatasetInfo};
use foreframe_data::inspection::{ActionDelay, ChannelSummary, Inspection, inspect, page};

/// Looks through a data set and prints what was found, also as a page into the file `html`.
pub(super) fn describe(dir: &Path, dataset: &Dataset, html: Option<&Path>, is_json: bool) -> Result<(), CliError> {
    let inspection = inspect(dataset)?;
    if let Some(path) = html {
        let page = page(&inspection, dataset).map_err(CliError::failed)?;
        write_atomically(path, page.as_bytes()).map_err(|error| CliError::io("write", path, &error))?;
    }
    if is_json {
        return print_line(serde_json::to_string_pretty(&inspection).map_err(CliError::failed)?);
    }
    print_description(dir, dataset.info())?;
    print_times(&inspection)?;
    print_images(&inspection)?;
    inspection.channels.iter().try_for_each(print_channel)?;
    let period_s = inspection.timing.frame_period_s;
    inspection
        .delays
        .iter()
        .try_for_each(|delay| print_delay(delay, period_s))?;
    if inspection.warnings.is_empty() {
        print_line("no warnings")?;
    }
    let mut warnings = inspection.warnings.iter();
    warnings.try_for_each(|warning| print_line(format!("warning: {warning}")))?;
    match html {
        Some(path) => print_line(format!("page: {}", path.display())),
        None => Ok(()),
    }
}

fn print_description(dir: &Path, info: &DatasetInfo) -> Result<(), CliError> {
    print_line(format!("{} ({})", dir.display(), info.name))?;
    print_line(format!(
        "  frames      {} of {}×{} px, {} s apart",
        info.frame_count, info.frame_width_px, info.frame_height_px, info.frame_period_s
    ))?;
    print_line(format!("  episodes    {}", info.episode_count))?;
    print_line(format!("  action      [{}]", comma_separated(&info.action_channels)))?;
    print_line(format!("  state       [{}]", comma_separated(&info.state_channels)))?;
    print_line(format!("  masks       {}", if info.has_masks { "yes" } else { "no" }))?;
    print_line(format!("  camera      {}", camera(info)))?;
    print_line(format!(
        "  scenario    {}",
        info.scenario.as_deref().unwrap_or("none (recorded)")
    ))?;
    print_line(format!("  content     SHA-256 {}", info.content_hash))
}

fn camera(info: &DatasetInfo) -> String {
    if info.world.as_ref().is_some_and(|world| world.rooms.is_some()) {
        return "each trial has its own".to_owned();
    }
    info.camera.map_or_else(
        || "not described".to_owned(),
        |camera| {
            let height = camera.height_m;
            format!(
                "pinhole, {:.1}° wide, tilted down {:.1}°{}",
                camera.horizontal_fov_rad.to_degrees(),
                camera.tilt_down_rad.to_degrees(),
                height.map_or_else(String::new, |height_m| format!(", {height_m} m above the floor"))
            )
        },
    )
}

fn print_times(inspection: &Inspection) -> Result<(), CliError> {
    let timing = &inspection.timing;
    print_line(format!(
        "  lengths     {:.1} s in all; episodes of {} to {} frames, median {}",
        timing.total_s, timing.shortest_episode_frames, timing.longest_episode_frames, timing.median_episode_frames
    ))?;
    print_line(format!(
        "  steps       {:.1} to {:.1} ms, median {:.1} ms; {} of {} irregular, {} gaps",
        timing.shortest_step_s * 1e3,
        timing.longest_step_s * 1e3,
        timing.median_step_s * 1e3,
        timing.irregular_steps,
        timing.steps,
        timing.gaps.len()
    ))
}

fn print_images(inspection: &Inspection) -> Result<(), CliError> {
    let images = &inspection.images;
    print_line(format!(
        "  images      mean gray level {:.0}, black {:.1} %, white {:.1} %, mean change to the next frame {:.1} levels",
        images.mean_level,
        100.0 * images.black_share,
        100.0 * images.white_share,
        images.mean_change
    ))?;
    print_line(format!(
        "  repeats     {} frames equal the one before; {} frozen places; {} exposure jumps",
        images.repeated_frames.len(),
        images.frozen.len(),
        images.exposure_jumps.len()
    ))
}

fn print_channel(channel: &ChannelSummary) -> Result<(), CliError> {
    print_line(format!(
        "  {:<11} {} {}: {} to {}, mean {}, deviation {}  {}",
        channel.role,
        channel.name,
        channel.unit,
        shown(channel.min),
        shown(channel.max),
        shown(channel.mean),
        shown(channel.std),
        sparkline(&channel.histogram.counts)
    ))
}

/// A number with three decimals, or with three digits that count if it is too small for them.
fn shown(value: f64) -> String {
    if value != 0.0 && value.abs() < 0.01 {
        format!("{value:.2e}")
    } else {
        format!("{value:.3}")
    }
}

/// A histogram in one line of text.
fn sparkline(counts: &[u64]) -> String {
    const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let pairs: Vec<u64> = counts.chunks(2).map(|pair| pair.iter().sum()).collect();
    let most = pairs.iter().copied().max().unwrap_or_default().max(1);
    let level = |count: u64| match count {
        0 => ' ',
        count => LEVELS[(count * 7 / most) as usize],
    };
    pairs.into_iter().map(level).collect()
}

fn print_delay(delay: &ActionDelay, period_s: f64) -> Result<(), CliError> {
    let found = delay.delay_frames.map_or_else(
        || "too little correlation to say".to_owned(),
        |frames| format!("{frames:+.1} frames ({:+.2} s)", frames * period_s),
    );
    print_line(format!(
        "  delay       {} → {}: {found}, correlation {:.2} ({:.2} without a delay)",
        delay.action, delay.motion, delay.correlation, delay.correlation_without_lag
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_numbers_keep_their_digits() {
        assert_eq!(
            [0.0, 7e-5, -0.25, 123.0].map(shown),
            ["0.000", "7.00e-5", "-0.250", "123.000"]
        );
    }

    #[test]
    fn a_sparkline_shows_empty_and_full_ranges() {
        assert_eq!(sparkline(&[0, 0, 1, 0, 40, 40]), " ▁█");
    }
}
