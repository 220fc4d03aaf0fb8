//! Attributes of XML elements as numbers, with errors that name line, element and attribute.

use glam::{DQuat, DVec3};
use roxmltree::Node;

use super::ImportError;

/// Returns the line of an element, from 1.
pub fn line(node: Node) -> u32 {
    node.document().text_pos_at(node.range().start).row
}

/// Returns the error of an attribute.
pub fn attribute_error(node: Node, attribute: &'static str, expected: &'static str) -> ImportError {
    let found = node.attribute(attribute).map_or("missing".to_owned(), |value| format!("\"{value}\""));
    ImportError::Attribute { line: line(node), element: node.tag_name().name().to_owned(), attribute, found, expected }
}

/// Parses `N` numbers separated by spaces. Returns `None` if the text has another form.
pub fn parse_numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers: Vec<f64> = text.split_whitespace().map(|word| word.parse().ok()).collect::<Option<_>>()?;
    <[f64; N]>::try_from(numbers).ok().filter(|numbers| numbers.iter().all(|number| number.is_finite()))
}

/// Returns the numbers of an attribute, or `None` if it is missing. Fails if it has another form.
pub fn optional<const N: usize>(
    node: Node,
    attribute: &'static str,
    expected: &'static str,
) -> Result<Option<[f64; N]>, ImportError> {
    let Some(text) = node.attribute(attribute) else { return Ok(None) };
    parse_numbers(text).map(Some).ok_or_else(|| attribute_error(node, attribute, expected))
}

/// Returns the numbers of an attribute. Fails if it is missing or has another form.
pub fn required<const N: usize>(
    node: Node,
    attribute: &'static str,
    expected: &'static str,
) -> Result<[f64; N], ImportError> {
    optional(node, attribute, expected)?.ok_or_else(|| attribute_error(node, attribute, expected))
}

/// Returns one number of an attribute. Fails if it is missing or has another form.
pub fn number(node: Node, attribute: &'static str) -> Result<f64, ImportError> {
    required::<1>(node, attribute, "a number").map(|[number]| number)
}

/// Returns the text of an attribute. Fails if it is missing.
pub fn text<'a>(node: Node<'a, '_>, attribute: &'static str) -> Result<&'a str, ImportError> {
    node.attribute(attribute).ok_or_else(|| attribute_error(node, attribute, "a name"))
}

/// Returns the first child element of this name.
pub fn child<'a, 'input>(node: Node<'a, 'input>, name: &str) -> Option<Node<'a, 'input>> {
    node.children().find(|child| child.has_tag_name(name))
}

/// Returns three numbers as a vector.
pub fn vector(numbers: [f64; 3]) -> DVec3 {
    DVec3::from(numbers)
}

/// Returns the rotation of a quaternion `[w, x, y, z]` of any length above zero.
pub fn rotation_from_wxyz([w, x, y, z]: [f64; 4]) -> Option<DQuat> {
    let quaternion = DQuat::from_xyzw(x, y, z, w);
    (quaternion.length() > 1e-9).then(|| quaternion.normalize())
}
