//! Heights of the feet of a standing robot, from measured joint positions and orientation.
//!
//! Feet that stand on flat ground are at one height. An encoder that slips moves the computed height of its foot, and nothing is
//! simulated to see it. Neither is the position of the base needed: heights are relative to the other feet.

use std::ops::Range;

use twinstep_logs::Log;
use twinstep_model::{BaseMount, FootKinematics, JOINT_NAMES, Joint, NUM_JOINTS, NUM_LEGS, PerJoint, RobotModel};

use crate::orientation::orientation;

/// Time over which heights are averaged [s].
const BLOCK_S: f64 = 0.5;
/// Root mean square of the joint velocities in a block below which the robot stands or sways [rad/s].
const STANDING: f64 = 0.4;
/// Change of a joint position from which the lever arm is computed [rad].
const STEP: f32 = 1e-2;
/// Number of neighbouring blocks whose errors are not independent: a robot that sways loads its legs in turn.
const CORRELATED_BLOCKS: f64 = 4.0;
/// Least number of independent blocks in each half of the rows.
const LEAST_BLOCKS: f64 = 2.0;

/// Heights of the feet in all blocks of a log in which the robot stands.
#[derive(Clone, Debug)]
pub struct FootHeights {
    blocks: Vec<Block>,
}

#[derive(Clone, Debug)]
struct Block {
    rows: Range<usize>,
    /// Mean height of each foot above the mean of the other three [m].
    heights: [f64; NUM_LEGS],
    /// Derivative of the height of a joint's foot with respect to its position [m/rad].
    levers: [f64; NUM_JOINTS],
}

/// Change of an encoder offset from the first half of the blocks to the second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OffsetChange {
    /// The change [rad].
    pub value: f64,
    /// Its standard error [rad].
    pub std: f64,
}

impl FootHeights {
    /// Computes the heights with the lengths of `robot`. There are none if the log lacks orientation, joint positions or
    /// velocities.
    pub fn new(log: &Log, robot: &RobotModel) -> Self {
        let columns = |of: fn(&Log, &str) -> Option<Vec<f64>>| -> Option<Vec<Vec<f64>>> {
            JOINT_NAMES.iter().map(|joint| of(log, joint)).collect()
        };
        let q = columns(|log, joint| log.q(joint).map(<[f64]>::to_vec));
        let dq = columns(|log, joint| log.dq(joint).map(<[f64]>::to_vec));
        let (Some(q), Some(dq), Some(_)) = (q, dq, log.channel("quat_w")) else { return Self { blocks: Vec::new() } };
        let feet = FootKinematics::new(robot);
        let length = ((BLOCK_S * log.meta().rate_hz).round() as usize).max(1);
        let floating = log.segments().filter(|(segment, _)| segment.base == BaseMount::Floating);
        let blocks = floating.flat_map(|(_, rows)| {
            (rows.start..rows.end).step_by(length).map(move |start| start..rows.end.min(start + length))
        });
        let stands = |rows: &Range<usize>| {
            let squares = dq.iter().flat_map(|dq| &dq[rows.clone()]).map(|dq| dq * dq);
            // False for rows without a velocity.
            squares.sum::<f64>() / (rows.len() * NUM_JOINTS) as f64 <= STANDING * STANDING
        };
        let block = |rows: Range<usize>| {
            let poses = rows.clone().map(|row| std::array::from_fn(|joint| q[joint][row] as f32));
            let of_rows: Vec<_> = rows.clone().zip(poses).map(|(row, q)| heights(log, row, &feet, &q)).collect();
            let middle = rows.start + rows.len() / 2;
            let pose = std::array::from_fn(|joint| q[joint][middle] as f32);
            let mean = |leg: usize| of_rows.iter().map(|heights| heights[leg]).sum::<f64>() / of_rows.len() as f64;
            let means: [f64; NUM_LEGS] = std::array::from_fn(mean);
            let relative =
                |leg: usize| (means[leg] * NUM_LEGS as f64 - means.iter().sum::<f64>()) / (NUM_LEGS - 1) as f64;
            Block {
                rows,
                heights: std::array::from_fn(relative),
                levers: std::array::from_fn(|joint| lever(log, middle, &feet, &pose, joint)),
            }
        };
        let blocks = blocks.filter(stands).map(block).filter(|block| block.heights.iter().all(|one| one.is_finite()));
        Self { blocks: blocks.collect() }
    }

    /// Returns the height of a foot above the mean of the other three by row of the log, averaged over half a second; NaN where the
    /// robot does not stand [m].
    pub fn table(&self, leg: usize, rows: usize) -> Vec<f64> {
        let mut table = vec![f64::NAN; rows];
        for block in &self.blocks {
            table[block.rows.clone()].fill(block.heights[leg]);
        }
        table
    }

    /// Returns by how much the encoder offset of a joint changes from the first half of the blocks to the second; `None` if there are
    /// too few.
    pub fn offset_change(&self, joint: Joint) -> Option<OffsetChange> {
        let (first, second) = self.blocks.split_at(self.blocks.len() / 2);
        let independent = first.len() as f64 / CORRELATED_BLOCKS;
        if independent < LEAST_BLOCKS {
            return None;
        }
        let height = |block: &Block| block.heights[joint.leg as usize];
        let mean = |half: &[Block]| half.iter().map(height).sum::<f64>() / half.len() as f64;
        let variance = |half: &[Block]| {
            let mean = mean(half);
            half.iter().map(|block| (height(block) - mean).powi(2)).sum::<f64>() / half.len() as f64 / independent
        };
        let levers = self.blocks.iter().map(|block| block.levers[joint.index()]);
        let lever = levers.sum::<f64>() / self.blocks.len() as f64;
        // A measured position that is too large puts the foot where the lever arm says.
        let value = (mean(second) - mean(first)) / lever;
        Some(OffsetChange { value, std: (variance(first) + variance(second)).sqrt() / lever.abs() })
    }
}

/// Returns the height of each foot relative to the base's origin, in world axes [m].
fn heights(log: &Log, row: usize, feet: &FootKinematics, q: &PerJoint) -> [f64; NUM_LEGS] {
    let rotation = orientation(log, row);
    feet.feet(q, &[0.0; NUM_JOINTS]).map(|foot| (rotation * foot.position.as_dvec3()).z)
}

/// Returns the derivative of the height of a joint's foot with respect to its position [m/rad].
fn lever(log: &Log, row: usize, feet: &FootKinematics, q: &PerJoint, joint: usize) -> f64 {
    let leg = joint / (NUM_JOINTS / NUM_LEGS);
    let [low, high] = [-STEP, STEP].map(|step| {
        let mut moved = *q;
        moved[joint] += step;
        heights(log, row, feet, &moved)[leg]
    });
    (high - low) / f64::from(2.0 * STEP)
}

#[cfg(test)]
mod tests {
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::go2;

    use super::*;

    /// Returns a log of a robot that hangs for 10 s and is on the ground for 20 s with this velocity of all joints [rad/s]. Its left
    /// front calf has this encoder offset [rad] at each time.
    fn log(offset: impl Fn(f64) -> f64, speed: f64) -> Log {
        const ROWS: usize = 6000;
        let column = |name: String, of: &dyn Fn(f64) -> f64| {
            (name, (0..ROWS).map(|row| of(row as f64 / 200.0)).collect::<Vec<f64>>())
        };
        let pose = go2().control.default_pose;
        let mut columns = vec![column("t".to_owned(), &|t| t)];
        for (joint, name) in JOINT_NAMES.into_iter().enumerate() {
            let measured = |t: f64| pose[joint] + if name == "FL_calf" { offset(t) } else { 0.0 };
            columns.push(column(format!("q_{name}"), &measured));
            columns.push(column(format!("q_cmd_{name}"), &|_| pose[joint]));
            columns.push(column(format!("dq_{name}"), &|_| speed));
        }
        let constants = [("kp", 25.0), ("kd", 0.6), ("quat_w", 1.0), ("quat_x", 0.0), ("quat_y", 0.0), ("quat_z", 0.0)];
        columns.extend(constants.map(|(name, value)| column(name.to_owned(), &|_| value)));
        columns.push(column("segment".to_owned(), &|t| f64::from(t >= 10.0)));
        let segment = |name: &str, base| Segment { name: name.to_owned(), base };
        let segments = vec![segment("air", BaseMount::Fixed), segment("stance", BaseMount::Floating)];
        Log::new(Meta::new(200.0, TorqueSensor::None, segments), columns).expect("a log")
    }

    #[test]
    fn encoder_that_slips_moves_its_foot_and_a_constant_offset_does_not_change() {
        let calf = Joint::ALL[2];
        let change = |log: &Log| FootHeights::new(log, &go2()).offset_change(calf).expect("20 s").value;
        assert!(change(&log(|_| 0.03, 0.1)).abs() < 1e-6);
        // From 15 s to 25 s, the middles of both halves.
        let slipping = log(|t| 0.003 * t, 0.1);
        assert!((change(&slipping) - 0.03).abs() < 2e-3, "{}", change(&slipping));
        let table = FootHeights::new(&slipping, &go2()).table(0, slipping.rows());
        assert!(table[..2000].iter().all(|height| height.is_nan()), "it hangs");
        assert!((table[5999] - table[2000]).abs() > 5e-3);
    }

    #[test]
    fn feet_of_a_robot_that_walks_have_no_height() {
        assert_eq!(FootHeights::new(&log(|_| 0.0, 0.1), &go2()).blocks.len(), 40);
        let walking = FootHeights::new(&log(|_| 0.0, 2.0), &go2());
        assert!(walking.blocks.is_empty());
        assert_eq!(walking.offset_change(Joint::ALL[2]), None);
    }
}
