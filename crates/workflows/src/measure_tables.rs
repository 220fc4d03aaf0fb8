//! Tables of what a policy does, by condition.

use std::fmt::Write;

use serde::Serialize;
use twinstep_measures::{
    AttitudeErrors, Evaluation, GETUP_S, GaitMotion, GettingUpTimes, JUMP_S, KindOfGround, Landings, Level, PoseErrors,
    SpeedBin, Tracking, TrackingErrors,
};
use twinstep_sim::{Engine, PatchKind};

/// What was measured under a condition.
#[derive(Serialize)]
pub struct Row<T> {
    /// Name of the condition.
    pub condition: &'static str,
    /// Physics engine.
    pub engine: Engine,
    /// What was measured.
    #[serde(flatten)]
    pub found: T,
}

/// Errors along several paths.
#[derive(Serialize)]
pub struct ByPath {
    /// Errors by path.
    pub paths: Vec<TrackingErrors>,
}

/// Motion in several gaits.
#[derive(Serialize)]
pub struct ByGait {
    /// Measured motion by gait.
    pub gaits: Vec<GaitMotion>,
}

/// Jumps to several targets.
#[derive(Serialize)]
pub struct ByTarget {
    /// Landings by target.
    pub targets: Vec<Landings>,
}

/// Returns the name of an engine in tables.
fn name(engine: Engine) -> String {
    format!("{engine:?}").to_lowercase()
}

/// Returns the shares of robots that leave their patch of a course as a table.
pub fn course(kinds: &[KindOfGround]) -> String {
    let mut text =
        "Share of the robots that arrive, by kind and level; below it the angle [deg] or height [cm]\n".to_owned();
    for KindOfGround { kind, passed, levels } in kinds {
        let name = format!("{kind:?}");
        let _ = writeln!(text, "\n{name:11} {passed:2} levels passed (80 %)");
        let unit = |size: f32| match kind {
            PatchKind::SlopeUp | PatchKind::SlopeDown => size.to_degrees(),
            _ => 100.0 * size,
        };
        let share = |level: &Level| match level.robots {
            0 => format!("{:>7}", "-"),
            robots => format!("{:5.0} %", 100.0 * level.arrived as f64 / robots as f64),
        };
        let row = |cells: &mut dyn Iterator<Item = String>| cells.collect::<Vec<_>>().join(" ");
        let shares = row(&mut levels.iter().map(share));
        let sizes = row(&mut levels.iter().map(|level| format!("{:7.1}", unit(level.size))));
        let _ = writeln!(text, "  {shares}\n {sizes}");
    }
    text
}

/// Returns the evaluations as a table.
pub fn walking(robots: u32, seconds: f64, rows: &[Row<Evaluation>]) -> String {
    let mut text = format!(
        "{robots} robots, {seconds} s, new command every 5 s. Errors: RMS (from 1 s after each new command)\n\n\
         condition  engine   up       velocity [m/s]  yaw rate [rad/s]  swing    duty  slip       power\n"
    );
    for Row { condition, engine, found: e } in rows {
        let engine = name(*engine);
        let _ = writeln!(
            text,
            "{condition:10} {engine:8} {:5.1} %  {:.3} ({:.3})   {:.3} ({:.3})     {:.1} cm  {:.2}  {:.3} m/s  {:3.0} W",
            100.0 * e.up,
            e.velocity_rms,
            e.settled_velocity_rms,
            e.yaw_rate_rms,
            e.settled_yaw_rate_rms,
            100.0 * e.swing_height,
            e.duty_factor,
            e.slip_speed,
            e.power,
        );
    }
    text
}

/// Returns the errors of an evaluation by the commanded speed.
pub fn by_speed(evaluation: &Evaluation) -> String {
    let mut text = "First row by commanded speed:\nspeed [m/s]  share  velocity [m/s]  yaw rate [rad/s]\n".to_owned();
    for (index, SpeedBin { from, share, velocity_rms, yaw_rate_rms }) in evaluation.by_speed.iter().enumerate() {
        let to = evaluation.by_speed.get(index + 1).map_or(String::new(), |next| next.from.to_string());
        let range = format!("{from} to {to}");
        let _ = writeln!(text, "{range:11} {:4.0} %  {velocity_rms:.3}           {yaw_rate_rms:.3}", 100.0 * share);
    }
    text
}

/// Returns the errors as a table.
pub fn tracking(robots: u32, seconds: f64, rows: &[Row<ByPath>]) -> String {
    let mut text = format!(
        "{robots} robots, {seconds} s along each path at 0.5 m/s. L_track: mean |dx| + |dy| + |dyaw| [m + rad] (RMS \
         distance,\nshare that did not fall). Without motion capture the observed pose error is zero.\n\n"
    );
    let names = Tracking::PATHS.map(|(_, name)| name);
    let _ = writeln!(text, "condition  engine   motion capture  {:24} {:24} {:24}", names[0], names[1], names[2]);
    for Row { condition, engine, found } in rows {
        let engine = name(*engine);
        for paths in found.paths.chunks(names.len()) {
            let observed = if paths[0].motion_capture { "yes" } else { "no" };
            let _ = write!(text, "{condition:10} {engine:8} {observed:14}");
            for errors in paths {
                let TrackingErrors { l_track, position_rms, up, .. } = errors;
                let _ = write!(text, "  {l_track:.3} ({position_rms:.3} m, {:3.0} %) ", 100.0 * up);
            }
            text.push('\n');
        }
    }
    text
}

/// Returns the measurements as a table.
pub fn gaits(robots: u32, seconds: f64, rows: &[Row<ByGait>]) -> String {
    let mut text = format!(
        "{robots} robots, {seconds} s, new command every 5 s. Followed: share of the commands with a step frequency within \
         5 % and each\nphase within 0.1 cycles, from 1 s after the command. Errors of velocity: RMS, all of the time\n\n\
         condition  engine   gait   up       followed  frequency  phase         duty  velocity   yaw rate\n"
    );
    for Row { condition, engine, found } in rows {
        let engine = name(*engine);
        for motion in &found.gaits {
            let _ = writeln!(
                text,
                "{condition:10} {engine:8} {:6} {:5.1} %  {:5.1} %   {:5.1} %    {:.3} cycles  {:.2}  {:.3} m/s  {:.3} rad/s",
                motion.gait,
                100.0 * motion.up,
                100.0 * motion.followed,
                100.0 * motion.frequency_error,
                motion.phase_error,
                motion.duty_factor,
                motion.velocity_rms,
                motion.yaw_rate_rms,
            );
        }
    }
    text
}

/// Returns the errors as a table.
pub fn attitude(robots: u32, seconds: f64, rows: &[Row<AttitudeErrors>]) -> String {
    let mut text = format!(
        "{robots} robots, {seconds} s. L_attitude: mean |droll| + |dpitch| [rad]\n\n\
         condition  engine   up       L_attitude  roll RMS   pitch RMS  height RMS\n"
    );
    for Row { condition, engine, found } in rows {
        let engine = name(*engine);
        let AttitudeErrors { up, l_attitude, roll_rms, pitch_rms, height_rms } = found;
        let _ = writeln!(
            text,
            "{condition:10} {engine:8} {:5.1} %  {l_attitude:.4}      {roll_rms:.4}     {pitch_rms:.4}     {height_rms:.4} m",
            100.0 * up
        );
    }
    text
}

/// Returns the times as a table.
pub fn getup(robots: u32, rows: &[Row<GettingUpTimes>]) -> String {
    let mut text = format!(
        "{robots} robots dropped in any orientation and pose, {GETUP_S} s\n\n\
         condition  engine   within 3 s  at the end  median  longest\n"
    );
    for Row { condition, engine, found } in rows {
        let engine = name(*engine);
        let GettingUpTimes { within_3_s, at_end, median_s, longest_s } = found;
        let _ = writeln!(
            text,
            "{condition:10} {engine:8}    {:5.1} %     {:5.1} %  {median_s:.2} s   {longest_s:.2} s",
            100.0 * within_3_s,
            100.0 * at_end
        );
    }
    text
}

/// Returns the landings as a table.
pub fn jumps(robots: u32, rows: &[Row<ByTarget>]) -> String {
    let mut text = format!(
        "{robots} robots, one jump from standing, {JUMP_S} s. L_jump: mean |x_land - x_target|\n\n\
         condition  engine   target [m, m, rad]  landed  up       L_jump    mean error  distance  yaw error  turn in flight  flight  clearance\n"
    );
    for Row { condition, engine, found } in rows {
        let engine = name(*engine);
        for landings in &found.targets {
            let [x, y, yaw] = landings.target;
            let _ = write!(
                text,
                "{condition:10} {engine:8} {x:.2}, {y:.2}, {yaw:5.2}   {:5.1} %  {:5.1} %  ",
                100.0 * landings.landed,
                100.0 * landings.up
            );
            let Landings { l_jump, mean_error, distance, yaw_error, flight_turn, flight_s, clearance, .. } = landings;
            let _ = if landings.landed == 0.0 {
                writeln!(text, "no robot has jumped and landed")
            } else {
                let cm = 100.0 * clearance;
                writeln!(
                    text,
                    "{l_jump:6.3} m  {mean_error:+7.3} m   {distance:6.3} m  {yaw_error:.3} rad  {flight_turn:+.3} rad      {flight_s:.2} s  {cm:4.1} cm"
                )
            };
        }
    }
    text
}

/// Returns the errors as a table, the largest first.
pub fn pose(robots: usize, seconds: f64, errors: &PoseErrors) -> String {
    let PoseErrors { up, rms, joints, target_rms } = errors;
    let mut text = format!(
        "{robots} fresh robots, {seconds:.0} s, mean action:\n\
         \x20 still up          {:.1} %\n\
         \x20 joint error, RMS  {rms:.4} rad or m ({target_rms:.4} without motion)\n",
        100.0 * up
    );
    let mut joints: Vec<_> = joints.iter().collect();
    joints.sort_by(|(_, one), (_, other)| other.total_cmp(one));
    for (joint, rms) in joints {
        let _ = writeln!(text, "    {joint:32} {rms:.4}");
    }
    text
}
