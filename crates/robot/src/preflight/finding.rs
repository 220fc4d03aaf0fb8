//! What preflight found, and what it could not check.

use std::fmt;

/// Something that is wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// Name of the mistake, such as `encoder_dead`.
    pub id: &'static str,
    /// What is wrong.
    pub what: String,
    /// How preflight knows, with numbers.
    pub evidence: String,
    /// How to mend it.
    pub remedy: String,
    /// Which motions it makes unsafe.
    pub blocks: Blocks,
}

/// Motions that a finding makes unsafe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Blocks {
    /// None.
    Nothing,
    /// Those of the whole robot on its feet.
    Stance,
    /// All.
    Motion,
}

impl Finding {
    /// Returns a finding that makes no motion unsafe.
    pub(super) fn new(id: &'static str, what: String, evidence: String, remedy: &str) -> Self {
        Self { id, what, evidence, remedy: remedy.to_owned(), blocks: Blocks::Nothing }
    }

    /// Returns the finding as one that makes motions unsafe.
    pub(super) fn blocking(self, blocks: Blocks) -> Self {
        Self { blocks, ..self }
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { id, what, evidence, remedy, .. } = self;
        write!(formatter, "{id}: {what}\n  evidence: {evidence}\n  remedy: {remedy}")
    }
}

/// A check that was not made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    /// What was not checked.
    pub check: &'static str,
    /// Why not.
    pub reason: String,
}

impl fmt::Display for LeftOut {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "not checked: {}, because {}", self.check, self.reason)
    }
}
