//! The columns of a data file as they stand there, before anything about them is checked.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::columns::Column;
use crate::{LogError, CellLocation};

/// Known columns with a cell for each row, in the file's order.
#[derive(Debug)]
pub(crate) struct Table {
    pub file: PathBuf,
    /// A missing cell is NaN.
    pub columns: Vec<(String, Vec<f64>)>,
    /// The names of the columns outside the grammar.
    pub ignored: Vec<String>,
    /// The line of each row, for text.
    pub lines: Vec<u64>,
    /// What was odd about the file and yet no error.
    pub notes: Vec<String>,
}

impl Table {
    /// A table without rows from all the names in a file's header.
    ///
    /// Gives, for each name, the place of its column in the table; none if it is ignored.
    pub fn from_header<N: AsRef<str>>(file: &Path, names: &[N]) -> Result<(Table, Vec<Option<usize>>), LogError> {
        let mut table =
            Table { file: file.into(), columns: Vec::new(), ignored: Vec::new(), lines: Vec::new(), notes: Vec::new() };
        let mut seen = BTreeSet::new();
        let mut places = Vec::with_capacity(names.len());
        for name in names.iter().map(|name| name.as_ref().trim()) {
            if Column::parse(name).is_none() {
                table.ignored.push(name.to_owned());
                places.push(None);
                continue;
            }
            if !seen.insert(name) {
                return Err(LogError::DuplicateColumn { file: file.into(), column: name.to_owned() });
            }
            places.push(Some(table.columns.len()));
            table.columns.push((name.to_owned(), Vec::new()));
        }
        Ok((table, places))
    }

    /// Names the cell in `column` at `row`, which counts from 0 here.
    pub fn place(&self, column: &str, row: usize) -> CellLocation {
        let line = self.lines.get(row).copied();
        CellLocation { file: self.file.clone(), column: column.to_owned(), row: row + 1, line }
    }

    /// The cells of a column.
    pub fn column(&self, name: &str) -> Option<&[f64]> {
        self.columns.iter().find(|(column, _)| column == name).map(|(_, cells)| cells.as_slice())
    }

    /// Removes a column and gives its cells.
    pub fn take(&mut self, name: &str) -> Option<Vec<f64>> {
        let place = self.columns.iter().position(|(column, _)| column == name)?;
        Some(self.columns.remove(place).1)
    }

    /// The first names of all columns, for an error.
    pub fn names(&self) -> String {
        const SHOWN: usize = 12;
        let names = self.columns.iter().map(|(name, _)| name).chain(&self.ignored);
        let count = self.columns.len() + self.ignored.len();
        let shown = names.take(SHOWN).map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
        match count {
            0 => "none".to_owned(),
            _ if count > SHOWN => format!("{shown} and {} more", count - SHOWN),
            _ => shown,
        }
    }
}
