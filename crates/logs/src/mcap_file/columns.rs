//! Columns of a log from the rows of an MCAP file.

use twinstep_model::{Joint, Leg};
use twinstep_unitree::{foot_index, motor_index};

use super::rows::StateWithCommand;
use super::{NANOSECONDS, NO_FORCE, NO_TEMPERATURE, SegmentStart};
use crate::go2_message::{MotorCmd, MotorState};

/// Function that returns a value of a motor.
type OfMotor = fn(&MotorState, &MotorCmd) -> f32;

/// Returns all columns: those in `written`, or else those that are not zero throughout.
pub(crate) fn columns(
    rows: &[StateWithCommand<'_>],
    parts: &[(u64, SegmentStart)],
    written: Option<&[String]>,
) -> Vec<(String, Vec<f64>)> {
    let had = |name: &str| written.is_none_or(|written| written.iter().any(|column| column == name));
    let column =
        |of: &dyn Fn(&StateWithCommand<'_>) -> f32| rows.iter().map(|row| f64::from(of(row))).collect::<Vec<_>>();
    let joints: Vec<Joint> = Joint::ALL.into_iter().filter(|joint| had(&format!("q_cmd_{joint}"))).collect();
    let mut columns = time_columns(rows, parts);

    let of_motors = |of: OfMotor| {
        let of_joint = |joint: &Joint| {
            column(&|row| of(&row.state.motors[motor_index(*joint)], &row.command.motors[motor_index(*joint)]))
        };
        joints.iter().map(of_joint).collect::<Vec<_>>()
    };
    let gains: [(&str, OfMotor); 2] = [("kp", |_, command| command.kp), ("kd", |_, command| command.kd)];
    for (name, of) in gains {
        let cells = of_motors(of);
        if written.map_or_else(|| cells.windows(2).all(|pair| pair[0] == pair[1]), |_| had(name)) {
            columns.extend(cells.into_iter().next().map(|cells| (name.to_owned(), cells)));
        } else {
            columns.extend(joints.iter().map(|joint| format!("{name}_{joint}")).zip(cells));
        }
    }
    let commands: [(&str, OfMotor); 3] =
        [("q_cmd", |_, command| command.q), ("dq_cmd", |_, command| command.dq), ("tau_ff", |_, command| command.tau)];
    let sensors: [(&str, OfMotor); 4] = [
        ("q", |state, _| state.q),
        ("dq", |state, _| state.dq),
        ("tau_measured", |state, _| state.tau_est),
        ("temp", |state, _| if state.temperature == NO_TEMPERATURE { f32::NAN } else { f32::from(state.temperature) }),
    ];
    let zero = |cells: &[Vec<f64>]| cells.iter().flatten().all(|cell| *cell == 0.0);
    for (name, of) in commands {
        columns.extend(joints.iter().map(|joint| format!("{name}_{joint}")).zip(of_motors(of)));
    }
    for (name, of) in sensors {
        let cells = of_motors(of);
        if written.is_some() || name == "q" || !zero(&cells) {
            columns.extend(joints.iter().map(|joint| format!("{name}_{joint}")).zip(cells));
        }
    }
    let mut of_robot = |quantity: &str, names: &[&str], cells: Vec<Vec<f64>>| {
        if written.is_some() || !zero(&cells) {
            columns.extend(names.iter().map(|name| format!("{quantity}{name}")).zip(cells));
        }
    };
    of_robot("gyro", &["_x", "_y", "_z"], (0..3).map(|axis| column(&|row| row.state.gyroscope[axis])).collect());
    of_robot("acc", &["_x", "_y", "_z"], (0..3).map(|axis| column(&|row| row.state.accelerometer[axis])).collect());
    of_robot("quat", &["_w", "_x", "_y", "_z"], (0..4).map(|part| column(&|row| row.state.quaternion[part])).collect());
    let force = |leg: Leg| {
        column(&|row| match row.state.foot_force[foot_index(leg)] {
            NO_FORCE => f32::NAN,
            force => f32::from(force),
        })
    };
    of_robot(
        "foot_force",
        &Leg::ALL.map(|leg| ["_FL", "_FR", "_RL", "_RR"][leg as usize]),
        Leg::ALL.map(force).to_vec(),
    );
    of_robot("battery_V", &[""], vec![column(&|row| row.state.power_v)]);
    columns.retain(|(name, _)| matches!(name.as_str(), "t" | "segment" | "episode") || had(name));
    columns
}

/// Returns the column `t`, and `segment` and `episode` if the file has the starts of segments.
fn time_columns(rows: &[StateWithCommand<'_>], parts: &[(u64, SegmentStart)]) -> Vec<(String, Vec<f64>)> {
    let first = rows.first().map_or(0, |row| row.time);
    let whole = (first, SegmentStart { segment: 0, episode: 0, t: 0.0 });
    let mut at = 0;
    let (mut t, mut segment, mut episode) = (Vec::new(), Vec::new(), Vec::new());
    for row in rows {
        while parts.get(at).is_some_and(|(time, _)| *time <= row.time) {
            at += 1;
        }
        let (start, part) = if at == 0 { whole } else { parts[at - 1] };
        t.push(part.t + (row.time - start) as f64 / NANOSECONDS);
        segment.push(f64::from(part.segment));
        episode.push(f64::from(part.episode));
    }
    let mut columns = vec![("t".to_owned(), t)];
    if !parts.is_empty() {
        columns.extend([("segment".to_owned(), segment), ("episode".to_owned(), episode)]);
    }
    columns
}
