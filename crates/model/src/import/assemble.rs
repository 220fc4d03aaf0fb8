//! Builds a robot model from a description: finds the joints by name and checks the tree.

use glam::DVec3;

use super::description::{Description, Link, LinkJoint, ShapeKind};
use super::{ImportError, ImportNames};
use crate::{
    ActuatorParams, Contact, ControlConfig, Derating, Joint, JointKind, JointModel, JointSpring, Leg, LegModel,
    RigidBody, RobotModel, Shapes, Stribeck,
};

/// Largest component of an axis or a rotation that counts as zero.
const TOLERANCE: f64 = 1e-4;

/// Builds the robot model.
pub fn assemble(
    description: &Description,
    names: &ImportNames,
    control: ControlConfig,
    contact: Contact,
) -> Result<RobotModel, ImportError> {
    let mut links = Vec::new();
    for joint in Joint::ALL {
        links.push(find(description, names, joint)?);
    }
    for joint in Joint::ALL {
        let parent = if joint.kind == JointKind::Hip { 0 } else { links[joint.index() - 1] };
        check(joint, &description.links[links[joint.index()]], parent)?;
    }
    let mut others = (1..description.links.len()).filter(|index| !links.contains(index));
    if let Some(link) = others.next().map(|index| &description.links[index]) {
        let problem = "it is none of the twelve joints of the legs; make it `fixed`".to_owned();
        return Err(ImportError::Joint { joint: joint_of(link).name.clone(), problem });
    }
    let body = |index: usize| body_of(&description.links[index]);
    let mut legs = Vec::new();
    for leg in Leg::ALL {
        let of = JointKind::ALL.map(|kind| links[Joint { leg, kind }.index()]);
        legs.push(LegModel {
            bodies: [body(of[0])?, body(of[1])?, body(of[2])?],
            origins: of.map(|index| joint_of(&description.links[index]).pose.translation),
        });
    }
    let mut joints = Vec::new();
    for index in &links {
        joints.push(joint_model(joint_of(&description.links[*index]))?);
    }
    Ok(RobotModel {
        name: description.name.clone(),
        trunk: body(0)?,
        legs: legs.try_into().expect("four legs"),
        joints: joints.try_into().expect("twelve joints"),
        shapes: shapes(description, &links, names)?,
        contact,
        control,
        gyro_bias: DVec3::ZERO,
        derating: Derating::NONE,
    })
}

/// Returns the index of the link that a joint moves.
fn find(description: &Description, names: &ImportNames, joint: Joint) -> Result<usize, ImportError> {
    let own = joint.name();
    let wanted = names
        .joints
        .as_ref()
        .map_or_else(|| vec![own.to_owned(), format!("{own}_joint")], |names| vec![names[joint.index()].clone()]);
    let is_wanted = |link: &Link| link.joint.as_ref().is_some_and(|joint| wanted.contains(&joint.name));
    description.links.iter().position(is_wanted).ok_or_else(|| {
        let known: Vec<&str> = description.links.iter().filter_map(|link| Some(link.joint.as_ref()?.name.as_str())).collect();
        let problem = format!("missing; the moving joints are {}. `[joints] names` of the model file lists twelve in the order FL, FR, RL, RR; hip, thigh, calf", known.join(", "));
        ImportError::Joint { joint: wanted[0].clone(), problem }
    })
}

/// Checks parent, axis and frame of a joint.
fn check(joint: Joint, link: &Link, parent: usize) -> Result<(), ImportError> {
    let found = joint_of(link);
    let error = |problem: String| Err(ImportError::Joint { joint: found.name.clone(), problem });
    if found.parent != parent {
        return error("its parent is not the trunk (hip) or the previous link of its leg (thigh, calf)".to_owned());
    }
    let axis = RobotModel::axis(joint);
    if (found.axis.normalize_or_zero() - axis).abs().max_element() > TOLERANCE {
        let name = if joint.kind == JointKind::Hip { "x" } else { "y" };
        return error(format!("its axis is {}; +{name} expected", found.axis));
    }
    if (found.pose.rotation - glam::DMat3::IDENTITY).to_cols_array().iter().any(|entry| entry.abs() > TOLERANCE) {
        return error(
            "its frame is rotated relative to its parent; all frames must be parallel at position 0".to_owned(),
        );
    }
    Ok(())
}

fn joint_of(link: &Link) -> &LinkJoint {
    link.joint.as_ref().expect("only the root has no joint")
}

fn body_of(link: &Link) -> Result<RigidBody, ImportError> {
    let error = |problem: &str| ImportError::Link { link: link.name.clone(), problem: problem.to_owned() };
    let body = link.body.ok_or_else(|| error("it has no mass and inertia; <inertial> expected"))?;
    let i = &body.inertia;
    let minor = i.x_axis.x * i.y_axis.y - i.x_axis.y * i.y_axis.x;
    if body.mass > 0.0 && i.x_axis.x > 0.0 && minor > 0.0 && i.determinant() > 0.0 {
        return Ok(body);
    }
    Err(error("its mass or inertia is not positive"))
}

fn joint_model(joint: &LinkJoint) -> Result<JointModel, ImportError> {
    let error = |problem: String| Err(ImportError::Joint { joint: joint.name.clone(), problem });
    let [low, high] = joint.range;
    if low >= high {
        return error(format!("its range is {low} to {high} rad; low < high expected"));
    }
    let torque_limit = joint.torque_limit.unwrap_or(0.0);
    if torque_limit <= 0.0 {
        return error(
            "it has no torque limit above 0: `effort` of <limit> (URDF), `forcerange` of its actuator (MJCF)"
                .to_owned(),
        );
    }
    for (name, value) in [("damping", joint.damping), ("friction", joint.friction), ("armature", joint.armature)] {
        if value < 0.0 {
            return error(format!("`{name}` is {value}; 0 or more expected"));
        }
    }
    Ok(JointModel {
        range: joint.range,
        torque_limit,
        speed_limit: joint.speed_limit,
        armature: joint.armature,
        viscous_friction: joint.damping,
        coulomb_friction: joint.friction,
        stribeck_friction: Stribeck::NONE,
        load_friction: 0.0,
        spring: JointSpring::NONE,
        actuator: ActuatorParams::IDEAL,
    })
}

/// Returns the collision shapes: the trunk's largest box, and a box, a capsule and a sphere of the front left leg.
fn shapes(description: &Description, links: &[usize], names: &ImportNames) -> Result<Shapes, ImportError> {
    let (trunk, thigh, calf) = (&description.links[0], &description.links[links[1]], &description.links[links[2]]);
    let error = |link: &Link, problem: &str| ImportError::Link { link: link.name.clone(), problem: problem.to_owned() };
    let volume = |size: &DVec3| size.x * size.y * size.z;
    let boxes = trunk.shapes.iter().filter_map(|shape| match shape.kind {
        ShapeKind::Box(half) => Some((shape.pose.rotation * half).abs()),
        _ => None,
    });
    let trunk_half_size = boxes
        .max_by(|one, other| volume(one).total_cmp(&volume(other)))
        .ok_or_else(|| error(trunk, "it has no collision box"))?;
    let (foot_centre, foot_radius) = foot(calf, names)?;
    let (calf_ends, calf_radius) = match capsule(calf) {
        Some(([one, other], radius)) if one.z < other.z => ([other, one], radius),
        Some((ends, radius)) => (ends, radius),
        // Without a shape: a thin capsule over the upper part of the calf.
        None => ([DVec3::ZERO, 0.6 * foot_centre], 0.5 * foot_radius),
    };
    let knee = joint_of(calf).pose.translation;
    let thigh_radius = capsule(thigh).map_or(calf_radius, |(_, radius)| radius);
    Ok(Shapes {
        trunk_half_size,
        thigh_half_size: DVec3::new(thigh_radius, thigh_radius, 0.5 * knee.z.abs()),
        thigh_centre: 0.5 * knee,
        calf_radius,
        calf_ends,
        foot_radius,
        foot_centre,
    })
}

/// Returns centre and radius of the front left foot.
fn foot(calf: &Link, names: &ImportNames) -> Result<(DVec3, f64), ImportError> {
    let named = names.feet.as_ref().map(|feet| &feet[0]);
    let spheres = calf.shapes.iter().filter(|shape| named.is_none_or(|name| *name == shape.name));
    let spheres = spheres.filter_map(|shape| match shape.kind {
        ShapeKind::Sphere(radius) => Some((shape.pose.translation, radius)),
        _ => None,
    });
    spheres.min_by(|one, other| one.0.z.total_cmp(&other.0.z)).ok_or_else(|| {
        let problem = named.map_or("it has no foot: a collision sphere, in it or fixed to it".to_owned(), |name| {
            format!("the foot `{name}` of `[joints] feet` is not a collision sphere in it or fixed to it")
        });
        ImportError::Link { link: calf.name.clone(), problem }
    })
}

/// Returns ends and radius of the longest shape of a link that is not a sphere.
fn capsule(link: &Link) -> Option<([DVec3; 2], f64)> {
    let capsules = link.shapes.iter().filter_map(|shape| {
        let (axis, half_length, radius) = match shape.kind {
            ShapeKind::Sphere(_) => return None,
            ShapeKind::Capsule { radius, half_length } => (DVec3::Z, half_length, radius),
            ShapeKind::Box(half) => {
                let longest = half.max_element();
                let axis = if half.x == longest {
                    DVec3::X
                } else if half.y == longest {
                    DVec3::Y
                } else {
                    DVec3::Z
                };
                (axis, longest, half.min_element())
            }
        };
        Some(([-half_length, half_length].map(|along| shape.pose.point(along * axis)), radius))
    });
    let length = |ends: &[DVec3; 2]| (ends[1] - ends[0]).length();
    capsules.max_by(|one, other| length(&one.0).total_cmp(&length(&other.0)))
}

#[cfg(test)]
mod tests {
    use expect_test::{Expect, expect};

    use crate::{ImportNames, MjcfOptions, RobotModel, go2, import_robot, mjcf};

    fn import(text: &str) -> Result<RobotModel, super::ImportError> {
        import_robot(text, &ImportNames::default(), go2().control)
    }

    fn near(one: &RobotModel, other: &RobotModel) {
        assert!((one.total_mass() - other.total_mass()).abs() < 1e-9);
        for (one, other) in one.legs.iter().zip(&other.legs) {
            assert_eq!(one.origins, other.origins);
            for (one, other) in one.bodies.iter().zip(&other.bodies) {
                assert!((one.com - other.com).length() < 1e-12);
                assert!((one.inertia - other.inertia).to_cols_array().iter().all(|entry| entry.abs() < 1e-12));
            }
        }
        for (one, other) in one.joints.iter().zip(&other.joints) {
            assert_eq!((one.range, one.torque_limit, one.armature), (other.range, other.torque_limit, other.armature));
        }
        assert_eq!(one.shapes.trunk_half_size, other.shapes.trunk_half_size);
        assert_eq!(
            (one.shapes.foot_centre, one.shapes.foot_radius),
            (other.shapes.foot_centre, other.shapes.foot_radius)
        );
    }

    #[test]
    fn exported_go2_is_read_back() {
        near(&import(&mjcf(&go2(), &MjcfOptions::default())).expect("valid"), &go2());
    }

    #[test]
    fn errors_name_what_is_wrong_and_what_is_expected() {
        let go2 = mjcf(&go2(), &MjcfOptions::default());
        let check = |text: &str, expected: Expect| expected.assert_eq(&import(text).expect_err("invalid").to_string());
        check("<mujoco", expect!["the document does not have a root node"]);
        check("<sdf/>", expect!["the root is <sdf>; <robot> (URDF) or <mujoco> (MJCF) expected"]);
        check(
            &go2.replace("joint name=\"FR_calf\" axis=\"0 1 0\"", "joint name=\"FR_calf\" axis=\"0 -1 0\""),
            expect!["joint `FR_calf`: its axis is [0, -1, 0]; +y expected"],
        );
        check(
            &go2.replace("joint name=\"RL_hip\"", "joint name=\"knee\""),
            expect![
                "joint `RL_hip`: missing; the moving joints are FL_hip, FL_thigh, FL_calf, FR_hip, FR_thigh, FR_calf, knee, RL_thigh, RL_calf, RR_hip, RR_thigh, RR_calf. `[joints] names` of the model file lists twelve in the order FL, FR, RL, RR; hip, thigh, calf"
            ],
        );
        check(
            &go2.replace("mass=\"6.921\"", "mass=\"heavy\""),
            expect![[r#"line 13: `mass` of <inertial> is "heavy"; a number expected"#]],
        );
    }
}
