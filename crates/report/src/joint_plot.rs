//! Plot of a replay: one small panel per joint, with measured and simulated position.

use std::ops::Range;
use std::path::Path;

use plotters::prelude::RGBColor;
use plotters::style::text_anchor::HPos;
use twinstep_model::{Joint, JointKind, Leg};

use crate::chart::{self, Area, GREY, INK, ORANGE, Panel, PlotError};
use crate::timeline::Timeline;
use twinstep_identify::replay::{JointError, Replay};

/// Width and height of the plot [px].
const SIZE: (u32, u32) = (1500, 1320);
/// Height of the title and the legend above the panels [half px].
const HEADER_HEIGHT: u32 = 200;

/// The three lines of a panel, in the order in which they are drawn.
const LINES: [Line; 3] = [
    Line { name: "command", colour: GREY, width: 2, of: |joint| &joint.command },
    Line { name: "measured", colour: INK, width: 6, of: |joint| &joint.measured },
    Line { name: "simulated", colour: ORANGE, width: 3, of: |joint| &joint.simulated },
];

/// Plots the replay's joints as an SVG, with one row of panels per leg and one column per joint type.
///
/// The position axes of a column have the same scale. Segments of a log follow each other without pauses.
pub fn write_svg(replay: &Replay, title: &str, path: &Path) -> Result<(), PlotError> {
    chart::write(&draw(replay, title)?, path)
}

fn draw(replay: &Replay, title: &str) -> Result<String, PlotError> {
    chart::picture(SIZE, |root| {
        let (header, grid) = root.split_vertically(HEADER_HEIGHT);
        draw_header(&header, replay, title)?;
        let time = Timeline::new(&replay.t, &replay.ranges);
        for (area, joint) in grid.split_evenly((Leg::ALL.len(), JointKind::ALL.len())).iter().zip(Joint::ALL) {
            match replay.joints.iter().find(|error| error.name == joint.name()) {
                Some(error) => panel(joint, error, &time, position_range(replay, error)).draw(area)?,
                None => draw_empty_panel(area, joint)?,
            }
        }
        Ok(())
    })
}

fn draw_header(header: &Area, replay: &Replay, title: &str) -> Result<(), PlotError> {
    let centre = SIZE.0 as i32;
    chart::text(header, title, 56, HPos::Center, (centre, 60))?;
    let names: Vec<_> = LINES.iter().rev().map(|line| (line.name, line.colour)).collect();
    chart::legend(header, &names, 340, (centre - 800, 144))?;
    let overall = format!("RMSE of all joints {:.4} rad", replay.rmse_rad);
    chart::text(header, &overall, 40, HPos::Left, (centre + 260, 144))
}

fn panel(joint: Joint, error: &JointError, time: &Timeline, position_range: Range<f64>) -> Panel {
    let line =
        |line: &Line| chart::Line { colour: line.colour, width: line.width, pieces: time.points((line.of)(error)) };
    Panel {
        caption: format!("{}: RMSE {:.4} rad", error.name, error.rmse_rad),
        x_label: if joint.leg == Leg::RR { "time [s]" } else { "" },
        y_label: if joint.kind == JointKind::Hip { "position [rad]" } else { "" },
        x: time.range(),
        y: position_range,
        lines: LINES.iter().map(line).collect(),
    }
}

fn draw_empty_panel(area: &Area, joint: Joint) -> Result<(), PlotError> {
    let (width, height) = area.dim_in_pixel();
    let centre = (width as i32 / 2, height as i32 / 2);
    chart::text(area, &format!("{joint} is not in the log"), 38, HPos::Center, centre)
}

/// Line of a panel.
struct Line {
    name: &'static str,
    colour: RGBColor,
    width: u32,
    of: fn(&JointError) -> &Vec<f64>,
}

/// Returns the position range of a joint's panel [rad].
///
/// It is centred on the joint's lines. All joints of a type have the same span, so that their panels are comparable.
fn position_range(replay: &Replay, error: &JointError) -> Range<f64> {
    let of_kind = |other: &&JointError| kind(other).is_some() && kind(other) == kind(error);
    let widest = replay.joints.iter().filter(of_kind).map(bounds).map(|[low, high]| high - low).fold(0.0, f64::max);
    let [low, high] = bounds(error);
    let middle = f64::midpoint(low, high);
    // A joint at rest needs an axis, too.
    let half = (0.54 * widest).max(0.005);
    middle - half..middle + half
}

fn kind(error: &JointError) -> Option<JointKind> {
    error.name.parse().ok().map(|joint: Joint| joint.kind)
}

/// Returns the lowest and highest value of a panel's lines [rad].
fn bounds(error: &JointError) -> [f64; 2] {
    let values = || LINES.iter().flat_map(|line| (line.of)(error)).copied();
    [values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max)]
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
        // Time starts again in the second range, as it may in the episodes of a log.
        let t = (0..rows).map(|row| (row % (rows / 2)) as f64 * 0.005).collect();
        Replay { joints, t, ranges: vec![0..rows / 2, rows / 2..rows], rmse_rad: 0.05 }
    }

    #[test]
    fn plot_names_all_twelve_joints_and_stays_below_half_a_megabyte() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("joints.svg");
        write_svg(&replay(&JOINT_NAMES, 20_000), "twenty thousand rows", &path).expect("a plot");
        let svg = std::fs::read_to_string(path).expect("the plot");
        for name in JOINT_NAMES {
            assert!(svg.contains(name), "{name}");
        }
        assert!(svg.contains("twenty thousand rows"));
        assert!(svg.starts_with(r#"<svg width="1500" height="1320" viewBox="0 0 3000 2640""#));
        assert!(svg.len() < 500_000, "{}", svg.len());
    }

    #[test]
    fn joint_that_the_log_lacks_has_a_panel_with_a_note() {
        let svg = draw(&replay(&JOINT_NAMES[1..], 10), "eleven joints").expect("a plot");
        assert!(svg.contains("FL_hip is not in the log"));
    }
}
