//! Reasons why a robot file is refused.

/// Reason why a robot file was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RobotFileError {
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
        attribute: String,
        /// Its value, or `missing`.
        found: String,
        /// What is expected.
        expected: &'static str,
    },
    /// The file has something that is not supported.
    #[error("line {line}: {problem}")]
    Unsupported {
        /// Line, from 1.
        line: u32,
        /// What it is, and what to do.
        problem: String,
    },
    /// A joint is missing or does not fit.
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
    /// An included file cannot be read.
    #[error("line {line}: <include file=\"{file}\">: {problem}")]
    Include {
        /// Line, from 1.
        line: u32,
        /// Value of `file`.
        file: String,
        /// What is wrong.
        problem: String,
    },
}
