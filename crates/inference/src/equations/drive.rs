//! Torque of a drive on the measured states: nothing is simulated but the drive itself.

use twinstep_dynamics::{SimdActuators, SimdCommands};
use twinstep_logs::replay::delayed_mean;
use twinstep_model::JointModel;

use super::measurements::{JointRows, Measurements};
use super::robot::Robot;

/// Returns the torque that the sensor of a joint reads, by row [N·m].
///
/// The PD loop uses positions and velocities of the encoder by row, and is updated once per row.
pub fn sensed_torque(measured: &Measurements, rows: &JointRows, [q, dq]: [&[f64]; 2], robot: &Robot) -> Vec<f64> {
    let joint = &robot.joints[rows.joint];
    let mut model = *joint;
    // The readings contain what the encoder adds.
    (model.actuator.encoder_offset, model.actuator.encoder_lead) = (0.0, 0.0);
    (model.actuator.backlash, model.actuator.gear_stiffness) = (0.0, f64::INFINITY);
    let mut sensed = vec![f64::NAN; measured.t.len()];
    for range in &measured.ranges {
        let mut drive = SimdActuators::<f64, [f64; 1]>::new(&[model], measured.dt, measured.dt);
        drive.set(0, &[model], &[q[range.start]], &[0.0]);
        let mut torques: Vec<f64> = Vec::with_capacity(range.len());
        for row in range.clone() {
            let next = (row + 1).min(range.end - 1);
            let middle = 0.5 * (dq[row] + dq[next]);
            drive.set_derating(0, &[derating(measured, rows, robot, row) as f32]);
            drive.update_command(&commands(rows, row), &[q[row]], &[dq[row]]);
            drive.step(0, &[q[row] + 0.5 * measured.dt * dq[row]], &[middle]);
            torques.push(drive.estimated_torque()[0]);
            // A missing cell must not spread into the state of a lag.
            if !torques[torques.len() - 1].is_finite() {
                drive = SimdActuators::new(&[model], measured.dt, measured.dt);
                drive.set(0, &[model], &[if q[row].is_finite() { q[row] } else { 0.0 }], &[0.0]);
            }
        }
        if measured.is_at_output {
            for (index, row) in range.clone().enumerate() {
                let next = (row + 1).min(range.end - 1);
                let [middle, slope] = [0.5 * (dq[row] + dq[next]), (dq[next] - dq[row]) / measured.dt];
                torques[index] = link_torque(joint, torques[index], [q[row], middle, slope]);
            }
        }
        let delay = joint.actuator.sensor_delay / measured.dt;
        for (index, row) in range.clone().enumerate() {
            sensed[row] = delayed_mean(|sample| torques[sample], index..index + 1, delay);
        }
    }
    sensed
}

impl Measurements {
    /// Takes the torques of a robot's drives on smooth readings for measured ones, in the rows that are used.
    pub fn set_torques_of_drives(&mut self, robot: &Robot) {
        let of = |rows: &JointRows| sensed_torque(self, rows, [&rows.smooth[0], &rows.smooth[1]], robot);
        let torques: Vec<Vec<f64>> = self.joints.iter().map(of).collect();
        for (rows, torques) in self.joints.iter_mut().zip(torques) {
            for (used, torque) in rows.torque.iter_mut().zip(torques).filter(|(used, _)| used.is_finite()) {
                *used = torque;
            }
        }
    }
}

fn commands(rows: &JointRows, row: usize) -> SimdCommands<[f64; 1]> {
    let [q, dq, tau_ff] = [0, 1, 2].map(|quantity| [rows.command[quantity][row]]);
    let [kp, kd] = [0, 1].map(|gain| [rows.gains[gain][row]]);
    SimdCommands { q, dq, tau_ff, kp, kd }
}

/// Returns the factor on the torque for supply voltage and motor temperature.
fn derating(measured: &Measurements, rows: &JointRows, robot: &Robot, row: usize) -> f64 {
    let share = measured.voltage_share.get(row).copied().unwrap_or(1.0);
    let [per_kelvin, above] = robot.thermal[rows.joint];
    let hot = rows.temperature.get(row).map_or(0.0, |now| (now - above).max(0.0));
    share.max(0.0).powf(robot.voltage_exponent) * (1.0 - per_kelvin * hot).max(0.0)
}

/// Returns the Coulomb friction's share of a speed [rad/s]: −1 to 1.
pub fn smooth_sign(dq: f64) -> f64 {
    (dq / 0.03).tanh()
}

/// Returns the torque on the link of a joint [N·m], given the torque of its motor, and the motion of the encoder.
pub fn link_torque(joint: &JointModel, motor: f64, motion: [f64; 3]) -> f64 {
    link_torque_with(joint, motor, motion, smooth_sign(motion[1]))
}

/// Returns the torque on the link of a joint [N·m], given the Coulomb friction's share of its speed.
///
/// What a joint does not have is not computed: most of the time of a search is spent here.
pub fn link_torque_with(joint: &JointModel, motor: f64, [q, dq, ddq]: [f64; 3], sign: f64) -> f64 {
    let actuator = &joint.actuator;
    let mut torque = actuator.gain * motor;
    if actuator.ripple.amplitude != 0.0 {
        torque += actuator.ripple.amplitude * (actuator.ripple.cycles * q + actuator.ripple.phase).sin();
    }
    let mut dry = joint.coulomb_friction + joint.load_friction * torque.abs();
    if joint.stribeck_friction.breakaway_torque != 0.0 {
        let speed = dq / joint.stribeck_friction.stribeck_velocity;
        dry += joint.stribeck_friction.breakaway_torque * (-speed * speed).exp();
    }
    let spring = joint.spring.torque_offset - joint.spring.stiffness * (q - actuator.encoder_offset);
    torque - joint.viscous_friction * dq - dry * sign + spring - joint.armature * ddq
}

/// Returns the torque of a motor [N·m] that has this torque on the link, given what each torque of the motor has, and its gain.
pub fn inverse(gain: f64, link: f64, link_torque: impl Fn(f64) -> f64) -> f64 {
    let mut motor = link / gain;
    // Friction that grows with the torque is small, so that few steps suffice; without it, one.
    for _ in 0..4 {
        let left = link - link_torque(motor);
        motor += left / gain;
        if left.abs() < 1e-9 {
            break;
        }
    }
    motor
}
