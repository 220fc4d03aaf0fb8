//! A scripted trot for demonstrations.

use std::f32::consts::TAU;

use twinstep_model::{JointKind, Leg, NUM_JOINTS};

/// Step frequency of one leg [Hz].
const STEP_RATE: f32 = 2.0;

/// Returns the action at `time` [s], in units of the action scale. Diagonal pairs of legs alternate.
pub fn action(time: f32) -> [f32; NUM_JOINTS] {
    let mut action = [0.0; NUM_JOINTS];
    for leg in Leg::ALL {
        let diagonal = matches!(leg, Leg::FL | Leg::RR);
        let phase = TAU * (STEP_RATE * time + if diagonal { 0.0 } else { 0.5 });
        let lift = phase.sin().max(0.0);
        let first = leg as usize * 3;
        action[first + JointKind::Thigh as usize] = 0.5 * lift - 0.12 * phase.cos();
        action[first + JointKind::Calf as usize] = -lift;
    }
    action
}
