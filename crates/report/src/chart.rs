//! Plots as SVG: panels with axes and lines, in one style for all commands.

use std::ops::Range;
use std::path::{Path, PathBuf};

use plotters::coord::Shift;
use plotters::prelude::*;
pub use plotters::style::RGBColor;
pub use plotters::style::text_anchor::HPos;
use plotters::style::text_anchor::{Pos, VPos};

/// Units of length per pixel. plotters rounds to whole units, and lines in whole pixels look like stairs.
const UNITS: u32 = 2;
const FONT: &str = "sans-serif";
/// Colour of text, of measurements, and of a simulation without an effect.
pub const INK: RGBColor = RGBColor(0x26, 0x26, 0x26);
/// Colour of commands.
pub const GREY: RGBColor = RGBColor(0xa8, 0xa8, 0xa8);
/// Colour of simulations.
pub const ORANGE: RGBColor = RGBColor(0xff, 0x6a, 0x13);
const RULE: RGBColor = RGBColor(0xe6, 0xe6, 0xe6);

/// Reason why a plot could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The motion of the plot could not be simulated.
    #[error("cannot simulate the motion of the plot: {0}")]
    Simulate(String),
    /// The drawing library failed.
    #[error("cannot draw the plot: {0}")]
    Draw(String),
    /// The file could not be written.
    #[error("cannot write `{path}`: {cause}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        cause: std::io::Error,
    },
}

impl<E: std::error::Error + Send + Sync> From<DrawingAreaErrorKind<E>> for PlotError {
    fn from(error: DrawingAreaErrorKind<E>) -> Self {
        PlotError::Draw(error.to_string())
    }
}

/// Part of a plot.
pub type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Returns an error if `path` cannot be written. Called before the work, so that its result cannot be lost.
pub fn check_writable(path: &Path) -> Result<(), PlotError> {
    let opened = std::fs::OpenOptions::new().append(true).create(true).open(path);
    opened.map(drop).map_err(|cause| PlotError::Write { path: path.into(), cause })
}

/// Writes a plot.
pub fn write(svg: &str, path: &Path) -> Result<(), PlotError> {
    twinstep_files::write(path, svg).map_err(|cause| PlotError::Write { path: path.into(), cause })
}

/// Returns an SVG of `size` [px]. `draw` works in half pixels.
pub fn picture(size: (u32, u32), draw: impl FnOnce(&Area) -> Result<(), PlotError>) -> Result<String, PlotError> {
    let canvas = (UNITS * size.0, UNITS * size.1);
    let mut svg = String::new();
    let root = SVGBackend::with_string(&mut svg, canvas).into_drawing_area();
    root.fill(&WHITE)?;
    draw(&root)?;
    root.present()?;
    drop(root);
    let tag = |(width, height): (u32, u32)| format!("<svg width=\"{width}\" height=\"{height}\" ");
    Ok(svg.replacen(&tag(canvas), &tag(size), 1))
}

/// Draws text of `height` [half px]. `at` selects whether `position` is its start or its centre.
pub fn text(area: &Area, text: &str, height: u32, at: HPos, position: (i32, i32)) -> Result<(), PlotError> {
    let style = (FONT, height).into_text_style(area).color(&INK).pos(Pos::new(at, VPos::Center));
    Ok(area.draw_text(text, &style, position)?)
}

/// Draws line samples with their names from `x` to the right, at intervals of `spacing`.
pub fn legend(area: &Area, lines: &[(&str, RGBColor)], spacing: i32, (mut x, y): (i32, i32)) -> Result<(), PlotError> {
    const SAMPLE: i32 = 88;
    for (name, colour) in lines {
        area.draw(&PathElement::new([(x, y), (x + SAMPLE, y)], colour.stroke_width(6)))?;
        text(area, name, 40, HPos::Left, (x + SAMPLE + 20, y))?;
        x += spacing;
    }
    Ok(())
}

/// Line of a panel.
pub struct Line {
    /// Colour of the line.
    pub colour: RGBColor,
    /// Width of the line [half px].
    pub width: u32,
    /// Pieces of the line, each a list of points.
    pub pieces: Vec<Vec<(f64, f64)>>,
}

/// Panel with axes and lines.
pub struct Panel {
    /// Title above the panel.
    pub caption: String,
    /// Label of the x axis; may be empty.
    pub x_label: &'static str,
    /// Label of the y axis; may be empty.
    pub y_label: &'static str,
    /// Range of the x axis.
    pub x: Range<f64>,
    /// Range of the y axis.
    pub y: Range<f64>,
    /// Lines, in drawing order.
    pub lines: Vec<Line>,
}

impl Panel {
    /// Draws the panel.
    pub fn draw(&self, area: &Area) -> Result<(), PlotError> {
        let label = |size: u32| (FONT, size).into_text_style(area).color(&INK);
        let mut chart = ChartBuilder::on(area)
            .margin(16)
            .margin_right(40)
            .caption(&self.caption, label(40))
            .x_label_area_size(88)
            .y_label_area_size(160)
            .build_cartesian_2d(self.x.clone(), self.y.clone())?;
        let x_tick = |value: &f64| tick_label(*value, self.x.end - self.x.start);
        let y_tick = |value: &f64| tick_label(*value, self.y.end - self.y.start);
        let mut mesh = chart.configure_mesh();
        mesh.x_labels(9)
            .y_labels(6)
            .x_label_formatter(&x_tick)
            .y_label_formatter(&y_tick)
            .set_all_tick_mark_size(10)
            .label_style(label(34))
            .axis_desc_style(label(36));
        mesh.bold_line_style(RULE.stroke_width(2))
            .light_line_style(TRANSPARENT)
            .axis_style(RGBColor(0x80, 0x80, 0x80).stroke_width(2));
        if !self.x_label.is_empty() {
            mesh.x_desc(self.x_label);
        }
        if !self.y_label.is_empty() {
            mesh.y_desc(self.y_label);
        }
        mesh.draw()?;
        for line in &self.lines {
            for piece in &line.pieces {
                chart.draw_series(LineSeries::new(piece.iter().copied(), line.colour.stroke_width(line.width)))?;
            }
        }
        Ok(())
    }
}

/// Returns the range of the finite `values` with a margin. The range of equal values is centred on them.
pub fn range(values: impl Iterator<Item = f64>) -> Range<f64> {
    let finite = values.filter(|value| value.is_finite());
    let (low, high) = finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    let (low, high) = if low <= high { (low, high) } else { (0.0, 0.0) };
    let room = (0.06 * (high - low)).max(1e-3);
    low - room..high + room
}

/// Formats a number with enough decimals to distinguish six ticks on `span`. Never returns a negative zero.
pub fn tick_label(value: f64, span: f64) -> String {
    let decimals = (6.0 / span).log10().ceil().clamp(0.0, 6.0);
    let scale = 10f64.powf(decimals);
    let rounded = (value * scale).round() / scale + 0.0;
    format!("{rounded:.*}", decimals as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tick_labels_differ_and_zero_has_no_sign() {
        assert_eq!([0.0, 2.0, 14.0].map(|value| tick_label(value, 16.0)), ["0", "2", "14"]);
        assert_eq!([-0.2, -1e-17, 0.2].map(|value| tick_label(value, 0.7)), ["-0.2", "0.0", "0.2"]);
        assert_eq!([1.004, 1.006].map(|value| tick_label(value, 0.01)), ["1.004", "1.006"]);
    }

    #[test]
    fn range_has_a_margin_and_ignores_nan() {
        assert_eq!(range([0.0, f64::NAN, 100.0].into_iter()), -6.0..106.0);
        assert!(!range(std::iter::empty()).is_empty());
    }

    #[test]
    fn error_names_a_path_that_cannot_be_written() {
        let path = Path::new("/no/such/folder/joints.svg");
        for refused in [check_writable(path), write("", path)] {
            let error = refused.expect_err("refused").to_string();
            assert!(error.starts_with("cannot write `/no/such/folder/joints.svg`: "), "{error}");
        }
    }
}
