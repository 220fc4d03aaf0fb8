//! Tables as CSV: one header, one line per row, empty cells for missing values.

use std::io::{self, Read, Write};
use std::path::Path;

use crate::LogError;
use crate::column_map::ColumnMap;
use crate::log::{ColumnCells, NamedColumn};
use crate::table::Table;

/// Reads all rows. Errors contain `file`.
pub(crate) fn read(file: &Path, source: impl Read, map: &ColumnMap) -> Result<Table, LogError> {
    let failed = |error: csv::Error| LogError::Read { file: file.into(), cause: into_io(error) };
    let mut reader = csv::ReaderBuilder::new()
        // Ragged rows are reported below, with row and line.
        .flexible(true)
        // The reader's default terminator counts lines of `\r\n` files one too low. Here `\r` is trimmed as white
        // space.
        .terminator(csv::Terminator::Any(b'\n'))
        .trim(csv::Trim::All)
        .from_reader(source);
    let header = reader.byte_headers().map_err(failed)?;
    let names: Vec<_> = header.iter().map(|name| String::from_utf8_lossy(name).into_owned()).collect();
    let (mut table, indices) = Table::from_header(file, &map.names(file, &names)?)?;

    let mut record = csv::ByteRecord::new();
    while reader.read_byte_record(&mut record).map_err(failed)? {
        if record.len() == 1 && record[0].is_empty() && names.len() > 1 {
            continue; // Blank line.
        }
        let row = table.lines.len();
        let line = record.position().map_or(0, csv::Position::line);
        table.lines.push(line);
        if record.len() != names.len() {
            let (cells, columns) = (record.len(), names.len());
            return Err(LogError::RaggedRow { file: file.into(), row: row + 1, line, cells, columns });
        }
        for (cell, index) in record.iter().zip(&indices) {
            let Some(index) = *index else { continue };
            let Some(value) = number(cell) else {
                let text = String::from_utf8_lossy(cell).into_owned();
                return Err(LogError::NotANumber { place: table.place(&table.columns[index].0, row), text });
            };
            table.columns[index].1.push(value);
        }
    }
    map.convert(&names, &mut table);
    Ok(table)
}

/// Writes all rows.
pub(crate) fn write(columns: &[NamedColumn<'_>], target: impl Write) -> io::Result<()> {
    let mut writer = csv::Writer::from_writer(target);
    writer.write_record(columns.iter().map(|column| &column.name)).map_err(into_io)?;
    let rows = columns.first().map_or(0, |column| column.cells.len());
    for row in 0..rows {
        for column in columns {
            let text = match column.cells {
                ColumnCells::Index(cells) => cells[row].to_string(),
                ColumnCells::Number(cells) => shortest(cells[row]),
            };
            writer.write_field(text).map_err(into_io)?;
        }
        writer.write_record(None::<&[u8]>).map_err(into_io)?;
    }
    writer.flush()
}

/// Returns the value of a cell; NaN if it is empty, `None` for other text. pandas writes booleans as `True` and
/// `False`.
fn number(cell: &[u8]) -> Option<f64> {
    match cell {
        b"" => Some(f64::NAN),
        b"True" | b"true" => Some(1.0),
        b"False" | b"false" => Some(0.0),
        _ => std::str::from_utf8(cell).ok()?.parse().ok(),
    }
}

/// Returns the shortest text that parses to the same number; empty for NaN.
pub(crate) fn shortest(value: f64) -> String {
    if value.is_nan() {
        return String::new();
    }
    // `{:?}` writes the shortest digits, with an exponent if that is shorter, but always a fraction.
    let mut text = format!("{value:?}");
    if text.ends_with(".0") {
        text.truncate(text.len() - 2);
    }
    text
}

fn into_io(error: csv::Error) -> io::Error {
    match error.into_kind() {
        csv::ErrorKind::Io(cause) => cause,
        other => io::Error::new(io::ErrorKind::InvalidData, format!("{other:?}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_written_with_the_shortest_text() {
        let cases = [(0.1, "0.1"), (20.0, "20"), (-0.0, "-0"), (1e-7, "1e-7"), (1e300, "1e300"), (f64::NAN, "")];
        for (value, text) in cases {
            assert_eq!(shortest(value), text);
        }
    }

    #[test]
    fn spaces_byte_order_mark_and_windows_line_ends_are_ignored() {
        let text = "\u{feff}t , battery_V\r\n0, 28.5\r\n0.005, \r\n\r\n";
        let table = read(Path::new("data.csv"), text.as_bytes(), &ColumnMap::default()).expect("a table");
        assert_eq!(table.column("t"), Some(&[0.0, 0.005][..]));
        assert_eq!(format!("{:?}", table.column("battery_V").expect("a column")), "[28.5, NaN]");
        assert_eq!(table.lines, [2, 3]);
    }
}
