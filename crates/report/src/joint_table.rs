//! Text table of the position error of each joint.

use std::fmt::Write as _;

use twinstep_identify::replay::Replay;

/// Width of the longest bar [columns].
const BAR_WIDTH: f64 = 24.0;
/// Minimum RMSE of the longest bar [rad], so that rounding errors draw no bars.
const MIN_BAR_SCALE: f64 = 1e-3;

/// Returns one line per joint, with a bar in proportion to the RMSE, and a last line over all joints.
pub fn joint_table(replay: &Replay) -> String {
    let worst = replay.joints.iter().map(|joint| joint.rmse_rad).fold(MIN_BAR_SCALE, f64::max);
    let largest = replay.joints.iter().map(|joint| joint.max_rad).fold(0.0, f64::max);
    let mut table = "joint       RMSE [rad]  largest error [rad]\n".to_owned();
    let mut line = |name: &str, rmse_rad: f64, max_rad: f64, bar: &str| {
        let line = format!("{name:<10}  {rmse_rad:>10.4}  {max_rad:>19.4}  {bar}");
        writeln!(table, "{}", line.trim_end()).expect("writing to a String cannot fail");
    };
    for joint in &replay.joints {
        line(&joint.name, joint.rmse_rad, joint.max_rad, &bar(joint.rmse_rad / worst));
    }
    line("all joints", replay.rmse_rad, largest, "");
    table
}

/// Returns a bar of `share` times the full width, in eighths of a column.
fn bar(share: f64) -> String {
    const EIGHTHS: [&str; 8] = ["", "▏", "▎", "▍", "▌", "▋", "▊", "▉"];
    let eighths = (share * BAR_WIDTH * 8.0).round() as usize;
    "█".repeat(eighths / 8) + EIGHTHS[eighths % 8]
}

#[cfg(test)]
mod tests {
    use expect_test::expect;
    use twinstep_identify::replay::JointError;

    use super::*;

    #[test]
    fn table_shows_each_joint_with_a_bar_and_all_joints_last() {
        let joint = |name: &str, rmse_rad: f64, max_rad: f64| JointError {
            name: name.to_owned(),
            rmse_rad,
            max_rad,
            measured: Vec::new(),
            simulated: Vec::new(),
            command: Vec::new(),
        };
        let joints =
            vec![joint("FL_hip", 0.0123, 0.05), joint("FL_thigh", 0.04, 0.123_45), joint("FL_calf", 0.000_02, 0.0001)];
        let replay = Replay { joints, t: Vec::new(), ranges: Vec::new(), rmse_rad: 0.0242 };
        expect![[r"
            joint       RMSE [rad]  largest error [rad]
            FL_hip          0.0123               0.0500  ███████▍
            FL_thigh        0.0400               0.1235  ████████████████████████
            FL_calf         0.0000               0.0001
            all joints      0.0242               0.1235
        "]]
        .assert_eq(&joint_table(&replay));
    }
}
