//! Checks of the agent's actions and commands: bounds of the commands are those of the observation's entries.

use crate::{EnvError, EnvSpec, GaitCommand, VelocityCommand};

/// Name of the velocity command in the observation.
const VELOCITY_COMMAND: &str = "velocity_command";
/// Names and sizes of the parts of a gait command in the observation.
const GAIT_COMMAND: [(&str, usize); 2] = [("step_frequency", 1), ("phase_offset", 3)];

impl EnvSpec {
    /// Checks that there is a finite action for each of `num_envs` environments.
    pub fn check_actions(&self, actions: &[f32], num_envs: usize) -> Result<(), EnvError> {
        let (action_len, given) = (self.action_len(), actions.len());
        let expected = num_envs * action_len;
        if given != expected {
            return Err(EnvError::WrongLength { field: "actions", given, expected });
        }
        // One branch-free pass over all actions, which the compiler vectorises. The index is searched only on failure.
        if !actions.iter().fold(true, |finite, value| finite & value.is_finite()) {
            let index = actions.iter().position(|value| !value.is_finite()).unwrap_or_default();
            let entry = self.action_entry(index % action_len);
            return Err(EnvError::ActionNotFinite { env: index / action_len, entry, value: actions[index] });
        }
        Ok(())
    }

    /// Checks velocity commands, one per environment, against the bounds of `velocity_command`.
    pub fn check_velocity_commands(&self, commands: &[VelocityCommand], num_envs: usize) -> Result<(), EnvError> {
        match self.bounds(&[(VELOCITY_COMMAND, 3)]) {
            Some(bounds) => check(commands, num_envs, "command", &bounds),
            None => Err(EnvError::NoVelocityCommand { task: self.task.clone() }),
        }
    }

    /// Checks gait commands, one per environment, against the bounds of `step_frequency` and `phase_offset`.
    pub fn check_gait_commands(&self, commands: &[GaitCommand], num_envs: usize) -> Result<(), EnvError> {
        match self.bounds(&GAIT_COMMAND) {
            Some(bounds) => check(commands, num_envs, "gait_command", &bounds),
            None => Err(EnvError::NoGaitCommand { task: self.task.clone() }),
        }
    }

    /// Returns name and bounds of each entry of these parts of the observation; `None` if one is missing.
    fn bounds(&self, parts: &[(&str, usize)]) -> Option<Vec<(String, [f32; 2])>> {
        let mut bounds = Vec::new();
        for (name, size) in parts {
            let (_, field) = self.observation_field(name).filter(|(_, field)| field.size == *size)?;
            let entry = |index: usize| if *size == 1 { (*name).to_owned() } else { format!("{name}[{index}]") };
            bounds.extend((0..*size).map(|index| (entry(index), [field.low, field.high])));
        }
        Some(bounds)
    }
}

fn check<const N: usize>(
    commands: &[[f32; N]],
    num_envs: usize,
    field: &'static str,
    bounds: &[(String, [f32; 2])],
) -> Result<(), EnvError> {
    if commands.len() != num_envs {
        return Err(EnvError::WrongLength { field, given: N * commands.len(), expected: N * num_envs });
    }
    for (env, command) in commands.iter().enumerate() {
        for (&value, (entry, [low, high])) in command.iter().zip(bounds) {
            if !(*low..=*high).contains(&value) {
                let (entry, low, high) = (entry.clone(), *low, *high);
                return Err(EnvError::CommandOutOfRange { field, env, entry, value, low, high });
            }
        }
    }
    Ok(())
}
