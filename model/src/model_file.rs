//! The model file: which robot a server simulates, in TOML.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::{RobotModel, go2};

/// The names that `robot` may have.
const BUILT_IN: [&str; 1] = ["go2"];

/// Why a model file was refused.
#[derive(Debug, thiserror::Error)]
pub enum ModelFileError {
    /// The file could not be read.
    #[error("cannot read the model file {}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The text is not TOML, a key is unknown, or a value has the wrong type. The message has line and column.
    #[error("{name}: {message}")]
    Malformed {
        /// The file, or where else the text came from.
        name: String,
        /// What is wrong and where.
        message: String,
    },
    /// The robot is unknown.
    #[error("{name}: `robot` = \"{robot}\" is unknown; possible: \"{possible}\"", possible = BUILT_IN.join("\", \""))]
    UnknownRobot {
        /// The file, or where else the text came from.
        name: String,
        /// The robot that was asked for.
        robot: String,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelText {
    robot: String,
}

impl RobotModel {
    /// Reads a model file.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ModelFileError> {
        let path = path.as_ref();
        let text = std::fs::read_to_string(path)
            .map_err(|source| ModelFileError::Unreadable { path: path.to_owned(), source })?;
        Self::parse(&text, &path.display().to_string())
    }

    /// Reads the text of a model file; errors call it `name`.
    pub fn parse(text: &str, name: &str) -> Result<Self, ModelFileError> {
        let model: ModelText = toml::from_str(text)
            .map_err(|error| ModelFileError::Malformed { name: name.to_owned(), message: error.to_string() })?;
        match model.robot.as_str() {
            "go2" => Ok(go2()),
            other => Err(ModelFileError::UnknownRobot { name: name.to_owned(), robot: other.to_owned() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use expect_test::{Expect, expect};

    use super::*;

    fn check_refusal(text: &str, message: &Expect) {
        let error = RobotModel::parse(text, "robot.toml").expect_err("refused");
        message.assert_eq(&error.to_string());
    }

    #[test]
    fn built_in_robot_needs_one_line() {
        assert_eq!(RobotModel::parse("robot = \"go2\"", "robot.toml").expect("valid"), go2());
    }

    #[test]
    fn misspelt_key_is_named_with_its_line_and_the_possible_keys() {
        check_refusal(
            "# my robot\nrobto = \"go2\"\n",
            &expect![[r#"
            robot.toml: TOML parse error at line 2, column 1
              |
            2 | robto = "go2"
              | ^^^^^
            unknown field `robto`, expected `robot`
        "#]],
        );
    }

    #[test]
    fn unknown_robot_is_answered_with_the_known_ones() {
        check_refusal("robot = \"spot\"", &expect![[r#"robot.toml: `robot` = "spot" is unknown; possible: "go2""#]]);
    }

    #[test]
    fn missing_file_is_named() {
        let error = RobotModel::load("/nowhere/robot.toml").expect_err("no such file").to_string();
        assert!(error.starts_with("cannot read the model file /nowhere/robot.toml"), "{error}");
    }
}
