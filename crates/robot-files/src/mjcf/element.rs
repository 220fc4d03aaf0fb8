//! An element with the attributes of its default class.

use glam::DAffine3;
use roxmltree::Node;

use super::compiler::Settings;
use super::defaults::{Class, Classes};
use crate::RobotFileError;
use crate::orientation::rotation;
use crate::xml::{attribute_error, is_same, parse_numbers, unsupported, vector};

/// Element with its default class.
#[derive(Clone, Copy)]
pub struct Element<'a, 'b> {
    /// The element.
    pub node: Node<'a, 'a>,
    /// Kind by which the class has its attributes: the name of the element, or `actuator`.
    pub kind: &'static str,
    /// The class.
    pub class: &'b Class<'a>,
}

impl<'a, 'b> Element<'a, 'b> {
    /// Returns the element with its own class, or with `childclass`.
    pub fn new(
        node: Node<'a, 'a>,
        kind: &'static str,
        childclass: &str,
        classes: &'b Classes<'a>,
    ) -> Result<Self, RobotFileError> {
        let name = node.attribute("class").unwrap_or(childclass);
        let class = classes.get(name).ok_or_else(|| attribute_error(node, "class", "the name of a default class"))?;
        Ok(Self { node, kind, class })
    }

    /// Returns an attribute of the element or of its class.
    pub fn attribute(&self, name: &str) -> Option<&'a str> {
        self.node.attribute(name).or_else(|| self.class.get(&(self.kind, name)).copied())
    }

    /// Fails with the name of the first attribute, of the element or its class, that is not in the lists.
    pub fn check(&self, known: &[&[&str]]) -> Result<(), RobotFileError> {
        let own = self.node.attributes().map(|attribute| attribute.name());
        let of_class = self.class.keys().filter(|(kind, _)| *kind == self.kind).map(|(_, name)| *name);
        match own.chain(of_class).find(|name| !known.iter().any(|names| names.contains(name))) {
            None => Ok(()),
            Some(name) => {
                let element = self.node.tag_name().name();
                Err(unsupported(
                    self.node,
                    format!("`{name}` of <{element}> is not supported: remove it, or write the model without it"),
                ))
            }
        }
    }

    /// Fails if an attribute has another value than the one without effect.
    pub fn check_value(&self, name: &str, without_effect: &[&str]) -> Result<(), RobotFileError> {
        match self.attribute(name) {
            Some(value) if !without_effect.iter().any(|other| is_same(value, other)) => {
                let element = self.node.tag_name().name();
                Err(unsupported(self.node, format!("`{name}=\"{value}\"` of <{element}> is not supported")))
            }
            _ => Ok(()),
        }
    }

    /// Returns the error of an attribute.
    pub fn error(&self, name: &str, expected: &'static str) -> RobotFileError {
        let found = self.attribute(name).map_or("missing".to_owned(), |value| format!("\"{value}\""));
        match attribute_error(self.node, name, expected) {
            RobotFileError::Attribute { line, element, attribute, expected, .. } => {
                RobotFileError::Attribute { line, element, attribute, found, expected }
            }
            error => error,
        }
    }

    /// Returns exactly `N` numbers.
    pub fn numbers<const N: usize>(
        &self,
        name: &str,
        expected: &'static str,
    ) -> Result<Option<[f64; N]>, RobotFileError> {
        let Some(text) = self.attribute(name) else { return Ok(None) };
        parse_numbers(text).map(Some).ok_or_else(|| self.error(name, expected))
    }

    /// Returns one number, or `default`.
    pub fn number(&self, name: &str, default: f64) -> Result<f64, RobotFileError> {
        Ok(self.numbers::<1>(name, "a number")?.map_or(default, |[number]| number))
    }

    /// Returns one to `N` numbers; those that are missing are 0.
    pub fn up_to<const N: usize>(
        &self,
        name: &str,
        expected: &'static str,
    ) -> Result<Option<[f64; N]>, RobotFileError> {
        let Some(text) = self.attribute(name) else { return Ok(None) };
        let mut words: Vec<&str> = text.split_whitespace().collect();
        words.resize(words.len().max(N), "0");
        parse_numbers(&words.join(" ")).map(Some).ok_or_else(|| self.error(name, expected))
    }

    /// Returns `true` or `false`, or what `auto` and a missing attribute mean.
    pub fn flag(&self, name: &str, auto: bool) -> Result<bool, RobotFileError> {
        match self.attribute(name) {
            None | Some("auto") => Ok(auto),
            Some("true") => Ok(true),
            Some("false") => Ok(false),
            Some(_) => Err(self.error(name, "true, false or auto")),
        }
    }

    /// Returns the attribute `range`, if `limited` says that it limits, or if it is a range and `autolimits` says so.
    pub fn limits(
        &self,
        range: &'static str,
        limited: &'static str,
        settings: &Settings,
    ) -> Result<Option<[f64; 2]>, RobotFileError> {
        let given = self.numbers::<2>(range, "two numbers")?;
        let is_auto = matches!(self.attribute(limited), None | Some("auto"));
        if is_auto && given.is_some() && !settings.autolimits {
            let problem =
                format!("`{range}` without `{limited}`, and `autolimits` of <compiler> is false: state `{limited}`");
            return Err(unsupported(self.node, problem));
        }
        if !self.flag(limited, given.is_some_and(|[low, high]| low < high))? {
            return Ok(None);
        }
        match given {
            Some([low, high]) if low < high => Ok(Some([low, high])),
            _ => Err(self.error(range, "two numbers, the lower one first")),
        }
    }

    /// Returns position and orientation.
    pub fn pose(&self, settings: &Settings) -> Result<DAffine3, RobotFileError> {
        let translation = vector(self.numbers("pos", "three numbers")?.unwrap_or_default());
        let matrix3 = rotation(self.node, |name| self.attribute(name), settings.angles())?;
        Ok(DAffine3 { matrix3, translation })
    }
}
