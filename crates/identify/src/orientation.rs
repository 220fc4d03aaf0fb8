//! Measured orientation of the base.

use glam::DQuat;
use twinstep_logs::Log;

/// Returns the measured orientation world-from-base; the identity if it is missing.
pub fn orientation(log: &Log, row: usize) -> DQuat {
    let [w, x, y, z] =
        ["w", "x", "y", "z"].map(|part| log.channel(&format!("quat_{part}")).map_or(f64::NAN, |cells| cells[row]));
    normalized([w, x, y, z])
}

/// Returns the normalised quaternion; the identity if it is not finite or nearly zero.
pub fn normalized([w, x, y, z]: [f64; 4]) -> DQuat {
    let rotation = DQuat::from_xyzw(x, y, z, w);
    if rotation.is_finite() && rotation.length() > 0.5 { rotation.normalize() } else { DQuat::IDENTITY }
}
