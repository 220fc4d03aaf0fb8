//! Texts of all errors: what is wrong, where, and how to fix it.

use std::fs;
use std::path::Path;

use expect_test::{Expect, expect};
use twinstep_logs::{Log, LogError};

use crate::{CSV, META, columns, folder, meta, write};

/// Returns the error of opening this log, with its folder replaced by `log`.
fn error(folder: &Path) -> String {
    let error = Log::open(folder).expect_err("no log").to_string();
    error.replace(&folder.display().to_string(), "log")
}

fn check_csv(csv: &str, expected: &Expect) {
    expected.assert_eq(&error(folder(csv, META).path()));
}

fn check_meta(meta: &str, expected: &Expect) {
    expected.assert_eq(&error(folder(CSV, meta).path()));
}

fn check_columns<const N: usize>(extra: [(&str, Vec<f64>); N], expected: &Expect) {
    let mut all = columns([("t", vec![0.0, 0.1]), ("q_a", vec![0.0; 2]), ("q_cmd_a", vec![0.0; 2])]);
    all.retain(|(name, _)| extra.iter().all(|(other, _)| name != other));
    all.extend(columns(extra));
    expected.assert_eq(&Log::new(meta(), all).expect_err("no log").to_string());
}

#[test]
fn errors_for_missing_files_say_what_to_pass() {
    let empty = tempfile::tempdir().expect("a folder");
    expect![[r#"
        there is no log at `log`
          pass a folder with meta.json and one of data.parquet, data.csv, data.csv.gz and data.mcap, or a data file"#]]
    .assert_eq(&error(empty.path()));
    write(empty.path(), "data.csv", CSV);
    expect![[r#"
        `log/meta.json`, the metadata of `log/data.csv`, is missing
          its minimal content is {"rate_hz": 200, "tau_sensor": "none", "segments": [{"name": "walk", "base": "floating"}]}"#]].assert_eq(&error(empty.path()));
    write(empty.path(), "meta.json", META);
    write(empty.path(), "data.parquet", "");
    expect![[r#"
        `log` must have one data file, not data.parquet and data.csv
          keep one of them, or pass the path of the data file"#]]
    .assert_eq(&error(empty.path()));
}

#[test]
fn error_for_an_unknown_format_lists_the_known_ones() {
    let folder = folder(CSV, META);
    let file = write(folder.path(), "walk.xlsx", "");
    let error = Log::open(file).expect_err("no log").to_string();
    expect![[r#"
        the format of `log/walk.xlsx` is unknown
          name it *.parquet, *.csv, *.csv.gz or *.mcap; docs/logs.md says how to convert *.npz and *.db3"#]]
    .assert_eq(&error.replace(&folder.path().display().to_string(), "log"));
}

#[test]
fn errors_for_missing_columns_contain_their_names() {
    check_csv(
        "time,q_a,q_cmd_a\n0,0,0\n",
        &expect![[r#"
            `log/data.csv` has no column `t` (the time of each row [s]); its columns are `q_a`, `q_cmd_a`, `time`
              if it is `time`, rename that to `t`"#]],
    );
    check_csv(
        "t,position\n0,0\n",
        &expect![
            "`log/data.csv` has no column `q_<joint>` (a joint's measured position, such as `q_FL_hip` [rad]); its columns are `t`, `position`"
        ],
    );
    check_csv(
        "t,kp,kd,q_a\n0,1,1,0\n",
        &expect![[r#"
        `log/data.csv` has no column `q_cmd_a`, which the joint `a` needs
          add it, or list the joints without `a` in `joints` of the meta file"#]],
    );
}

#[test]
fn joints_in_the_metadata_need_columns() {
    check_meta(
        &META.replacen('{', r#"{"joints": ["FL_hip", "FR_hip"], "#, 1),
        &expect![[r#"
        `log/data.csv` has no column `q_FR_hip`, which the joint `FR_hip` needs
          add it, or list the joints without `FR_hip` in `joints` of the meta file"#]],
    );
}

#[test]
fn log_without_rows_is_rejected() {
    check_csv("t,kp,kd,q_a,q_cmd_a\n", &expect!["`log/data.csv` has no rows; a log needs at least one"]);
}

#[test]
fn duplicate_column_is_rejected() {
    check_csv(
        "t,kp,kd,q_a,q_cmd_a,q_a\n0,1,1,0,0,0\n",
        &expect!["`log/data.csv` has the column `q_a` twice; rename or remove one"],
    );
}

#[test]
fn error_for_text_in_a_cell_contains_its_line() {
    check_csv(
        &CSV.replace("0.3,", "O.3,"),
        &expect![[r#"
        `log/data.csv`, column `q_FL_hip`, row 3 (line 4): `O.3` is not a number
          a missing value in an optional column is an empty cell"#]],
    );
}

#[test]
fn error_for_a_ragged_row_contains_its_line() {
    check_csv(
        &CSV.replace(",28\n", "\n"),
        &expect![[r#"
            `log/data.csv`, row 3 (line 4) has 5 cells, but the header has 6
              write an empty cell for a missing value; a row has one comma less than columns"#]],
    );
}

#[test]
fn empty_cell_of_a_required_column_is_rejected() {
    check_csv(
        &CSV.replace("0.2,", ","),
        &expect![[r#"
            `log/data.csv`, column `q_FL_hip`, row 2 (line 3) is empty or NaN, but it must be a finite number
              remove the row, or fill the cell with the value that was in force"#]],
    );
}

#[test]
fn time_that_does_not_increase_is_rejected() {
    check_csv(
        &CSV.replace("0.01,", "0.005,"),
        &expect![[r#"
        `log/data.csv`, column `t`, row 3 (line 4): 0.005 s follows 0.005 s, but time must increase within a segment of an episode
          increment `episode` at every reset of the robot"#]],
    );
}

#[test]
fn negative_gain_is_rejected() {
    check_csv(
        &CSV.replace("0.01,20", "0.01,-20"),
        &expect![[r#"
            `log/data.csv`, column `kp`, row 3 (line 4): the gain -20 is negative
              kp [N·m/rad] and kd [N·m·s/rad] act as kp·(q_cmd − q) + kd·(dq_cmd − dq): change its sign"#]],
    );
}

#[test]
fn cells_out_of_range_are_rejected() {
    check_columns(
        [("segment", vec![0.0, 2.0])],
        &expect![[r#"
        `columns in memory`, column `segment`, row 2: segment 2 is not in `segments` of the meta file, which has 2 entries, counted from 0
          add {"name": …, "base": "fixed" or "floating"} to `segments`, or correct the column"#]],
    );
    check_columns(
        [("episode", vec![0.0, 0.5])],
        &expect![[r#"
        `columns in memory`, column `episode`, row 2 is 0.5, but it must be a whole number from 0
          omit the column if it is constant"#]],
    );
    check_columns(
        [("episode", vec![0.0, -1.0])],
        &expect![[r#"
        `columns in memory`, column `episode`, row 2 is -1, but it must be a whole number from 0
          omit the column if it is constant"#]],
    );
    check_columns(
        [("gyro_x", vec![0.0, f64::INFINITY])],
        &expect![[r#"
        `columns in memory`, column `gyro_x`, row 2 is inf, but it must be finite
          a missing value in an optional column is an empty cell"#]],
    );
    check_columns(
        [("t", vec![f64::NAN, 0.0])],
        &expect![[r#"
        `columns in memory`, column `t`, row 1 is empty or NaN, but it must be a finite number
          remove the row, or fill the cell with the value that was in force"#]],
    );
}

#[test]
fn quaternion_must_have_unit_norm() {
    let part = |second: f64| vec![0.5, second];
    let quaternion = |w| [("quat_w", part(w)), ("quat_x", part(0.5)), ("quat_y", part(0.5)), ("quat_z", part(0.5))];
    check_columns(
        quaternion(0.6),
        &expect![[r#"
        `columns in memory`, column `quat_w`, row 2: the quaternion's norm is 1.0536, but it must be within 0.01 of 1
          quat_w, quat_x, quat_y, quat_z rotate base coordinates into world coordinates; leave the cells empty if the orientation is unknown"#]],
    );
    let mut all = columns([("t", vec![0.0, 0.1]), ("q_a", vec![0.0; 2]), ("q_cmd_a", vec![0.0; 2])]);
    all.extend(columns(quaternion(f64::NAN)));
    assert!(Log::new(meta(), all).is_ok(), "missing cells are not an invalid orientation");
}

#[test]
fn columns_of_unequal_length_are_rejected() {
    check_columns([("dq_a", vec![0.0])], &expect!["`columns in memory`, column `dq_a` has 1 rows, but `t` has 2"]);
}

#[test]
fn missing_key_of_the_metadata_is_named() {
    check_meta(
        &META.replace("rate_hz", "rate"),
        &expect!["`log/meta.json`: missing field `rate_hz` at line 1 column 85"],
    );
}

#[test]
fn unknown_key_of_the_metadata_is_ignored_with_a_warning() {
    let log = folder(CSV, &META.replacen('{', r#"{"robot": "Go2 EDU", "#, 1));
    let log = Log::open(log.path()).expect("a log");
    expect!["unknown key `robot` of the meta file is ignored; the known keys are rate_hz, policy_hz, joints, tau_sensor, segments, pd, kp, kd, base_quat, noise, source, licence"]
    .assert_eq(&log.read_warnings().join("\n"));
}

#[test]
fn values_of_the_metadata_out_of_range_are_rejected() {
    check_meta(
        &META.replace("200", "0"),
        &expect!["`log/meta.json`: `rate_hz` = 0, but it must be a finite number greater than 0 [Hz]"],
    );
    check_meta(
        r#"{"rate_hz": 200, "tau_sensor": "none", "segments": []}"#,
        &expect!["`log/meta.json`: `segments` = [], but it must be a list with at least one segment"],
    );
    check_meta(
        &META.replace("fixed", "held"),
        &expect!["`log/meta.json`: unknown variant `held`, expected `fixed` or `floating` at line 1 column 84"],
    );
    let with = |text: &str| META.replacen('{', &format!("{{{text}, "), 1);
    check_meta(
        &with(r#""kp": "20""#),
        &expect![
            "`log/meta.json`: a gain must be a number, or a list with one number for each joint at line 1 column 11"
        ],
    );
    check_meta(
        &with(r#""kp": [20, 21]"#),
        &expect!["`log/meta.json`: `kp` = [20.0, 21.0], but it must be one number, or one for each joint"],
    );
    check_meta(
        &with(r#""kd": -0.5"#),
        &expect!["`log/meta.json`: `kd` = -0.5, but it must be finite and not negative"],
    );
    check_meta(
        &with(r#""noise": {"torque": 0.1}"#),
        &expect![
            "`log/meta.json`: `noise.torque` = 0.1, but it must be named after a channel such as `q_FL_hip`, or a quantity such as `q`"
        ],
    );
    check_meta(
        &with(r#""joints": ["FL_hip", "FL_hip"]"#),
        &expect!["`log/meta.json`: `joints` = `FL_hip`, but it must be a list of different names"],
    );
    check_meta(
        &with(r#""joints": ["cmd_FL"]"#),
        &expect![
            "`log/meta.json`: `joints` = `cmd_FL`, but it must be a name without spaces around it or `cmd_` before it"
        ],
    );
}

#[test]
fn error_for_a_joint_name_with_a_suffix_contains_the_probable_column() {
    for name in ["q_FL_hip_deg", "q_FL_hip [rad]"] {
        let error = error(folder(&CSV.replace(",q_FL_hip", &format!(",{name}")), META).path());
        assert!(
            error.contains(&format!("column `{name}`")) && error.contains("rename the column to `q_FL_hip`, in rad"),
            "{error}"
        );
    }
}

#[test]
fn positions_in_degrees_give_a_warning() {
    let log = Log::open(folder(&CSV.replace("0.3,", "85,"), META).path()).expect("a log");
    expect!["q_FL_hip exceeds 7 rad in magnitude: positions must be in radians, not degrees"]
        .assert_eq(&log.describe().warnings.join("; "));
}

#[test]
fn location_of_a_cell_is_in_the_fields_of_the_error() {
    let folder = folder(&CSV.replace("0.3,", "?,"), META);
    let Err(LogError::NotANumber { place, text }) = Log::open(folder.path()) else { panic!("another error") };
    assert_eq!((place.column.as_str(), place.row, place.line, text.as_str()), ("q_FL_hip", 3, Some(4), "?"));
}

#[test]
fn truncated_gzip_file_is_an_error() {
    let folder = folder(CSV, META);
    let file = folder.path().join("cut.csv.gz");
    Log::open(folder.path()).expect("a log").write(&file).expect("written");
    let whole = fs::read(&file).expect("a file");
    fs::write(&file, &whole[..whole.len() / 2]).expect("a file");
    let error = Log::open(&file).expect_err("no log").to_string();
    assert!(error.ends_with("it may be truncated or damaged: copy or write it again"), "{error}");
}
