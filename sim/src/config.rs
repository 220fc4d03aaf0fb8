//! How robots are simulated: the `[sim]` table of the server's config file.

use serde::{Deserialize, Serialize};
use twinstep_model::{ControlConfig, Ground, HeightField};

/// Cells along a side of rough ground at most: a field of 4 MB.
const MAX_CELLS: f32 = 1024.0;

/// Settings of the simulation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// The engine that integrates the equations of motion.
    pub engine: Engine,
    /// Rate of the physics [Hz]; a multiple of the drive's rate. Without, the engine's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics_hz: Option<u32>,
    /// Solver iterations a physics step. rapier integrates the joints in each of them, so two iterations cost and give
    /// about what twice the rate does; in the batch engine they refine the contact forces alone. Without, the engine's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub solver_iterations: Option<u32>,
    /// The ground.
    pub terrain: Terrain,
    /// Whether the trunk moves or is held.
    pub base: BaseMount,
    /// Threads that step robots; 0 takes all cores.
    pub threads: usize,
}

impl Default for SimConfig {
    fn default() -> Self {
        Self {
            engine: Engine::Batch,
            physics_hz: None,
            solver_iterations: None,
            terrain: Terrain::Flat,
            base: BaseMount::Floating,
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

impl Engine {
    /// Rate [Hz] and solver iterations that `twinstep bench sim` recommends; `docs/physics.md` has the table and the
    /// reason.
    fn recommended(self) -> (u32, u32) {
        match self {
            Engine::Rapier => (200, 2),
            Engine::Batch => (1000, 4),
        }
    }
}

/// The ground under the robots.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Terrain {
    /// The plane z = 0.
    Flat,
    /// A plane through the origin that rises along x by this angle [rad].
    SlopeRad(f32),
    /// Random heights on a grid around the origin.
    Rough(RoughTerrain),
}

/// Rough ground: heights at the corners of square cells, drawn evenly from 0 to `height_m`, with two triangles a cell.
///
/// Its rim and all around it is the plane z = 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoughTerrain {
    /// Greatest height [m].
    pub height_m: f32,
    /// Side of a cell [m].
    pub cell_m: f32,
    /// Side of the square that is rough [m]; in whole cells.
    #[serde(default = "Rough::default_size_m")]
    pub size_m: f32,
    /// Seed of the heights. Equal seeds give equal ground, and all robots have the same.
    pub seed: u64,
}

impl RoughTerrain {
    fn default_size_m() -> f32 {
        40.0
    }

    /// Cells along a side.
    fn cells(self) -> f32 {
        (self.size_m / self.cell_m).round()
    }

    fn check(self) -> Result<(), SimConfigError> {
        let refuse =
            |field, value: f32, allowed: String| Err(SimConfigError { field, value: value.to_string(), allowed });
        if !(0.0..=0.3).contains(&self.height_m) {
            return refuse("terrain.rough.height_m", self.height_m, "0 to 0.3 m".to_owned());
        }
        if !(0.02..=10.0).contains(&self.cell_m) {
            return refuse("terrain.rough.cell_m", self.cell_m, "0.02 to 10 m".to_owned());
        }
        if !(2.0..=MAX_CELLS).contains(&self.cells()) {
            let allowed = format!("2 to {MAX_CELLS} cells of {} m", self.cell_m);
            return refuse("terrain.rough.size_m", self.size_m, allowed);
        }
        Ok(())
    }
}

impl Terrain {
    /// The ground. Rough ground is drawn anew, so build it once and share it.
    pub fn ground(self) -> Ground {
        match self {
            Terrain::Flat => Ground::FLAT,
            Terrain::SlopeRad(angle) => Ground { normal: [-angle.sin(), 0.0, angle.cos()], ..Ground::FLAT },
            Terrain::Rough(rough) => {
                let cells = (rough.cells() as usize).clamp(2, MAX_CELLS as usize);
                let field = HeightField::random_uniform(rough.height_m, rough.cell_m, cells, rough.seed);
                Ground { height_field: Some(field.expect("the config was checked").into()), ..Ground::FLAT }
            }
        }
    }
}

/// Whether the trunk moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BaseMount {
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
    /// Rate of the physics [Hz].
    pub fn physics_hz(&self) -> u32 {
        self.physics_hz.unwrap_or(self.engine.recommended().0)
    }

    /// Solver iterations a physics step.
    pub fn solver_iterations(&self) -> u32 {
        self.solver_iterations.unwrap_or(self.engine.recommended().1)
    }

    /// Fails if a value is outside its range for a robot with `control`.
    pub fn check(&self, control: &ControlConfig) -> Result<(), SimConfigError> {
        let drive_hz = control.actuator_hz as u32;
        let refuse = |field, value: String, allowed: String| Err(SimConfigError { field, value, allowed });
        if !(drive_hz..=20_000).contains(&self.physics_hz()) || !self.physics_hz().is_multiple_of(drive_hz) {
            let allowed = format!("a multiple of the drive's {drive_hz} Hz up to 20000");
            return refuse("physics_hz", self.physics_hz().to_string(), allowed);
        }
        if !(1..=64).contains(&self.solver_iterations()) {
            return refuse("solver_iterations", self.solver_iterations().to_string(), "1 to 64".to_owned());
        }
        if self.threads > 1024 {
            return refuse("threads", self.threads.to_string(), "0 (all cores) to 1024".to_owned());
        }
        match self.terrain {
            Terrain::SlopeRad(angle) if !(-1.0..=1.0).contains(&angle) => {
                refuse("terrain.slope_rad", angle.to_string(), "-1 to 1 rad".to_owned())
            }
            Terrain::Rough(rough) => rough.check(),
            Terrain::Flat | Terrain::SlopeRad(_) => Ok(()),
        }
    }

    /// Physics steps in one period of the drive.
    pub fn steps_per_drive_period(&self, control: &ControlConfig) -> usize {
        self.physics_hz() as usize / control.actuator_hz as usize
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::go2;

    use super::*;

    #[test]
    fn rate_that_is_no_multiple_of_the_drives_is_refused_with_what_is_allowed() {
        let config = SimConfig { physics_hz: Some(500), ..SimConfig::default() };
        let error = config.check(&go2().control).expect_err("refused").to_string();
        assert_eq!(error, "`sim.physics_hz` = 500 is not allowed: a multiple of the drive's 200 Hz up to 20000");
    }

    #[test]
    fn slope_that_is_not_a_number_is_refused() {
        let config = SimConfig { terrain: Terrain::SlopeRad(f32::NAN), ..SimConfig::default() };
        assert!(config.check(&go2().control).is_err());
    }

    const ROUGH: RoughTerrain = RoughTerrain { height_m: 0.05, cell_m: 0.25, size_m: 40.0, seed: 1 };

    fn read(text: &str) -> SimConfig {
        toml::from_str(text).expect("a `[sim]` table")
    }

    #[test]
    fn terrain_reads_as_people_write_it() {
        assert_eq!(read("terrain = \"flat\"").terrain, Terrain::Flat);
        assert_eq!(read("terrain = { slope_rad = 0.1 }").terrain, Terrain::SlopeRad(0.1));
        let rough = "terrain = { rough = { height_m = 0.05, cell_m = 0.25, seed = 1 } }";
        assert_eq!(read(rough).terrain, Terrain::Rough(ROUGH));
        let sized = "terrain = { rough = { height_m = 0.05, cell_m = 0.25, size_m = 10.0, seed = 1 } }";
        assert_eq!(read(sized).terrain, Terrain::Rough(RoughTerrain { size_m: 10.0, ..ROUGH }));
    }

    #[test]
    fn misspelt_key_of_rough_ground_is_named_with_its_line_and_the_keys() {
        let error = toml::from_str::<SimConfig>("[terrain.rough]\nheight = 0.05\n").expect_err("refused").to_string();
        assert!(error.contains("line 2") && error.contains("unknown field `height`"), "{error}");
        assert!(error.contains("`height_m`, `cell_m`, `size_m`, `seed`"), "{error}");
    }

    #[test]
    fn rough_ground_outside_its_range_is_refused_with_what_is_allowed() {
        let refused = |rough| {
            let config = SimConfig { terrain: Terrain::Rough(rough), ..SimConfig::default() };
            config.check(&go2().control).expect_err("refused").to_string()
        };
        let height = refused(RoughTerrain { height_m: 0.5, ..ROUGH });
        assert_eq!(height, "`sim.terrain.rough.height_m` = 0.5 is not allowed: 0 to 0.3 m");
        let cell = refused(RoughTerrain { cell_m: f32::NAN, ..ROUGH });
        assert_eq!(cell, "`sim.terrain.rough.cell_m` = NaN is not allowed: 0.02 to 10 m");
        let size = refused(RoughTerrain { cell_m: 0.02, ..ROUGH });
        assert_eq!(size, "`sim.terrain.rough.size_m` = 40 is not allowed: 2 to 1024 cells of 0.02 m");
    }

    #[test]
    fn each_engine_has_its_own_rate_unless_one_is_given() {
        assert_eq!((read("").physics_hz(), read("").solver_iterations()), (1000, 4));
        let rapier = read("engine = \"rapier\"");
        assert_eq!((rapier.physics_hz(), rapier.solver_iterations()), (200, 2));
        assert_eq!(read("engine = \"rapier\"\nphysics_hz = 400").physics_hz(), 400);
    }
}
