//! Commands of the agent in place of the task's own.

/// Velocity command: forward [m/s], left [m/s], yaw rate [rad/s].
pub type VelocityCommand = [f32; 3];
/// Gait command: step frequency [Hz], phases of FR, RL and RR relative to FL [cycles].
pub type GaitCommand = [f32; 4];

/// Commands of the agent, one of each kind per environment; `None` while the task has its own.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AgentCommands {
    /// Velocity commands.
    pub velocity: Option<Vec<VelocityCommand>>,
    /// Gait commands.
    pub gait: Option<Vec<GaitCommand>>,
}

impl AgentCommands {
    /// Replaces the commands that `newer` has.
    pub fn update(&mut self, newer: Self) {
        self.velocity = newer.velocity.or(self.velocity.take());
        self.gait = newer.gait.or(self.gait.take());
    }
}
