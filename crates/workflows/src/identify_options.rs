//! Settings and result of an identification.

use std::path::PathBuf;

use twinstep_identify::IdentifyOptions as SearchOptions;

use crate::rows::RowSelection;

/// Settings of [`identify`](crate::identify()).
#[derive(Clone, Debug)]
pub struct IdentifyOptions {
    /// Measured logs: data files, or folders that contain one.
    pub logs: Vec<PathBuf>,
    /// Model file to start from. `None`: the ideal Go2.
    pub model: Option<PathBuf>,
    /// Model file of an earlier identification, from whose values the search starts.
    pub start: Option<PathBuf>,
    /// Effects to estimate, with scopes, as in `payload@base`. `None`: the default ones.
    pub effects: Option<Vec<String>>,
    /// Rows of the logs that are used.
    pub rows: RowSelection,
    /// True to estimate parameters that are not identifiable from the logs, too.
    pub force: bool,
    /// Maximum number of generations of CMA-ES. With 0, gradient steps alone.
    pub generations: usize,
    /// Seed of the search.
    pub seed: u64,
    /// True to continue the search that was interrupted.
    pub resume: bool,
    /// Model file to write.
    pub out: PathBuf,
}

/// Result of [`identify`](crate::identify()).
#[derive(Clone, Debug)]
pub struct Identified {
    /// The estimates.
    pub estimates: Vec<Estimated>,
    /// Errors on the rows that were used, by log.
    pub fits: Vec<Fit>,
    /// The estimates as a table, with highly correlated pairs.
    pub table: String,
    /// True if it was interrupted: the values are the best so far.
    pub is_interrupted: bool,
}

/// An estimated parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimated {
    /// Effect, scope and parameter.
    pub name: String,
    /// Unit of the value.
    pub unit: String,
    /// The value.
    pub value: f64,
    /// Its 95 % interval.
    pub interval: Option<[f64; 2]>,
}

/// Closed-loop error of the joint positions on a log.
#[derive(Clone, Debug, PartialEq)]
pub struct Fit {
    /// Path of the log.
    pub log: PathBuf,
    /// Root mean square error with the model before and after [rad].
    pub q_rmse_rad: [f64; 2],
}

impl Identified {
    /// Returns table and errors as text.
    pub fn text(&self) -> String {
        let fits = self.fits.iter().map(|Fit { log, q_rmse_rad: [before, after] }| {
            let log = log.display();
            format!("{log}: closed-loop joint RMSE {before:.4} -> {after:.4} rad on the rows it was fitted to\n")
        });
        self.table.clone() + &fits.collect::<String>()
    }
}

impl IdentifyOptions {
    /// Returns options without logs, which write the model file `out`.
    pub fn new(out: impl Into<PathBuf>) -> Self {
        let SearchOptions { generations, seed, .. } = SearchOptions::default();
        Self {
            logs: Vec::new(),
            model: None,
            start: None,
            effects: None,
            rows: RowSelection::default(),
            force: false,
            generations,
            seed,
            resume: false,
            out: out.into(),
        }
    }
}
