//! Plots with axes, lines and points, as SVG. The page's style sheet sets the colours.

use std::fmt::Write as _;
use std::ops::Range;

use crate::chart::{range, tick_label};
use crate::html::escape;
use crate::residual_plot::Bin;
use crate::time_series::Curve;

/// Width and height [px], small enough that the text stays readable on a narrow screen.
const SIZE: (f64, f64) = (520.0, 290.0);
/// Left, top, right and bottom of the axes [px].
const BOX: [f64; 4] = [78.0, 10.0, 508.0, 242.0];

/// Plot area with axes.
struct Plane {
    x: Range<f64>,
    y: Range<f64>,
    svg: String,
}

/// Plots lines over time.
pub fn curves(curves: &[Curve], y_label: &str) -> String {
    let points = || curves.iter().flat_map(|curve| curve.pieces.iter().flatten());
    let (first, last) = points().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), (t, _)| (a.min(*t), b.max(*t)));
    let x = if first < last { first..last } else { 0.0..1.0 };
    let mut plane = Plane::new(x, range(points().map(|(_, value)| *value)), "time [s]", y_label);
    for curve in curves {
        for piece in &curve.pieces {
            plane.line(piece.iter().copied(), curve.class);
        }
    }
    plane.end()
}

/// Plots binned means with their spread, and the explained part as a line.
pub fn law(bins: &[Bin], x_label: &str, y_label: &str) -> String {
    let y = bins.iter().flat_map(|bin| [bin.spread[0], bin.spread[1], bin.mean, bin.law]);
    let mut plane = Plane::new(range(bins.iter().map(|bin| bin.x)), range(y), x_label, y_label);
    for bin in bins {
        let ([x, low], [_, high]) = (plane.to_px(bin.x, bin.spread[0]), plane.to_px(bin.x, bin.spread[1]));
        plane.add(&format!("<path class=\"spread\" d=\"M{x:.1} {low:.1}V{high:.1}\"/>"));
    }
    plane.line(bins.iter().map(|bin| (bin.x, bin.law)), "law");
    for bin in bins {
        let [x, y] = plane.to_px(bin.x, bin.mean);
        plane.add(&format!("<circle class=\"mean\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\"/>"));
    }
    plane.end()
}

impl Plane {
    fn new(x: Range<f64>, y: Range<f64>, x_label: &str, y_label: &str) -> Self {
        let [left, top, right, bottom] = BOX;
        let (width, height) = SIZE;
        let label = escape(&format!("{y_label} over {x_label}"));
        let svg = format!("<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{label}\">");
        let mut plane = Self { x, y, svg };
        for value in ticks(&plane.y) {
            let [_, y] = plane.to_px(plane.x.start, value);
            let name = tick_label(value, plane.y.end - plane.y.start).replace('-', "−");
            let class = if value == 0.0 { "zero" } else { "rule" };
            plane.add(&format!("<path class=\"{class}\" d=\"M{left} {y:.1}H{right}\"/>"));
            plane.add(&format!("<text class=\"y\" x=\"{:.1}\" y=\"{:.1}\">{name}</text>", left - 7.0, y + 4.0));
        }
        for value in ticks(&plane.x) {
            let [x, _] = plane.to_px(value, plane.y.start);
            let name = tick_label(value, plane.x.end - plane.x.start).replace('-', "−");
            let class = if value == 0.0 && plane.x.start < 0.0 { "zero" } else { "rule" };
            plane.add(&format!("<path class=\"{class}\" d=\"M{x:.1} {top}V{bottom}\"/>"));
            plane.add(&format!("<text class=\"x\" x=\"{x:.1}\" y=\"{:.1}\">{name}</text>", bottom + 18.0));
        }
        let (middle, centre) = (f64::midpoint(left, right), f64::midpoint(top, bottom));
        plane.add(&format!("<text class=\"x\" x=\"{middle}\" y=\"{}\">{}</text>", height - 8.0, escape(x_label)));
        let turn = format!("transform=\"translate(13 {centre}) rotate(-90)\"");
        plane.add(&format!("<text class=\"x\" {turn}>{}</text>", escape(y_label)));
        plane
    }

    fn to_px(&self, x: f64, y: f64) -> [f64; 2] {
        let [left, top, right, bottom] = BOX;
        let share = |value: f64, range: &Range<f64>| (value - range.start) / (range.end - range.start);
        [left + share(x, &self.x) * (right - left), bottom - share(y, &self.y) * (bottom - top)]
    }

    fn line(&mut self, points: impl Iterator<Item = (f64, f64)>, class: &str) {
        let mut path = String::new();
        for (x, y) in points {
            let [x, y] = self.to_px(x, y);
            write!(path, "{}{x:.1} {y:.1}", if path.is_empty() { "M" } else { "L" })
                .expect("writing to a String cannot fail");
        }
        self.add(&format!("<path class=\"line {class}\" d=\"{path}\"/>"));
    }

    fn add(&mut self, element: &str) {
        self.svg.push_str(element);
    }

    fn end(self) -> String {
        self.svg + "</svg>"
    }
}

/// Returns about five round numbers in a range.
fn ticks(range: &Range<f64>) -> Vec<f64> {
    let span = range.end - range.start;
    let rough = span / 5.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * power).into_iter().find(|step| *step >= rough);
    let step = step.unwrap_or(span);
    let (first, last) = ((range.start / step).ceil() as i64, (range.end / step).floor() as i64);
    (first..=last).map(|index| index as f64 * step).collect()
}

/// Plots a value with its interval over the prior range.
pub fn whisker(value: f64, [low, high]: [f64; 2], prior: [f64; 2]) -> String {
    const WIDTH: f64 = 400.0;
    let known = [value, low, high, prior[0], prior[1]].into_iter().filter(|end| end.is_finite());
    let whole = range(known);
    let to_px = |value: f64| ((value - whole.start) / (whole.end - whole.start)).clamp(0.0, 1.0) * WIDTH;
    let [value, low, high, from, to] = [value, low, high, prior[0], prior[1]].map(to_px);
    format!(
        "<svg class=\"whisker\" viewBox=\"0 0 {WIDTH} 24\" role=\"img\" aria-label=\"value and interval\">\
         <rect class=\"plausible\" x=\"{from:.1}\" y=\"4\" width=\"{:.1}\" height=\"16\" rx=\"3\"/>\
         <path class=\"interval\" d=\"M{low:.1} 7V17M{low:.1} 12H{high:.1}M{high:.1} 7V17\"/>\
         <circle class=\"value\" cx=\"{value:.1}\" cy=\"12\" r=\"4.5\"/></svg>",
        (to - from).max(1.0)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside_the_range() {
        assert_eq!(ticks(&(-0.9..2.1)), [0.0, 1.0, 2.0]);
        assert_eq!(ticks(&(0.0..16.0)).len(), 4);
    }

    #[test]
    fn unbounded_interval_fills_the_line() {
        let svg = whisker(1.0, [f64::NEG_INFINITY, f64::INFINITY], [0.0, 2.0]);
        assert!(svg.contains("M0.0 7V17M0.0 12H400.0") && !svg.contains("inf") && !svg.contains("NaN"), "{svg}");
    }
}
