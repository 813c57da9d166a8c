//! Error by horizon as an SVG line chart.

use plotters::prelude::{
    ChartBuilder, Circle, DashedLineSeries, EmptyElement, IntoDrawingArea, IntoLogRange, LineSeries, PathElement, RGBColor,
    SVGBackend, SeriesLabelPosition, ShapeStyle, WHITE,
};
use plotters::style::Color;

use super::Chart;
use crate::evaluation::EvaluationError;
use crate::evaluation::baselines::Method;

const SIZE_PX: (u32, u32) = (860, 480);
/// Errors are shown in this unit.
const UNIT: f64 = 1e-4;

/// The chart as the text of an SVG file. Errors: `Chart`.
pub fn draw(chart: &Chart) -> Result<String, EvaluationError> {
    let mut svg = String::new();
    draw_into(&mut svg, chart).map_err(|reason| EvaluationError::Chart {
        file: chart.file.clone(),
        reason,
    })?;
    Ok(svg)
}

fn draw_into(svg: &mut String, chart: &Chart) -> Result<(), String> {
    let steps = chart.series.iter().map(|(_, values)| values.len()).max().unwrap_or(0);
    let (low, high) = bounds(chart);
    let area = SVGBackend::with_string(svg, SIZE_PX).into_drawing_area();
    area.fill(&WHITE).map_err(told)?;
    let (drawing, legend) = area.split_horizontally(640);
    let mut plot = ChartBuilder::on(&drawing)
        .caption(&chart.caption, ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(46)
        .y_label_area_size(64)
        .build_cartesian_2d(0.8..steps as f64 + 0.2, (low..high).log_scale())
        .map_err(told)?;
    plot.configure_mesh()
        .x_labels(steps + 1)
        .x_label_formatter(&|step| format!("t+{step:.0}"))
        .y_label_formatter(&|value| if *value < 1.0 { format!("{value:.2}") } else { format!("{value:.0}") })
        .x_desc("frames ahead")
        .y_desc("MSE per pixel, ×10⁻⁴ (log scale)")
        .label_style(("sans-serif", 14))
        .light_line_style(RGBColor(238, 238, 238))
        .draw()
        .map_err(told)?;
    let _ = (legend, SeriesLabelPosition::UpperLeft);
    Ok(())
}
