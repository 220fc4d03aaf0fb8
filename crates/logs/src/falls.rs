//! Detection of falls.

use serde::Serialize;

use crate::Log;
use crate::statistics::quantile;
use twinstep_model::BaseMount;

/// Cosine of the tilt beyond which the robot has fallen: 60°.
const FALLEN_COSINE: f64 = 0.5;
/// Base height below which the robot has fallen, divided by the median height of the contiguous range of rows.
const FALLEN_HEIGHT: f64 = 0.5;

/// First row of a fall: the robot was upright in the previous row and is not in this one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Fall {
    /// Name of the segment.
    pub segment: String,
    /// Data row, from 1.
    pub row: usize,
    /// Time [s].
    pub t: f64,
    /// Angle between the z axes of base and world [°]; `None` without orientation.
    pub tilt_deg: Option<f64>,
    /// Height of the base in the world frame [m]; `None` without position.
    pub height_m: Option<f64>,
}

/// Returns the falls in segments with a floating base. Returns `None` without orientation and height.
pub(crate) fn falls(log: &Log) -> Option<Vec<Fall>> {
    let (x, y, height) = (log.channel("quat_x"), log.channel("quat_y"), log.channel("pos_z"));
    let floating = log.segments().any(|(segment, _)| segment.base == BaseMount::Floating);
    if !floating || ((x.is_none() || y.is_none()) && height.is_none()) {
        return None;
    }
    let cosine = |row: usize| Some(1.0 - 2.0 * (x?[row].powi(2) + y?[row].powi(2))).filter(|cosine| !cosine.is_nan());
    let metres = |row: usize| Some(height?[row]).filter(|metres| !metres.is_nan());
    let mut falls = Vec::new();
    for (segment, rows) in log.segments().filter(|(segment, _)| segment.base == BaseMount::Floating) {
        let mut heights: Vec<f64> = rows.clone().filter_map(metres).collect();
        heights.sort_by(f64::total_cmp);
        let low = quantile(&heights, 0.5).map(|median| FALLEN_HEIGHT * median);
        let mut upright = false;
        for row in rows {
            let tilted = cosine(row).is_some_and(|cosine| cosine < FALLEN_COSINE);
            let is_low = metres(row).zip(low).is_some_and(|(metres, low)| metres < low);
            if upright && (tilted || is_low) {
                let tilt_deg = cosine(row).map(|cosine| cosine.clamp(-1.0, 1.0).acos().to_degrees());
                falls.push(Fall {
                    segment: segment.name.clone(),
                    row: row + 1,
                    t: log.t()[row],
                    tilt_deg,
                    height_m: metres(row),
                });
            }
            upright = !(tilted || is_low);
        }
    }
    Some(falls)
}
