//! Runs an imported policy in simulation: whether a mapping is right shows in what the robot does.

use std::path::Path;

use twinstep_agent::{
    Control, LoadedPolicy, Mapping, OnnxNetwork, Recorders, RunPlan, RunSummary, WantedCommands, contract_of_mapping,
    run,
};
use twinstep_env_server::{Config, EnvFactory, ServerConfig, SimEnvFactory};
use twinstep_model::AutoresetMode;
use twinstep_sim::SimConfig;

/// Time of each command [s].
const SECONDS: f64 = 3.0;
/// Forward velocity [m/s] and yaw rate [rad/s] that are commanded, one after the other.
const FORWARD: f32 = 0.5;
const TURN: f32 = 0.5;
/// Largest error of a policy that walks [m/s, rad/s]. The mean contains the start from a stand.
const MAX_ERROR: f64 = 0.25;

/// What a robot did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rehearsal {
    /// Mean forward velocity under a command forward [m/s].
    forward: f64,
    /// Mean yaw rate under a command to turn [rad/s].
    turn: f64,
    /// Root mean square errors of the horizontal velocity [m/s] and the yaw rate [rad/s] under both commands, added up.
    error: f64,
    /// Number of falls.
    falls: u64,
    /// Share of the entries of actions that were clipped.
    clipped: f64,
}

impl Rehearsal {
    /// Runs a network with the text of its mapping on a simulated Go2 with the gains of the mapping.
    pub fn of(network: &Path, mapping: &str) -> Result<Self, String> {
        let network = OnnxNetwork::read(network).map_err(|error| error.to_string())?;
        let mapping = Mapping::parse(mapping)?;
        let config = Config {
            server: ServerConfig::default(),
            sim: SimConfig { threads: 1, ..SimConfig::default() },
            control: Some(contract_of_mapping(&mapping)?),
            ..Config::default()
        };
        let factory = SimEnvFactory::new(config).map_err(|error| error.to_string())?;
        let under = |velocity: [f32; 3]| -> Result<RunSummary, String> {
            let mut env = factory.build(1, AutoresetMode::Disabled, None).map_err(|error| error.to_string())?;
            let policy = LoadedPolicy::mapped(network.clone(), mapping.clone());
            let mut policy = policy.bind(env.spec()).map_err(|error| error.to_string())?;
            let plan = RunPlan { seconds: Some(SECONDS), real_time: false, action_noise: 0.0, seed: 1, goes_on: false };
            let step = Control::Step(WantedCommands::velocity(Some(velocity)));
            run(env.as_mut(), &mut policy, Recorders::default(), plan, &mut |_, _| step)
                .map_err(|error| error.to_string())
        };
        let (forward, turn) = (under([FORWARD, 0.0, 0.0])?, under([0.0, 0.0, TURN])?);
        Ok(Self {
            forward: forward.mean_velocity.map_or(f64::NAN, |velocity| velocity[0]),
            turn: turn.mean_velocity.map_or(f64::NAN, |velocity| velocity[2]),
            error: [&forward, &turn].iter().flat_map(|one| [one.velocity_rms, one.yaw_rate_rms]).flatten().sum(),
            falls: forward.falls + turn.falls,
            clipped: f64::midpoint(forward.clipped_share, turn.clipped_share),
        })
    }

    /// Returns the size of the errors.
    pub fn error(&self) -> f64 {
        self.error
    }

    /// Returns true if the robot does what is commanded.
    pub fn walks(&self) -> bool {
        let errors = [self.forward - f64::from(FORWARD), self.turn - f64::from(TURN)];
        self.falls == 0 && errors.iter().all(|error| error.abs() <= MAX_ERROR)
    }
}

impl std::fmt::Display for Rehearsal {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { forward, turn, falls, clipped, .. } = self;
        let falls = match falls {
            0 => "no fall".to_owned(),
            1 => "1 fall".to_owned(),
            falls => format!("{falls} falls"),
        };
        let clipped =
            if *clipped > 0.001 { format!(", {:.1} % of actions clipped", 100.0 * clipped) } else { String::new() };
        write!(
            formatter,
            "in simulation {forward:.2} m/s for a command of {FORWARD}, {turn:.2} rad/s for {TURN}, {falls}{clipped}"
        )
    }
}
