//! Index lists of a tree.

use std::ops::Range;

use glam::DVec3;
use twinstep_model::{BaseMount, RobotTree, TreeJointKind};

/// Axis of a joint in the frame of its body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JointAxis {
    /// Along an axis of the frame (0 to 2), in its direction (1) or against it (−1).
    Along(usize, f64),
    /// Any direction. The frame is turned, so that its z axis is the axis of the joint.
    Turned,
}

impl JointAxis {
    /// Returns the axis of a joint of a robot with parallel frames.
    pub fn of(axis: DVec3) -> Self {
        let along = (0..3).find(|index| (axis[*index].abs() - 1.0).abs() < 1e-12);
        along.map_or(Self::Turned, |index| Self::Along(index, axis[index].signum()))
    }
}

/// Structure of a robot, the same in all lanes. Joint `i` moves body `i + 1`; body 0 is the base.
#[derive(Clone, Debug, PartialEq)]
pub struct TreeStructure {
    /// Parent body of each joint.
    pub parents: Vec<usize>,
    /// Kind of each joint.
    pub kinds: Vec<TreeJointKind>,
    /// Axis of each joint.
    pub axes: Vec<JointAxis>,
    /// True for each joint whose frames are parallel at position 0.
    pub is_parallel: Vec<bool>,
    /// Joints between the base and each body, from the base outwards; that of the body itself is the last.
    pub branches: Vec<Vec<usize>>,
    /// The joints of each branch as ranges, because loops over ranges are faster.
    pub runs: Vec<Vec<Range<usize>>>,
    /// True if the base moves freely.
    pub is_free: bool,
}

impl TreeStructure {
    /// Returns the structure of a robot. A base of which nothing says how it is mounted is free.
    pub fn new(tree: &RobotTree) -> Self {
        let parents: Vec<usize> = tree.joints.iter().map(|joint| joint.parent).collect();
        let mut branches = vec![Vec::new()];
        for (joint, parent) in parents.iter().enumerate() {
            let mut branch: Vec<usize> = branches[*parent].clone();
            branch.push(joint);
            branches.push(branch);
        }
        let kinds = tree.joints.iter().map(|joint| joint.kind).collect();
        let axes: Vec<JointAxis> =
            tree.with_parallel_frames().joints.iter().map(|joint| JointAxis::of(joint.axis)).collect();
        let is_turned = |body: usize| body > 0 && axes[body - 1] == JointAxis::Turned;
        let is_parallel = (0..parents.len()).map(|joint| !is_turned(joint + 1) && !is_turned(parents[joint])).collect();
        let runs = branches.iter().map(|branch| runs(branch)).collect();
        Self { parents, kinds, axes, is_parallel, branches, runs, is_free: tree.base != Some(BaseMount::Fixed) }
    }

    /// Returns the number of joints.
    pub fn num_joints(&self) -> usize {
        self.parents.len()
    }

    /// Returns the number of velocities: six of a free base, then one of each joint.
    pub fn num_velocities(&self) -> usize {
        self.num_base_velocities() + self.num_joints()
    }

    /// Returns 6 for a free base, else 0.
    pub fn num_base_velocities(&self) -> usize {
        if self.is_free { 6 } else { 0 }
    }
}

/// Returns the ranges of a branch, whose joints ascend.
fn runs(branch: &[usize]) -> Vec<Range<usize>> {
    branch.chunk_by(|joint, next| joint + 1 == *next).map(|run| run[0]..run[0] + run.len()).collect()
}
