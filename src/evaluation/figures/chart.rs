//! Error by horizon as an SVG line chart.

use std::fmt::Display;

use plotters::coord::Shift;
use plotters::prelude::{
    ChartBuilder, Circle, DashedLineSeries, DrawingArea, IntoDrawingArea, IntoLogRange, LineSeries, PathElement,
    RGBColor, SVGBackend, Text, WHITE,
};
use plotters::style::Color;

use super::Chart;
use crate::evaluation::EvaluationError;
use crate::evaluation::baselines::Method;

const SIZE_PX: (u32, u32) = (920, 480);
const LEGEND_WIDTH_PX: u32 = 250;
const LEGEND_LINE_PX: i32 = 28;
/// Errors are shown in this unit.
const UNIT: f64 = 1e-4;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

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
    let area = SVGBackend::with_string(svg, SIZE_PX).into_drawing_area();
    area.fill(&WHITE).map_err(told)?;
    let (plot, legend) = area.split_horizontally(SIZE_PX.0 - LEGEND_WIDTH_PX);
    draw_plot(&plot, chart)?;
    draw_legend(&legend, chart)?;
    area.present().map_err(told)
}

fn draw_plot(area: &Area, chart: &Chart) -> Result<(), String> {
    let steps = chart.series.iter().map(|(_, values)| values.len()).max().unwrap_or(0);
    let (low, high) = bounds(chart);
    let mut plot = ChartBuilder::on(area)
        .margin(16)
        .x_label_area_size(46)
        .y_label_area_size(70)
        .build_cartesian_2d(0.8..steps as f64 + 0.2, (low..high).log_scale())
        .map_err(told)?;
    plot.configure_mesh()
        .x_labels(steps.min(12) + 1)
        .x_label_formatter(&|step| {
            let whole = (step - step.round()).abs() < 1e-6;
            if whole { format!("t+{step:.0}") } else { String::new() }
        })
        .y_labels(12)
        .y_label_formatter(&|value| value.to_string())
        .x_desc("frames ahead")
        .y_desc("MSE per pixel, ×10⁻⁴ (log scale)")
        .label_style(("sans-serif", 14))
        .max_light_lines(0)
        .bold_line_style(RGBColor(225, 225, 225))
        .draw()
        .map_err(told)?;
    for (method, values) in &chart.series {
        let points: Vec<(f64, f64)> = (1..)
            .zip(values)
            .map(|(step, value)| (f64::from(step), shown(*value, low)))
            .collect();
        let color = color(*method);
        let style = color.stroke_width(if *method == Method::Model { 4 } else { 2 });
        if *method == Method::CodecOnly {
            plot.draw_series(DashedLineSeries::new(points.iter().copied(), 6, 5, style))
                .map_err(told)?;
        } else {
            plot.draw_series(LineSeries::new(points.iter().copied(), style))
                .map_err(told)?;
        }
        plot.draw_series(points.iter().map(|&point| Circle::new(point, 4, color.filled())))
            .map_err(told)?;
    }
    Ok(())
}

fn draw_legend(area: &Area, chart: &Chart) -> Result<(), String> {
    for (place, (method, _)) in (0..).zip(&chart.series) {
        let y = 40 + place * LEGEND_LINE_PX;
        let color = color(*method);
        let style = color.stroke_width(if *method == Method::Model { 4 } else { 2 });
        area.draw(&PathElement::new(vec![(8, y), (40, y)], style))
            .map_err(told)?;
        area.draw(&Circle::new((24, y), 4, color.filled())).map_err(told)?;
        area.draw(&Text::new(method.label(), (50, y - 9), ("sans-serif", 16)))
            .map_err(told)?;
    }
    Ok(())
}

fn told(error: impl Display) -> String {
    error.to_string()
}

/// A logarithmic axis has no zero; a value of none is drawn at the bottom.
fn shown(value: f64, low: f64) -> f64 {
    (value / UNIT).max(low)
}

/// Bounds of the axis, with some room; a perfect or still scene gives 0 everywhere.
fn bounds(chart: &Chart) -> (f64, f64) {
    let values = || {
        chart
            .series
            .iter()
            .flat_map(|(_, values)| values)
            .map(|value| value / UNIT)
            .filter(|v| *v > 0.0)
    };
    let low = values().fold(f64::INFINITY, f64::min);
    let high = values().fold(0.0, f64::max);
    if high > 0.0 {
        (low / 1.5, high * 1.5)
    } else {
        (0.1, 1.0)
    }
}

/// Colours that stay apart for most kinds of colour blindness (Okabe & Ito 2008).
fn color(method: Method) -> RGBColor {
    match method {
        Method::Model => RGBColor(213, 94, 0),
        Method::CopyLast => RGBColor(0, 114, 178),
        Method::MeanOfInputs => RGBColor(0, 158, 115),
        Method::MeanTrainingFrame => RGBColor(204, 121, 167),
        Method::LinearExtrapolation => RGBColor(230, 159, 0),
        Method::ConstantShift => RGBColor(86, 180, 233),
        Method::CodecOnly => RGBColor(90, 90, 90),
    }
}
