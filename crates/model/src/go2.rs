//! The nominal Unitree Go2, with the source of each parameter.
//!
//! - *menagerie*: `unitree_go2/go2.xml` of mujoco_menagerie (commit 2ffe3e3, BSD-3-Clause), which follows Unitree's URDF.
//! - *unitree_mujoco*: Unitree's own MuJoCo model, for torque limits.
//! - *URDF*: Unitree's `go2_description`, for speed limits and collision shapes.
//! - *U2E*: section IV-A of the paper, for rates.

use glam::{DQuat, DVec3, dvec3};

use crate::{
    ActuatorParams, CONTACT, ControlConfig, Derating, Joint, JointKind, JointModel, JointSpring, Leg, LegModel,
    NUM_JOINTS, RigidBody, RobotModel, Shapes, Stribeck,
};

/// Returns the ideal Go2: without joint friction, damping or delay.
pub fn go2() -> RobotModel {
    RobotModel {
        name: "go2".to_owned(),
        trunk: trunk(),
        legs: Leg::ALL.map(leg),
        joints: Joint::ALL.map(joint),
        shapes: shapes(),
        contact: CONTACT,
        control: control(),
        gyro_bias: DVec3::ZERO,
        derating: Derating::NONE,
    }
}

/// Source: menagerie, body `base`.
fn trunk() -> RigidBody {
    RigidBody::from_principal(
        6.921,
        dvec3(0.021_112, 0.0, -0.005_366),
        dvec3(0.107_027, 0.098_077_1, 0.024_453_1),
        quat_wxyz([-0.000_543_471, 0.713_435, -0.001_737_69, 0.700_719]),
    )
}

/// Source: menagerie, bodies `FL_hip`, `FL_thigh`, `FL_calf`; the other legs are mirror images.
fn leg(leg: Leg) -> LegModel {
    let (front, left) = (leg.front_sign(), leg.left_sign());
    let hip = RigidBody::from_principal(
        0.678,
        dvec3(-0.0054, 0.001_94, -0.000_105),
        dvec3(0.000_884_03, 0.000_596_003, 0.000_479_967),
        quat_wxyz([0.497_014, 0.499_245, 0.505_462, 0.498_237]),
    );
    let thigh = RigidBody::from_principal(
        1.152,
        dvec3(-0.003_74, -0.0223, -0.0327),
        dvec3(0.005_949_73, 0.005_841_49, 0.000_878_787),
        quat_wxyz([0.829_533, 0.084_763_5, -0.020_063_2, 0.551_623]),
    );
    let calf = RigidBody::from_principal(
        0.241_352,
        dvec3(0.006_295_95, -0.000_622_121, -0.141_417),
        dvec3(0.001_490_1, 0.001_463_56, 0.000_053_139_7),
        quat_wxyz([0.710_672, 0.001_540_99, -0.004_500_87, 0.703_508]),
    );
    let sideways = dvec3(1.0, left, 1.0);
    LegModel {
        bodies: [hip.mirrored(dvec3(front, left, 1.0)), thigh.mirrored(sideways), calf.mirrored(sideways)],
        origins: [dvec3(0.1934 * front, 0.0465 * left, 0.0), dvec3(0.0, 0.0955 * left, 0.0), dvec3(0.0, 0.0, -0.213)],
    }
}

/// Sources: ranges from menagerie, torque from unitree_mujoco, speed from the URDF, armature from menagerie.
///
/// The calf's linkage multiplies the motor torque by 1.917 and divides the motor speed by 1.917.
#[allow(clippy::approx_constant, reason = "digits of the source")]
fn joint(joint: Joint) -> JointModel {
    let range = match (joint.kind, joint.leg) {
        (JointKind::Hip, _) => [-1.0472, 1.0472],
        (JointKind::Thigh, Leg::FL | Leg::FR) => [-1.5708, 3.4907],
        (JointKind::Thigh, Leg::RL | Leg::RR) => [-0.5236, 4.5379],
        (JointKind::Calf, _) => [-2.7227, -0.837_76],
    };
    let (torque_limit, speed_limit) = match joint.kind {
        JointKind::Hip | JointKind::Thigh => (23.7, 30.1),
        JointKind::Calf => (45.43, 15.70),
    };
    JointModel {
        range,
        torque_limit,
        speed_limit,
        armature: 0.01,
        viscous_friction: 0.0,
        coulomb_friction: 0.0,
        stribeck_friction: Stribeck::NONE,
        load_friction: 0.0,
        spring: JointSpring::NONE,
        actuator: ActuatorParams::IDEAL,
    }
}

/// Source: menagerie's geoms of the trunk, a hip, a thigh and a foot. The cylinder of the hip is a sphere here, and that of the calf
/// a capsule.
fn shapes() -> Shapes {
    Shapes {
        trunk_half_size: dvec3(0.1881, 0.046_75, 0.057),
        hip_centre: dvec3(0.0, 0.08, 0.0),
        hip_radius: 0.046,
        thigh_half_size: dvec3(0.017, 0.012_25, 0.1065),
        thigh_centre: dvec3(0.0, 0.0, -0.1065),
        calf_radius: 0.012,
        calf_ends: [DVec3::ZERO, dvec3(0.016, 0.0, -0.12)],
        foot_radius: 0.022,
        foot_centre: dvec3(-0.002, 0.0, -0.213),
    }
}

/// Rates: U2E §IV-A (policy at 50 Hz, decimation 4). Gains and pose: common values for 50 Hz policies of the Go2
/// (kp 20–40, kd 0.5–1).
fn control() -> ControlConfig {
    let default_pose = Joint::ALL.map(|joint| match joint.kind {
        JointKind::Hip => 0.1 * joint.leg.left_sign(),
        JointKind::Thigh if joint.leg.front_sign() > 0.0 => 0.8,
        JointKind::Thigh => 1.0,
        JointKind::Calf => -1.5,
    });
    ControlConfig {
        kp: [30.0; NUM_JOINTS],
        kd: [0.75; NUM_JOINTS],
        action_scale: 0.5,
        default_pose,
        actuator_hz: 200.0,
        decimation: 4,
    }
}

fn quat_wxyz([w, x, y, z]: [f64; 4]) -> DQuat {
    DQuat::from_xyzw(x, y, z, w)
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    #[test]
    fn total_mass_is_15_2_kg() {
        assert!((go2().total_mass() - 15.206_408).abs() < 1e-9);
    }

    #[test]
    fn linkage_ratio_of_the_calf_is_in_its_torque_and_speed_limits() {
        let robot = go2();
        let (thigh, calf) = (robot.joints[1], robot.joints[2]);
        assert!((calf.torque_limit / thigh.torque_limit - 1.917).abs() < 1e-3);
        assert!((thigh.speed_limit / calf.speed_limit - 1.917).abs() < 1e-3);
    }

    /// Menagerie specifies the inertia of the right thigh with another quaternion.
    #[test]
    fn mirrored_left_thigh_has_the_inertia_of_menageries_right_thigh() {
        let robot = go2();
        let right = RigidBody::from_principal(
            1.152,
            dvec3(-0.003_74, 0.0223, -0.0327),
            dvec3(0.005_949_73, 0.005_841_49, 0.000_878_787),
            quat_wxyz([0.551_623, -0.020_063_2, 0.084_763_5, 0.829_533]),
        );
        let mirrored = robot.legs[Leg::FR as usize].bodies[1];
        assert!((mirrored.inertia - right.inertia).abs_diff_eq(DMat3::ZERO, 1e-8));
        assert_eq!(mirrored.com, right.com);
    }

    #[test]
    fn default_pose_is_inside_the_joint_limits() {
        let robot = go2();
        for (joint, position) in robot.joints.iter().zip(robot.control.default_pose) {
            assert!(joint.range[0] < position && position < joint.range[1]);
        }
    }
}
