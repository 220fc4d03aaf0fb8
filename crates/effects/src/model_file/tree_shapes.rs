//! Table `[shapes]`: collision shapes that replace those of a robot file, by link.

use std::collections::BTreeMap;

use glam::{DAffine3, DQuat, DVec3, EulerRot};
use serde::{Deserialize, Serialize};
use twinstep_model::{TreeModel, TreeShape, TreeShapeKind};

/// A collision shape: one of `box`, `sphere` and `capsule`, at a place in its link.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShapeText {
    /// Lengths of a box along its axes [m].
    #[serde(rename = "box", skip_serializing_if = "Option::is_none")]
    lengths: Option<[f64; 3]>,
    /// Radius of a sphere [m].
    #[serde(skip_serializing_if = "Option::is_none")]
    sphere: Option<f64>,
    /// Radius of a capsule, and length of the cylinder between its half spheres, along z [m].
    #[serde(skip_serializing_if = "Option::is_none")]
    capsule: Option<[f64; 2]>,
    /// Place of its centre in the frame of the link [m].
    #[serde(default, skip_serializing_if = "is_zero")]
    at: [f64; 3],
    /// Roll, pitch and yaw in the frame of the link [rad], about its fixed axes.
    #[serde(default, skip_serializing_if = "is_zero")]
    rpy: [f64; 3],
}

fn is_zero(values: &[f64; 3]) -> bool {
    *values == [0.0; 3]
}

impl ShapeText {
    fn kind(&self) -> Result<TreeShapeKind, String> {
        let (kind, lengths) = match (self.lengths, self.sphere, self.capsule) {
            (Some(lengths), None, None) => (TreeShapeKind::Box(0.5 * DVec3::from(lengths)), lengths.to_vec()),
            (None, Some(radius), None) => (TreeShapeKind::Sphere(radius), vec![radius]),
            (None, None, Some([radius, length])) => {
                (TreeShapeKind::Capsule { radius, half_length: 0.5 * length }, vec![radius, length])
            }
            _ => return Err("one of `box`, `sphere` and `capsule` expected".to_owned()),
        };
        let numbers = self.at.iter().chain(&self.rpy);
        match lengths.iter().find(|length| !(length.is_finite() && **length > 0.0)) {
            Some(length) => Err(format!("a length is {length}; above 0 m expected")),
            None if numbers.clone().any(|number| !number.is_finite()) => {
                Err("`at` or `rpy` is not a number; finite numbers expected".to_owned())
            }
            None => Ok(kind),
        }
    }
}

/// Returns the robot with these shapes in place of those of its links. Fails with what is wrong.
pub fn with_shapes(robot: TreeModel, shapes: &BTreeMap<String, Vec<ShapeText>>) -> Result<TreeModel, String> {
    if shapes.is_empty() {
        return Ok(robot);
    }
    let mut tree = robot.tree.clone();
    for (link, given) in shapes {
        let body = tree.link(link).ok_or_else(|| {
            let links: Vec<_> = tree.bodies.iter().map(|body| body.name.as_str()).collect();
            format!("`shapes`: the robot has no link `{link}`; its links are {}", links.join(", "))
        })?;
        tree.shapes.retain(|shape| shape.body != body);
        for (index, shape) in given.iter().enumerate() {
            let kind = shape.kind().map_err(|problem| format!("`shapes.{link}`, shape {}: {problem}", index + 1))?;
            let [roll, pitch, yaw] = shape.rpy;
            let turn = DQuat::from_euler(EulerRot::ZYX, yaw, pitch, roll);
            let body_from_shape = DAffine3::from_rotation_translation(turn, shape.at.into());
            tree.shapes.push(TreeShape { name: link.clone(), body, kind, body_from_shape });
        }
    }
    let points = tree.contact_points();
    Ok(TreeModel { tree, points, ..robot })
}

#[cfg(test)]
mod tests {
    use twinstep_model::{RobotTree, go2};

    use super::*;

    fn read(text: &str) -> Result<TreeModel, String> {
        let shapes: BTreeMap<String, Vec<ShapeText>> = toml::from_str(text).map_err(|error| error.to_string())?;
        with_shapes(TreeModel::new(RobotTree::from(&go2())).expect("equal limits"), &shapes)
    }

    #[test]
    fn shapes_of_a_link_are_replaced_and_touch_the_ground() {
        let robot = read(
            "FL_calf = [{ sphere = 0.02, at = [0.0, 0.0, -0.2] }]\n\
             trunk = [{ box = [0.4, 0.2, 0.1] }, { capsule = [0.03, 0.2], rpy = [0.0, 1.5707963267948966, 0.0] }]\n",
        )
        .expect("valid");
        assert_eq!((robot.tree.shapes.len(), robot.points.len()), (3, 1 + 8 + 2));
        assert_eq!((robot.points[0].body, robot.points[0].centre.x.abs()), (0, 0.2));
        // The capsule lies along x.
        assert!((robot.points[8].centre.x.abs() - 0.1).abs() < 1e-12, "{:?}", robot.points[8]);
        assert_eq!((robot.points[10].body, robot.points[10].radius), (3, 0.02));
    }

    #[test]
    fn link_with_several_joints_has_its_shapes_at_the_last() {
        let mut tree = RobotTree::from(&go2());
        "FL_calf".clone_into(&mut tree.bodies[2].name);
        let shapes: BTreeMap<String, Vec<ShapeText>> = toml::from_str("FL_calf = [{ sphere = 0.1 }]").expect("valid");
        let robot = with_shapes(TreeModel::new(tree).expect("equal limits"), &shapes).expect("a link");
        assert_eq!(robot.tree.shapes[0].body, 3);
    }

    #[test]
    fn refusals_name_the_link_and_what_is_expected() {
        let error = read("toe = []").expect_err("no link");
        assert!(error.contains("`shapes`: the robot has no link `toe`; its links are trunk, FL_hip"), "{error}");
        let error = read("trunk = [{ sphere = 0.1, box = [1, 1, 1] }]").expect_err("two kinds");
        assert!(error.contains("`shapes.trunk`, shape 1: one of `box`, `sphere` and `capsule` expected"), "{error}");
        let error = read("trunk = [{ sphere = 0.1 }, { capsule = [0.1, -0.2] }]").expect_err("a length");
        assert!(error.contains("`shapes.trunk`, shape 2: a length is -0.2; above 0 m expected"), "{error}");
        let error = read("trunk = [{ mesh = 3 }]").expect_err("no key");
        assert!(
            error.contains("unknown field `mesh`, expected one of `box`, `sphere`, `capsule`, `at`, `rpy`"),
            "{error}"
        );
    }
}
