//! Settings of the simulation: the `[sim]` table of the server's config file.

use serde::{Deserialize, Serialize};
use twinstep_model::{BaseMount, Ground, HeightField};

use crate::config_error::{SimConfigError, in_range};
use crate::course::CourseTerrain;

/// Maximum number of cells along a side of a height field: 4 MB.
const MAX_CELLS: f32 = 1024.0;

/// Settings of the simulation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// The engine that integrates the equations of motion.
    pub engine: Engine,
    /// Rate of the physics [Hz], a multiple of the actuator rate. Default: recommended for the engine.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics_hz: Option<u32>,
    /// Solver iterations per physics step. Default: recommended for the engine.
    ///
    /// rapier integrates the joints in each iteration, so two iterations have about the cost and the accuracy of twice
    /// the rate. In the batch engine the iterations refine only the contact forces. In MuJoCo they are an upper limit
    /// for its Newton solver.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub solver_iterations: Option<u32>,
    /// The ground.
    pub terrain: Terrain,
    /// Fixed or floating base.
    pub base: BaseMount,
    /// Number of threads that step robots. 0: one per core.
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

/// Physics engine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Engine {
    /// rapier3d: reduced-coordinate multibodies, one world per robot. The reference.
    Rapier,
    /// One robot per SIMD lane, with MuJoCo's soft constraints. The default, and the faster one.
    Batch,
    /// MuJoCo, in a Python process of its own: an engine that others wrote, for comparison. The slowest one.
    Mujoco,
}

impl Engine {
    /// Returns the recommended rate of the physics [Hz] and number of solver iterations.
    ///
    /// Measured with `twinstep bench sim`; `docs/physics.md` contains the table and the reason.
    fn recommended(self) -> (u32, u32) {
        match self {
            Engine::Rapier => (200, 2),
            Engine::Batch => (1000, 4),
            // The time step of the comparisons in `docs/physics.md`. MuJoCo's Newton solver stops long before its limit.
            Engine::Mujoco => (1000, 64),
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
    /// A height field with random heights around the origin.
    Rough(RoughTerrain),
    /// A height field of level treads around the origin, with steps between them.
    Steps(StepTerrain),
    /// Patches of several kinds at several levels, through which robots advance.
    Course(CourseTerrain),
}

/// Rough terrain: heights at the corners of square cells, sampled uniformly from 0 to `height_m`.
///
/// Each cell is two triangles. The border of the height field and everything outside are the plane z = 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoughTerrain {
    /// Maximum height [m].
    pub height_m: f32,
    /// Side length of a cell [m].
    pub cell_m: f32,
    /// Side length of the height field [m], rounded to whole cells. Default: 40.
    #[serde(default = "RoughTerrain::default_size_m")]
    pub size_m: f32,
    /// Seed of the heights. Equal seeds give equal terrain, which all robots share.
    pub seed: u64,
}

impl RoughTerrain {
    fn default_size_m() -> f32 {
        40.0
    }

    /// Returns the number of cells along a side.
    fn cells(self) -> f32 {
        (self.size_m / self.cell_m).round()
    }

    fn check(self) -> Result<(), SimConfigError> {
        in_range("terrain.rough.height_m", self.height_m, [0.0, 0.3], || "0 to 0.3 m".to_owned())?;
        in_range("terrain.rough.cell_m", self.cell_m, [0.02, 10.0], || "0.02 to 10 m".to_owned())?;
        let allowed = || format!("2 to {MAX_CELLS} cells of {} m", self.cell_m);
        in_range("terrain.rough.size_m", self.cells(), [2.0, MAX_CELLS], allowed)
            .map_err(|error| SimConfigError { value: self.size_m.to_string(), ..error })
    }
}

/// Steps: level square treads, each at random at height 0 or `height_m`, so that every step is `height_m` high.
///
/// A face is not vertical: it rises within [`StepTerrain::FACE_M`], because the ground is a height field. The border of
/// the height field and everything outside are the plane z = 0.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepTerrain {
    /// Height of the steps [m].
    pub height_m: f32,
    /// Side length of a tread with the face to its neighbour [m], rounded to multiples of [`StepTerrain::FACE_M`].
    pub tread_m: f32,
    /// Side length of the height field [m], rounded to multiples of [`StepTerrain::FACE_M`]. Default: 20.
    #[serde(default = "StepTerrain::default_size_m")]
    pub size_m: f32,
    /// Seed of the heights. Equal seeds give equal terrain, which all robots share.
    pub seed: u64,
}

impl StepTerrain {
    /// Width of a face [m]: one cell of the height field.
    pub const FACE_M: f32 = 0.02;

    fn default_size_m() -> f32 {
        20.0
    }

    fn check(self) -> Result<(), SimConfigError> {
        in_range("terrain.steps.height_m", self.height_m, [0.0, 0.3], || "0 to 0.3 m".to_owned())?;
        in_range("terrain.steps.tread_m", self.tread_m, [0.1, 10.0], || "0.1 to 10 m".to_owned())?;
        in_range("terrain.steps.size_m", self.size_m, [1.0, 20.0], || "1 to 20 m".to_owned())
    }

    fn field(self) -> HeightField {
        let cells = |length_m: f32| (length_m / Self::FACE_M).round() as usize;
        let (tread, cells) = (cells(self.tread_m), cells(self.size_m));
        HeightField::random_steps(self.height_m, Self::FACE_M, tread, cells, self.seed).expect("the config was checked")
    }
}

impl Terrain {
    /// Builds the ground. A height field is sampled in each call, so build it once and share it.
    pub fn ground(self) -> Ground {
        match self {
            Terrain::Flat => Ground::FLAT,
            Terrain::SlopeRad(angle) => Ground { normal: [-angle.sin(), 0.0, angle.cos()], ..Ground::FLAT },
            Terrain::Rough(rough) => {
                let cells = (rough.cells() as usize).clamp(2, MAX_CELLS as usize);
                let field = HeightField::random_uniform(rough.height_m, rough.cell_m, cells, rough.seed);
                Ground { height_field: Some(field.expect("the config was checked").into()), ..Ground::FLAT }
            }
            Terrain::Steps(steps) => Ground { height_field: Some(steps.field().into()), ..Ground::FLAT },
            Terrain::Course(course) => course.ground(),
        }
    }
}

impl SimConfig {
    /// Returns the rate of the physics [Hz]; without a rate of its own, the engine's recommended rate.
    pub fn physics_hz(&self) -> u32 {
        self.physics_hz.unwrap_or(self.engine.recommended().0)
    }

    /// Returns the settings with a physics rate for actuators of this rate.
    ///
    /// Without a rate of its own the physics runs at the smallest multiple of the actuator rate that is not below the
    /// engine's recommended rate.
    #[must_use]
    pub fn at_actuator_rate(self, actuator_hz: f64) -> Self {
        let (actuator_hz, recommended) = (actuator_hz as u32, self.engine.recommended().0);
        let multiple = recommended.div_ceil(actuator_hz.max(1)) * actuator_hz;
        Self { physics_hz: Some(self.physics_hz.unwrap_or(multiple)), ..self }
    }

    /// Returns the number of solver iterations per physics step.
    pub fn solver_iterations(&self) -> u32 {
        self.solver_iterations.unwrap_or(self.engine.recommended().1)
    }

    /// Checks that every value is within its range for actuators of this rate [Hz].
    pub fn check(&self, actuator_hz: f64) -> Result<(), SimConfigError> {
        let physics_hz = self.at_actuator_rate(actuator_hz).physics_hz();
        let actuator_hz = actuator_hz as u32;
        let reject = |field, value: String, allowed: String| Err(SimConfigError { field, value, allowed });
        if !(actuator_hz..=20_000).contains(&physics_hz) || !physics_hz.is_multiple_of(actuator_hz) {
            let allowed = format!("a multiple of the actuator rate, {actuator_hz} Hz, up to 20000");
            return reject("physics_hz", physics_hz.to_string(), allowed);
        }
        if !(1..=64).contains(&self.solver_iterations()) {
            return reject("solver_iterations", self.solver_iterations().to_string(), "1 to 64".to_owned());
        }
        if self.threads > 1024 {
            return reject("threads", self.threads.to_string(), "0 (one per core) to 1024".to_owned());
        }
        match self.terrain {
            Terrain::SlopeRad(angle) if !(-1.0..=1.0).contains(&angle) => {
                reject("terrain.slope_rad", angle.to_string(), "-1 to 1 rad".to_owned())
            }
            Terrain::Rough(rough) => rough.check(),
            Terrain::Steps(steps) => steps.check(),
            Terrain::Course(course) => course.check(),
            Terrain::Flat | Terrain::SlopeRad(_) => Ok(()),
        }
    }

    /// Returns the number of physics steps per actuator period.
    pub fn steps_per_actuator_period(&self, actuator_hz: f64) -> usize {
        self.physics_hz() as usize / actuator_hz as usize
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::go2;

    use super::*;

    #[test]
    fn error_of_a_rate_that_is_not_a_multiple_lists_the_allowed_rates() {
        let config = SimConfig { physics_hz: Some(500), ..SimConfig::default() };
        let error = config.check(go2().control.actuator_hz).expect_err("error").to_string();
        assert_eq!(
            error,
            "`sim.physics_hz` = 500 is not allowed: a multiple of the actuator rate, 200 Hz, up to 20000"
        );
    }

    #[test]
    fn nan_slope_is_rejected() {
        let config = SimConfig { terrain: Terrain::SlopeRad(f32::NAN), ..SimConfig::default() };
        assert!(config.check(go2().control.actuator_hz).is_err());
    }

    const ROUGH: RoughTerrain = RoughTerrain { height_m: 0.05, cell_m: 0.25, size_m: 40.0, seed: 1 };

    fn read(text: &str) -> SimConfig {
        toml::from_str(text).expect("a `[sim]` table")
    }

    #[test]
    fn each_terrain_is_parsed() {
        assert_eq!(read("terrain = \"flat\"").terrain, Terrain::Flat);
        assert_eq!(read("terrain = { slope_rad = 0.1 }").terrain, Terrain::SlopeRad(0.1));
        let rough = "terrain = { rough = { height_m = 0.05, cell_m = 0.25, seed = 1 } }";
        assert_eq!(read(rough).terrain, Terrain::Rough(ROUGH));
        let sized = "terrain = { rough = { height_m = 0.05, cell_m = 0.25, size_m = 10.0, seed = 1 } }";
        assert_eq!(read(sized).terrain, Terrain::Rough(RoughTerrain { size_m: 10.0, ..ROUGH }));
    }

    #[test]
    fn error_of_an_unknown_key_of_rough_terrain_has_its_line_and_the_keys() {
        let error = toml::from_str::<SimConfig>("[terrain.rough]\nheight = 0.05\n").expect_err("error").to_string();
        assert!(error.contains("line 2") && error.contains("unknown field `height`"), "{error}");
        assert!(error.contains("`height_m`, `cell_m`, `size_m`, `seed`"), "{error}");
    }

    #[test]
    fn error_of_rough_terrain_outside_its_range_has_the_allowed_range() {
        let error = |rough| {
            let config = SimConfig { terrain: Terrain::Rough(rough), ..SimConfig::default() };
            config.check(go2().control.actuator_hz).expect_err("error").to_string()
        };
        let height = error(RoughTerrain { height_m: 0.5, ..ROUGH });
        assert_eq!(height, "`sim.terrain.rough.height_m` = 0.5 is not allowed: 0 to 0.3 m");
        let cell = error(RoughTerrain { cell_m: f32::NAN, ..ROUGH });
        assert_eq!(cell, "`sim.terrain.rough.cell_m` = NaN is not allowed: 0.02 to 10 m");
        let size = error(RoughTerrain { cell_m: 0.02, ..ROUGH });
        assert_eq!(size, "`sim.terrain.rough.size_m` = 40 is not allowed: 2 to 1024 cells of 0.02 m");
    }

    #[test]
    fn every_step_has_the_given_height_and_its_treads_are_level() {
        let steps = StepTerrain { height_m: 0.03, tread_m: 0.3, size_m: 6.0, seed: 1 };
        let ground = Terrain::Steps(steps).ground();
        let at = |tread: usize, part: f32| -3.0 + 0.3 * (tread as f32 + part);
        let heights: Vec<f32> = (1..19).map(|tread| ground.height(at(tread, 0.5), 0.15)).collect();
        assert!(heights.contains(&0.0) && heights.contains(&0.03), "{heights:?}");
        for (tread, height) in (1..19).zip(heights) {
            assert!(height == 0.0 || height == 0.03, "{height}");
            for part in [0.02, 0.3, 0.9] {
                assert_eq!(ground.height(at(tread, part), 0.15), height, "tread {tread} at {part}");
            }
        }
        assert_eq!(ground.height(3.5, 0.15), 0.0);
    }

    #[test]
    fn error_of_steps_outside_their_range_has_the_allowed_range() {
        let error = |text: &str| read(text).check(go2().control.actuator_hz).expect_err("invalid").to_string();
        let high = error("terrain = { steps = { height_m = 0.4, tread_m = 0.3, seed = 1 } }");
        assert_eq!(high, "`sim.terrain.steps.height_m` = 0.4 is not allowed: 0 to 0.3 m");
        let short = error("terrain = { steps = { height_m = 0.1, tread_m = nan, seed = 1 } }");
        assert_eq!(short, "`sim.terrain.steps.tread_m` = NaN is not allowed: 0.1 to 10 m");
        let large = error("terrain = { steps = { height_m = 0.1, tread_m = 0.3, size_m = 21, seed = 1 } }");
        assert_eq!(large, "`sim.terrain.steps.size_m` = 21 is not allowed: 1 to 20 m");
    }

    #[test]
    fn each_engine_has_a_default_rate() {
        assert_eq!((read("").physics_hz(), read("").solver_iterations()), (1000, 4));
        let rapier = read("engine = \"rapier\"");
        assert_eq!((rapier.physics_hz(), rapier.solver_iterations()), (200, 2));
        assert_eq!(read("engine = \"rapier\"\nphysics_hz = 400").physics_hz(), 400);
        assert_eq!(read("engine = \"mujoco\"").physics_hz(), 1000);
    }
}
