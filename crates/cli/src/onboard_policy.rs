//! A policy that runs next to the control loop, so that no network can make it late.

use std::path::Path;
use std::thread::JoinHandle;
use std::time::Duration;

use twinstep_agent::{BoundPolicy, Control, LoadedPolicy, Recorders, RunPlan, Status, WantedCommands, run};
use twinstep_env_server::EnvFactory;
use twinstep_model::{AutoresetMode, VecEnv};
use twinstep_robot::{RobotHandle, State};

use crate::exit::{Failure, input, other};
use crate::robot_env_factory::RobotEnvFactory;

/// Time after which the end of the process is looked for.
const PATIENCE: Duration = Duration::from_millis(100);

/// The thread of the policy.
pub struct OnboardPolicy(JoinHandle<()>);

impl OnboardPolicy {
    /// Compares the policy with the robot and starts to run it whenever the robot is ready.
    pub fn start(path: &Path, mapping: Option<&Path>, factory: &RobotEnvFactory) -> Result<Self, Failure> {
        // A run has no time limit, and begins its episodes itself.
        let env = factory.build(1, AutoresetMode::Disabled, Some(u32::MAX)).map_err(input)?;
        let policy = LoadedPolicy::read(path, mapping).map_err(input)?.bind(env.spec()).map_err(input)?;
        let handle = factory.handle.clone();
        let thread = std::thread::Builder::new().name("policy".to_owned());
        Ok(Self(thread.spawn(move || run_when_ready(env, policy, &handle)).map_err(other)?))
    }

    /// Waits for the end of the thread, which comes after [`RobotHandle::end`].
    pub fn join(self) {
        let _ = self.0.join();
    }
}

fn run_when_ready(mut env: Box<dyn VecEnv>, mut policy: BoundPolicy, handle: &RobotHandle) {
    let plan = RunPlan { seconds: None, real_time: false, action_noise: 0.0, seed: 0, goes_on: false };
    while !handle.is_ending() {
        if handle.wait_until(PATIENCE, |board| board.state == Some(State::Ready)).state != Some(State::Ready) {
            continue;
        }
        let mut control = |_: &Status, _: &dyn VecEnv| {
            if handle.is_ending() { Control::End } else { Control::Step(WantedCommands::default()) }
        };
        if let Err(error) = run(&mut *env, &mut policy, Recorders::default(), plan, &mut control) {
            tracing::warn!("the policy stopped: {error}");
        }
    }
}
