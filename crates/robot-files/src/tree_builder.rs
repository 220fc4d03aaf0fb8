//! Collects bodies, joints and shapes while a reader descends into a file, and checks the whole.

use std::collections::BTreeSet;

use glam::{DAffine3, DMat3, DVec3};
use twinstep_model::{BaseMount, FreeJoint, RigidBody, RobotTree, TreeBody, TreeJoint, TreeShape, TreeShapeKind};

use crate::inertia::{is_real, transformed};
use crate::{FileControl, RobotFile, RobotFileError};

/// A tree that grows.
pub struct TreeBuilder {
    tree: RobotTree,
    notes: Vec<String>,
}

const NO_BODY: RigidBody = RigidBody { mass: 0.0, com: DVec3::ZERO, inertia: DMat3::ZERO };

impl TreeBuilder {
    /// Creates a tree with its base.
    pub fn new(name: &str, base_name: &str, base: Option<BaseMount>, world_from_base: DAffine3) -> Self {
        let bodies = vec![TreeBody { name: base_name.to_owned(), inertia: NO_BODY }];
        let name = name.to_owned();
        let (free_joint, joints, shapes) = (FreeJoint::default(), Vec::new(), Vec::new());
        let tree = RobotTree { name, base, free_joint, world_from_base, bodies, joints, shapes };
        Self { tree, notes: Vec::new() }
    }

    /// Sets inertia and friction of the free base.
    pub fn set_free_joint(&mut self, free_joint: FreeJoint) {
        self.tree.free_joint = free_joint;
    }

    /// Adds the body that a joint moves. Returns its index.
    pub fn add_body(&mut self, name: &str, joint: TreeJoint) -> usize {
        self.tree.joints.push(joint);
        self.tree.bodies.push(TreeBody { name: name.to_owned(), inertia: NO_BODY });
        self.tree.bodies.len() - 1
    }

    /// Adds mass to a body, in whose frame that of the mass has this pose.
    pub fn add_mass(&mut self, body: usize, pose: DAffine3, mass: RigidBody) {
        let whole = &mut self.tree.bodies[body].inertia;
        *whole = whole.combined(transformed(pose, mass));
    }

    /// Adds a collision shape to a body.
    pub fn add_shape(&mut self, name: &str, body: usize, kind: TreeShapeKind, body_from_shape: DAffine3) {
        self.tree.shapes.push(TreeShape { name: name.to_owned(), body, kind, body_from_shape });
    }

    /// Returns true if there is a joint with this name.
    pub fn has_joint(&self, name: &str) -> bool {
        self.tree.joint(name).is_some()
    }

    /// Adds a note, once.
    pub fn note(&mut self, note: impl Into<String>) {
        let note = note.into();
        if !self.notes.contains(&note) {
            self.notes.push(note);
        }
    }

    /// Multiplies all masses and inertias by the same factor, so that they have this sum [kg].
    pub fn set_total_mass(&mut self, total: f64) {
        let factor = total / self.tree.total_mass();
        for body in &mut self.tree.bodies {
            body.inertia.mass *= factor;
            body.inertia.inertia *= factor;
        }
    }

    /// Checks the tree.
    pub fn finish(self) -> Result<RobotFile, RobotFileError> {
        let Self { mut tree, mut notes } = self;
        if tree.base.is_none() && tree.bodies[0].inertia.mass > 0.0 && !is_real(&tree.bodies[0].inertia) {
            tree.base = Some(BaseMount::Fixed);
            notes.push("the base has an inertia that no body has, so it does not move".to_owned());
        }
        let mut names = BTreeSet::new();
        for joint in &tree.joints {
            let error = |problem: String| Err(RobotFileError::Joint { joint: joint.name.clone(), problem });
            if !joint.parent_from_child.is_finite() {
                return error("it is too far away".to_owned());
            }
            if !names.insert(&joint.name) {
                return error("two joints have this name".to_owned());
            }
            let [low, high] = joint.range;
            if low >= high {
                return error(format!("its range is {low} to {high}; low < high expected"));
            }
            for (name, value) in
                [("damping", joint.damping), ("friction", joint.friction), ("armature", joint.armature)]
            {
                if value < 0.0 {
                    return error(format!("`{name}` is {value}; 0 or more expected"));
                }
            }
        }
        if let Some(shape) = tree.shapes.iter().find(|shape| !shape.body_from_shape.is_finite()) {
            let problem = "a shape of it is too far away".to_owned();
            return Err(RobotFileError::Link { link: shape.name.clone(), problem });
        }
        for (index, TreeBody { name, inertia }) in tree.bodies.iter().enumerate() {
            let error = |problem: &str| Err(RobotFileError::Link { link: name.clone(), problem: problem.to_owned() });
            let is_fixed_base = index == 0 && tree.base == Some(BaseMount::Fixed);
            let has_children = tree.joints.iter().any(|joint| joint.parent == index);
            let may_be_empty = if index == 0 { tree.base != Some(BaseMount::Floating) } else { has_children };
            if inertia.mass == 0.0 && !may_be_empty {
                return error("it has no mass and inertia; <inertial> expected");
            }
            let numbers = inertia.inertia.to_cols_array();
            if !(inertia.mass.is_finite() && inertia.com.is_finite() && numbers.iter().all(|number| number.is_finite()))
            {
                return error("its mass, centre of mass or inertia is too large");
            }
            if inertia.mass != 0.0 && !is_fixed_base && !is_real(inertia) {
                return error("its mass or inertia is not positive");
            }
        }
        Ok(RobotFile { tree, notes, control: FileControl::default() })
    }
}
