//! Groups of environments whose steps are in progress at the same time.

use std::ops::Range;

use twinstep_model::{
    AutoresetMode, EnvError, EnvSpec, GaitCommand, ResetRequest, RobotSample, Scene, StepBatch, VecEnv, VelocityCommand,
};

use twinstep_protocol::random_u64;

use crate::merge::{copy_rows, merge};
use crate::{ClientError, ConnectOptions, RemoteVecEnv};

/// Environments on a server, in groups with a lease each. Several groups step while the agent computes actions.
///
/// As a [`VecEnv`] it steps all groups together. An agent whose own computation takes time steps them one by one:
///
/// ```no_run
/// # use twinstep_client::{ConnectOptions, GroupedVecEnv};
/// # use twinstep_model::{ResetRequest, VecEnv};
/// # fn policy(obs: &[f32]) -> Vec<f32> { vec![0.0; obs.len() / 45 * 12] }
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let mut env = GroupedVecEnv::connect(&ConnectOptions::new("tcp/127.0.0.1:7447", 192), 3)?;
/// let obs = env.reset(&ResetRequest::seeded(1, 192))?.to_vec();
/// for group in 0..env.num_groups() {
///     let rows = env.obs_range(group);
///     env.send(group, &policy(&obs[rows]))?;
/// }
/// for step in 0..3000 {
///     let group = step % env.num_groups();
///     let actions = policy(&env.recv(group)?.obs);
///     // The other groups step meanwhile.
///     env.send(group, &actions)?;
/// }
/// # Ok(())
/// # }
/// ```
///
/// Environment `i` is the same robot for any number of groups.
pub struct GroupedVecEnv {
    groups: Vec<RemoteVecEnv>,
    /// First environment of each group.
    first: Vec<usize>,
    batch: StepBatch,
    /// True after the first reset.
    has_seeds: bool,
}

impl GroupedVecEnv {
    /// Leases `options.num_envs` environments in `groups` groups, which differ by at most one environment.
    ///
    /// Fails with [`ClientError::Groups`] unless there are 1 to `num_envs` groups.
    pub fn connect(options: &ConnectOptions, groups: usize) -> Result<Self, ClientError> {
        let num_envs = options.num_envs;
        if groups == 0 || groups > num_envs {
            return Err(ClientError::Groups { groups, num_envs });
        }
        let first: Vec<usize> = (0..groups).map(|group| group * num_envs / groups).collect();
        let size = |group: usize| first.get(group + 1).unwrap_or(&num_envs) - first[group];
        let mut options = options.clone();
        let mut leases = Vec::new();
        for group in 0..groups {
            let env = RemoteVecEnv::connect(&ConnectOptions { num_envs: size(group), ..options.clone() })?;
            // All groups are at one server.
            options.server_id = Some(env.server_id().to_owned());
            leases.push(env);
        }
        let batch = StepBatch::new(num_envs, leases[0].spec());
        Ok(Self { batch, groups: leases, first, has_seeds: false })
    }

    /// Returns the number of groups.
    pub fn num_groups(&self) -> usize {
        self.groups.len()
    }

    /// Returns the environments of a group.
    pub fn range(&self, group: usize) -> Range<usize> {
        self.first[group]..self.first[group] + self.groups[group].num_envs()
    }

    /// Returns where the observations of a group are in those of all environments.
    pub fn obs_range(&self, group: usize) -> Range<usize> {
        let (range, obs_len) = (self.range(group), self.spec().obs_len());
        range.start * obs_len..range.end * obs_len
    }

    /// Sends the actions of a group without waiting. Call [`GroupedVecEnv::recv`] of the group next.
    ///
    /// Panics if there is no such group.
    pub fn send(&mut self, group: usize, actions: &[f32]) -> Result<(), EnvError> {
        self.groups[group].send(actions)
    }

    /// Waits for the result of the actions of a group. [`RemoteVecEnv::recv`] says what may follow an error.
    pub fn recv(&mut self, group: usize) -> Result<&StepBatch, EnvError> {
        self.groups[group].recv()
    }

    /// Ends the leases at once.
    pub fn close(self) -> Result<(), ClientError> {
        // Every lease is closed; the first error is returned.
        self.groups.into_iter().map(RemoteVecEnv::close).fold(Ok(()), Result::and)
    }
}

impl VecEnv for GroupedVecEnv {
    fn spec(&self) -> &EnvSpec {
        self.groups[0].spec()
    }

    fn num_envs(&self) -> usize {
        self.batch.reward.len()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.groups[0].autoreset()
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        request.check(self.num_envs())?;
        // Without seeds every lease has the same random streams, and the groups would be copies of each other.
        let random = || ResetRequest::seeded(random_u64(), self.num_envs()).seeds;
        let all_seeds = request.seeds.clone().or_else(|| (!self.has_seeds).then(random).flatten());
        for group in 0..self.groups.len() {
            let range = self.range(group);
            let seeds = all_seeds.as_ref().map(|seeds| seeds[range.clone()].to_vec());
            let mask = request.mask.as_ref().map(|mask| mask[range.clone()].to_vec());
            let env = &mut self.groups[group];
            let obs = env.reset(&ResetRequest { seeds, mask })?;
            copy_rows(&mut self.batch.obs, range.start, obs, range.len());
            copy_rows(&mut self.batch.critic_obs, range.start, env.critic_obs(), range.len());
        }
        self.has_seeds |= request.mask.is_none();
        Ok(&self.batch.obs)
    }

    fn obs(&self) -> &[f32] {
        &self.batch.obs
    }

    fn critic_obs(&self) -> &[f32] {
        &self.batch.critic_obs
    }

    fn set_velocity_commands(&mut self, commands: &[VelocityCommand]) -> Result<(), EnvError> {
        self.spec().check_velocity_commands(commands, self.num_envs())?;
        for group in 0..self.groups.len() {
            let range = self.range(group);
            self.groups[group].set_velocity_commands(&commands[range])?;
        }
        Ok(())
    }

    fn set_gait_commands(&mut self, commands: &[GaitCommand]) -> Result<(), EnvError> {
        self.spec().check_gait_commands(commands, self.num_envs())?;
        for group in 0..self.groups.len() {
            let range = self.range(group);
            self.groups[group].set_gait_commands(&commands[range])?;
        }
        Ok(())
    }

    /// Steps all groups. After an error some groups have stepped and others have not: reset all.
    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        let action_len = self.spec().action_len();
        let expected = self.num_envs() * action_len;
        if actions.len() != expected {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), expected });
        }
        for group in 0..self.groups.len() {
            let range = self.range(group);
            self.groups[group].send(&actions[range.start * action_len..range.end * action_len])?;
        }
        self.batch.ended.clear();
        for (group, &first) in self.groups.iter_mut().zip(&self.first) {
            merge(&mut self.batch, group.recv()?, first);
        }
        Ok(&self.batch)
    }

    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let group = self.first.partition_point(|first| *first <= env) - 1;
        self.groups[group].scene(env - self.first[group])
    }

    fn samples(&mut self, env: usize) -> Result<Vec<RobotSample>, EnvError> {
        let group = self.first.partition_point(|first| *first <= env) - 1;
        self.groups[group].samples(env - self.first[group])
    }
}
