//! What a description tells.

use expect_test::expect;
use twinstep_logs::{Log, Meta, SpeedSource};

use crate::{RECORDING, columns, meta};

#[test]
fn the_real_recording_is_described() {
    let log = Log::open(RECORDING).expect("the recording");
    expect![[r#"
        3200 rows, 16.00 s
        200.0 Hz (stated 200), steps: σ 0.007 ms, 99 % within 0.010 ms of the median, no gap
        segments
          air_chirp      base fixed, 3200 rows, 16.00 s
        channels
          kp             1 column [N·m/rad]
          kd             1 column [N·m·s/rad]
          q_cmd          12 columns [rad]
          q              12 columns [rad]
        absent
          tau_measured   no comparison of torques: a model is judged by its motion alone
          dq             velocity is derived from q: friction and damping are seen less sharply
          dq_cmd         taken as zero: a velocity that was commanded looks like a wrong damping
          tau_ff         taken as zero: a torque that was commanded looks like an effect
          temp           a drift of friction cannot be told from warming
          battery_V      a sagging supply cannot be told from weak motors
          quat           the trunk is taken as level: a tilt looks like a load
        joints
          FL_hip         -0.047 to  0.485 rad, up to 1.07 rad/s, derived
          FL_thigh        0.518 to  1.167 rad, up to 1.22 rad/s, derived
          FL_calf        -2.404 to -1.259 rad, up to 2.39 rad/s, derived
          FR_hip         -0.499 to  0.044 rad, up to 1.22 rad/s, derived
          FR_thigh        0.521 to  1.171 rad, up to 1.29 rad/s, derived
          FR_calf        -2.443 to -1.269 rad, up to 2.37 rad/s, derived
          RL_hip         -0.044 to  0.498 rad, up to 1.02 rad/s, derived
          RL_thigh        0.517 to  1.173 rad, up to 1.25 rad/s, derived
          RL_calf        -2.369 to -1.275 rad, up to 2.28 rad/s, derived
          RR_hip         -0.493 to  0.044 rad, up to 1.08 rad/s, derived
          RR_thigh        0.529 to  1.162 rad, up to 1.25 rad/s, derived
          RR_calf        -2.412 to -1.272 rad, up to 2.22 rad/s, derived
    "#]]
    .assert_eq(&log.describe().to_string());
}

#[test]
fn a_walk_is_described_with_its_gaps_and_oddities() {
    let rows = columns([
        ("t", vec![0.0, 0.01, 0.02, 0.05, 0.06, 0.0, 0.01]),
        ("segment", vec![1.0; 7]),
        ("episode", vec![0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]),
        ("q_a", vec![0.0, 0.1, 0.2, 0.5, 0.4, 9.0, 9.0]),
        ("q_cmd_a", vec![0.0; 7]),
        ("battery_V", vec![28.0, f64::NAN, f64::NAN, 28.0, 28.0, 28.0, 28.0]),
        ("note", vec![0.0; 7]),
    ]);
    let log = Log::new(meta(), rows).expect("a log");
    expect![[r#"
        7 rows, 0.07 s
        100.0 Hz (stated 200), steps: σ 8.000 ms, 99 % within 20.000 ms of the median, one gap of 30.0 ms
        segments
          walk           base floating, 7 rows, 0.07 s in 2 parts
        channels
          q_cmd          1 column [rad]
          q              1 column [rad]
          battery_V      1 column [V], 2 cells empty
        absent
          tau_measured   no comparison of torques: a model is judged by its motion alone
          dq             velocity is derived from q: friction and damping are seen less sharply
          dq_cmd         taken as zero: a velocity that was commanded looks like a wrong damping
          tau_ff         taken as zero: a torque that was commanded looks like an effect
          temp           a drift of friction cannot be told from warming
          quat           the trunk is taken as level: a tilt looks like a load
          gyro           the trunk's rotation is not compared, and no gyro bias is found
          acc            the trunk's acceleration is not compared
          pos            the trunk's path is not compared
          vel            the trunk's velocity is not compared, and starting states lack it
          contact        the times of contact are inferred from a model
          foot_force     the ground's forces are inferred from a model
        joints
          a               0.000 to  9.000 rad, up to 10.00 rad/s, derived
        ignored columns
          note
        notes
          rows come at 100.0 Hz, but the meta file says 200 Hz
          the meta file names a `tau_sensor`, but there is no tau_measured
    "#]]
    .assert_eq(&log.describe().to_string());
}

#[test]
fn derived_speed_does_not_cross_from_one_part_to_the_next() {
    let rows = columns([
        ("t", vec![0.0, 0.1, 0.2, 0.3]),
        ("episode", vec![0.0, 0.0, 1.0, 1.0]),
        ("q_a", vec![0.0, 0.1, 5.0, 5.0]),
        ("q_cmd_a", vec![0.0; 4]),
    ]);
    let joint = Log::new(meta(), rows).expect("a log").describe().joints.remove(0);
    assert_eq!(joint.speed_from, SpeedSource::Derived);
    // 0.1 rad in 0.1 s; the tolerance is that of three roundings.
    assert!(joint.speed_max.is_some_and(|speed| (speed - 1.0).abs() < 1e-12));
}

#[test]
fn measured_speed_wins_over_differences() {
    let rows = columns([
        ("t", vec![0.0, 0.1]),
        ("q_a", vec![0.0, 0.1]),
        ("q_cmd_a", vec![0.0; 2]),
        ("dq_a", vec![-3.0, f64::NAN]),
    ]);
    let joint = Log::new(meta(), rows).expect("a log").describe().joints.remove(0);
    assert_eq!((joint.speed_from, joint.speed_max), (SpeedSource::Measured, Some(3.0)));
}

#[test]
fn one_row_is_described_without_a_rate() {
    let rows = columns([("t", vec![0.0]), ("q_a", vec![0.0]), ("q_cmd_a", vec![0.0])]);
    let description = Log::new(Meta { policy_hz: Some(50.0), ..meta() }, rows).expect("a log").describe();
    assert_eq!((description.timing.rate_hz, description.joints[0].speed_max), (None, None));
    assert!(description.to_string().contains("no two rows"), "{description}");
}

#[test]
fn a_description_is_data_for_programs() {
    let rows = columns([("t", vec![0.0, 0.5]), ("q_a", vec![0.0, 1.0]), ("q_cmd_a", vec![0.0, 0.0])]);
    let json = serde_json::to_value(Log::new(meta(), rows).expect("a log").describe()).expect("JSON");
    assert_eq!(json["timing"]["rate_hz"], 2.0);
    assert_eq!(json["segments"][0]["base"], "fixed");
    assert_eq!(json["joints"][0]["speed_from"], "derived");
    assert_eq!(json["absent"][0]["quantity"], "tau_measured");
}
