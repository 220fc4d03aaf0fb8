//! Battery and motor temperatures.

use twinstep_model::{Joint, JointKind, PerJoint};

/// Voltage of the full and of the empty battery: seven cells of 4.2 V and of 3.4 V [V].
const VOLTAGE: [f32; 2] = [29.4, 23.8];
/// Resistance of battery and cable [Ω].
const RESISTANCE: f32 = 0.05;
/// Energy of the full battery [J]: 8 Ah at 26 V.
const ENERGY: f64 = 8.0 * 3600.0 * 26.0;
/// Power of the computers [W].
const IDLE_POWER: f32 = 40.0;
/// Heat of a motor divided by the square of its torque [W/(N·m)²].
const COPPER_LOSS: f32 = 0.5;
/// Rise of a motor's temperature at a lasting torque, divided by the square of the torque [K/(N·m)²].
const HEATING: f32 = 0.5;
/// Time constant of a motor's temperature [s].
const MOTOR_TIME_CONSTANT: f32 = 300.0;
/// Time constant of the temperature sensor [s].
const SENSOR_TIME_CONSTANT: f32 = 5.0;
/// Torque of a calf joint divided by that of its motor.
const CALF_RATIO: f32 = 1.917;

/// State of battery and motors.
#[derive(Clone, Debug)]
pub(super) struct Power {
    ambient: f32,
    /// Charge, 0 to 1.
    charge: f64,
    current: f32,
    /// Temperature of the windings and of their sensors [°C].
    motors: PerJoint,
    sensors: PerJoint,
    /// Voltage that a fault commands [V].
    pub forced_voltage: Option<f32>,
}

impl Power {
    pub fn new(charge_percent: f32, ambient: f32) -> Self {
        let charge = f64::from(charge_percent / 100.0);
        Self { ambient, charge, current: 0.0, motors: [ambient; 12], sensors: [ambient; 12], forced_voltage: None }
    }

    /// Advances by `dt` [s] with torques [N·m] and speeds [rad/s] of the joints.
    pub fn advance(&mut self, tau: &PerJoint, dq: &PerJoint, dt: f32) {
        let mut power = IDLE_POWER;
        for joint in Joint::ALL {
            let index = joint.index();
            let ratio = if joint.kind == JointKind::Calf { CALF_RATIO } else { 1.0 };
            let square = (tau[index] / ratio).powi(2);
            power += (tau[index] * dq[index]).max(0.0) + COPPER_LOSS * square;
            let steady = self.ambient + HEATING * square;
            self.motors[index] += dt / MOTOR_TIME_CONSTANT * (steady - self.motors[index]);
            self.sensors[index] += dt / SENSOR_TIME_CONSTANT * (self.motors[index] - self.sensors[index]);
        }
        self.current = power / self.open_voltage();
        self.charge = (self.charge - f64::from(power * dt) / ENERGY).max(0.0);
    }

    fn open_voltage(&self) -> f32 {
        VOLTAGE[1] + self.charge as f32 * (VOLTAGE[0] - VOLTAGE[1])
    }

    /// Returns the supply voltage [V].
    pub fn voltage(&self) -> f32 {
        self.forced_voltage.unwrap_or(self.open_voltage() - RESISTANCE * self.current)
    }

    /// Returns the supply current [A].
    pub fn current(&self) -> f32 {
        self.current
    }

    /// Returns the charge [%].
    pub fn percent(&self) -> u8 {
        (100.0 * self.charge).round() as u8
    }

    /// Sets the charge [%].
    pub fn set_percent(&mut self, percent: u8) {
        self.charge = f64::from(percent) / 100.0;
    }

    /// Returns the reading of each motor's temperature sensor [°C].
    pub fn temperatures(&self) -> [u8; 12] {
        self.sensors.map(|celsius| celsius as i8 as u8)
    }

    /// Sets the temperature of a motor [°C].
    pub fn heat(&mut self, joint: Joint, celsius: f32) {
        self.motors[joint.index()] = celsius;
        self.sensors[joint.index()] = celsius;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn torque_heats_a_motor_and_empties_the_battery() {
        let mut power = Power::new(80.0, 30.0);
        let mut tau = [0.0; 12];
        tau[1] = 10.0;
        for _ in 0..600 {
            power.advance(&tau, &[0.0; 12], 1.0);
        }
        let temperatures = power.temperatures();
        assert!((70..80).contains(&temperatures[1]), "{temperatures:?}");
        assert_eq!(temperatures[0], 30);
        assert!(power.percent() < 80 && power.voltage() < 28.0, "{} {}", power.percent(), power.voltage());
    }

    #[test]
    fn full_battery_has_29_volts() {
        assert!((Power::new(100.0, 30.0).voltage() - 29.4).abs() < 1e-4);
    }
}
