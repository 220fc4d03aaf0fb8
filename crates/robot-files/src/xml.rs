//! Attributes of XML elements as numbers, with errors that name line, element and attribute.

use glam::DVec3;
use roxmltree::Node;

use crate::RobotFileError;

/// Returns the line of an element, from 1.
pub fn line(node: Node) -> u32 {
    node.document().text_pos_at(node.range().start).row
}

/// Returns the error of an attribute.
pub fn attribute_error(node: Node, attribute: &str, expected: &'static str) -> RobotFileError {
    let found = node.attribute(attribute).map_or("missing".to_owned(), |value| format!("\"{value}\""));
    RobotFileError::Attribute {
        line: line(node),
        element: node.tag_name().name().to_owned(),
        attribute: attribute.to_owned(),
        found,
        expected,
    }
}

/// Returns the error of something that is not supported.
pub fn unsupported(node: Node, problem: impl Into<String>) -> RobotFileError {
    RobotFileError::Unsupported { line: line(node), problem: problem.into() }
}

/// Parses `N` numbers separated by spaces. Returns `None` if the text has another form.
pub fn parse_numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let numbers: Vec<f64> = text.split_whitespace().map(|word| word.parse().ok()).collect::<Option<_>>()?;
    <[f64; N]>::try_from(numbers).ok().filter(|numbers| numbers.iter().all(|number| number.is_finite()))
}

/// Returns the numbers of an attribute, or `None` if it is missing. Fails if it has another form.
pub fn optional<const N: usize>(
    node: Node,
    attribute: &str,
    expected: &'static str,
) -> Result<Option<[f64; N]>, RobotFileError> {
    let Some(text) = node.attribute(attribute) else { return Ok(None) };
    parse_numbers(text).map(Some).ok_or_else(|| attribute_error(node, attribute, expected))
}

/// Returns one number of an attribute. Fails if it is missing or has another form.
pub fn number(node: Node, attribute: &str) -> Result<f64, RobotFileError> {
    optional::<1>(node, attribute, "a number")?
        .map(|[number]| number)
        .ok_or_else(|| attribute_error(node, attribute, "a number"))
}

/// Returns the text of an attribute. Fails if it is missing.
pub fn text<'a>(node: Node<'a, '_>, attribute: &'static str) -> Result<&'a str, RobotFileError> {
    node.attribute(attribute).ok_or_else(|| attribute_error(node, attribute, "a name"))
}

/// Returns the first child element of this name.
pub fn child<'a, 'input>(node: Node<'a, 'input>, name: &str) -> Option<Node<'a, 'input>> {
    node.children().find(|child| child.has_tag_name(name))
}

/// Fails with the name of the first attribute that is neither resolved nor without effect on a robot.
pub fn check_attributes(node: Node, known: &[&[&str]]) -> Result<(), RobotFileError> {
    match node.attributes().find(|attribute| !known.iter().any(|names| names.contains(&attribute.name()))) {
        None => Ok(()),
        Some(attribute) => {
            let (name, element) = (attribute.name(), node.tag_name().name());
            Err(unsupported(
                node,
                format!("`{name}` of <{element}> is not supported: remove it, or write the model without it"),
            ))
        }
    }
}

/// Returns true if two values of an attribute are the same text, or the same numbers.
pub fn is_same(one: &str, other: &str) -> bool {
    let numbers = |text: &str| text.split_whitespace().map(|word| word.parse().ok()).collect::<Option<Vec<f64>>>();
    one == other || numbers(one).is_some_and(|one| Some(one) == numbers(other))
}

/// Returns three numbers as a vector.
pub fn vector(numbers: [f64; 3]) -> DVec3 {
    DVec3::from(numbers)
}
