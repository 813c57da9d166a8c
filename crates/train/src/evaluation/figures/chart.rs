//! Error by horizon as an SVG line chart.

use std::error::Error;

use plotters::coord::Shift;
use plotters::coord::combinators::BindKeyPoints;
use plotters::element::DashedPathElement;
use plotters::prelude::{
    ChartBuilder, Circle, DashedLineSeries, DrawingArea, IntoDrawingArea, IntoLogRange, LineSeries, PathElement,
    RGBColor, SVGBackend, Text, WHITE,
};
use plotters::style::{Color, ShapeStyle};

use crate::evaluation::method::Method;

const SIZE_PX: (u32, u32) = (920, 480);
const LEGEND_WIDTH_PX: u32 = 250;
const LEGEND_LINE_PX: i32 = 28;
/// Errors are shown in this unit.
const UNIT: f64 = 1e-4;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// The values of a method at t+1, t+2, …
pub(super) type Series = (Method, Vec<f64>);

/// The chart as the text of an SVG file. Errors: those of the drawing library.
pub(super) fn draw(series: &[Series]) -> Result<String, Box<dyn Error>> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE_PX).into_drawing_area();
        area.fill(&WHITE)?;
        let (plot, legend) = area.split_horizontally(SIZE_PX.0 - LEGEND_WIDTH_PX);
        draw_plot(&plot, series)?;
        draw_legend(&legend, series)?;
        area.present()?;
    }
    Ok(svg)
}

fn draw_plot(area: &Area, series: &[Series]) -> Result<(), Box<dyn Error>> {
    let steps = series.iter().map(|(_, values)| values.len()).max().unwrap_or(0);
    let (low, high) = bounds(series);
    let mut plot = ChartBuilder::on(area)
        .margin(16)
        .x_label_area_size(50)
        .y_label_area_size(74)
        .build_cartesian_2d(
            0.8..steps as f64 + 0.2,
            (low..high).log_scale().with_key_points(ticks(low, high)),
        )?;
    plot.configure_mesh()
        .x_labels(steps.min(12) + 1)
        .x_label_formatter(&|step| {
            let whole = (step - step.round()).abs() < 1e-6;
            if whole { format!("t+{step:.0}") } else { String::new() }
        })
        .y_label_formatter(&|value| format!("{}", (value * 1e6).round() / 1e6))
        .x_desc("frames ahead")
        .y_desc("MSE per pixel, ×10⁻⁴ (log scale)")
        .label_style(("sans-serif", 16))
        .max_light_lines(0)
        .bold_line_style(RGBColor(225, 225, 225))
        .draw()?;
    // The model is the first series and is drawn last, over the others.
    for &(method, ref values) in series.iter().rev() {
        let points = (1..).zip(values);
        // A logarithmic axis has no zero; a value of 0 is drawn at the bottom.
        let points = points.map(|(step, value)| (f64::from(step), (value / UNIT).max(low)));
        if is_dashed(method) {
            plot.draw_series(DashedLineSeries::new(points.clone(), 6, 5, stroke(method)))?;
        } else {
            plot.draw_series(LineSeries::new(points.clone(), stroke(method)))?;
        }
        plot.draw_series(points.map(|point| Circle::new(point, 4, color(method).filled())))?;
    }
    Ok(())
}

fn draw_legend(area: &Area, series: &[Series]) -> Result<(), Box<dyn Error>> {
    // From the greatest to the least error at the last step, in the order of the lines' ends.
    let last = |(_, values): &&Series| values.last().copied().unwrap_or(0.0);
    let mut series: Vec<_> = series.iter().collect();
    series.sort_by(|one, other| last(other).total_cmp(&last(one)));
    for (place, &(method, _)) in (0..).zip(series) {
        let y = 40 + place * LEGEND_LINE_PX;
        let ends = [(8, y), (40, y)];
        if is_dashed(method) {
            area.draw(&DashedPathElement::new(ends, 6, 5, stroke(method)))?;
        } else {
            area.draw(&PathElement::new(ends, stroke(method)))?;
        }
        area.draw(&Circle::new((24, y), 4, color(method).filled()))?;
        area.draw(&Text::new(method.label(), (50, y - 9), ("sans-serif", 18)))?;
    }
    Ok(())
}

/// The codec sees the true frame, so it is no prediction.
fn is_dashed(method: Method) -> bool {
    method == Method::CodecOnly
}

fn stroke(method: Method) -> ShapeStyle {
    color(method).stroke_width(if method == Method::Model { 4 } else { 2 })
}

/// Bounds of the axis, with some room; a perfect or still scene gives 0 everywhere.
fn bounds(series: &[Series]) -> (f64, f64) {
    let values = series.iter().flat_map(|(_, values)| values).map(|value| value / UNIT);
    let values: Vec<f64> = values.filter(|&value| value > 0.0).collect();
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(0.0, f64::max);
    if high > 0.0 {
        (low / 1.5, high * 1.5)
    } else {
        (0.1, 1.0)
    }
}

/// 1, 2 and 5 of every decade in the range; powers of ten alone where there would be too many.
fn ticks(low: f64, high: f64) -> Vec<f64> {
    let decades = low.log10().floor() as i32..=high.log10().ceil() as i32;
    let steps: &[f64] = if high / low > 1e4 { &[1.0] } else { &[1.0, 2.0, 5.0] };
    let all = decades.flat_map(|decade| steps.iter().map(move |step| step * 10f64.powi(decade)));
    all.filter(|tick| (low..=high).contains(tick)).collect()
}

/// Colours that most colour-blind readers can tell apart (Okabe & Ito 2008, and two more).
fn color(method: Method) -> RGBColor {
    match method {
        Method::Model => RGBColor(213, 94, 0),
        Method::CopyLast => RGBColor(0, 114, 178),
        Method::MeanOfInputs => RGBColor(0, 158, 115),
        Method::MeanTrainingFrame => RGBColor(204, 121, 167),
        Method::LinearExtrapolation => RGBColor(230, 159, 0),
        Method::ConstantShift => RGBColor(86, 180, 233),
        Method::EgoMotion => RGBColor(0, 0, 0),
        Method::GroundAndWall => RGBColor(120, 160, 60),
        Method::PlaneSweep => RGBColor(150, 60, 150),
        Method::MovingCutOut => RGBColor(190, 170, 0),
        Method::NearestWindows => RGBColor(130, 80, 40),
        Method::Black => RGBColor(60, 60, 160),
        Method::CodecOnly => RGBColor(110, 110, 110),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_axis_has_fewer_ticks_per_decade() {
        assert_eq!(ticks(0.9, 30.0), [1.0, 2.0, 5.0, 10.0, 20.0]);
        assert_eq!(ticks(1.5, 9.0), [2.0, 5.0]);
        assert_eq!(ticks(1e-4, 1e4).len(), 9);
    }

    #[test]
    fn the_legend_has_the_order_of_the_lines_ends() {
        let series = [
            (Method::Model, vec![1e-4, 2e-4]),
            (Method::CopyLast, vec![3e-4, 9e-4]),
            (Method::CodecOnly, vec![1e-4, 1e-4]),
        ];
        let svg = draw(&series).unwrap();
        let place = |method: Method| svg.find(method.label()).unwrap();
        assert!(place(Method::CopyLast) < place(Method::Model) && place(Method::Model) < place(Method::CodecOnly));
    }
}
