//! Summaries of logs.

use expect_test::expect;
use twinstep_logs::{Log, Meta, SpeedSource};

use crate::{RECORDING, columns, meta};

#[test]
fn summary_of_the_real_recording() {
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
          tau_measured   torque is not compared: a model is evaluated on its motion only
          dq             velocity is computed from q: friction and damping are estimated less accurately
          dq_cmd         assumed zero: a commanded velocity is attributed to a wrong damping
          tau_ff         assumed zero: a commanded torque is attributed to an effect
          temp           a drift of friction is confounded with motor temperature
          battery_V      supply sag is confounded with weak motors
          quat           a fixed base is assumed level without `base_quat` in meta.json: a tilt is attributed to a load
        joints             position [rad]          speed [rad/s]        torque [N·m]     reversals   frequency
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
          speed is computed from position by finite differences
          torque is computed by the PD law from commands and measured positions; it was not measured
        identifiability
          command_delay        weak  motion reaches only 0.5 Hz: move at 2 Hz or more; confounded with armature in slow motion
          encoder_offset       weak  kp is constant: repeat the motion with another kp; confounded with a constant load at a single kp
          pd_gain              no    torque was not measured: only motion is available
          torque_saturation    no    no joint exceeds 13 % of its torque limit: reach 60 % or more
          supply_sag           no    no joint exceeds 13 % of its torque limit: reach 40 % or more
          thermal_derating     no    no temp was recorded
          torque_delay         weak  motion reaches only 0.5 Hz: move at 2 Hz or more; differs from command_delay only if the joint is pushed
          torque_speed_limit   no    no joint exceeds 15 % of its speed limit: reach 50 % or more
          torque_dead_zone     no    torque was not measured: only motion is available
          drive_lag            no    motion reaches only 0.5 Hz: move at 2 Hz or more
          torque_sensor_delay  no    torque was not measured: only motion is available
          torque_gain          weak  torque was not measured: only motion is available; confounded with a wrong kp or mass
          torque_ripple        weak  torque was not measured: only motion is available
          backlash             weak  torque was not measured: only motion is available; visible where the load changes sign
          joint_elasticity     no    a rate of 200 Hz is too low: record at 500 Hz or more
          coulomb_friction     weak  torque was not measured: only motion is available
          viscous_friction     weak  kd is constant: repeat the motion with another kd; confounded with a wrong kd at a single kd
          stribeck_friction    weak  torque was not measured: only motion is available
          load_friction        no    no joint exceeds 13 % of its torque limit: reach 15 % or more
          armature             no    motion reaches only 0.5 Hz: move at 1 Hz or more
          joint_spring         weak  torque was not measured: only motion is available
          payload              no    the base is fixed: record a floating base
          com_shift            no    the base is fixed: record a floating base
          inertia              no    the base is fixed: record a floating base
          ground_friction      no    the base is fixed: record a floating base
          ground_stiffness     no    the base is fixed: record a floating base
          gyro_bias            no    no gyro was recorded
    "#]]
    .assert_eq(&log.describe().to_string());
}

#[test]
fn summary_of_a_log_with_gaps_missing_channels_and_warnings() {
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
          walk           base floating, 7 rows, 0.07 s in 2 contiguous ranges
        channels
          q_cmd          1 column [rad]
          q              1 column [rad]
          battery_V      1 column [V], 2 cells empty
        absent
          tau_measured   torque is not compared: a model is evaluated on its motion only
          dq             velocity is computed from q: friction and damping are estimated less accurately
          dq_cmd         assumed zero: a commanded velocity is attributed to a wrong damping
          tau_ff         assumed zero: a commanded torque is attributed to an effect
          temp           a drift of friction is confounded with motor temperature
          quat           a fixed base is assumed level without `base_quat` in meta.json: a tilt is attributed to a load
          gyro           base rotation is not compared, and a gyro bias is not identifiable
          acc            base acceleration is not compared
          pos            base height is estimated from the feet, and not compared
          vel            base velocity is estimated from the legs, and not compared
          contact        contact times are inferred from a model
          foot_force     contact forces are inferred from a model
        joints             position [rad]          speed [rad/s]        torque [N·m]     reversals   frequency
                         low    high  to limit    RMS   peak  limit    RMS   peak  limit              [Hz]
          a             0.000   9.000         –    8.94  10.00     –   96.35 180.00     –        1           –
          speed is computed from position by finite differences
          torque is computed by the PD law from commands and measured positions; it was not measured
        identifiability
          command_delay        no    no joint reverses four times: move one back and forth
          encoder_offset       no    no joint reverses four times: move one back and forth
          pd_gain              no    torque was not measured: only motion is available
          torque_saturation    no    the torque limits of the joints are unknown
          supply_sag           no    the torque limits of the joints are unknown
          thermal_derating     no    the torque limits of the joints are unknown
          torque_delay         no    no joint reverses four times: move one back and forth
          torque_speed_limit   no    the speed limits of the joints are unknown
          torque_dead_zone     no    torque was not measured: only motion is available
          drive_lag            no    no joint reverses four times: move one back and forth
          torque_sensor_delay  no    torque was not measured: only motion is available
          torque_gain          no    no joint reverses four times: move one back and forth
          torque_ripple        weak  no joint moves slowly: add motion of 0.02 to 0.3 rad/s
          backlash             no    no joint reverses four times: move one back and forth
          joint_elasticity     no    a rate of 100 Hz is too low: record at 500 Hz or more
          coulomb_friction     no    no joint reverses four times: move one back and forth
          viscous_friction     no    no joint reverses four times: move one back and forth
          stribeck_friction    no    no joint reverses four times: move one back and forth
          load_friction        no    no joint reverses four times: move one back and forth
          armature             no    no joint reverses four times: move one back and forth
          joint_spring         weak  torque was not measured: only motion is available
          payload              weak  torque was not measured: only motion is available; a load on a leg is also identifiable with a fixed base
          com_shift            weak  no orientation (quat) was recorded
          inertia              no    no gyro was recorded
          ground_friction      weak  no base position or velocity (pos, vel) was recorded; only slipping feet determine its value
          ground_stiffness     no    a rate of 100 Hz is too low: record at 200 Hz or more
          gyro_bias            no    no gyro was recorded
        problems
          the commands never change although the joints move: were they recorded?
        ignored columns
          note
        warnings
          the measured rate is 100.0 Hz, but `rate_hz` of the meta file is 200 Hz
          the meta file has a `tau_sensor`, but the log has no tau_measured
    "#]]
    .assert_eq(&log.describe().to_string());
}

#[test]
fn finite_differences_do_not_cross_from_one_range_to_the_next() {
    let rows = columns([
        ("t", vec![0.0, 0.1, 0.2, 0.3]),
        ("episode", vec![0.0, 0.0, 1.0, 1.0]),
        ("q_a", vec![0.0, 0.1, 5.0, 5.0]),
        ("q_cmd_a", vec![0.0; 4]),
    ]);
    let joint = Log::new(meta(), rows).expect("a log").describe().joints.remove(0);
    assert_eq!(joint.speed_from, SpeedSource::Derived);
    // 0.1 rad in 0.1 s; the tolerance is for three rounding errors.
    assert!(joint.speed_max.is_some_and(|speed| (speed - 1.0).abs() < 1e-12));
}

#[test]
fn measured_speed_is_preferred_to_finite_differences() {
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
fn summary_of_one_row_has_no_rate() {
    let rows = columns([("t", vec![0.0]), ("q_a", vec![0.0]), ("q_cmd_a", vec![0.0])]);
    let description = Log::new(Meta { policy_hz: Some(50.0), ..meta() }, rows).expect("a log").describe();
    assert_eq!((description.timing.rate_hz, description.joints[0].speed_max), (None, None));
    assert!(description.to_string().contains("no two rows are consecutive"), "{description}");
}

#[test]
fn summary_is_serialised_as_json() {
    let rows = columns([("t", vec![0.0, 0.5]), ("q_a", vec![0.0, 1.0]), ("q_cmd_a", vec![0.0, 0.0])]);
    let json = serde_json::to_value(Log::new(meta(), rows).expect("a log").describe()).expect("JSON");
    assert_eq!(json["timing"]["rate_hz"], 2.0);
    assert_eq!(json["segments"][0]["base"], "fixed");
    assert_eq!(json["joints"][0]["speed_from"], "derived");
    assert_eq!(json["absent"][0]["quantity"], "tau_measured");
}
