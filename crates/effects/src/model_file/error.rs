//! Reasons why a model file was rejected.

use std::path::PathBuf;

use crate::nominal::NominalRobotError;
use crate::{CATALOGUE, Effect, EntryError};

/// Reason why a model file was rejected.
#[derive(Debug, thiserror::Error)]
pub enum ModelFileError {
    /// The file could not be read.
    #[error("cannot read the model file {}: {source}{}", path.display(), shipped(path))]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The text is not TOML, a key is unknown, or a value has the wrong type.
    #[error("{name}: {message}")]
    Malformed {
        /// The file, or another source of the text.
        name: String,
        /// Problem, with line and column.
        message: String,
    },
    /// The nominal robot is unknown, or its file or tables are not valid.
    #[error("{name}: {cause}")]
    Robot {
        /// The file, or another source of the text.
        name: String,
        /// What is wrong.
        cause: Box<NominalRobotError>,
    },
    /// The file describes a robot of any tree, and the caller needs a quadruped like the Go2.
    #[error(
        "{name}: this is the model file of a robot of any tree: it has [joints.rename], [groups], [shapes], or gains or a \
         pose by joint. `serve` and `train` with the tasks `walk` and `pose`, `evaluate` and `identify` take it; this needs a quadruped like the Go2"
    )]
    OfTree {
        /// The file, or another source of the text.
        name: String,
    },
    /// An entry of `[[effect]]` is wrong.
    #[error("{name}: effect {number}: {problem}")]
    Effect {
        /// The file, or another source of the text.
        name: String,
        /// Number of the entry, from 1.
        number: usize,
        /// Problem of the entry, and what is allowed.
        problem: EffectEntryError,
    },
    /// The robot has an actuator network, but the caller needs analytic actuators.
    #[error(
        "{name}: this command does not simulate actuator networks; `serve`, `play`, `evaluate`, `train` and `view` do. \
         Remove the table `[actuator]` to use the analytic actuators with the effects of the file"
    )]
    ActuatorNetwork {
        /// The file, or another source of the text.
        name: String,
    },
    /// Entries cannot be combined.
    #[error("{name}: {cause}")]
    Conflict {
        /// The file, or another source of the text.
        name: String,
        /// Conflicting entry, and the reason.
        cause: EntryError,
    },
}

/// Problem of an entry of a model file.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EffectEntryError {
    /// The catalogue has no such effect.
    #[error("`name` = \"{given}\" is not in the catalogue; possible: {}", CATALOGUE.map(|effect| effect.name).join(", "))]
    Unknown {
        /// The name.
        given: String,
    },
    /// A key is missing or of the wrong kind.
    #[error("`{key}` is {found}; expected {expected}")]
    Key {
        /// The key.
        key: String,
        /// Value in the file.
        found: String,
        /// Expected value.
        expected: String,
    },
    /// The effect does not have this key.
    #[error("`{effect}` has no key `{key}`; possible: name, scope, interval, {}", names(effect))]
    UnknownKey {
        /// The effect.
        effect: &'static str,
        /// The key.
        key: String,
    },
    /// Scope or values are not allowed.
    #[error(transparent)]
    Entry(#[from] EntryError),
}

/// Returns the names of an effect's parameters, separated by commas.
fn names(effect: &str) -> String {
    let parameters = Effect::named(effect).map_or(&[][..], |effect| effect.parameters);
    parameters.iter().map(|parameter| parameter.name).collect::<Vec<_>>().join(", ")
}

/// Names the robots of the program if a name may be meant.
fn shipped(path: &std::path::Path) -> String {
    if path.extension().is_some() {
        return String::new();
    }
    let names: Vec<_> = crate::shipped_robots().collect();
    format!("\n  robots of this program, without a file: {}", names.join(", "))
}
