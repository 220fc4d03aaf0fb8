//! Columns of a data file before validation.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::columns::Column;
use crate::{CellLocation, LogError};

/// Known columns with one cell per row, in the order of the file.
#[derive(Debug)]
pub(crate) struct Table {
    pub file: PathBuf,
    /// Names and cells; a missing cell is NaN.
    pub columns: Vec<(String, Vec<f64>)>,
    /// Names of columns outside the grammar.
    pub ignored: Vec<String>,
    /// Line of each row in a text file.
    pub lines: Vec<u64>,
    /// Warnings about the file.
    pub notes: Vec<String>,
}

impl Table {
    /// Creates a table without rows from the names in a file's header.
    ///
    /// Also returns the index of each name's column in the table; `None` if it is ignored.
    pub fn from_header<N: AsRef<str>>(file: &Path, names: &[N]) -> Result<(Table, Vec<Option<usize>>), LogError> {
        let mut table =
            Table { file: file.into(), columns: Vec::new(), ignored: Vec::new(), lines: Vec::new(), notes: Vec::new() };
        let mut seen = BTreeSet::new();
        let mut indices = Vec::with_capacity(names.len());
        for name in names.iter().map(|name| name.as_ref().trim()) {
            if Column::parse(name).is_none() {
                table.ignored.push(name.to_owned());
                indices.push(None);
                continue;
            }
            if !seen.insert(name) {
                return Err(LogError::DuplicateColumn { file: file.into(), column: name.to_owned() });
            }
            indices.push(Some(table.columns.len()));
            table.columns.push((name.to_owned(), Vec::new()));
        }
        Ok((table, indices))
    }

    /// Returns the location of the cell in `column` at `row`, counted from 0.
    pub fn place(&self, column: &str, row: usize) -> CellLocation {
        let line = self.lines.get(row).copied();
        CellLocation { file: self.file.clone(), column: column.to_owned(), row: row + 1, line }
    }

    /// Returns the cells of a column.
    pub fn column(&self, name: &str) -> Option<&[f64]> {
        self.columns.iter().find(|(column, _)| column == name).map(|(_, cells)| cells.as_slice())
    }

    /// Removes a column and returns its cells.
    pub fn take(&mut self, name: &str) -> Option<Vec<f64>> {
        let index = self.columns.iter().position(|(column, _)| column == name)?;
        Some(self.columns.remove(index).1)
    }

    /// Returns the names of at most 12 columns as text, for errors.
    pub fn names(&self) -> String {
        const MAX_NAMES: usize = 12;
        let names = self.columns.iter().map(|(name, _)| name).chain(&self.ignored);
        let count = self.columns.len() + self.ignored.len();
        let listed = names.take(MAX_NAMES).map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        match count {
            0 => "none".to_owned(),
            _ if count > MAX_NAMES => format!("{listed} and {} more", count - MAX_NAMES),
            _ => listed,
        }
    }
}
