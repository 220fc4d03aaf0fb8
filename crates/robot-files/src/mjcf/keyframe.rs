//! The pose in which a file lets its robot start: `<keyframe>`.

use std::collections::BTreeMap;

use roxmltree::Node;

use super::bodies::joints_of;

/// Returns the position of each joint in the keyframe `home`, or else in the first one; empty without keyframe. Fails with the reason if it does
/// not have a number for each position of the file.
pub fn home(root: Node) -> Result<BTreeMap<String, f64>, String> {
    let frames = root.children().filter(|node| node.has_tag_name("keyframe")).flat_map(|frame| frame.children());
    let keys: Vec<_> = frames.filter(|node| node.has_tag_name("key")).collect();
    let named = keys.iter().find(|key| key.attribute("name") == Some("home"));
    let Some(qpos) = named.or(keys.first()).and_then(|key| key.attribute("qpos")) else { return Ok(BTreeMap::new()) };
    let values: Vec<f64> = qpos.split_whitespace().filter_map(|value| value.parse().ok()).collect();
    let mut joints = Vec::new();
    root.children().filter(|node| node.has_tag_name("worldbody")).for_each(|world| joints_below(world, &mut joints));
    let expected: usize = joints.iter().map(|joint| positions(*joint)).sum();
    if values.len() != expected || values.iter().any(|value| !value.is_finite()) {
        return Err(format!("the keyframe is left out: it has {} positions, and the file {expected}", values.len()));
    }
    let mut at = 0;
    let mut home = BTreeMap::new();
    for joint in joints {
        if let (1, Some(name)) = (positions(joint), joint.attribute("name")) {
            home.insert(name.to_owned(), values[at]);
        }
        at += positions(joint);
    }
    Ok(home)
}

/// Collects the joints of all bodies in the order of MuJoCo: depth first, those of a body before those below it.
fn joints_below<'a>(place: Node<'a, 'a>, joints: &mut Vec<Node<'a, 'a>>) {
    for node in place.children() {
        if node.has_tag_name("body") {
            joints.extend(joints_of(node));
        }
        if node.has_tag_name("body") || node.has_tag_name("frame") {
            joints_below(node, joints);
        }
    }
}

/// Returns how many numbers the position of a joint has.
fn positions(joint: Node) -> usize {
    match joint.attribute("type") {
        _ if joint.has_tag_name("freejoint") => 7,
        Some("free") => 7,
        Some("ball") => 4,
        _ => 1,
    }
}
