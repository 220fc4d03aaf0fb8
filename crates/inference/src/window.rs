//! Windows of a log, which are simulated from their first measured state.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use twinstep_model::RobotTree;
use twinstep_sim::Placement;

use crate::JointLog;
use crate::joint_log::SelectedRows;

/// Length of windows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WindowLength {
    /// One window for the selected rows of each contiguous range; every row after the first is compared.
    WholeRanges,
    /// Windows of this length [s], of which the first part is not compared: errors of the initial state decay in it.
    Seconds {
        /// Length of a window [s].
        length: f64,
        /// Length of its first part [s]; at most half of the window.
        burn_in: f64,
    },
}

impl WindowLength {
    /// Windows for identification: several oscillations of a slow loop, and the decay of its start.
    pub const IDENTIFICATION: Self = Self::Seconds { length: 4.0, burn_in: 0.4 };
}

/// Rows that are simulated from the first of them.
#[derive(Clone, Debug, PartialEq)]
pub struct Window {
    /// Rows of the log.
    pub rows: Range<usize>,
    /// First row of the contiguous range: commands of earlier rows arrive in the window after their delay.
    pub range_start: usize,
    /// First row that is compared.
    pub first_compared: usize,
    /// Measured state of the first row.
    pub start: Placement,
}

/// Splits a log into windows. Joints that the log lacks are at the middle of their range.
pub fn windows(log: &JointLog, robot: &RobotTree, length: WindowLength) -> Vec<Window> {
    let mut found = Vec::new();
    for SelectedRows { rows: selected, range, base_orientation } in &log.selected {
        let duration = log.t[selected.end - 1] - log.t[selected.start];
        let (parts, burn_in) = match length {
            WindowLength::WholeRanges => (1, 0.0),
            WindowLength::Seconds { length, burn_in } => ((duration / length).round().max(1.0) as usize, burn_in),
        };
        for part in 0..parts {
            let at = |part: usize| selected.start + (selected.len() - 1) * part / parts;
            let rows = at(part)..at(part + 1) + 1;
            let burn_in = burn_in.min(0.5 * (log.t[rows.end - 1] - log.t[rows.start]));
            let compared = rows.clone().skip(1).find(|row| log.t[*row] - log.t[rows.start] >= burn_in);
            let Some(first_compared) = compared else { continue };
            let start = start(log, robot, range, rows.start, *base_orientation);
            found.push(Window { rows, range_start: range.start, first_compared, start });
        }
    }
    found
}

/// Returns the measured state in a row of a contiguous range.
fn start(
    log: &JointLog,
    robot: &RobotTree,
    range: &Range<usize>,
    row: usize,
    orientation: Option<[f64; 4]>,
) -> Placement {
    let middle = |[low, high]: [f64; 2]| if (high - low).is_finite() { f64::midpoint(low, high) } else { 0.0 };
    let mut start = Placement::of(robot, robot.joints.iter().map(|joint| middle(joint.range)).collect());
    if let Some(orientation) = orientation {
        start.base_orientation = orientation;
    }
    let t = &log.t[range.clone()];
    for channels in &log.joints {
        let [q, derivative] = smoothed(t, &channels.q[range.clone()], row - range.start);
        let measured = channels.dq.as_ref().map(|dq| smoothed(t, &dq[range.clone()], row - range.start)[0]);
        start.q[channels.joint] = q;
        start.dq[channels.joint] = measured.filter(|dq| dq.is_finite()).unwrap_or(derivative);
    }
    start
}

/// Returns value and derivative at `row` of a parabola through the cells within five rows or 20 ms.
fn smoothed(t: &[f64], cells: &[f64], row: usize) -> [f64; 2] {
    let near = (0..cells.len())
        .filter(|other| (other.abs_diff(row) <= 2 || (t[*other] - t[row]).abs() < 0.0201) && cells[*other].is_finite());
    let near: Vec<_> = near.map(|other| (t[other] - t[row], cells[other])).collect();
    if near.is_empty() {
        return [cells[row], 0.0];
    }
    let order = near.len().min(3);
    let scale = near.iter().map(|(t, _)| t.abs()).fold(1e-3, f64::max);
    let design = DMatrix::from_fn(near.len(), order, |row, power| (near[row].0 / scale).powi(power as i32));
    let values = DVector::from_iterator(near.len(), near.iter().map(|(_, value)| *value));
    let solved = (design.transpose() * &design).cholesky().map(|factor| factor.solve(&(design.transpose() * values)));
    solved.map_or([cells[row], 0.0], |fit| [fit[0], fit.get(1).map_or(0.0, |slope| slope / scale)])
}
