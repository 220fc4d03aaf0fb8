//! Robots from URDF and MJCF files, as trees of bodies and joints.
//!
//! - [`read_robot`]: reads a file to a [`RobotFile`]: a [`RobotTree`], and notes about what the tree does not have.
//! - [`urdf`], [`mjcf`]: the two formats. Each element has a list of the attributes that are resolved, and of those that
//!   do not change a robot; any other attribute is an error that names it. So an attribute is never dropped in silence.
//! - [`mesh`]: bounds of meshes. [`inertia`]: mass and inertia of bodies from their shapes, as MuJoCo computes them.
//! - [`quadruped`]: the tree as a [`RobotModel`](twinstep_model::RobotModel), if it has the shape of the Go2.
//! - [`write_mjcf`]: the tree as a MuJoCo model.
//!
//! What "as MuJoCo does" means is measured, not claimed: the test `test_robot_files.py` compares compiled models.

mod collada;
mod error;
mod include;
mod inertia;
mod mesh;
mod mjcf;
mod orientation;
mod quadruped;
mod quadruped_shapes;
mod tree_builder;
mod urdf;
mod write_mjcf;
mod xml;

use std::collections::BTreeMap;
use std::path::Path;

use twinstep_model::RobotTree;

pub use error::RobotFileError;
pub use quadruped::{QuadrupedNames, quadruped};
pub use write_mjcf::{TreeMjcf, geom_name, write_mjcf};

/// Maximum depth of the elements of a robot file, and maximum number of its nodes.
const MAX_DEPTH: usize = 256;
const MAX_NODES: u32 = 1 << 20;

/// Contents of a robot file.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotFile {
    /// The robot.
    pub tree: RobotTree,
    /// What the file has and the tree does not, one sentence each.
    pub notes: Vec<String>,
    /// Gains and pose of the controllers inside the file.
    pub control: FileControl,
}

/// Gains and pose that an MJCF file states for the controllers inside its actuators.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FileControl {
    /// Position gain [N·m/rad or N/m] and velocity gain [N·m·s/rad or N·s/m] of each joint with one position actuator.
    pub gains: BTreeMap<String, [f64; 2]>,
    /// Position of each joint in the keyframe `home`, or else in the first one [rad or m]; empty without keyframe.
    pub home: BTreeMap<String, f64>,
}

/// Reads the text of a URDF or MJCF file. `folder` is that of the file: files that it includes, and meshes, are in it.
pub fn read_robot(text: &str, folder: Option<&Path>) -> Result<RobotFile, RobotFileError> {
    let whole = include::expand(text, folder)?;
    let document = parse(&whole)?;
    let root = document.root_element();
    match root.tag_name().name() {
        "robot" => urdf::read(root, folder),
        "mujoco" => mjcf::read(root, folder),
        other => Err(RobotFileError::Xml(format!("the root is <{other}>; <robot> (URDF) or <mujoco> (MJCF) expected"))),
    }
}

/// Parses XML of bounded size and depth.
fn parse(text: &str) -> Result<roxmltree::Document<'_>, RobotFileError> {
    let options = roxmltree::ParsingOptions { nodes_limit: MAX_NODES, ..roxmltree::ParsingOptions::default() };
    let document = roxmltree::Document::parse_with_options(text, options)
        .map_err(|error| RobotFileError::Xml(error.to_string()))?;
    check_depth(document.root_element())?;
    Ok(document)
}

/// Fails if elements are nested too deep for the readers, which descend into them.
fn check_depth(root: roxmltree::Node) -> Result<(), RobotFileError> {
    let (mut node, mut depth) = (root, 0_usize);
    loop {
        if depth > MAX_DEPTH {
            let problem = format!("elements are nested deeper than {MAX_DEPTH}: no robot has so many bodies in a row");
            return Err(RobotFileError::Unsupported { line: xml::line(node), problem });
        }
        if let Some(child) = node.first_element_child() {
            (node, depth) = (child, depth + 1);
            continue;
        }
        while node.next_sibling_element().is_none() {
            let Some(parent) = node.parent_element().filter(|_| node != root) else { return Ok(()) };
            (node, depth) = (parent, depth - 1);
        }
        if node == root {
            return Ok(());
        }
        node = node.next_sibling_element().expect("there is one");
    }
}
