//! Plot of an evaluation: the error of each joint, and the worst joint over time.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;
use twinstep_identify::{Evaluation, JointEvaluation};
use twinstep_logs::Log;

use crate::chart::{self, Area, GREY, INK, Line, ORANGE, Panel, PlotError};
use crate::timeline::Timeline;

/// Width and height of the plot [px].
const SIZE: (u32, u32) = (1500, 900);
/// Heights of the title and of the bars [half px].
const HEADER_HEIGHT: u32 = 110;
const BARS_HEIGHT: u32 = 800;

/// Simulated minus measured position [rad] with its row, by joint.
pub type Errors = BTreeMap<String, Vec<(usize, f64)>>;

/// Plots the errors of the joints as bars, and the joint with the largest position error over time.
pub fn write_svg(
    log: &Log,
    evaluation: &Evaluation,
    errors: &Errors,
    title: &str,
    path: &Path,
) -> Result<(), PlotError> {
    let svg = chart::picture(SIZE, |root| {
        let (header, rest) = root.split_vertically(HEADER_HEIGHT);
        chart::text(&header, title, 52, HPos::Center, (SIZE.0 as i32, 60))?;
        let (upper, lower) = rest.split_vertically(BARS_HEIGHT);
        let [q, torque] = [evaluation.q_rmse_rad, evaluation.torque_rmse_nm];
        let mut bars = Vec::new();
        let of = |joint: fn(&JointEvaluation) -> Option<f64>| heights(log.joints(), evaluation, joint);
        bars.extend(q.map(|all| ("joint position, RMSE [rad]", of(|joint| joint.q_rmse_rad), all)));
        bars.extend(torque.map(|all| ("torque, RMSE [N·m]", of(|joint| joint.torque_rmse_nm), all)));
        for (area, (name, heights, all)) in upper.split_evenly((1, bars.len().max(1))).iter().zip(&bars) {
            draw_bars(area, name, heights, *all)?;
        }
        match worst(evaluation) {
            Some(joint) => draw_joint(&lower, log, joint, errors.get(joint).map_or(&[], Vec::as_slice)),
            None => chart::text(&lower, "the log has no measured position", 40, HPos::Center, (SIZE.0 as i32, 400)),
        }
    })?;
    chart::write(&svg, path)
}

/// Returns the joint with the largest position error.
fn worst(evaluation: &Evaluation) -> Option<&str> {
    let errors = evaluation.per_joint.iter().filter_map(|(name, joint)| Some((name, joint.q_rmse_rad?)));
    errors.max_by(|one, other| one.1.total_cmp(&other.1)).map(|(name, _)| name.as_str())
}

/// Returns the known errors of the joints, in the order of `joints`.
fn heights<'a>(
    joints: &'a [String],
    evaluation: &Evaluation,
    of: fn(&JointEvaluation) -> Option<f64>,
) -> Vec<(&'a str, f64)> {
    joints.iter().filter_map(|joint| Some((joint.as_str(), of(evaluation.per_joint.get(joint)?)?))).collect()
}

fn draw_bars(area: &Area, name: &str, heights: &[(&str, f64)], overall: f64) -> Result<(), PlotError> {
    let label = |size: u32| ("sans-serif", size).into_text_style(area).color(&INK);
    let highest = heights.iter().map(|(_, height)| *height).fold(1e-6, f64::max);
    let mut chart = ChartBuilder::on(area)
        .margin(16)
        .margin_right(40)
        .caption(format!("{name}; over all joints {overall:.4}"), label(40))
        .x_label_area_size(60)
        .y_label_area_size(160)
        .build_cartesian_2d(-0.5..heights.len() as f64 - 0.5, 0.0..1.1 * highest)?;
    let joint_name = |position: &f64| {
        let joint = heights.get(position.round() as usize).filter(|_| position.fract().abs() < 1e-6);
        joint.map_or(String::new(), |(joint, _)| (*joint).to_owned())
    };
    let tick = |value: &f64| chart::tick_label(*value, 1.1 * highest);
    let mut mesh = chart.configure_mesh();
    mesh.disable_x_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(GREY.stroke_width(1))
        .x_labels(heights.len())
        .y_labels(6)
        .x_label_formatter(&joint_name)
        .y_label_formatter(&tick)
        .label_style(label(32))
        .axis_style(GREY.stroke_width(2));
    mesh.draw()?;
    let bar = |(index, (_, height)): (usize, &(&str, f64))| {
        let middle = index as f64;
        Rectangle::new([(middle - 0.35, 0.0), (middle + 0.35, *height)], ORANGE.filled())
    };
    chart.draw_series(heights.iter().enumerate().map(bar))?;
    Ok(())
}

fn draw_joint(area: &Area, log: &Log, joint: &str, errors: &[(usize, f64)]) -> Result<(), PlotError> {
    let rows: Vec<usize> = errors.iter().map(|(row, _)| *row).collect();
    let at = |cells: &[f64]| rows.iter().map(|row| cells[*row]).collect::<Vec<f64>>();
    let t = at(log.t());
    let measured = log.q(joint).map_or(Vec::new(), at);
    let simulated: Vec<f64> = measured.iter().zip(errors).map(|(measured, (_, error))| measured + error).collect();
    let parts = parts(log, &rows);
    let timeline = Timeline::new(&t, &parts);
    let values = measured.iter().chain(&simulated).copied();
    let lines = [(&measured, INK, 6), (&simulated, ORANGE, 3)];
    let line =
        |(values, colour, width): (&Vec<f64>, RGBColor, u32)| Line { colour, width, pieces: timeline.points(values) };
    let panel = Panel {
        caption: format!("{joint}, the joint with the largest error"),
        x_label: "time [s]",
        y_label: "joint position [rad]",
        x: timeline.range(),
        y: chart::range(values),
        lines: lines.map(line).into(),
    };
    panel.draw(area)?;
    chart::legend(area, &[("measured", INK), ("simulated", ORANGE)], 340, (160, 40))
}

/// Returns the ranges of `rows` that belong to the same contiguous range of the log.
fn parts(log: &Log, rows: &[usize]) -> Vec<Range<usize>> {
    let of =
        |part: Range<usize>| rows.partition_point(|row| *row < part.start)..rows.partition_point(|row| *row < part.end);
    log.segments().map(|(_, part)| of(part)).filter(|part| !part.is_empty()).collect()
}
