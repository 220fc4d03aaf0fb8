//! Mappings from the configs that training programs leave beside a policy.
//!
//! Each reader turns one kind of file into [`facts::Facts`], what that source says, with the place of every value: [`deploy_yaml`],
//! [`isaac_lab`], [`rl_sar`], [`rl_gym`], [`legged_gym`], [`metadata`] of the network. [`import_policy`] merges them (the first
//! source that has a value gives it), compares them with each other and with the network, and [`text`] writes the mapping.

mod deploy_yaml;
mod facts;
mod isaac_lab;
mod legged_gym;
mod merge;
mod metadata;
mod orders;
mod rl_gym;
mod rl_sar;
mod sources;
mod text;
mod yaml;

use std::path::{Path, PathBuf};

use crate::error::AgentError;
use merge::Draft;
use sources::Sources;

/// A mapping made from configs.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportedPolicy {
    /// Text of the mapping file. Entries that were not found are comments.
    pub mapping: String,
    /// The network, if it is among the sources.
    pub network: Option<PathBuf>,
    /// Key of each entry, and where its value comes from.
    pub origins: Vec<(String, String)>,
    /// What was not found, with what to do.
    pub missing: Vec<String>,
    /// Values on which sources or the network do not agree.
    pub disagreements: Vec<String>,
    /// What was taken without being said by a source.
    pub notes: Vec<String>,
    /// The mapping with every other order of the observation, if no source contains the order.
    pub alternatives: Vec<Alternative>,
}

/// Another mapping that the sources allow.
#[derive(Clone, Debug, PartialEq)]
pub struct Alternative {
    /// Order of the observation.
    pub order: String,
    /// Text of the mapping file.
    pub mapping: String,
}

/// Makes a mapping from files, or from folders that contain them.
pub fn import_policy(paths: &[impl AsRef<Path>]) -> Result<ImportedPolicy, AgentError> {
    let sources = Sources::find(paths)?;
    let facts = sources.facts()?;
    let draft = Draft::new(facts, sources.network.as_ref());
    let mapping = text::mapping(&draft);
    let others = orders::other_orders(&draft).into_iter();
    let alternatives = others.map(|(order, draft)| Alternative { order, mapping: text::mapping(&draft) }).collect();
    let Draft { origins, missing, disagreements, notes, .. } = draft;
    let network = sources.network.map(|network| network.path().to_owned());
    Ok(ImportedPolicy { mapping, network, origins, missing, disagreements, notes, alternatives })
}

#[cfg(test)]
mod tests;
