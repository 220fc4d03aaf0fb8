//! Robots from URDF and MJCF files with the kinematic tree of the Go2: a trunk, and four legs of hip, thigh and calf.
//!
//! - [`description`]: links, joints and shapes of a file, with fixed links merged into their parents.
//! - [`urdf`], [`mjcf`]: readers. Meshes are ignored.
//! - [`assemble`]: finds the twelve joints by name and builds the [`RobotModel`].

pub(crate) mod assemble;
pub(crate) mod description;
mod mjcf;
mod urdf;
mod xml;

use crate::{ControlConfig, RobotModel, go2};

/// Maximum depth of the elements of a robot file, and maximum number of its nodes.
const MAX_DEPTH: usize = 256;
const MAX_NODES: u32 = 1 << 20;

/// Reason why a robot file was rejected.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ImportError {
    /// The text is not XML, or its root is neither `<robot>` nor `<mujoco>`.
    #[error("{0}")]
    Xml(String),
    /// An attribute is missing or has a wrong value.
    #[error("line {line}: `{attribute}` of <{element}> is {found}; {expected} expected")]
    Attribute {
        /// Line of the element, from 1.
        line: u32,
        /// Name of the element.
        element: String,
        /// Name of the attribute.
        attribute: &'static str,
        /// Its value, or `missing`.
        found: String,
        /// What is expected.
        expected: &'static str,
    },
    /// The file uses a feature that is not supported.
    #[error("line {line}: {problem}")]
    Unsupported {
        /// Line, from 1.
        line: u32,
        /// The feature, and what to do.
        problem: String,
    },
    /// A joint is missing or does not fit the tree of the Go2.
    #[error("joint `{joint}`: {problem}")]
    Joint {
        /// Name of the joint.
        joint: String,
        /// What does not fit, and what is expected.
        problem: String,
    },
    /// A body or shape is missing.
    #[error("link `{link}`: {problem}")]
    Link {
        /// Name of the link.
        link: String,
        /// What is missing.
        problem: String,
    },
}

/// Names in a robot file that are not the Go2's.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ImportNames {
    /// Joint names in the order of [`crate::Joint::ALL`]. `None`: those of the Go2, with or without `_joint`.
    pub joints: Option<[String; 12]>,
    /// Names of the feet in the order of [`crate::Leg::ALL`]: links of a URDF, geoms of an MJCF. `None`: the lowest
    /// sphere of each calf.
    pub feet: Option<[String; 4]>,
}

/// Fails if elements are nested too deep for the readers, which descend into them.
fn check_depth(root: roxmltree::Node) -> Result<(), ImportError> {
    let (mut node, mut depth) = (root, 0_usize);
    loop {
        if depth > MAX_DEPTH {
            let problem = format!("elements are nested deeper than {MAX_DEPTH}: no robot has so many bodies in a row");
            return Err(ImportError::Unsupported { line: xml::line(node), problem });
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

/// Reads a robot from the text of a URDF or MJCF file. Its control settings are `control`.
///
/// Damping and friction of the file's joints are viscous and Coulomb friction of the robot. Contact parameters are
/// those of the built-in Go2. Fails if the tree is not that of the Go2.
pub fn import_robot(text: &str, names: &ImportNames, control: ControlConfig) -> Result<RobotModel, ImportError> {
    let options = roxmltree::ParsingOptions { nodes_limit: MAX_NODES, ..roxmltree::ParsingOptions::default() };
    let document =
        roxmltree::Document::parse_with_options(text, options).map_err(|error| ImportError::Xml(error.to_string()))?;
    check_depth(document.root_element())?;
    let root = document.root_element();
    let description = match root.tag_name().name() {
        "robot" => urdf::read(root)?,
        "mujoco" => mjcf::read(root)?,
        other => {
            let problem = format!("the root is <{other}>; <robot> (URDF) or <mujoco> (MJCF) expected");
            return Err(ImportError::Xml(problem));
        }
    };
    assemble::assemble(&description, names, control, go2().contact)
}
