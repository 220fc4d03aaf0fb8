//! What a sample of a log has: the feet that stand, means of laws, and a gyroscope with less noise.

use super::measurements::Regime;
use super::tests::{ROWS, columns, log_of, system, system_of};

/// The forces on its other parts are not known.
#[test]
fn a_robot_that_has_fallen_has_no_equations_on_the_ground() {
    let on_ground = |[w, x]: [f64; 2]| {
        let mut columns = columns();
        for (name, part) in [("quat_w", w), ("quat_x", x)] {
            columns.insert(name.to_owned(), vec![part; ROWS]);
        }
        let (system, _) = system_of(&log_of(columns));
        system.balance.samples.iter().filter(|sample| sample.regime != Regime::Hang).count()
    };
    assert!(on_ground([1.0, 0.0]) > 20);
    assert_eq!(on_ground([0.0, 1.0]), 0);
}

/// A ripple has several periods while a joint turns through a sample.
#[test]
fn law_of_a_joint_is_averaged_over_the_rows_of_a_sample() {
    let (system, mut robot) = system();
    let joint = 4;
    let ripple = &mut robot.joints[joint].actuator.ripple;
    (ripple.amplitude, ripple.cycles) = (1.0, 126.0);
    robot.joints[joint].armature = 0.0;
    let q = &system.measured.joints[joint].smooth[0];
    let mut largest: f64 = 0.0;
    for sample in &system.balance.samples {
        let ripple = |q: f64| (126.0 * q).sin();
        let rows = sample.rows.clone().zip(sample.weights.iter());
        let mean: f64 = rows.map(|(row, weight)| weight * ripple(0.5 * (q[row] + q[row + 1]))).sum();
        assert!((sample.link_torque(&robot, joint, 0.0) - mean).abs() < 0.05, "at {} s", sample.t);
        largest = largest.max((ripple(sample.response.q[joint]) - mean).abs());
    }
    assert!(largest > 0.5, "the law of the mean is another one: {largest}");
}

#[test]
fn smooth_gyroscope_is_closer_to_the_motion_than_its_readings() {
    let mut columns = columns();
    let truth: Vec<f64> = columns["t"].iter().map(|t| 0.5 * (9.0 * t).sin()).collect();
    // Far above any motion, and without a period in the log.
    let noise = |row: usize| 0.02 * std::f64::consts::SQRT_2 * (2.4 * row as f64 + 0.01 * (row * row) as f64).sin();
    columns.insert("gyro_y".to_owned(), truth.iter().enumerate().map(|(row, rate)| rate + noise(row)).collect());
    let (system, _) = system_of(&log_of(columns));
    let base = system.measured.base.as_ref().expect("a gyroscope");
    let error = |rates: &[[f64; 3]]| {
        let squares = rates.iter().zip(&truth).map(|(rate, truth)| (rate[1] - truth).powi(2));
        (squares.sum::<f64>() / ROWS as f64).sqrt()
    };
    let [smooth, raw] = [&base.smooth_gyro, &base.gyro].map(|rates| error(rates));
    assert!(smooth < 0.7 * raw, "{smooth} of {raw}");
}
