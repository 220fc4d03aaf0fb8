//! A picture of a replay: one small panel a joint, measured against simulated.

use std::ops::Range;
use std::path::{Path, PathBuf};

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use twinstep_model::{Joint, JointKind, Leg};

use crate::replay::{JointError, Replay};

/// Width and height of the picture [px].
const SIZE: (u32, u32) = (1500, 1320);
/// Width and height of the canvas in half pixels, the unit of all lengths below: the library rounds to whole units, and
/// lines in whole pixels look like stairs.
const CANVAS: (u32, u32) = (2 * SIZE.0, 2 * SIZE.1);
/// Height of the title and the legend above the panels.
const HEADER_HEIGHT: u32 = 200;
/// Points a line, at most; a panel is about 400 pixels wide.
const MAX_POINTS: usize = 800;
const FONT: &str = "sans-serif";
const INK: RGBColor = RGBColor(0x26, 0x26, 0x26);
const RULE: RGBColor = RGBColor(0xe6, 0xe6, 0xe6);

/// The three lines of a panel, in the order in which they are drawn.
const LINES: [Line; 3] = [
    Line { name: "command", colour: RGBColor(0xa8, 0xa8, 0xa8), width: 2, of: |joint| &joint.command },
    Line { name: "measured", colour: INK, width: 6, of: |joint| &joint.measured },
    Line { name: "simulated", colour: RGBColor(0xff, 0x6a, 0x13), width: 3, of: |joint| &joint.simulated },
];

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// The drawing library failed.
    #[error("cannot draw the joints: {0}")]
    Draw(String),
    /// The system refused to write the file.
    #[error("cannot write `{path}`: {cause}")]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's answer.
        cause: std::io::Error,
    },
}

impl<E: std::error::Error + Send + Sync> From<DrawingAreaErrorKind<E>> for PlotError {
    fn from(error: DrawingAreaErrorKind<E>) -> Self {
        PlotError::Draw(error.to_string())
    }
}

/// Writes the replay's joints as an SVG: a row of panels a leg, a column each for hip, thigh and calf.
///
/// The position axes of a column have the same scale. Parts of a log follow one another without pauses.
pub fn write_svg(replay: &Replay, title: &str, path: &Path) -> Result<(), PlotError> {
    let svg = draw(replay, title)?;
    std::fs::write(path, svg).map_err(|cause| PlotError::Write { path: path.into(), cause })
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn draw(replay: &Replay, title: &str) -> Result<String, PlotError> {
    let mut svg = String::new();
    let root = SVGBackend::with_string(&mut svg, CANVAS).into_drawing_area();
    root.fill(&WHITE)?;
    let (header, grid) = root.split_vertically(HEADER_HEIGHT);
    draw_header(&header, replay, title)?;
    let time = Timeline::of(replay);
    for (area, joint) in grid.split_evenly((Leg::ALL.len(), JointKind::ALL.len())).iter().zip(Joint::ALL) {
        match replay.joints.iter().find(|error| error.name == joint.name()) {
            Some(error) => draw_panel(area, joint, error, &time, position_range(replay, error))?,
            None => draw_empty_panel(area, joint)?,
        }
    }
    root.present()?;
    drop((header, grid, root));
    let size = |(width, height): (u32, u32)| format!("<svg width=\"{width}\" height=\"{height}\" ");
    Ok(svg.replacen(&size(CANVAS), &size(SIZE), 1))
}

fn draw_header(header: &Area, replay: &Replay, title: &str) -> Result<(), PlotError> {
    let centre = CANVAS.0 as i32 / 2;
    let text = |size: u32| (FONT, size).into_text_style(header).color(&INK);
    header.draw_text(title, &text(56).pos(Pos::new(HPos::Center, VPos::Center)), (centre, 60))?;
    let (y, spacing, sample) = (144, 340, 88);
    let mut x = centre - 800;
    for line in LINES.iter().rev() {
        header.draw(&PathElement::new([(x, y), (x + sample, y)], line.colour.stroke_width(line.width + 2)))?;
        header.draw_text(line.name, &text(40).pos(Pos::new(HPos::Left, VPos::Center)), (x + sample + 20, y))?;
        x += spacing;
    }
    let overall = format!("RMSE of all joints {:.4} rad", replay.rmse_rad);
    header.draw_text(&overall, &text(40).pos(Pos::new(HPos::Left, VPos::Center)), (x + 40, y))?;
    Ok(())
}

fn draw_panel(
    area: &Area,
    joint: Joint,
    error: &JointError,
    time: &Timeline,
    position_range: Range<f64>,
) -> Result<(), PlotError> {
    let label = |size: u32| (FONT, size).into_text_style(area).color(&INK);
    let span = position_range.end - position_range.start;
    let mut chart = ChartBuilder::on(area)
        .margin(16)
        .margin_right(40)
        .caption(format!("{}: RMSE {:.4} rad", error.name, error.rmse_rad), label(38))
        .x_label_area_size(88)
        .y_label_area_size(128)
        .build_cartesian_2d(0.0..time.duration, position_range)?;
    let seconds = |seconds: &f64| tick_label(*seconds, time.duration);
    let radians = |radians: &f64| tick_label(*radians, span);
    let mut mesh = chart.configure_mesh();
    mesh.x_labels(9)
        .y_labels(6)
        .x_label_formatter(&seconds)
        .y_label_formatter(&radians)
        .set_all_tick_mark_size(10)
        .label_style(label(30))
        .axis_desc_style(label(32));
    mesh.bold_line_style(RULE.stroke_width(2))
        .light_line_style(TRANSPARENT)
        .axis_style(RGBColor(0x80, 0x80, 0x80).stroke_width(2));
    if joint.kind == JointKind::Hip {
        mesh.y_desc("position [rad]");
    }
    if joint.leg == Leg::RR {
        mesh.x_desc("time [s]");
    }
    mesh.draw()?;
    for line in &LINES {
        for points in time.points((line.of)(error)) {
            chart.draw_series(LineSeries::new(points, line.colour.stroke_width(line.width)))?;
        }
    }
    Ok(())
}

fn draw_empty_panel(area: &Area, joint: Joint) -> Result<(), PlotError> {
    let (width, height) = area.dim_in_pixel();
    let style = (FONT, 38).into_text_style(area).color(&INK).pos(Pos::new(HPos::Center, VPos::Center));
    let text = format!("{joint} is not in the log");
    Ok(area.draw_text(&text, &style, (width as i32 / 2, height as i32 / 2))?)
}

/// One of a panel's lines.
struct Line {
    name: &'static str,
    colour: RGBColor,
    width: u32,
    of: fn(&JointError) -> &Vec<f64>,
}

/// The time axis: the parts of the log one after another.
struct Timeline<'a> {
    parts: &'a [Range<usize>],
    /// Recorded time of each row, without the pauses [s].
    time: Vec<f64>,
    duration: f64,
    /// Rows that share two points of a line.
    rows_per_bucket: usize,
}

impl<'a> Timeline<'a> {
    fn of(replay: &'a Replay) -> Self {
        let mut time = Vec::with_capacity(replay.t.len());
        let mut duration = 0.0;
        for part in &replay.parts {
            let t = &replay.t[part.clone()];
            time.extend(t.iter().map(|t_row| duration + t_row - t[0]));
            duration = time.last().copied().unwrap_or(duration);
        }
        let rows_per_bucket = if time.len() <= MAX_POINTS { 1 } else { (2 * time.len()).div_ceil(MAX_POINTS) };
        Self { parts: &replay.parts, time, duration, rows_per_bucket }
    }

    /// The points of each part's line, thinned to the lowest and the highest of each bucket, which keeps every peak.
    fn points(&self, values: &[f64]) -> Vec<Vec<(f64, f64)>> {
        let by_value = |a: &usize, b: &usize| values[*a].total_cmp(&values[*b]);
        let bucket_points = |bucket: Range<usize>| {
            let lowest = bucket.clone().min_by(by_value).unwrap_or(bucket.start);
            let highest = bucket.clone().max_by(by_value).unwrap_or(bucket.start);
            let mut rows = vec![lowest.min(highest), lowest.max(highest)];
            rows.dedup();
            rows.into_iter().map(|row| (self.time[row], values[row]))
        };
        let line = |part: &Range<usize>| {
            let starts = part.clone().step_by(self.rows_per_bucket);
            starts.flat_map(|start| bucket_points(start..part.end.min(start + self.rows_per_bucket))).collect()
        };
        self.parts.iter().map(line).collect()
    }
}

/// The middle of a joint's lines, with room for the widest lines of its kind: panels of a column compare by eye [rad].
fn position_range(replay: &Replay, error: &JointError) -> Range<f64> {
    let of_kind = |other: &&JointError| kind(other).is_some() && kind(other) == kind(error);
    let widest = replay.joints.iter().filter(of_kind).map(bounds).map(|[low, high]| high - low).fold(0.0, f64::max);
    let [low, high] = bounds(error);
    let middle = f64::midpoint(low, high);
    // A joint at rest gets an axis too.
    let half = (0.54 * widest).max(0.005);
    middle - half..middle + half
}

fn kind(error: &JointError) -> Option<JointKind> {
    error.name.parse().ok().map(|joint: Joint| joint.kind)
}

/// The lowest and highest value of a panel's lines [rad].
fn bounds(error: &JointError) -> [f64; 2] {
    let values = || LINES.iter().flat_map(|line| (line.of)(error)).copied();
    [values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max)]
}

/// A number with the decimals that tell six ticks on `span` apart; never a negative zero.
fn tick_label(value: f64, span: f64) -> String {
    let decimals = (6.0 / span).log10().ceil().clamp(0.0, 6.0);
    let scale = 10f64.powf(decimals);
    let rounded = (value * scale).round() / scale + 0.0;
    format!("{rounded:.*}", decimals as usize)
}

#[cfg(test)]
mod tests {
    use twinstep_model::JOINT_NAMES;

    use super::*;

    fn replay(joints: &[&str], rows: usize) -> Replay {
        let sine = |phase: f64| (0..rows).map(|row| (row as f64 * 0.05 + phase).sin()).collect();
        let joint = |(index, name): (usize, &&str)| JointError {
            name: (*name).to_owned(),
            rmse_rad: 0.01 * index as f64,
            max_rad: 0.1,
            measured: sine(0.0),
            simulated: sine(0.1),
            command: sine(-0.1),
        };
        let joints = joints.iter().enumerate().map(joint).collect();
        // The second part starts over, as a log's episodes may.
        let t = (0..rows).map(|row| (row % (rows / 2)) as f64 * 0.005).collect();
        Replay { joints, t, parts: vec![0..rows / 2, rows / 2..rows], rmse_rad: 0.05 }
    }

    #[test]
    fn picture_names_all_twelve_joints_and_stays_below_half_a_megabyte() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("joints.svg");
        write_svg(&replay(&JOINT_NAMES, 20_000), "twenty thousand rows", &path).expect("a picture");
        let svg = std::fs::read_to_string(path).expect("the picture");
        for name in JOINT_NAMES {
            assert!(svg.contains(name), "{name}");
        }
        assert!(svg.contains("twenty thousand rows"));
        assert!(svg.starts_with(r#"<svg width="1500" height="1320" viewBox="0 0 3000 2640""#));
        assert!(svg.len() < 500_000, "{}", svg.len());
    }

    #[test]
    fn joint_that_the_log_lacks_has_a_panel_that_says_so() {
        let svg = draw(&replay(&JOINT_NAMES[1..], 10), "eleven joints").expect("a picture");
        assert!(svg.contains("FL_hip is not in the log"));
    }

    #[test]
    fn thinned_line_keeps_its_peak_and_time_never_goes_back() {
        let replay = replay(&[], 10_000);
        let time = Timeline::of(&replay);
        let mut values = vec![0.0; 10_000];
        values[7_003] = 1.0;
        let points = time.points(&values).concat();
        assert!(points.len() <= MAX_POINTS);
        assert!(points.iter().any(|(_, value)| *value == 1.0));
        assert!(points.is_sorted_by(|a, b| a.0 <= b.0));
    }

    #[test]
    fn tick_labels_differ_and_zero_has_no_sign() {
        assert_eq!([0.0, 2.0, 14.0].map(|value| tick_label(value, 16.0)), ["0", "2", "14"]);
        assert_eq!([-0.2, -1e-17, 0.2].map(|value| tick_label(value, 0.7)), ["-0.2", "0.0", "0.2"]);
        assert_eq!([1.004, 1.006].map(|value| tick_label(value, 0.01)), ["1.004", "1.006"]);
    }

    #[test]
    fn folder_that_does_not_exist_is_named() {
        let path = Path::new("/no/such/folder/joints.svg");
        let error = write_svg(&replay(&JOINT_NAMES, 10), "nowhere", path).expect_err("refused").to_string();
        assert!(error.starts_with("cannot write `/no/such/folder/joints.svg`: "), "{error}");
    }
}
