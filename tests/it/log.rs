//! `twinstep log` as a process.

use std::path::Path;
use std::process::{Command, Output};

use expect_test::{Expect, expect};
use twinstep_logs::{Gain, Log, Meta, Segment, TorqueSensor};
use twinstep_model::BaseMount;
use twinstep_tests::python::Programs;

/// Recording of a real Go2 with a fixed base, 16 s at 200 Hz.
const RECORDING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../data/go2_air_chirp");

fn log(arguments: &[&str]) -> Output {
    let programs = Programs::beside(env!("CARGO_BIN_EXE_faults")).unwrap();
    Command::new(programs.twinstep()).arg("log").args(arguments).output().unwrap()
}

fn stdout(arguments: &[&str]) -> String {
    let output = log(arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn convert(from: &Path, to: &Path) -> String {
    stdout(&[from.to_str().unwrap(), "--convert", to.to_str().unwrap()])
}

fn check_error(output: &Output, folder: &Path, message: &Expect) {
    assert_eq!(output.status.code(), Some(2));
    assert!(output.stdout.is_empty(), "stdout is empty after an error");
    message.assert_eq(&String::from_utf8_lossy(&output.stderr).replace(&folder.display().to_string(), "log"));
}

/// Returns a log of a robot with a floating base that tips over after 1 s.
fn tumble() -> Log {
    const ROWS: usize = 400;
    let t = |row: usize| row as f64 * 0.005;
    let column = |of: &dyn Fn(f64) -> f64| (0..ROWS).map(|row| of(t(row))).collect::<Vec<_>>();
    let swing = |seconds: f64| 0.3 * (20.0 * seconds).sin();
    let tilt = |seconds: f64| (2.0 * (seconds - 1.0)).clamp(0.0, 3.0);
    let columns = [
        ("t", column(&|seconds| seconds)),
        ("q_FL_hip", column(&swing)),
        ("dq_FL_hip", column(&|seconds| 6.0 * (20.0 * seconds).cos())),
        ("q_cmd_FL_hip", column(&|seconds| 1.2 * swing(seconds))),
        ("tau_measured_FL_hip", column(&|seconds| 18.0 * (20.0 * seconds).cos())),
        ("quat_w", column(&|seconds| (tilt(seconds) / 2.0).cos())),
        ("quat_x", column(&|seconds| (tilt(seconds) / 2.0).sin())),
        ("quat_y", vec![0.0; ROWS]),
        ("quat_z", vec![0.0; ROWS]),
        ("gyro_x", column(&|seconds| if tilt(seconds) > 0.0 { 2.0 } else { 0.0 })),
        ("pos_z", column(&|seconds| 0.3 - 0.07 * tilt(seconds))),
    ];
    let segments = vec![Segment { name: "tumble".to_owned(), base: BaseMount::Floating }];
    let meta = Meta {
        kp: Some(Gain::Uniform(30.0)),
        kd: Some(Gain::Uniform(0.75)),
        ..Meta::new(200.0, TorqueSensor::MotorCurrent, segments)
    };
    Log::new(meta, columns.map(|(name, cells)| (name.to_owned(), cells))).unwrap()
}

#[test]
fn log_of_the_real_robot_is_described() {
    let text = stdout(&[RECORDING]);
    for line in [
        "3200 rows, 16.00 s\n",
        "no gap\n",
        "  air_chirp      base fixed, 3200 rows, 16.00 s\n",
        "  payload              no    the base is fixed: record a floating base\n",
        "  coulomb_friction     weak  torque was not measured: only motion is available\n",
    ] {
        assert!(text.contains(line), "{line} is not in\n{text}");
    }
}

#[test]
fn description_of_a_tumble_has_the_fall_and_the_identifiability() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tumble.csv.gz");
    tumble().write(&path).unwrap();
    let text = stdout(&[path.to_str().unwrap()]);
    let details = text.split_once("joints  ").unwrap().1;
    expect![[r#"
                   position [rad]          speed [rad/s]        torque [N·m]     reversals   frequency
                         low    high  to limit    RMS   peak  limit    RMS   peak  limit              [Hz]
          FL_hip       -0.300   0.300     0.747    4.22   6.00   20 %  12.66  18.00   76 %      13   3.12–3.23
        falls
          tumble         at 1.53 s (row 306), tilted by 60°, base at 0.23 m
        identifiability
          command_delay        yes   FL_hip moves in both directions, recorded at 200 Hz; confounded with armature in slow motion
          encoder_offset       weak  kp is constant: repeat the motion with another kp; confounded with a constant load at a single kp
          pd_gain              weak  kd is constant: repeat the motion with another kd
          torque_saturation    yes   FL_hip reaches 76 % of its torque limit
          supply_sag           no    no battery_V was recorded
          thermal_derating     no    no temp was recorded
          torque_delay         yes   FL_hip moves in both directions, recorded at 200 Hz; differs from command_delay only if the joint is pushed
          torque_speed_limit   no    no joint exceeds 20 % of its speed limit: reach 50 % or more
          torque_dead_zone     yes   torque was measured, FL_hip moves in both directions
          drive_lag            yes   FL_hip moves in both directions, recorded at 200 Hz, motion reaches 3.2 Hz; its gain falls with frequency, that of a delay does not
          torque_sensor_delay  yes   torque was measured, FL_hip moves in both directions, recorded at 200 Hz
          torque_gain          yes   FL_hip moves in both directions; confounded with a wrong kp or mass
          torque_ripple        weak  no joint moves slowly: add motion of 0.02 to 0.3 rad/s
          backlash             weak  no joint moves slowly: add motion of 0.02 to 0.3 rad/s; visible where the load changes sign
          joint_elasticity     no    a rate of 200 Hz is too low: record at 500 Hz or more
          coulomb_friction     yes   FL_hip moves in both directions
          viscous_friction     weak  kd is constant: repeat the motion with another kd; confounded with a wrong kd at a single kd
          stribeck_friction    no    no joint moves slowly: add motion of 0.02 to 0.3 rad/s
          load_friction        yes   FL_hip moves in both directions, FL_hip reaches 76 % of its torque limit; differs from coulomb_friction only under different loads
          armature             yes   FL_hip moves in both directions, recorded at 200 Hz, motion reaches 3.2 Hz; confounded with a delay: two spectra, or the first 10 ms of a step, discriminate
          joint_spring         yes   positions span up to 0.60 rad
          payload              yes   the base is floating for 2.0 s; a load on a leg is also identifiable with a fixed base
          com_shift            yes   the base is floating for 2.0 s
          inertia              yes   the base is floating for 2.0 s, the gyro reaches 2.00 rad/s
          ground_friction      yes   the base is floating for 2.0 s; only slipping feet determine its value
          ground_stiffness     weak  no foot_force or contact was recorded
          gyro_bias            yes   the gyro reaches 2.00 rad/s
    "#]].assert_eq(details);
}

#[test]
fn description_is_one_json_object() {
    let text = stdout(&[RECORDING, "--json"]);
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(text.lines().count(), 1);
    assert_eq!((&json["rows"], &json["segments"][0]["base"]), (&3200.into(), &"fixed".into()));
    assert_eq!(json["joints"].as_array().unwrap().len(), 12);
    let identifiability = |effect: &str| {
        let conclusions = json["conclusions"].as_array().unwrap();
        conclusions.iter().find(|conclusion| conclusion["effect"] == effect).unwrap()["verdict"].clone()
    };
    assert_eq!((identifiability("coulomb_friction"), identifiability("payload")), ("weakly".into(), "cannot".into()));
}

#[test]
fn conversion_through_every_format_preserves_the_log() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let original = Log::open(RECORDING).unwrap();
    for (from, to) in
        [("start.csv", "a.parquet"), ("a.parquet", "b.csv.gz"), ("b.csv.gz", "a_folder"), ("a_folder", "c.mcap")]
    {
        if from == "start.csv" {
            original.write(path(from)).unwrap();
        }
        assert_eq!(
            convert(&path(from), &path(to)).lines().next(),
            Some(&*format!("wrote {} (3200 rows)", path(to).display()))
        );
        if to != "c.mcap" {
            assert_eq!(Log::open(path(to)).unwrap(), original);
        }
    }
    convert(&path("c.mcap"), &path("end.csv"));
    let end = Log::open(path("end.csv")).unwrap();
    assert_eq!((end.meta(), end.joints(), end.segment()), (original.meta(), original.joints(), original.segment()));
    for (name, cells) in original.channels() {
        // MCAP stores single precision.
        assert!(cells.iter().zip(end.channel(name).unwrap()).all(|(a, b)| f64::from(*a as f32) == *b), "{name}");
    }
}

#[test]
fn conversion_reports_omitted_columns() {
    let folder = tempfile::tempdir().unwrap();
    let (csv, mcap) = (folder.path().join("tumble.csv"), folder.path().join("tumble.mcap"));
    tumble().write(&csv).unwrap();
    assert!(convert(&csv, &mcap).contains("omitted, not supported by the format: pos_z\n"));
    let json = stdout(&[csv.to_str().unwrap(), "--json", "--convert", mcap.to_str().unwrap()]);
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["converted"]["left_out"][0], "pos_z");
}

#[test]
fn conversion_does_not_overwrite_its_source() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    tumble().write(path("data.csv")).unwrap();
    let convert = |from: &str, to: &str| log(&[&path(from), "--convert", &path(to)]);
    check_error(
        &convert("data.csv", "data.csv"),
        folder.path(),
        &expect![[r#"
        error: `--convert log/data.csv` would replace `log/data.csv`, which belongs to the log itself
          name another file or folder
    "#]],
    );
    // Another data file, but the same meta.json.
    check_error(
        &convert("", "data.parquet"),
        folder.path(),
        &expect![[r#"
        error: `--convert log/data.parquet` would replace `log/meta.json`, which belongs to the log itself
          name another file or folder
    "#]],
    );
    assert_eq!(Log::open(path("data.csv")).unwrap(), tumble());
}

#[test]
fn bad_input_is_named_and_stdout_is_empty() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.csv");
    std::fs::write(&path, "t,q_FL_hip_deg,q_cmd_FL_hip,kp,kd\n0,0,0,20,0.5\n").unwrap();
    let segments = vec![Segment { name: "walk".to_owned(), base: BaseMount::Floating }];
    let meta = serde_json::to_string(&Meta::new(200.0, TorqueSensor::None, segments)).unwrap();
    std::fs::write(folder.path().join("walk.json"), meta).unwrap();
    check_error(
        &log(&[path.to_str().unwrap(), "--json"]),
        folder.path(),
        &expect![[r#"
        error: `log/walk.csv`, column `q_FL_hip_deg`: the Go2 has no joint `FL_hip_deg`
          rename the column to `q_FL_hip`, in rad; column names do not contain units
    "#]],
    );
    check_error(
        &log(&["nowhere"]),
        folder.path(),
        &expect![[r#"
        error: there is no log at `nowhere`
          pass a folder with meta.json and one of data.parquet, data.csv, data.csv.gz and data.mcap, or a data file
    "#]],
    );
    check_error(
        &log(&[RECORDING, "--convert", "walk.xlsx"]),
        folder.path(),
        &expect![[r#"
        error: the format of `walk.xlsx` is unknown
          name it *.parquet, *.csv, *.csv.gz or *.mcap; docs/logs.md says how to convert *.npz and *.db3
    "#]],
    );
}

#[test]
fn motion_file_is_described_without_identifiability() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sway.csv");
    let segments = vec![Segment { name: "sway".to_owned(), base: BaseMount::Fixed }];
    let columns = [("t", vec![0.0, 0.02, 0.04]), ("q_cmd_FL_hip", vec![0.0, 0.1, 0.2])];
    let meta = Meta::new(50.0, TorqueSensor::None, segments);
    Log::new_commands(meta, columns.map(|(name, cells)| (name.to_owned(), cells))).unwrap().write(&path).unwrap();
    let text = stdout(&[path.to_str().unwrap()]);
    assert!(text.contains("nothing was measured: this is a motion file"), "{text}");
    assert!(!text.contains("identifiability"));
}
