//! Small charts as SVG. The colours are those of the page's style sheet.

use std::fmt::Write as _;

use super::delays::LagCorrelation;
use super::histogram::Histogram;

const WIDTH: f64 = 320.0;
const HEIGHT: f64 = 84.0;

/// A point of time that the timeline marks.
pub(super) struct Mark {
    /// 0 (start) to 1 (end).
    pub(super) at: f64,
    pub(super) title: String,
}

fn svg(width: f64, height: f64, label: &str, content: &str) -> String {
    format!(
        "<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{label}\" preserveAspectRatio=\"none\">{content}</svg>"
    )
}

/// Bars, one for each range.
pub(super) fn bars(counts: &[u64]) -> String {
    let most = counts.iter().copied().max().unwrap_or_default().max(1) as f64;
    let step = WIDTH / counts.len().max(1) as f64;
    let mut content = String::new();
    for (place, &count) in counts.iter().enumerate() {
        // A bar that is not empty can be seen.
        let height = if count == 0 {
            0.0
        } else {
            (HEIGHT * count as f64 / most).max(1.0)
        };
        let _ = write!(
            content,
            "<rect x=\"{:.2}\" y=\"{:.2}\" width=\"{:.2}\" height=\"{height:.2}\"><title>{count}</title></rect>",
            place as f64 * step,
            HEIGHT - height,
            step * 0.86
        );
    }
    svg(WIDTH, HEIGHT, "histogram", &content)
}

/// A histogram with its least and greatest value below.
pub(super) fn histogram(histogram: &Histogram, unit: &str) -> String {
    let (from, to) = (number(histogram.from), number(histogram.to));
    let ends = format!("<div class=\"ends\"><span>{from}</span><span>{unit}</span><span>{to}</span></div>");
    bars(&histogram.counts) + &ends
}

/// A correlation for each lag: a line with the zero lag and the greatest correlation marked.
pub(super) fn lags(lags: &[LagCorrelation], delay: Option<f64>) -> String {
    let Some((first, last)) = lags.first().zip(lags.last()) else {
        return String::new();
    };
    let (from, to) = (first.lag_frames as f64, last.lag_frames as f64);
    let x = |lag: f64| WIDTH * (lag - from) / (to - from).max(1.0);
    let y = |correlation: f64| HEIGHT * (0.5 - 0.48 * correlation);
    let points: Vec<String> = lags
        .iter()
        .map(|lag| format!("{:.1},{:.1}", x(lag.lag_frames as f64), y(lag.correlation)))
        .collect();
    let mut content = format!(
        "<path class=\"axis\" d=\"M0 {0:.1}H{WIDTH}M{1:.1} 0V{HEIGHT}\"/><polyline points=\"{2}\"/>",
        y(0.0),
        x(0.0),
        points.join(" ")
    );
    if let Some(delay) = delay {
        let _ = write!(content, "<path class=\"found\" d=\"M{:.1} 0V{HEIGHT}\"/>", x(delay));
    }
    let ends = format!("<span>{from:.0} frames</span><span>0</span><span>+{to:.0} frames</span>");
    format!(
        "{}<div class=\"ends\">{ends}</div>",
        svg(WIDTH, HEIGHT, "correlation by lag", &content)
    )
}

/// The range of the brightness (0 to 255) in equal parts of time, with marks.
pub(super) fn timeline(ranges: &[[f64; 2]], marks: &[Mark]) -> String {
    const LONG: f64 = 960.0;
    let step = LONG / ranges.len().max(1) as f64;
    let y = |level: f64| HEIGHT * (1.0 - level / 255.0);
    let point = |(place, level): (usize, f64)| format!("{:.1} {:.1}", (place as f64 + 0.5) * step, y(level));
    let upper = ranges.iter().map(|range| range[1]).enumerate().map(point);
    let lower = ranges.iter().map(|range| range[0]).enumerate().rev().map(point);
    let outline: Vec<String> = upper.chain(lower).collect();
    let mut content = format!("<path class=\"area\" d=\"M{}Z\"/>", outline.join("L"));
    for mark in marks {
        let _ = write!(
            content,
            "<path class=\"found\" d=\"M{:.1} 0V{HEIGHT}\"><title>{}</title></path>",
            mark.at * LONG,
            mark.title
        );
    }
    svg(LONG, HEIGHT, "brightness over time", &content)
}

/// A number with about three digits that count.
pub(super) fn number(value: f64) -> String {
    let digits = match value.abs() {
        0.0 => 0,
        size if size >= 1000.0 => 0,
        size if size >= 100.0 => 1,
        size if size >= 1.0 => 2,
        size if size >= 0.01 => 3,
        _ => return format!("{value:.1e}"),
    };
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_the_digits_that_count() {
        let texts: Vec<String> = [0.0, 0.0512, -1.5, 123.4, 4096.2, 1e-5].map(number).into();
        assert_eq!(texts, ["0", "0.051", "-1.50", "123.4", "4096", "1.0e-5"]);
    }

    #[test]
    fn a_chart_of_nothing_is_empty() {
        assert_eq!(lags(&[], None), "");
        assert!(!bars(&[]).contains("<rect") && !timeline(&[], &[]).contains("NaN"));
    }
}
