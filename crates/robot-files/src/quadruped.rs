//! The tree of a quadruped as a [`RobotModel`]: a trunk and four legs whose first joint turns about +x, the other two about +y.

use glam::DVec3;
use twinstep_model::{
    Contact, ControlConfig, Derating, FreeJoint, Joint, JointKind, JointModel, Leg, LegModel, RobotModel, RobotTree,
    TreeJoint, TreeJointKind, go2,
};

use crate::inertia::is_real;
use crate::quadruped_shapes::shapes;
use crate::{RobotFile, RobotFileError};

/// Largest component of the difference of two axes that counts as zero.
const TOLERANCE: f64 = 1e-4;

/// Names in a robot file that are not the Go2's.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct QuadrupedNames {
    /// Joint names in the order of [`Joint::ALL`]. `None`: those of the Go2, with or without `_joint`.
    pub joints: Option<[String; 12]>,
    /// Names of the feet in the order of [`Leg::ALL`]: links of a URDF, geoms of an MJCF. `None`: the lowest sphere of each
    /// calf.
    pub feet: Option<[String; 4]>,
}

/// Returns the robot of a file, with notes about what it does not have. Its control settings are `control`, its contact
/// parameters those of the Go2. Damping and friction of the file's joints are viscous and Coulomb friction.
pub fn quadruped(
    file: &RobotFile,
    names: &QuadrupedNames,
    control: ControlConfig,
) -> Result<(RobotModel, Vec<String>), RobotFileError> {
    let tree = file.tree.with_parallel_frames();
    let mut notes = file.notes.clone();
    let mut found = Vec::new();
    for joint in Joint::ALL {
        found.push(find(&tree, names, joint)?);
    }
    let trunk = tree.joints[found[0]].parent;
    for joint in Joint::ALL {
        let parent = if joint.kind == JointKind::Hip { trunk } else { 1 + found[joint.index() - 1] };
        check(joint, &tree.joints[found[joint.index()]], parent)?;
    }
    if trunk != 0 || !is_real(&tree.bodies[0].inertia) {
        let problem = "the legs hang in it without a trunk: a body with mass and a free joint expected".to_owned();
        return Err(RobotFileError::Link { link: tree.bodies[trunk].name.clone(), problem });
    }
    if let Some(other) = (0..tree.joints.len()).find(|index| !found.contains(index)) {
        let problem = "it is none of the twelve joints of the legs; make it `fixed`".to_owned();
        return Err(RobotFileError::Joint { joint: tree.joints[other].name.clone(), problem });
    }
    if tree.free_joint != FreeJoint::default() {
        let problem = "its free joint has armature, damping or friction; a free joint without them expected".to_owned();
        return Err(RobotFileError::Link { link: tree.bodies[0].name.clone(), problem });
    }
    let legs = Leg::ALL.map(|leg| {
        let of = JointKind::ALL.map(|kind| found[Joint { leg, kind }.index()]);
        LegModel {
            bodies: of.map(|joint| tree.bodies[1 + joint].inertia),
            origins: of.map(|joint| tree.joints[joint].parent_from_child.translation),
        }
    });
    let mut joints = Vec::new();
    for index in &found {
        joints.push(joint_model(&tree.joints[*index])?);
    }
    let model = RobotModel {
        name: tree.name.clone(),
        trunk: tree.bodies[0].inertia,
        legs,
        joints: joints.try_into().expect("twelve joints"),
        shapes: shapes(&tree, &found, names.feet.as_ref(), &mut notes)?,
        contact: contact(),
        control,
        gyro_bias: DVec3::ZERO,
        derating: Derating::NONE,
    };
    Ok((model, notes))
}

fn contact() -> Contact {
    go2().contact
}

/// Returns the index of a joint in the tree.
fn find(tree: &RobotTree, names: &QuadrupedNames, joint: Joint) -> Result<usize, RobotFileError> {
    let own = joint.name();
    let wanted = names
        .joints
        .as_ref()
        .map_or_else(|| vec![own.to_owned(), format!("{own}_joint")], |names| vec![names[joint.index()].clone()]);
    tree.joints.iter().position(|joint| wanted.contains(&joint.name)).ok_or_else(|| {
        let known: Vec<&str> = tree.joints.iter().map(|joint| joint.name.as_str()).collect();
        let problem = format!(
            "missing; the moving joints are {}. `[joints] names` of the model file lists twelve in the order FL, FR, RL, RR; \
             hip, thigh, calf",
            known.join(", ")
        );
        RobotFileError::Joint { joint: wanted[0].clone(), problem }
    })
}

/// Checks kind, parent and axis of a joint.
fn check(joint: Joint, found: &TreeJoint, parent: usize) -> Result<(), RobotFileError> {
    let error = |problem: String| Err(RobotFileError::Joint { joint: found.name.clone(), problem });
    if found.kind != TreeJointKind::Revolute {
        return error("it slides; the joints of the legs turn".to_owned());
    }
    if found.parent != parent {
        return error("its parent is not the trunk (hip) or the previous link of its leg (thigh, calf)".to_owned());
    }
    let axis = RobotModel::axis(joint);
    if (found.axis - axis).abs().max_element() > TOLERANCE {
        let name = if joint.kind == JointKind::Hip { "x" } else { "y" };
        return error(format!("its axis is {}; +{name} expected", found.axis));
    }
    Ok(())
}

fn joint_model(joint: &TreeJoint) -> Result<JointModel, RobotFileError> {
    let error = |problem: String| Err(RobotFileError::Joint { joint: joint.name.clone(), problem });
    let torque_limit = match joint.effort {
        Some([low, high]) if high > 0.0 && high.is_finite() && (low + high).abs() <= 1e-9 * high => high,
        Some([low, high]) if high > 0.0 && high.is_finite() => {
            return error(format!(
                "its torque is {low} to {high} N·m, by `ctrlrange`, `forcerange`, `actuatorfrcrange` and `gear`; as much in \
                 both directions expected"
            ));
        }
        _ => {
            return error(
                "it has no torque limit above 0: `effort` of <limit> (URDF), `forcerange` of its actuator (MJCF)"
                    .to_owned(),
            );
        }
    };
    Ok(joint.with_ideal_actuator(torque_limit))
}

#[cfg(test)]
mod tests {
    use expect_test::{Expect, expect};
    use twinstep_model::{MjcfOptions, RobotModel, go2, mjcf};

    use super::*;
    use crate::read_robot;

    fn import(text: &str) -> Result<(RobotModel, Vec<String>), RobotFileError> {
        quadruped(&read_robot(text, None)?, &QuadrupedNames::default(), go2().control)
    }

    fn exported() -> String {
        mjcf(&go2(), &MjcfOptions::default())
    }

    fn near(one: &RobotModel, other: &RobotModel) {
        assert!((one.total_mass() - other.total_mass()).abs() < 1e-9);
        for (one, other) in one.legs.iter().zip(&other.legs) {
            for (one, other) in one.origins.iter().zip(&other.origins) {
                assert!((*one - *other).length() < 1e-12);
            }
            for (one, other) in one.bodies.iter().zip(&other.bodies) {
                assert!((one.com - other.com).length() < 1e-12);
                assert!((one.inertia - other.inertia).to_cols_array().iter().all(|entry| entry.abs() < 1e-12));
            }
        }
        for (one, other) in one.joints.iter().zip(&other.joints) {
            assert_eq!((one.range, one.torque_limit, one.armature), (other.range, other.torque_limit, other.armature));
        }
        assert!((one.shapes.trunk_half_size - other.shapes.trunk_half_size).length() < 1e-12);
        assert!((one.shapes.foot_centre - other.shapes.foot_centre).length() < 1e-12);
    }

    #[test]
    fn exported_go2_is_read_back() {
        near(&import(&exported()).expect("valid").0, &go2());
    }

    /// The frame of a thigh is turned, and everything in it turned back.
    #[test]
    fn turned_frames_are_the_same_robot() {
        let mut file = read_robot(&exported(), None).expect("valid");
        let turn = glam::DAffine3::from_rotation_y(0.7) * glam::DAffine3::from_rotation_x(-0.4);
        let joint = file.tree.joint("RL_thigh").expect("a joint");
        let (tree, back) = (&mut file.tree, turn.inverse());
        tree.joints[joint].parent_from_child *= turn;
        tree.joints[joint].axis = back.transform_vector3(tree.joints[joint].axis);
        tree.bodies[joint + 1].inertia = crate::inertia::transformed(back, tree.bodies[joint + 1].inertia);
        for below in tree.joints.iter_mut().filter(|below| below.parent == joint + 1) {
            below.parent_from_child = back * below.parent_from_child;
        }
        let (robot, _) = quadruped(&file, &QuadrupedNames::default(), go2().control).expect("valid");
        near(&robot, &go2());
    }

    #[test]
    fn trunk_without_a_box_of_its_size_collides_between_the_legs() {
        let text = exported().replace("size=\"0.1881 0.04675 0.057\"", "size=\"0.001 0.001 0.001\"");
        let (robot, notes) = import(&text).expect("valid");
        assert!((robot.shapes.trunk_half_size - DVec3::new(0.1934, 0.0465, 0.0465)).length() < 1e-9);
        assert!(notes.iter().any(|note| note.contains("plausible size")), "{notes:?}");
    }

    #[test]
    fn errors_name_what_is_wrong_and_what_is_expected() {
        let go2 = exported();
        let check = |text: &str, expected: Expect| expected.assert_eq(&import(text).expect_err("invalid").to_string());
        check("<mujoco", expect!["the document does not have a root node"]);
        check("<sdf/>", expect!["the root is <sdf>; <robot> (URDF) or <mujoco> (MJCF) expected"]);
        check(
            &go2.replace("joint name=\"FR_calf\" axis=\"0 1 0\"", "joint name=\"FR_calf\" axis=\"0 -1 0\""),
            expect!["joint `FR_calf`: its axis is [0, -1, 0]; +y expected"],
        );
        check(
            &go2.replace("joint name=\"RL_hip\"", "joint name=\"knee\"").replace("joint=\"RL_hip\"", "joint=\"knee\""),
            expect![
                "joint `RL_hip`: missing; the moving joints are FL_hip, FL_thigh, FL_calf, FR_hip, FR_thigh, FR_calf, knee, RL_thigh, RL_calf, RR_hip, RR_thigh, RR_calf. `[joints] names` of the model file lists twelve in the order FL, FR, RL, RR; hip, thigh, calf"
            ],
        );
        check(
            &go2.replace("mass=\"6.921\"", "mass=\"heavy\""),
            expect![[r#"line 13: `mass` of <inertial> is "heavy"; a number expected"#]],
        );
        check(
            &go2.replace("ctrlrange=\"-23.7 23.7\"", "ctrlrange=\"-20 40\""),
            expect![
                "joint `FL_hip`: its torque is -20 to 40 N·m, by `ctrlrange`, `forcerange`, `actuatorfrcrange` and `gear`; as much in both directions expected"
            ],
        );
        check(
            &go2.replace("<freejoint name=\"base\"/>", "")
                .replace("<body name=\"trunk\"", "<body name=\"trunk\" gravcomp=\"1\""),
            expect![[r#"line 11: `gravcomp="1"` of <body> is not supported"#]],
        );
    }

    #[test]
    fn legs_that_hang_in_the_world_have_no_trunk() {
        let text = exported();
        let trunk = text.lines().find(|line| line.contains("<body name=\"trunk\"")).expect("a trunk");
        // The trunk's frame instead of its body: the legs are bodies of the world.
        let text = text.replace(trunk, "<frame>").replace("<freejoint name=\"base\"/>", "");
        let inertial = text.lines().find(|line| line.contains("mass=\"6.921\"")).expect("a mass").to_owned();
        let text = text.replace(&inertial, "");
        let end = text.rfind("</body>").expect("an end");
        let text = format!("{}</frame>{}", &text[..end], &text[end + "</body>".len()..]);
        let error = import(&text).expect_err("no trunk").to_string();
        assert!(error.contains("hang in it without a trunk"), "{error}");
    }
}
