//! Domain randomisation: each episode has its own robot. The differences are effects of the catalogue.

use glam::DVec3;
use rand::RngExt;
use serde::{Deserialize, Serialize};
use twinstep_effects::{Apply, Effect, EffectSite};
use twinstep_model::{JointModel, NUM_JOINTS, RobotModel, Stream, TreeModel};

use crate::ObservationNoise;
use crate::config::{ConfigError, Range, check_range};

/// Domain randomisation. Each value is sampled uniformly from its range at every reset.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Randomisation {
    /// Factor on the mass and inertia of every body.
    pub mass_scale: Range,
    /// Point mass at the trunk's centre of mass [kg].
    pub payload_kg: Range,
    /// Shift of the trunk's centre of mass, each axis [m].
    pub com_shift_m: Range,
    /// Factor on the ground's friction coefficient.
    pub friction_scale: Range,
    /// Factor on the position gain.
    pub kp_scale: Range,
    /// Factor on the velocity gain.
    pub kd_scale: Range,
    /// Delay between a command and its arrival at the actuators [ms].
    pub command_delay_ms: Range,
    /// Velocity that a push adds to that of the base, in a random horizontal direction [m/s].
    pub push_m_s: Range,
    /// Time between two pushes [s].
    pub push_interval_s: Range,
    /// Noise of the observation.
    pub noise: ObservationNoise,
    /// True to sample every value of the model file that has an interval from that interval.
    pub effects: bool,
}

impl Default for Randomisation {
    /// No randomisation.
    fn default() -> Self {
        Self {
            mass_scale: [1.0, 1.0],
            payload_kg: [0.0, 0.0],
            com_shift_m: [0.0, 0.0],
            friction_scale: [1.0, 1.0],
            kp_scale: [1.0, 1.0],
            kd_scale: [1.0, 1.0],
            command_delay_ms: [0.0, 0.0],
            push_m_s: [0.0, 0.0],
            push_interval_s: [5.0, 10.0],
            noise: ObservationNoise::default(),
            effects: false,
        }
    }
}

impl Randomisation {
    /// Checks that every range is one for which the simulation is stable.
    pub fn check(&self) -> Result<(), ConfigError> {
        check_range("randomise.mass_scale", self.mass_scale, 0.1, 10.0)?;
        check_range("randomise.payload_kg", self.payload_kg, -3.0, 20.0)?;
        check_range("randomise.com_shift_m", self.com_shift_m, -0.2, 0.2)?;
        check_range("randomise.friction_scale", self.friction_scale, 0.0, 10.0)?;
        check_range("randomise.kp_scale", self.kp_scale, 0.0, 10.0)?;
        check_range("randomise.kd_scale", self.kd_scale, 0.0, 10.0)?;
        check_range("randomise.command_delay_ms", self.command_delay_ms, 0.0, 40.0)?;
        check_range("randomise.push_m_s", self.push_m_s, 0.0, 5.0)?;
        check_range("randomise.push_interval_s", self.push_interval_s, 0.02, 1e6)?;
        self.noise.check()
    }

    /// Returns true if robots are pushed.
    pub fn has_pushes(&self) -> bool {
        self.push_m_s[1] > 0.0
    }

    /// Checks that the base of a robot, with this mass [kg], keeps a positive mass.
    pub fn check_base(&self, mass: f64) -> Result<(), ConfigError> {
        let [scale, payload] = [self.mass_scale[0], self.payload_kg[0]];
        let lowest = -(mass as f32) * scale;
        if payload > lowest {
            return Ok(());
        }
        Err(ConfigError {
            field: "randomise.payload_kg".to_owned(),
            value: format!("{:?}", self.payload_kg),
            allowed: format!("above {lowest:.2} kg, because the base with the lowest `mass_scale` weighs that much"),
        })
    }

    /// Samples the number of policy steps until the next push, at least 1.
    pub fn sample_push_steps(&self, policy_dt: f64, random: &mut Stream) -> u32 {
        (f64::from(sample(self.push_interval_s, random)) / policy_dt).round().max(1.0) as u32
    }

    /// Samples the velocity that a push adds, in the world frame [m/s].
    pub fn sample_push(&self, random: &mut Stream) -> [f32; 3] {
        let (sin, cos) = sample([0.0, std::f32::consts::TAU], random).sin_cos();
        let speed = sample(self.push_m_s, random);
        [speed * cos, speed * sin, 0.0]
    }

    /// Samples the robot of an episode: `robot` with effects. Returns `None` if no range differs from no effect.
    ///
    /// The number of random numbers does not depend on the ranges, so that poses and commands do not either.
    pub fn sample(&self, robot: &RobotModel, random: &mut Stream) -> Option<RobotModel> {
        let Draw { mass_scale, payload, shift, friction_scale, gains, delay_s } = self.draw(random)?;
        let mut sampled = robot.clone();
        let bodies = sampled.legs.iter_mut().flat_map(|leg| &mut leg.bodies).chain([&mut sampled.trunk]);
        bodies.for_each(|body| *body = body.scaled(mass_scale));
        let com = robot.trunk.com;
        apply(&mut sampled, "payload", EffectSite::Global, &[payload, com.x, com.y, com.z]);
        apply(&mut sampled, "com_shift", EffectSite::Global, &shift);
        apply(&mut sampled, "ground_friction", EffectSite::Global, &[friction_scale * robot.contact.friction]);
        for joint in 0..NUM_JOINTS {
            apply(&mut sampled, "pd_gain", EffectSite::Joint(joint), &gains);
            apply(&mut sampled, "command_delay", EffectSite::Joint(joint), &[delay_s]);
        }
        Some(sampled)
    }

    /// Samples the robot of an episode like [`Randomisation::sample`], for a robot of any tree. Payload and shift are those of its base.
    pub fn sample_tree(&self, robot: &TreeModel, random: &mut Stream) -> Option<TreeModel> {
        let Draw { mass_scale, payload, shift, friction_scale, gains, delay_s } = self.draw(random)?;
        let mut sampled = robot.clone();
        for body in &mut sampled.tree.bodies {
            body.inertia = body.inertia.scaled(mass_scale);
        }
        let base = &mut sampled.tree.bodies[0].inertia;
        *base = base.with_point_mass(payload, base.com);
        base.com += DVec3::from(shift);
        sampled.contact.friction *= friction_scale;
        for joint in &mut sampled.joints {
            apply_to_joint(joint, "pd_gain", &gains);
            apply_to_joint(joint, "command_delay", &[delay_s]);
        }
        Some(sampled)
    }

    /// Draws what differs in an episode. Returns `None` if no range differs from no effect.
    fn draw(&self, random: &mut Stream) -> Option<Draw> {
        let mut draw = |range: Range| f64::from(sample(range, random));
        let drawn = Draw {
            mass_scale: draw(self.mass_scale),
            payload: draw(self.payload_kg),
            shift: std::array::from_fn(|_| draw(self.com_shift_m)),
            friction_scale: draw(self.friction_scale),
            gains: [draw(self.kp_scale), draw(self.kd_scale)],
            delay_s: 1e-3 * draw(self.command_delay_ms),
        };
        let Self { push_m_s, push_interval_s, noise, effects, .. } = *self;
        let is_nominal = Self { push_m_s, push_interval_s, noise, effects, ..Self::default() } == *self;
        (!is_nominal).then_some(drawn)
    }
}

/// What differs in an episode.
struct Draw {
    mass_scale: f64,
    payload: f64,
    shift: [f64; 3],
    friction_scale: f64,
    gains: [f64; 2],
    delay_s: f64,
}

/// Returns a value from a range, with uniform probability.
fn sample([low, high]: Range, random: &mut Stream) -> f32 {
    low + (high - low) * random.random::<f32>()
}

fn apply(robot: &mut RobotModel, name: &str, site: EffectSite, values: &[f64]) {
    let effect = Effect::named(name).expect("an effect of the catalogue");
    effect.apply(robot, site, values).expect("`check_robot` has checked the ranges");
}

fn apply_to_joint(joint: &mut JointModel, name: &str, values: &[f64]) {
    let effect = Effect::named(name).expect("an effect of the catalogue");
    let Apply::Joint(change) = effect.apply else { unreachable!("an effect of joints") };
    change(joint, values).expect("`check` has checked the ranges");
}

#[cfg(test)]
mod tests {
    use expect_test::expect;
    use twinstep_model::{go2, stream};

    use super::*;

    #[test]
    fn reversed_range_is_rejected_with_its_key() {
        let config = Randomisation { payload_kg: [2.0, 1.0], ..Randomisation::default() };
        expect![
            "`randomise.payload_kg` = [2.0, 1.0] is not allowed: [low, high] with low <= high, both within -3 to 20"
        ]
        .assert_eq(&config.check().expect_err("reversed").to_string());
    }

    #[test]
    fn payload_that_outweighs_the_trunk_is_rejected() {
        let config = Randomisation { mass_scale: [0.4, 1.0], payload_kg: [-3.0, 0.0], ..Randomisation::default() };
        expect!["`randomise.payload_kg` = [-3.0, 0.0] is not allowed: above -2.77 kg, because the base with the lowest `mass_scale` weighs that much"].assert_eq(&config.check_base(go2().trunk.mass).expect_err("too light").to_string());
    }

    #[test]
    fn defaults_are_valid_and_return_no_robot() {
        let config = Randomisation::default();
        assert_eq!((config.check(), config.check_base(go2().trunk.mass)), (Ok(()), Ok(())));
        assert_eq!(config.sample(&go2(), &mut stream(0, "test", 0)), None);
    }

    #[test]
    fn sampled_robot_has_the_requested_differences() {
        let config = Randomisation {
            mass_scale: [1.1, 1.1],
            payload_kg: [2.0, 2.0],
            com_shift_m: [0.01, 0.01],
            friction_scale: [0.5, 0.5],
            kp_scale: [0.9, 0.9],
            kd_scale: [1.2, 1.2],
            command_delay_ms: [15.0, 15.0],
            ..Randomisation::default()
        };
        let (ideal, sampled) = (go2(), config.sample(&go2(), &mut stream(0, "test", 0)).expect("differs"));
        let near = |one: f64, other: f64| assert!((one - other).abs() < 1e-6, "{one} {other}");
        near(sampled.total_mass(), 1.1 * ideal.total_mass() + 2.0);
        near(sampled.trunk.com.y, ideal.trunk.com.y + 0.01);
        near(sampled.contact.friction, 0.5 * ideal.contact.friction);
        for joint in &sampled.joints {
            near(joint.actuator.kp_scale, 0.9);
            near(joint.actuator.kd_scale, 1.2);
            near(joint.actuator.command_delay, 0.015);
        }
    }

    #[test]
    fn pushes_are_horizontal_and_have_the_speed_of_their_range() {
        let config = Randomisation { push_m_s: [0.2, 0.5], ..Randomisation::default() };
        let mut random = stream(0, "test", 0);
        let pushes: Vec<_> = (0..1000).map(|_| config.sample_push(&mut random)).collect();
        let speed = |[x, y, z]: [f32; 3]| x.hypot(y).hypot(z);
        assert!(pushes.iter().all(|push| push[2] == 0.0 && (0.199..0.501).contains(&speed(*push))));
        // The mean of uniform directions is 0, with a standard deviation of 0.35 / sqrt(2000).
        for axis in 0..2 {
            let mean = pushes.iter().map(|push| push[axis]).sum::<f32>() / 1000.0;
            assert!(mean.abs() < 0.04, "{mean}");
        }
    }
}
