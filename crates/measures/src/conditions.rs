//! Robots, grounds and disturbances under which a policy is judged.

use twinstep_envs::{ObservationNoise, Randomisation};
use twinstep_sim::{Engine, RoughTerrain, StepTerrain, Terrain};

/// Names of the conditions.
pub const CONDITION_NAMES: [&str; 8] = ["nominal", "robots", "pushes", "noise", "ground", "steps", "delay", "robust"];

/// What the robots are like in an evaluation.
#[derive(Clone, Copy, Debug)]
pub struct Condition {
    /// Name in tables.
    pub name: &'static str,
    /// Physics engine.
    pub engine: Engine,
    /// Robots, noise, delays and pushes.
    pub randomise: Randomisation,
    /// Ground.
    pub terrain: Terrain,
}

/// Returns all conditions in one engine. Without an engine it is the batch engine, and the nominal robot is also simulated in rapier, which
/// no policy is trained in.
pub fn conditions(engine: Option<Engine>) -> Vec<Condition> {
    let first = engine.unwrap_or(Engine::Batch);
    let calm = Randomisation::default();
    let condition = |name, randomise| Condition { name, engine: first, randomise, terrain: Terrain::Flat };
    let robots = Randomisation {
        mass_scale: [0.85, 1.15],
        // The nominal coefficient of friction is 0.8.
        friction_scale: [0.4 / 0.8, 1.25 / 0.8],
        kp_scale: [0.9, 1.1],
        kd_scale: [0.9, 1.1],
        ..calm
    };
    let push_m_s = [0.5, 0.5];
    let noise = ObservationNoise {
        angular_velocity_rad_s: 0.2,
        gravity: 0.05,
        joint_position_rad: 0.01,
        joint_velocity_rad_s: 1.5,
        ..ObservationNoise::default()
    };
    let mut conditions = vec![
        condition("nominal", calm),
        condition("robots", robots),
        condition("pushes", Randomisation { push_m_s, ..calm }),
        condition("noise", Randomisation { noise, ..calm }),
    ];
    if engine.is_none() {
        conditions.insert(1, Condition { engine: Engine::Rapier, ..condition("nominal", calm) });
    }
    let ground = Terrain::Rough(RoughTerrain { height_m: 0.03, cell_m: 0.3, size_m: 40.0, seed: 1 });
    let steps = Terrain::Steps(StepTerrain { height_m: 0.03, tread_m: 0.3, size_m: 20.0, seed: 1 });
    let command_delay_ms = [0.0, 20.0];
    let robust = Randomisation { push_m_s, command_delay_ms, ..robots };
    conditions.extend([
        Condition { terrain: ground, ..condition("ground", calm) },
        Condition { terrain: steps, ..condition("steps", calm) },
        condition("delay", Randomisation { command_delay_ms, ..calm }),
        Condition { terrain: steps, ..condition("robust", robust) },
    ]);
    conditions
}
