//! Tables as Parquet: plain numeric columns, null for missing values.

use std::fs::File;
use std::io::Write;
use std::panic::catch_unwind;
use std::path::Path;
use std::sync::Arc;

use parquet::basic::{Compression, ConvertedType, LogicalType, Repetition, Type as Physical, ZstdLevel};
use parquet::column::reader::{ColumnReader, ColumnReaderImpl, get_column_reader};
use parquet::data_type::{DataType, DoubleType, Int64Type};
use parquet::errors::{ParquetError, Result as ParquetResult};
use parquet::file::properties::WriterProperties;
use parquet::file::reader::{FileReader, SerializedFileReader};
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::types::{ColumnDescriptor, Type};

use crate::LogError;
use crate::column_map::ColumnMap;
use crate::columns::Column;
use crate::log::{ColumnCells, NamedColumn};
use crate::parquet_checks::{CheckedFile, CheckedPages};
use crate::table::Table;

/// Reads all row groups.
pub(crate) fn read(file: &Path, map: &ColumnMap) -> Result<Table, LogError> {
    // The Parquet library panics on some damaged files: negative offsets, dictionary indices without a dictionary,
    // pages that are shorter than their number of values.
    catch_unwind(|| read_row_groups(file, map)).unwrap_or_else(|_| {
        let cause = ParquetError::General("its metadata and its pages contradict each other".to_owned());
        Err(LogError::Parquet { file: file.into(), cause })
    })
}

fn read_row_groups(file: &Path, map: &ColumnMap) -> Result<Table, LogError> {
    let failed = |cause| LogError::Parquet { file: file.into(), cause };
    let opened = File::open(file).map_err(|cause| LogError::Read { file: file.into(), cause })?;
    let reader = SerializedFileReader::new(CheckedFile(opened)).map_err(failed)?;
    let leaves = reader.metadata().file_metadata().schema_descr().columns();
    let header = column_names(file, leaves)?;
    let (mut table, indices) = Table::from_header(file, &map.names(file, &header)?)?;

    for (leaf, (descriptor, index)) in leaves.iter().zip(&indices).enumerate() {
        let Some(index) = *index else { continue };
        let number = Number::stored_in(descriptor).ok_or_else(|| wrong_type(file, descriptor))?;
        for group in 0..reader.num_row_groups() {
            let group = reader.get_row_group(group).map_err(failed)?;
            let rows = usize::try_from(group.metadata().num_rows()).unwrap_or(0);
            let pages = group.get_column_page_reader(leaf).map(|pages| Box::new(CheckedPages(pages)));
            let column = pages.map(|pages| get_column_reader(Arc::clone(descriptor), pages));
            let cells = column.and_then(|column| read_column(column, number, rows));
            table.columns[index].1.extend(cells.map_err(failed)?);
        }
    }
    map.convert(&header, &mut table);
    Ok(table)
}

/// Writes one row group, compressed with Zstandard.
pub(crate) fn write(columns: &[NamedColumn<'_>], target: impl Write + Send) -> ParquetResult<()> {
    let fields = columns.iter().map(|column| {
        let (physical, repetition) = match column.cells {
            ColumnCells::Index(_) => (Physical::INT64, Repetition::REQUIRED),
            ColumnCells::Number(_) => (Physical::DOUBLE, Repetition::OPTIONAL),
        };
        Type::primitive_type_builder(&column.name, physical).with_repetition(repetition).build().map(Arc::new)
    });
    let schema = Type::group_type_builder("log").with_fields(fields.collect::<ParquetResult<_>>()?).build()?;
    let properties = WriterProperties::builder().set_compression(Compression::ZSTD(ZstdLevel::default())).build();
    let mut writer = SerializedFileWriter::new(target, Arc::new(schema), Arc::new(properties))?;
    let mut group = writer.next_row_group()?;
    for column in columns {
        let mut target = group.next_column()?.ok_or_else(|| ParquetError::EOF(column.name.clone()))?;
        match column.cells {
            ColumnCells::Index(cells) => {
                let cells: Vec<i64> = cells.iter().map(|&cell| i64::from(cell)).collect();
                target.typed::<Int64Type>().write_batch(&cells, None, None)?;
            }
            ColumnCells::Number(cells) => {
                let levels: Vec<i16> = cells.iter().map(|cell| i16::from(!cell.is_nan())).collect();
                let present: Vec<f64> = cells.iter().copied().filter(|cell| !cell.is_nan()).collect();
                target.typed::<DoubleType>().write_batch(&present, Some(&levels), None)?;
            }
        }
        target.close()?;
    }
    group.close()?;
    writer.close()?;
    Ok(())
}

/// Interpretation of a column's integers.
#[derive(Clone, Copy)]
enum Number {
    Signed,
    Unsigned,
}

impl Number {
    /// Returns `None` for text, dates, times and decimals.
    fn stored_in(descriptor: &ColumnDescriptor) -> Option<Number> {
        let unsigned = match (descriptor.logical_type_ref(), descriptor.converted_type()) {
            (Some(LogicalType::Integer(integer)), _) => !integer.is_signed,
            (None, ConvertedType::NONE) => false,
            (None, kind) if SIGNED.contains(&kind) => false,
            (None, kind) if UNSIGNED.contains(&kind) => true,
            _ => return None,
        };
        let number = matches!(
            descriptor.physical_type(),
            Physical::DOUBLE | Physical::FLOAT | Physical::INT32 | Physical::INT64 | Physical::BOOLEAN
        );
        number.then_some(if unsigned { Number::Unsigned } else { Number::Signed })
    }
}

const SIGNED: [ConvertedType; 4] =
    [ConvertedType::INT_8, ConvertedType::INT_16, ConvertedType::INT_32, ConvertedType::INT_64];
const UNSIGNED: [ConvertedType; 4] =
    [ConvertedType::UINT_8, ConvertedType::UINT_16, ConvertedType::UINT_32, ConvertedType::UINT_64];

fn read_column(column: ColumnReader, number: Number, rows: usize) -> ParquetResult<Vec<f64>> {
    match (column, number) {
        (ColumnReader::DoubleColumnReader(reader), _) => cells(reader, rows, |&value| value),
        (ColumnReader::FloatColumnReader(reader), _) => cells(reader, rows, |&value| f64::from(value)),
        (ColumnReader::BoolColumnReader(reader), _) => cells(reader, rows, |&value| f64::from(u8::from(value))),
        (ColumnReader::Int32ColumnReader(reader), Number::Signed) => cells(reader, rows, |&value| f64::from(value)),
        (ColumnReader::Int64ColumnReader(reader), Number::Signed) => cells(reader, rows, |&value| value as f64),
        (ColumnReader::Int32ColumnReader(reader), Number::Unsigned) => {
            cells(reader, rows, |&value| f64::from(value.cast_unsigned()))
        }
        (ColumnReader::Int64ColumnReader(reader), Number::Unsigned) => {
            cells(reader, rows, |&value| value.cast_unsigned() as f64)
        }
        _ => Err(ParquetError::General("a column's type differs between schema and data".to_owned())),
    }
}

/// Returns all rows of a column in one row group; NaN for null.
fn cells<T: DataType>(
    mut reader: ColumnReaderImpl<T>,
    rows: usize,
    to_number: impl Fn(&T::T) -> f64,
) -> ParquetResult<Vec<f64>> {
    let (mut values, mut levels) = (Vec::new(), Vec::new());
    let (found, _, _) = reader.read_records(rows, Some(&mut levels), None, &mut values)?;
    if found != rows {
        return Err(ParquetError::EOF(format!("a column ends after {found} of {rows} rows")));
    }
    let mut values = values.iter().map(to_number);
    if levels.is_empty() {
        return Ok(values.collect());
    }
    // Columns are not nested: definition level 1 is a value, level 0 is null.
    Ok(levels.iter().map(|&level| if level == 1 { values.next().unwrap_or(f64::NAN) } else { f64::NAN }).collect())
}

/// Returns the column names of a file. Fails if a nested column has a name of the grammar.
///
/// Other nested columns are ignored, and have their path as name.
fn column_names(file: &Path, leaves: &[Arc<ColumnDescriptor>]) -> Result<Vec<String>, LogError> {
    let name = |leaf: &Arc<ColumnDescriptor>| {
        let column = leaf.path().parts().first().map_or("", String::as_str);
        if is_nested(leaf) && Column::parse(column).is_some() {
            return Err(wrong_type(file, leaf));
        }
        Ok(leaf.path().string())
    };
    leaves.iter().map(name).collect()
}

fn is_nested(leaf: &ColumnDescriptor) -> bool {
    leaf.path().parts().len() > 1 || leaf.max_rep_level() > 0
}

fn wrong_type(file: &Path, leaf: &ColumnDescriptor) -> LogError {
    let found = match leaf.converted_type() {
        _ if is_nested(leaf) => "nested".to_owned(),
        ConvertedType::NONE => leaf.physical_type().to_string(),
        kind => format!("{} ({kind})", leaf.physical_type()),
    };
    let column = leaf.path().parts().first().cloned().unwrap_or_default();
    LogError::ColumnType { file: file.into(), column, found }
}
