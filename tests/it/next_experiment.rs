//! The next experiment: every motion that it is chosen from is safe.

use twinstep_logs::{Base as LoggedBase, Log};
use twinstep_model::{JOINT_NAMES, Joint, go2};
use twinstep_sim::{Base, BatchBackend, SimConfig};
use twinstep_sysid::{SAFE_MOTIONS, SafeMotion, record};

/// Distance that joints keep from the ends of their range [rad].
const MARGIN: f64 = 0.1;
/// Highest speed of a joint [rad/s]; the calf's drive ends at 15.7.
const FASTEST: f64 = 10.0;

fn played(motion: &SafeMotion) -> Log {
    let backend = |base: LoggedBase| {
        let base = if base == LoggedBase::Fixed { Base::Fixed } else { Base::Floating };
        let config = SimConfig { base, threads: 1, ..SimConfig::default() };
        Ok(BatchBackend::new(go2(), config, 1).unwrap())
    };
    record(&motion.motion(&go2()), &go2(), None, backend, String::new(), &mut |_| true).unwrap()
}

#[test]
fn nominal_robot_gets_through_every_safe_motion() {
    for motion in SAFE_MOTIONS {
        let (name, log) = (motion.name, played(&motion));
        let most = |cells: &[f64]| {
            cells.iter().filter(|cell| cell.is_finite()).fold(0.0, |most: f64, cell| most.max(cell.abs()))
        };
        let (mut fastest, mut strongest) = (0.0f64, 0.0f64);
        for joint in Joint::ALL {
            let limits = go2().joints[joint.index()];
            let [low, high] = limits.range;
            for cells in [log.q(joint.name()).unwrap(), log.q_cmd(joint.name()).unwrap()] {
                assert!(
                    cells.iter().all(|q| (low + MARGIN..high - MARGIN).contains(q)),
                    "{name}: {joint} near its end"
                );
            }
            let speed = most(log.dq(joint.name()).unwrap());
            let torque = most(log.tau_measured(joint.name()).unwrap());
            assert!(speed < FASTEST, "{name}: {joint} at {speed} rad/s");
            assert!(torque < 0.9 * limits.torque_limit, "{name}: {joint} with {torque} N·m");
            (fastest, strongest) = (fastest.max(speed), strongest.max(torque));
        }
        println!("{name}: at most {fastest:.1} rad/s and {strongest:.1} N·m");
        if motion.base == LoggedBase::Floating {
            let cells = |name: &str| log.channel(name).unwrap().iter();
            assert!(cells("pos_z").all(|height| (0.2..0.4).contains(height)), "{name}: falls or jumps");
            // 1 − 2 (x² + y²) is the cosine of the tilt.
            let upright = cells("quat_x").zip(cells("quat_y")).all(|(x, y)| 1.0 - 2.0 * (x * x + y * y) > 0.95);
            assert!(upright, "{name}: tips over");
        }
    }
}

#[test]
fn safe_motions_have_names_of_their_own_and_begin_and_end_in_the_default_pose() {
    for (index, motion) in SAFE_MOTIONS.iter().enumerate() {
        assert!(SAFE_MOTIONS[..index].iter().all(|other| other.name != motion.name));
        let log = motion.motion(&go2());
        for (joint, name) in JOINT_NAMES.into_iter().enumerate() {
            let (commands, pose) = (log.q_cmd(name).unwrap(), go2().control.default_pose[joint]);
            assert!([0, log.rows() - 1].iter().all(|row| (commands[*row] - pose).abs() < 0.01), "{}", motion.name);
        }
    }
}
