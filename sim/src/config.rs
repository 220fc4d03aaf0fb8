//! How robots are simulated: the `[sim]` table of the server's config file.

use serde::{Deserialize, Serialize};
use twinstep_model::{Control, Ground};

/// Settings of the simulation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// The engine that integrates the equations of motion.
    pub engine: Engine,
    /// Rate of the physics [Hz]; a multiple of the drive's rate.
    pub physics_hz: u32,
    /// Solver iterations a physics step. rapier integrates the joints in each of them, so two iterations cost and give
    /// about what twice the rate does; in the batch engine they refine the contact forces alone.
    pub solver_iterations: u32,
    /// The ground.
    pub terrain: Terrain,
    /// Whether the trunk moves or is held.
    pub base: Base,
    /// Threads that step robots; 0 takes all cores.
    pub threads: usize,
}

impl Default for SimConfig {
    /// The setting that `twinstep bench sim` recommends; `docs/physics.md` has the table and the reason.
    fn default() -> Self {
        Self {
            engine: Engine::Rapier,
            physics_hz: 200,
            solver_iterations: 2,
            terrain: Terrain::Flat,
            base: Base::Floating,
            threads: 0,
        }
    }
}

/// The engines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Engine {
    /// rapier3d: reduced-coordinate multibodies, one world a robot. The reference.
    Rapier,
    /// Many robots in SIMD lanes. The fast one.
    Batch,
}

/// The ground under the robots.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Terrain {
    /// The plane z = 0.
    Flat,
    /// A plane through the origin that rises along x by this angle [rad].
    SlopeRad(f32),
}

impl Terrain {
    /// The plane.
    pub fn ground(self) -> Ground {
        match self {
            Terrain::Flat => Ground::FLAT,
            Terrain::SlopeRad(angle) => Ground { normal: [-angle.sin(), 0.0, angle.cos()], ..Ground::FLAT },
        }
    }
}

/// Whether the trunk moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Base {
    /// The trunk moves freely.
    Floating,
    /// The trunk is held where it was placed, as on a stand.
    Fixed,
}

/// A setting outside what is allowed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`sim.{field}` = {value} is not allowed: {allowed}")]
pub struct SimConfigError {
    /// The key.
    pub field: &'static str,
    /// Its value.
    pub value: String,
    /// What is allowed.
    pub allowed: String,
}

impl SimConfig {
    /// Fails if a value is outside its range for a robot with `control`.
    pub fn check(&self, control: &Control) -> Result<(), SimConfigError> {
        let drive_hz = control.drive_hz as u32;
        let refuse = |field, value: String, allowed: String| Err(SimConfigError { field, value, allowed });
        if !(drive_hz..=20_000).contains(&self.physics_hz) || !self.physics_hz.is_multiple_of(drive_hz) {
            let allowed = format!("a multiple of the drive's {drive_hz} Hz up to 20000");
            return refuse("physics_hz", self.physics_hz.to_string(), allowed);
        }
        if !(1..=64).contains(&self.solver_iterations) {
            return refuse("solver_iterations", self.solver_iterations.to_string(), "1 to 64".to_owned());
        }
        if self.threads > 1024 {
            return refuse("threads", self.threads.to_string(), "0 (all cores) to 1024".to_owned());
        }
        match self.terrain {
            Terrain::SlopeRad(angle) if !(-1.0..=1.0).contains(&angle) => {
                refuse("terrain.slope_rad", angle.to_string(), "-1 to 1 rad".to_owned())
            }
            _ => Ok(()),
        }
    }

    /// Physics steps in one period of the drive.
    pub fn steps_per_drive_period(&self, control: &Control) -> usize {
        self.physics_hz as usize / control.drive_hz as usize
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::go2;

    use super::*;

    #[test]
    fn rate_that_is_no_multiple_of_the_drives_is_refused_with_what_is_allowed() {
        let config = SimConfig { physics_hz: 500, ..SimConfig::default() };
        let error = config.check(&go2().control).expect_err("refused").to_string();
        assert_eq!(error, "`sim.physics_hz` = 500 is not allowed: a multiple of the drive's 200 Hz up to 20000");
    }

    #[test]
    fn slope_that_is_not_a_number_is_refused() {
        let config = SimConfig { terrain: Terrain::SlopeRad(f32::NAN), ..SimConfig::default() };
        assert!(config.check(&go2().control).is_err());
    }
}
