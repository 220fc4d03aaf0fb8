//! What a description tells.

use expect_test::expect;
use twinstep_logs::{Log, Meta, SpeedSource};

use crate::{RECORDING, columns, meta};

#[test]
fn the_real_recording_is_described() {
    let log = Log::open(RECORDING).expect("the recording");
    expect![[r#"
        3200 rows, 16.00 s
        200.0 Hz (stated 200), steps: σ 0.007 ms; 50 % within 0.000 ms of the median, 99 % within 0.010 ms, all within 0.100 ms; no gap
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
        joints             position [rad]          speed [rad/s]        torque [N·m]         turns    moves at
                         low    high  to limit    RMS   peak  limit    RMS   peak  limit              [Hz]
          FL_hip       -0.047   0.485     0.562    0.45   1.07    4 %   1.79   3.12   13 %      12   0.34–0.48
          FL_thigh      0.518   1.167     2.089    0.55   1.22    4 %   1.21   2.18    9 %      12   0.36–0.49
          FL_calf      -2.404  -1.259     0.318    1.00   2.39   15 %   2.56   3.92    9 %      12   0.34–0.48
          FR_hip       -0.499   0.044     0.548    0.46   1.22    4 %   1.66   2.89   12 %      12   0.35–0.50
          FR_thigh      0.521   1.171     2.091    0.55   1.29    4 %   1.16   2.12    9 %      12   0.36–0.49
          FR_calf      -2.443  -1.269     0.280    1.02   2.37   15 %   2.24   3.28    7 %      12   0.36–0.49
          RL_hip       -0.044   0.498     0.549    0.46   1.02    3 %   1.66   2.89   12 %      12   0.36–0.49
          RL_thigh      0.517   1.173     1.040    0.55   1.25    4 %   1.17   2.12    9 %      12   0.35–0.49
          RL_calf      -2.369  -1.275     0.353    0.98   2.28   15 %   2.82   4.51   10 %      12   0.34–0.47
          RR_hip       -0.493   0.044     0.554    0.46   1.08    4 %   1.74   3.04   13 %      12   0.35–0.50
          RR_thigh      0.529   1.162     1.052    0.55   1.25    4 %   1.21   2.16    9 %      12   0.36–0.49
          RR_calf      -2.412  -1.272     0.311    1.01   2.22   14 %   2.37   3.65    8 %      12   0.35–0.49
          speed is derived from position by differences
          torque is what the PD law asks for, by the measured position; none was measured
        what this log can tell
          command_delay        weakly  motion reaches 0.5 Hz only: move at 2 Hz or more; armature looks alike in slow motion
          encoder_offset       weakly  kp never changes: repeat the motion at another kp; a constant load looks alike at one kp
          torque_saturation    cannot  no joint passes 13 % of its highest torque: reach 60 % or more
          supply_sag           cannot  no joint passes 13 % of its highest torque: reach 40 % or more
          thermal_derating     cannot  no temp was recorded
          torque_delay         weakly  motion reaches 0.5 Hz only: move at 2 Hz or more; command_delay differs only where the joint is pushed
          torque_speed_limit   cannot  no joint passes 15 % of its highest speed: reach 50 % or more
          drive_lag            cannot  motion reaches 0.5 Hz only: move at 2 Hz or more
          torque_sensor_delay  cannot  no torque was measured: motion alone must show it
          torque_gain          weakly  no torque was measured: motion alone must show it; a wrong kp or mass looks alike
          torque_ripple        weakly  no torque was measured: motion alone must show it
          backlash             weakly  no torque was measured: motion alone must show it; it shows where the load changes its sign
          joint_elasticity     cannot  200 Hz is too slow: record at 500 Hz or more
          coulomb_friction     weakly  no torque was measured: motion alone must show it
          viscous_friction     weakly  kd never changes: repeat the motion at another kd; at one kd it is the same as a wrong kd
          stribeck_friction    weakly  no torque was measured: motion alone must show it
          load_friction        cannot  no joint passes 13 % of its highest torque: reach 15 % or more
          armature             cannot  motion reaches 0.5 Hz only: move at 1 Hz or more
          joint_spring         weakly  no torque was measured: motion alone must show it
          payload              cannot  the base is fixed: record a floating base
          com_shift            cannot  the base is fixed: record a floating base
          inertia              cannot  the base is fixed: record a floating base
          ground_friction      cannot  the base is fixed: record a floating base
          ground_stiffness     cannot  the base is fixed: record a floating base
          gyro_bias            cannot  no gyro was recorded
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
        100.0 Hz (stated 200), steps: σ 8.000 ms; 50 % within 0.000 ms of the median, 99 % within 20.000 ms, all within 20.000 ms; one gap of 30.0 ms
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
        joints             position [rad]          speed [rad/s]        torque [N·m]         turns    moves at
                         low    high  to limit    RMS   peak  limit    RMS   peak  limit              [Hz]
          a             0.000   9.000         –    8.94  10.00     –   96.35 180.00     –        1           –
          speed is derived from position by differences
          torque is what the PD law asks for, by the measured position; none was measured
        what this log can tell
          command_delay        cannot  no joint turns four times: move it back and forth
          encoder_offset       cannot  no joint turns four times: move it back and forth
          torque_saturation    cannot  the joints' highest torque is not known
          supply_sag           cannot  the joints' highest torque is not known
          thermal_derating     cannot  the joints' highest torque is not known
          torque_delay         cannot  no joint turns four times: move it back and forth
          torque_speed_limit   cannot  the joints' highest speed is not known
          drive_lag            cannot  no joint turns four times: move it back and forth
          torque_sensor_delay  cannot  no torque was measured: motion alone must show it
          torque_gain          cannot  no joint turns four times: move it back and forth
          torque_ripple        weakly  no joint moves slowly: add motion of 0.02 to 0.3 rad/s
          backlash             cannot  no joint turns four times: move it back and forth
          joint_elasticity     cannot  100 Hz is too slow: record at 500 Hz or more
          coulomb_friction     cannot  no joint turns four times: move it back and forth
          viscous_friction     cannot  no joint turns four times: move it back and forth
          stribeck_friction    cannot  no joint turns four times: move it back and forth
          load_friction        cannot  no joint turns four times: move it back and forth
          armature             cannot  no joint turns four times: move it back and forth
          joint_spring         weakly  no torque was measured: motion alone must show it
          payload              weakly  no torque was measured: motion alone must show it; a load on a leg shows with the trunk held too
          com_shift            weakly  no orientation (quat) was recorded
          inertia              cannot  no gyro was recorded
          ground_friction      weakly  no path (pos, vel) was recorded; only feet that slip tell its size
          ground_stiffness     cannot  100 Hz is too slow: record at 200 Hz or more
          gyro_bias            cannot  no gyro was recorded
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
