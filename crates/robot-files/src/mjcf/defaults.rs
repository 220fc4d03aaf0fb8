//! Default classes. A class has the attributes of the class above it, and its own.

use std::collections::BTreeMap;

use roxmltree::Node;

use crate::RobotFileError;
use crate::xml::unsupported;

/// Attributes of one default class, by kind of element and name.
pub type Class<'a> = BTreeMap<(&'a str, &'a str), &'a str>;

/// Classes by name; `main` is that of elements without a class.
pub type Classes<'a> = BTreeMap<&'a str, Class<'a>>;

/// Names of the elements of actuators, of which each is a general actuator with some attributes set.
const SHORTCUTS: [&str; 11] = [
    "general",
    "motor",
    "position",
    "velocity",
    "intvelocity",
    "damper",
    "cylinder",
    "muscle",
    "adhesion",
    "dcmotor",
    "plugin",
];

/// Key under which a class has the name of the last element of an actuator, such as `position`.
pub const ACTUATOR_ELEMENT: (&str, &str) = ("actuator", "");

/// Maximum number of attributes of a default class, and of classes.
const MAX_ATTRIBUTES: usize = 1000;
const MAX_CLASSES: usize = 1000;

/// Reads all classes.
pub fn read<'a>(root: Node<'a, 'a>) -> Result<Classes<'a>, RobotFileError> {
    let mut classes = Classes::from([("main", Class::new())]);
    for default in root.children().filter(|node| node.has_tag_name("default")) {
        let name = default.attribute("class").unwrap_or("main");
        let earlier = classes.get(name).cloned().unwrap_or_default();
        read_class(default, name, &earlier, &mut classes)?;
    }
    Ok(classes)
}

fn read_class<'a>(
    node: Node<'a, 'a>,
    name: &'a str,
    parent: &Class<'a>,
    classes: &mut Classes<'a>,
) -> Result<(), RobotFileError> {
    let mut class = parent.clone();
    for element in node.children().filter(|child| child.is_element() && !child.has_tag_name("default")) {
        let tag = element.tag_name().name();
        // All kinds of actuators share one default.
        let kind = if SHORTCUTS.contains(&tag) { "actuator" } else { tag };
        if kind == "actuator" {
            class.insert(ACTUATOR_ELEMENT, tag);
        }
        for attribute in element.attributes() {
            class.insert((kind, attribute.name()), attribute.value());
        }
    }
    // Each class is a copy of the one above it.
    if class.len() > MAX_ATTRIBUTES {
        let problem = format!("a default class has {} attributes; at most {MAX_ATTRIBUTES} are read", class.len());
        return Err(unsupported(node, problem));
    }
    if classes.len() >= MAX_CLASSES {
        return Err(unsupported(node, format!("there are more than {MAX_CLASSES} default classes")));
    }
    for below in node.children().filter(|child| child.has_tag_name("default")) {
        let Some(name) = below.attribute("class") else {
            return Err(unsupported(below, "<default> within <default> has no `class`"));
        };
        read_class(below, name, &class, classes)?;
    }
    classes.insert(name, class);
    Ok(())
}
