//! Heights of the feet of a standing robot, from measured joint positions and orientation.
//!
//! Feet that stand on level ground are at one height. An encoder that slips moves the computed height of its foot, and nothing is
//! simulated to see it. Neither is the position of the base needed: heights are relative to the other feet.

use std::ops::Range;

use twinstep_logs::Log;
use twinstep_model::{BaseMount, Feet, JOINT_NAMES, Joint, NUM_JOINTS, NUM_LEGS, PerJoint, RobotModel};

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
const LEAST_BLOCKS: f64 = 4.0;
/// Least share of the rows of a block that must be measured.
const LEAST_SHARE: f64 = 0.5;
/// Height above the other feet from which a foot does not stand, or the ground is not level [m].
const MAX_HEIGHT_M: f64 = 0.03;
/// Difference of heights that contact explains [m].
const CONTACT_M: f64 = 0.002;
/// Least lever arm: a joint whose foot it moves along the ground hardly changes its height [m/rad].
const LEAST_LEVER: f64 = 0.05;

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
        let feet = Feet::from(robot);
        let length = ((BLOCK_S * log.meta().rate_hz).round() as usize).max(1);
        let floating = log.segments().filter(|(segment, _)| segment.base == BaseMount::Floating);
        let blocks = floating.flat_map(|(_, rows)| {
            (rows.start..rows.end).step_by(length).map(move |start| start..rows.end.min(start + length))
        });
        let stands = |rows: &Range<usize>| {
            let speeds: Vec<f64> =
                dq.iter().flat_map(|dq| &dq[rows.clone()]).copied().filter(|dq| dq.is_finite()).collect();
            let squares: f64 = speeds.iter().map(|dq| dq * dq).sum();
            speeds.len() as f64 >= LEAST_SHARE * (rows.len() * NUM_JOINTS) as f64
                && squares <= STANDING * STANDING * speeds.len() as f64
        };
        // Positions of the joints, of which the measured ones contain the encoder offsets.
        let pose = |row: usize| -> PerJoint {
            std::array::from_fn(|joint| (q[joint][row] - robot.joints[joint].actuator.encoder_offset) as f32)
        };
        let block = |rows: Range<usize>| {
            let is_measured = |row: &usize| {
                let rotation = ["w", "x", "y", "z"].map(|part| log.channel(&format!("quat_{part}")));
                rotation.iter().all(|part| part.is_some_and(|part| part[*row].is_finite()))
            };
            let measured: Vec<usize> = rows.clone().filter(is_measured).collect();
            if (measured.len() as f64) < LEAST_SHARE * rows.len() as f64 {
                return None;
            }
            let of_rows: Vec<_> = measured.iter().map(|row| heights(log, *row, &feet, &pose(*row))).collect();
            let mean = |leg: usize| of_rows.iter().map(|heights| heights[leg]).sum::<f64>() / of_rows.len() as f64;
            let means: [f64; NUM_LEGS] = std::array::from_fn(mean);
            let relative =
                |leg: usize| (means[leg] * NUM_LEGS as f64 - means.iter().sum::<f64>()) / (NUM_LEGS - 1) as f64;
            let middle = measured[measured.len() / 2];
            Some(Block {
                rows,
                heights: std::array::from_fn(relative),
                levers: std::array::from_fn(|joint| lever(log, middle, &feet, &pose(middle), joint)),
            })
        };
        let is_on_ground = |block: &Block| block.heights.iter().all(|height| height.abs() < MAX_HEIGHT_M);
        Self { blocks: blocks.filter(stands).filter_map(block).filter(is_on_ground).collect() }
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

    /// Returns by how much the encoder offset of a joint changes from the first half of the blocks to the second.
    ///
    /// `None` if there are too few blocks, if the joint hardly changes the height of its foot, if contact explains the change, or
    /// if the height of another foot changes more.
    pub fn offset_change(&self, joint: Joint) -> Option<OffsetChange> {
        let (first, second) = self.blocks.split_at(self.blocks.len() / 2);
        let independent = first.len() as f64 / CORRELATED_BLOCKS;
        let levers = self.blocks.iter().map(|block| block.levers[joint.index()]);
        let lever = levers.sum::<f64>() / self.blocks.len().max(1) as f64;
        if independent < LEAST_BLOCKS || lever.abs() < LEAST_LEVER {
            return None;
        }
        let mean =
            |half: &[Block], leg: usize| half.iter().map(|block| block.heights[leg]).sum::<f64>() / half.len() as f64;
        let changes: [f64; NUM_LEGS] = std::array::from_fn(|leg| mean(second, leg) - mean(first, leg));
        let leg = joint.leg as usize;
        if changes[leg].abs() < CONTACT_M || changes.iter().any(|change| change.abs() > changes[leg].abs()) {
            return None;
        }
        let variance = |half: &[Block]| {
            let squares = half.iter().map(|block| (block.heights[leg] - mean(half, leg)).powi(2));
            squares.sum::<f64>() / half.len() as f64 / (independent - 1.0)
        };
        // A measured position that is too large puts the foot where the lever arm says.
        let std = (variance(first) + variance(second)).sqrt() / lever.abs();
        Some(OffsetChange { value: changes[leg] / lever, std })
    }
}

/// Returns the height of each foot relative to the base's origin, in world axes [m].
fn heights(log: &Log, row: usize, feet: &Feet, q: &PerJoint) -> Vec<f64> {
    let rotation = orientation(log, row);
    feet.motions(q, &[0.0; NUM_JOINTS]).map(|foot| (rotation * foot.position.as_dvec3()).z).collect()
}

/// Returns the derivative of the height of a joint's foot with respect to its position [m/rad].
fn lever(log: &Log, row: usize, feet: &Feet, q: &PerJoint, joint: usize) -> f64 {
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

    const CALF: Joint = Joint::ALL[2];

    /// Returns a log of a robot that hangs for 10 s and is on the ground for 40 s with this velocity of all joints [rad/s]. Its
    /// knees bend after 30 s, and its left front calf has this encoder offset [rad] at each time.
    fn log(offset: impl Fn(f64) -> f64, speed: f64) -> Log {
        log_with(offset, speed, |_| 1.0)
    }

    /// Returns the same log with this cell of the orientation at each time.
    fn log_with(offset: impl Fn(f64) -> f64, speed: f64, quat_w: impl Fn(f64) -> f64) -> Log {
        const ROWS: usize = 10_000;
        let column = |name: String, of: &dyn Fn(f64) -> f64| {
            (name, (0..ROWS).map(|row| of(row as f64 / 200.0)).collect::<Vec<f64>>())
        };
        // Bent by `bend`, each foot stays below its hip.
        let pose = |joint: usize, t: f64| {
            let bend = if t < 30.0 { 0.6 } else { 1.1 };
            [0.0, bend, -2.0 * bend][joint % 3]
        };
        let mut columns = vec![column("t".to_owned(), &|t| t)];
        for (joint, name) in JOINT_NAMES.into_iter().enumerate() {
            let measured = |t: f64| pose(joint, t) + if joint == CALF.index() { offset(t) } else { 0.0 };
            columns.push(column(format!("q_{name}"), &measured));
            columns.push(column(format!("q_cmd_{name}"), &|t| pose(joint, t)));
            columns.push(column(format!("dq_{name}"), &|_| speed));
        }
        let constants = [("kp", 25.0), ("kd", 0.6), ("quat_x", 0.0), ("quat_y", 0.0), ("quat_z", 0.0)];
        columns.extend(constants.map(|(name, value)| column(name.to_owned(), &|_| value)));
        columns.push(column("quat_w".to_owned(), &quat_w));
        columns.push(column("segment".to_owned(), &|t| f64::from(t >= 10.0)));
        let segment = |name: &str, base| Segment { name: name.to_owned(), base };
        let segments = vec![segment("air", BaseMount::Fixed), segment("stance", BaseMount::Floating)];
        Log::new(Meta::new(200.0, TorqueSensor::None, segments), columns).expect("a log")
    }

    /// Returns the heights by a model that knows this offset of the calf [rad].
    fn heights_with(known: f64, log: &Log) -> FootHeights {
        let mut robot = go2();
        robot.joints[CALF.index()].actuator.encoder_offset = known;
        FootHeights::new(log, &robot)
    }

    #[test]
    fn encoder_that_slips_moves_its_foot() {
        // By 0.04 rad from 20 s to 40 s, the middles of both halves; of which the model knows the mean.
        let slipping = log(|t| 0.002 * t, 0.1);
        let heights = heights_with(0.06, &slipping);
        let change = heights.offset_change(CALF).expect("it slips").value;
        assert!((change - 0.04).abs() < 0.005, "{change}");
        assert_eq!(heights.offset_change(Joint::ALL[5]), None, "the height of FL changes more than that of FR");
        let table = heights.table(0, slipping.rows());
        assert!(table[..2000].iter().all(|height| height.is_nan()), "it hangs");
        assert!((table[9999] - table[2000]).abs() > 5e-3);
    }

    /// Bent knees have a longer lever arm: the same offset raises the foot more.
    #[test]
    fn constant_offset_that_the_model_knows_does_not_change_with_the_pose() {
        let constant = log(|_| 0.06, 0.1);
        assert_eq!(heights_with(0.06, &constant).offset_change(CALF), None);
        assert!(heights_with(0.0, &constant).offset_change(CALF).is_some(), "without it the height changes");
    }

    #[test]
    fn feet_of_a_robot_that_walks_and_lifted_feet_have_no_height() {
        let blocks = |log: &Log| heights_with(0.0, log).blocks.len();
        assert_eq!(blocks(&log(|_| 0.0, 0.1)), 80);
        assert_eq!(blocks(&log(|_| 0.0, 2.0)), 0);
        assert_eq!(blocks(&log(|_| 0.6, 0.1)), 0, "the foot is in the air");
    }

    #[test]
    fn lost_cells_leave_the_rest_of_a_block() {
        let blocks = |is_lost: &dyn Fn(usize) -> bool| {
            let cell = |t: f64| if is_lost((200.0 * t).round() as usize) { f64::NAN } else { 1.0 };
            heights_with(0.0, &log_with(|_| 0.0, 0.1, cell)).blocks.len()
        };
        assert_eq!(blocks(&|row| row.is_multiple_of(5)), 80);
        assert_eq!(blocks(&|row| !row.is_multiple_of(5)), 0, "most are lost");
    }
}
