//! Pairs of shapes that touch each other whatever their contact bits: `<contact><pair>`.

use std::collections::BTreeSet;

use roxmltree::Node;

use super::bodies::moves;
use crate::RobotFileError;
use crate::xml::unsupported;

/// Pairs of a file.
#[derive(Debug, Default)]
pub struct Pairs {
    /// Shapes of the robot that touch something that never moves.
    pub with_ground: BTreeSet<String>,
    /// True if two shapes of the robot touch each other.
    pub has_own: bool,
}

impl Pairs {
    /// Reads the pairs. A shape that is not in the file is one of the scene in which the robot will stand.
    pub fn read(root: Node) -> Result<Self, RobotFileError> {
        let moving = names_of_moving_geoms(root);
        let mut pairs = Self::default();
        let contacts = root.children().filter(|node| node.has_tag_name("contact"));
        for pair in contacts.flat_map(|contact| contact.children()).filter(|node| node.has_tag_name("pair")) {
            let geom =
                |name: &str| pair.attribute(name).ok_or_else(|| unsupported(pair, format!("<pair> without `{name}`")));
            let ends = [geom("geom1")?, geom("geom2")?];
            match ends.map(|name| moving.contains(name)) {
                [true, true] => pairs.has_own = true,
                [true, false] => drop(pairs.with_ground.insert(ends[0].to_owned())),
                [false, true] => drop(pairs.with_ground.insert(ends[1].to_owned())),
                [false, false] => {}
            }
        }
        Ok(pairs)
    }
}

fn names_of_moving_geoms<'a>(root: Node<'a, 'a>) -> BTreeSet<&'a str> {
    let worlds = root.children().filter(|node| node.has_tag_name("worldbody"));
    let bodies = worlds.flat_map(|world| world.descendants()).filter(|node| node.has_tag_name("body") && moves(*node));
    let geoms = bodies.flat_map(|body| body.descendants()).filter(|node| node.has_tag_name("geom"));
    geoms.filter_map(|geom| geom.attribute("name")).collect()
}
