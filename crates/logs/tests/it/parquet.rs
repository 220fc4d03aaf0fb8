//! Parquet files of other programs.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use expect_test::expect;
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::file::writer::SerializedFileWriter;
use parquet::schema::parser::parse_message_type;
use twinstep_logs::{Log, LogError};

use crate::{CSV, META, folder, write};

#[test]
fn log_written_by_pyarrow_is_read() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/pyarrow.parquet");
    let log = Log::open(file).expect("a log");
    assert_eq!(log.t(), [0.0, 0.005, 0.01, 0.015]);
    assert_eq!(log.episode(), [0, 0, 1, 1]);
    assert_eq!((log.kp("FL_hip", 3), log.kd("FL_hip", 3)), (Some(20.0), Some(0.5)));
    assert_eq!(log.q("FL_hip"), Some(&[0.1, 0.2, 0.3, 0.4][..]));
    let channel = |name: &str| format!("{:?}", log.channel(name).expect(name));
    assert_eq!(channel("temp_FL_hip"), "[31.0, NaN, NaN, 32.0]");
    assert_eq!(channel("contact_FL"), "[1.0, 0.0, NaN, 1.0]");
    assert_eq!(channel("battery_V"), "[28.5, NaN, 28.25, 28.0]");
    assert_eq!(log.ignored(), ["note", "raw.list.element"]);
}

/// Found by `fuzz --format log_parquet --seed 2`: a list in a page's header, and a dictionary, that claim more elements than
/// the file has.
#[test]
fn damaged_files_that_claim_billions_of_elements_are_refused_at_once() {
    for name in ["endless_header.parquet", "huge_dictionary.parquet"] {
        let error = Log::open(format!("{}/tests/data/damaged/{name}", env!("CARGO_MANIFEST_DIR"))).expect_err(name);
        assert!(matches!(error, LogError::Parquet { .. }), "{name}: {error}");
    }
}

/// Writes a file of one row with this schema: text "x", 1 in an INT64, 1.0 in a DOUBLE.
fn one_row(folder: &Path, columns: &str) -> PathBuf {
    let file = folder.join("data.parquet");
    let schema = Arc::new(parse_message_type(&format!("message log {{ {columns} }}")).expect("a schema"));
    let mut writer =
        SerializedFileWriter::new(File::create(&file).expect("a file"), schema, Arc::default()).expect("a writer");
    let mut group = writer.next_row_group().expect("a group");
    while let Some(mut column) = group.next_column().expect("a column") {
        match column.untyped() {
            parquet::column::writer::ColumnWriter::DoubleColumnWriter(_) => {
                column.typed::<DoubleType>().write_batch(&[1.0], Some(&[1]), None)
            }
            parquet::column::writer::ColumnWriter::Int64ColumnWriter(_) => {
                column.typed::<Int64Type>().write_batch(&[1], Some(&[1]), None)
            }
            _ => column.typed::<ByteArrayType>().write_batch(&[ByteArray::from("x")], Some(&[1]), None),
        }
        .expect("a cell");
        column.close().expect("closed");
    }
    group.close().expect("closed");
    writer.close().expect("closed");
    write(folder, "meta.json", META);
    file
}

fn check(columns: &str, expected: &expect_test::Expect) {
    let folder = tempfile::tempdir().expect("a folder");
    let error = Log::open(one_row(folder.path(), columns)).expect_err("no log").to_string();
    expected.assert_eq(&error.replace(&folder.path().display().to_string(), "log"));
}

#[test]
fn known_column_with_text_is_rejected() {
    check(
        "optional double t; optional binary q_a (UTF8);",
        &expect![
            "`log/data.parquet`, column `q_a` is BYTE_ARRAY (UTF8); store it as DOUBLE, FLOAT, INT32, INT64 or BOOLEAN"
        ],
    );
}

#[test]
fn timestamp_is_not_read_as_seconds() {
    check(
        "optional int64 t (TIMESTAMP(MICROS,true)); optional double q_a;",
        &expect![
            "`log/data.parquet`, column `t` is INT64 (TIMESTAMP_MICROS); store it as DOUBLE, FLOAT, INT32, INT64 or BOOLEAN"
        ],
    );
}

#[test]
fn nested_known_column_is_rejected() {
    check(
        "optional double t; required group gyro_x { optional double x; }",
        &expect!["`log/data.parquet`, column `gyro_x` is nested; store it as DOUBLE, FLOAT, INT32, INT64 or BOOLEAN"],
    );
}

#[test]
fn invalid_parquet_file_is_rejected() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = write(folder.path(), "data.parquet", "t,q_a,q_cmd_a\n0,0,0\n");
    write(folder.path(), "meta.json", META);
    let error = Log::open(file).expect_err("no log").to_string();
    expect![[r#"
        `log/data.parquet` is not a valid Parquet file: Parquet error: Invalid Parquet file. Corrupt footer
          it may be truncated or damaged: copy or write it again"#]]
    .assert_eq(&error.replace(&folder.path().display().to_string(), "log"));
}

/// Reading panics in the Parquet library are in the output of this test.
#[test]
fn file_with_any_damaged_byte_is_read_or_rejected() {
    let folder = folder(CSV, META);
    let log = Log::open(folder.path()).expect("a log");
    let written = tempfile::tempdir().expect("a folder");
    log.write(written.path()).expect("written");
    let path = written.path().join("data.parquet");
    let intact = fs::read(&path).expect("the file");
    let mut contradicting = 0;
    for at in 0..intact.len() {
        for flipped in [0x01, 0x80, 0xff] {
            let mut bytes = intact.clone();
            bytes[at] ^= flipped;
            fs::write(&path, bytes).expect("written");
            let error = Log::open(written.path()).err().map(|error| error.to_string()).unwrap_or_default();
            contradicting += usize::from(error.contains("contradict"));
        }
    }
    assert!(contradicting > 0, "no damage made the library panic: reading need not catch panics any more");
}
