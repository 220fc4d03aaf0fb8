//! The words of every error: what, where, and how to mend it.

use std::fs;
use std::path::Path;

use expect_test::{Expect, expect};
use twinstep_logs::{Log, LogError};

use crate::{CSV, META, columns, folder, meta, write};

/// The error of opening this log, with its folder called `log`.
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
fn missing_files_are_named_with_what_to_give() {
    let empty = tempfile::tempdir().expect("a folder");
    expect![[r#"
        no log is at `log`
          give a folder with meta.json and one of data.parquet, data.csv, data.csv.gz and data.mcap, or the data file itself"#]]
    .assert_eq(&error(empty.path()));
    write(empty.path(), "data.csv", CSV);
    expect![[r#"
        `log/meta.json` is missing beside `log/data.csv`
          the least it says is {"rate_hz": 200, "tau_sensor": "none", "segments": [{"name": "walk", "base": "floating"}]}"#]].assert_eq(&error(empty.path()));
    write(empty.path(), "meta.json", META);
    write(empty.path(), "data.parquet", "");
    expect![[r#"
        `log` would be ambiguous: it holds data.parquet and data.csv
          keep one of them, or name the data file itself"#]]
    .assert_eq(&error(empty.path()));
}

#[test]
fn an_unknown_format_is_answered_with_the_known_ones() {
    let folder = folder(CSV, META);
    let file = write(folder.path(), "walk.xlsx", "");
    let error = Log::open(file).expect_err("no log").to_string();
    expect![[r#"
        the format of `log/walk.xlsx` is unknown
          name it *.parquet, *.csv, *.csv.gz or *.mcap"#]]
    .assert_eq(&error.replace(&folder.path().display().to_string(), "log"));
}

#[test]
fn missing_columns_are_named() {
    check_csv(
        "time,q_a,q_cmd_a\n0,0,0\n",
        &expect![[r#"
            `log/data.csv` has no column `t` (the time of each row [s]); its columns are `q_a`, `q_cmd_a`, `time`
              is it `time`? call it `t`"#]],
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
          add it, or let `joints` of the meta file list the joints without `a`"#]],
    );
    check_csv(
        "t,q_a,q_cmd_a,kp\n0,0,0,1\n",
        &expect![[r#"
        `log/data.csv` has no `kd` for the joint `a`
          add a column `kd` or `kd_a`, or `"kd"` to the meta file"#]],
    );
}

#[test]
fn a_joint_of_the_description_needs_columns() {
    check_meta(
        &META.replacen('{', r#"{"joints": ["FL_hip", "FR_hip"], "#, 1),
        &expect![[r#"
        `log/data.csv` has no column `q_FR_hip`, which the joint `FR_hip` needs
          add it, or let `joints` of the meta file list the joints without `FR_hip`"#]],
    );
}

#[test]
fn an_empty_log_is_named() {
    check_csv(
        "t,kp,kd,q_a,q_cmd_a\n",
        &expect!["`log/data.csv` has no rows; a log needs at least one under its header"],
    );
}

#[test]
fn a_column_that_comes_twice_is_named() {
    check_csv(
        "t,kp,kd,q_a,q_cmd_a,q_a\n0,1,1,0,0,0\n",
        &expect!["`log/data.csv` has the column `q_a` twice; rename or remove one"],
    );
}

#[test]
fn a_cell_with_text_is_named_with_its_line() {
    check_csv(
        &CSV.replace("0.3,", "O.3,"),
        &expect![[r#"
        `log/data.csv`, column `q_FL_hip`, row 3 (line 4): `O.3` is not a number
          leave a cell of an optional column empty where nothing is known"#]],
    );
}

#[test]
fn a_ragged_row_is_named_with_its_line() {
    check_csv(
        &CSV.replace(",28\n", "\n"),
        &expect![[r#"
            `log/data.csv`, row 3 (line 4) has 5 cells, but the header has 6
              write an empty cell where nothing is known, and one comma fewer than columns"#]],
    );
}

#[test]
fn an_empty_cell_of_a_needed_column_is_named() {
    check_csv(
        &CSV.replace("0.2,", ","),
        &expect![[r#"
            `log/data.csv`, column `q_FL_hip`, row 2 (line 3) is empty or NaN, but it must be a finite number
              leave the row out, or fill the cell with what was in force"#]],
    );
}

#[test]
fn time_that_stands_still_is_named() {
    check_csv(
        &CSV.replace("0.01,", "0.005,"),
        &expect![[r#"
        `log/data.csv`, column `t`, row 3 (line 4): 0.005 s follows 0.005 s, but time must increase within a segment of an episode
          count `episode` up where the robot was re-placed"#]],
    );
}

#[test]
fn a_negative_gain_is_named() {
    check_csv(
        &CSV.replace("0.01,20", "0.01,-20"),
        &expect![[r#"
            `log/data.csv`, column `kp`, row 3 (line 4): a gain of -20 is negative
              kp [N·m/rad] and kd [N·m·s/rad] act as kp·(q_cmd − q) + kd·(dq_cmd − dq): change its sign"#]],
    );
}

#[test]
fn cells_out_of_range_are_named() {
    check_columns(
        [("segment", vec![0.0, 2.0])],
        &expect![[r#"
        `columns in memory`, column `segment`, row 2: segment 2 is not in `segments` of the meta file, which has 2, counted from 0
          add {"name": …, "base": "fixed" or "floating"} to `segments`, or correct the column"#]],
    );
    check_columns(
        [("episode", vec![0.0, 0.5])],
        &expect![[r#"
        `columns in memory`, column `episode`, row 2 is 0.5, but it must be a whole number from 0
          leave the column out where it never changes"#]],
    );
    check_columns(
        [("episode", vec![0.0, -1.0])],
        &expect![[r#"
        `columns in memory`, column `episode`, row 2 is -1, but it must be a whole number from 0
          leave the column out where it never changes"#]],
    );
    check_columns(
        [("gyro_x", vec![0.0, f64::INFINITY])],
        &expect![[r#"
        `columns in memory`, column `gyro_x`, row 2 is inf, but it must be finite
          leave a cell of an optional column empty where nothing is known"#]],
    );
    check_columns(
        [("t", vec![f64::NAN, 0.0])],
        &expect![[r#"
        `columns in memory`, column `t`, row 1 is empty or NaN, but it must be a finite number
          leave the row out, or fill the cell with what was in force"#]],
    );
}

#[test]
fn a_quaternion_is_a_unit_one() {
    let part = |second: f64| vec![0.5, second];
    let quaternion = |w| [("quat_w", part(w)), ("quat_x", part(0.5)), ("quat_y", part(0.5)), ("quat_z", part(0.5))];
    check_columns(
        quaternion(0.6),
        &expect![[r#"
        `columns in memory`, column `quat_w`, row 2: the quaternion's norm is 1.0536, but it must be within 0.01 of 1
          quat_w, quat_x, quat_y, quat_z turn the trunk's frame into the world's; leave the cells empty where it is unknown"#]],
    );
    let mut all = columns([("t", vec![0.0, 0.1]), ("q_a", vec![0.0; 2]), ("q_cmd_a", vec![0.0; 2])]);
    all.extend(columns(quaternion(f64::NAN)));
    assert!(Log::new(meta(), all).is_ok(), "a missing cell is no wrong orientation");
}

#[test]
fn columns_of_unequal_length_are_named() {
    check_columns(
        [("dq_a", vec![0.0])],
        &expect!["`columns in memory`, column `dq_a` has the length 1, but `t` has 2"],
    );
}

#[test]
fn a_misspelt_key_is_answered_with_the_keys() {
    check_meta(
        &META.replace("rate_hz", "rate"),
        &expect![
            "`log/meta.json`: unknown field `rate`, expected one of `rate_hz`, `policy_hz`, `joints`, `tau_sensor`, `segments`, `pd`, `kp`, `kd`, `noise`, `source`, `licence` at line 1 column 7"
        ],
    );
}

#[test]
fn values_of_the_description_are_in_range() {
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
fn a_joint_s_name_with_something_behind_it_is_answered_with_the_column_that_is_meant() {
    for name in ["q_FL_hip_deg", "q_FL_hip [rad]", "q_FL_hip_joint", "q_fl_hip"] {
        let error = error(folder(&CSV.replace(",q_FL_hip", &format!(",{name}")), META).path());
        assert!(
            error.contains(&format!("column `{name}`")) && error.contains("call the column `q_FL_hip`, in rad"),
            "{error}"
        );
    }
}

#[test]
fn positions_in_degrees_are_noted() {
    let log = Log::open(folder(&CSV.replace("0.3,", "85,"), META).path()).expect("a log");
    expect!["q_FL_hip goes beyond 7 rad: is it in degrees? Positions are in radians"]
        .assert_eq(&log.describe().warnings.join("; "));
}

#[test]
fn a_place_is_data_for_programs() {
    let folder = folder(&CSV.replace("0.3,", "?,"), META);
    let Err(LogError::NotANumber { place, text }) = Log::open(folder.path()) else { panic!("another error") };
    assert_eq!((place.column.as_str(), place.row, place.line, text.as_str()), ("q_FL_hip", 3, Some(4), "?"));
}

#[test]
fn a_truncated_archive_is_an_error() {
    let folder = folder(CSV, META);
    let file = folder.path().join("cut.csv.gz");
    Log::open(folder.path()).expect("a log").write(&file).expect("written");
    let whole = fs::read(&file).expect("a file");
    fs::write(&file, &whole[..whole.len() / 2]).expect("a file");
    let error = Log::open(&file).expect_err("no log").to_string();
    assert!(error.ends_with("it may have been cut off or damaged: copy or write it anew"), "{error}");
}
