//! The pose in which a file lets its robot start: `<keyframe>`.

use std::collections::BTreeMap;

use roxmltree::Node;
use twinstep_model::{BaseMount, RobotTree};

/// Returns the position of each joint in the keyframe `home`, or else in the first one; empty if it does not have the positions of this robot
/// alone.
pub fn home(root: Node, tree: &RobotTree) -> BTreeMap<String, f64> {
    let frames = root.children().filter(|node| node.has_tag_name("keyframe")).flat_map(|frame| frame.children());
    let keys: Vec<_> = frames.filter(|node| node.has_tag_name("key")).collect();
    let named = keys.iter().find(|key| key.attribute("name") == Some("home"));
    let Some(qpos) = named.or(keys.first()).and_then(|key| key.attribute("qpos")) else { return BTreeMap::new() };
    let Ok(values) = qpos.split_whitespace().map(str::parse::<f64>).collect::<Result<Vec<_>, _>>() else {
        return BTreeMap::new();
    };
    // A free base has a position and a quaternion. The joints of the tree are in the order of MuJoCo: depth first.
    let of_base = if tree.base == Some(BaseMount::Floating) { 7 } else { 0 };
    if values.len() != of_base + tree.joints.len() || values.iter().any(|value| !value.is_finite()) {
        return BTreeMap::new();
    }
    tree.joints.iter().map(|joint| joint.name.clone()).zip(values.into_iter().skip(of_base)).collect()
}
