//! Feet of a robot of any tree: their position and velocity in the base frame, from joint positions and velocities.

use glam::{DVec3, Mat3, Vec3};

use crate::{Leg, NUM_LEGS, RobotModel, RobotTree, TreeJointKind};

/// Link on which a robot stands.
#[derive(Clone, Debug, PartialEq)]
pub struct Foot {
    /// Name of the foot.
    pub name: String,
    /// Index of its body in [`RobotTree::bodies`].
    pub body: usize,
    /// Centre of its contact points in the frame of the body [m].
    pub centre: DVec3,
    /// Distance of the sole from the centre [m].
    pub radius: f64,
}

/// Motion of a foot's centre relative to the base, in the base frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FootMotion {
    /// Position [m].
    pub position: Vec3,
    /// Velocity in the rotating base frame [m/s].
    pub velocity: Vec3,
}

/// Feet, with the joints between each of them and the base.
#[derive(Clone, Debug, PartialEq)]
pub struct Feet {
    feet: Vec<Foot>,
    /// Of each foot, from the foot to the base.
    chains: Vec<Vec<Link>>,
}

/// Joint that moves a foot.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Link {
    joint: usize,
    kind: TreeJointKind,
    axis: Vec3,
    /// Rotation of the child's frame in the parent's at position 0; `None` if they are parallel.
    rotation: Option<Mat3>,
    /// Place of the child's frame in the parent's [m].
    place: Vec3,
}

/// Rotation about an axis.
struct Turn {
    axis: Vec3,
    sine: f32,
    cosine: f32,
}

impl Turn {
    fn new(axis: Vec3, angle: f32) -> Self {
        let (sine, cosine) = angle.sin_cos();
        Self { axis, sine, cosine }
    }

    /// Returns the turned vector, by Rodrigues' formula.
    fn of(&self, vector: Vec3) -> Vec3 {
        let Self { axis, sine, cosine } = *self;
        cosine * vector + sine * axis.cross(vector) + ((1.0 - cosine) * axis.dot(vector)) * axis
    }
}

impl Feet {
    /// Returns these feet of a robot.
    pub fn new(tree: &RobotTree, feet: Vec<Foot>) -> Self {
        let chains = feet.iter().map(|foot| chain(tree, foot.body)).collect();
        Self { feet, chains }
    }

    /// Returns the feet, in the order of [`Feet::motions`].
    pub fn feet(&self) -> &[Foot] {
        &self.feet
    }

    /// Returns the number of feet.
    pub fn len(&self) -> usize {
        self.feet.len()
    }

    /// Returns true if there is no foot.
    pub fn is_empty(&self) -> bool {
        self.feet.is_empty()
    }

    /// Returns the indices of the joints that move a foot, from the foot to the base.
    pub fn joints(&self, foot: usize) -> impl Iterator<Item = usize> {
        self.chains[foot].iter().map(|link| link.joint)
    }

    /// Returns the motion of each foot. `q` [rad or m] and `dq` [rad/s or m/s] are those of all joints.
    pub fn motions(&self, q: &[f32], dq: &[f32]) -> impl Iterator<Item = FootMotion> {
        self.feet.iter().zip(&self.chains).map(|(foot, chain)| {
            let (mut position, mut velocity) = (foot.centre.as_vec3(), Vec3::ZERO);
            for link in chain {
                let (q, dq) = (q[link.joint], dq[link.joint]);
                match link.kind {
                    TreeJointKind::Revolute => {
                        let turn = Turn::new(link.axis, q);
                        position = turn.of(position);
                        velocity = turn.of(velocity) + dq * link.axis.cross(position);
                    }
                    TreeJointKind::Prismatic => {
                        position += q * link.axis;
                        velocity += dq * link.axis;
                    }
                }
                if let Some(rotation) = link.rotation {
                    (position, velocity) = (rotation * position, rotation * velocity);
                }
                position += link.place;
            }
            FootMotion { position, velocity }
        })
    }
}

/// The feet of a quadruped in the order FL, FR, RL, RR.
impl From<&RobotModel> for Feet {
    fn from(robot: &RobotModel) -> Self {
        let foot = |leg: usize| Foot {
            name: Leg::ALL[leg].name().to_owned(),
            body: 3 * leg + 3,
            centre: robot.shapes.foot_centre,
            radius: robot.shapes.foot_radius,
        };
        Self::new(&RobotTree::from(robot), (0..NUM_LEGS).map(foot).collect())
    }
}

fn chain(tree: &RobotTree, body: usize) -> Vec<Link> {
    let (mut body, mut chain) = (body, Vec::new());
    while body > 0 {
        let joint = &tree.joints[body - 1];
        let rotation = joint.parent_from_child.matrix3.as_mat3();
        chain.push(Link {
            joint: body - 1,
            kind: joint.kind,
            axis: joint.axis.as_vec3(),
            rotation: Some(rotation).filter(|rotation| *rotation != Mat3::IDENTITY),
            place: joint.parent_from_child.translation.as_vec3(),
        });
        body = joint.parent;
    }
    chain
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, dvec3};
    use proptest::prelude::*;

    use super::*;
    use crate::{TreeJointKind, go2};

    /// Returns a Go2 with turned frames and a slide in its first leg.
    fn robot() -> RobotTree {
        let mut tree = RobotTree::from(&go2());
        tree.joints[1].kind = TreeJointKind::Prismatic;
        tree.joints[1].axis = dvec3(0.6, 0.0, 0.8);
        tree.joints[2].parent_from_child = DAffine3::from_axis_angle(DVec3::Z, 0.4) * tree.joints[2].parent_from_child;
        tree
    }

    proptest! {
        #[test]
        fn positions_are_those_of_forward_kinematics_and_velocities_their_derivatives(
            q in prop::array::uniform12(-1.5f32..1.5), dq in prop::array::uniform12(-5.0f32..5.0),
        ) {
            let tree = robot();
            let feet = Feet::new(&tree, Feet::from(&go2()).feet().to_vec());
            let at = |time: f64| {
                let moved: Vec<_> = q.iter().zip(&dq).map(|(q, dq)| f64::from(*q) + time * f64::from(*dq)).collect();
                let poses = tree.base_from_bodies(&moved);
                feet.feet().iter().map(|foot| poses[foot.body].transform_point3(foot.centre)).collect::<Vec<_>>()
            };
            let (before, now, after) = (at(-1e-5), at(0.0), at(1e-5));
            for (foot, motion) in feet.motions(&q, &dq).enumerate() {
                prop_assert!((motion.position.as_dvec3() - now[foot]).length() < 1e-5);
                let difference = (after[foot] - before[foot]) / 2e-5;
                prop_assert!((motion.velocity.as_dvec3() - difference).length() < 1e-4, "{} {difference}", motion.velocity);
            }
        }
    }

    #[test]
    fn joints_of_a_foot_are_those_of_its_leg() {
        let feet = Feet::from(&go2());
        assert_eq!(feet.joints(2).collect::<Vec<_>>(), [8, 7, 6]);
        assert_eq!(feet.feet()[3].name, "RR");
    }
}
