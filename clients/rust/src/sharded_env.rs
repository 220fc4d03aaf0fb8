//! Environments on several servers, with the interface of a lease on one server.

use std::time::{Duration, Instant};

use twinstep_model::{
    AgentCommands, AutoresetMode, EndedEpisode, EnvError, EnvSpec, GaitCommand, ResetRequest, Scene, StepBatch, VecEnv,
    VelocityCommand,
};
use twinstep_protocol::random_u64;

use crate::merge::{copy_rows, merge};
use crate::recovery::recovery_seed;
use crate::shard::Shard;
use crate::{ClientError, ConnectOptions};

/// Pause between two looks for a new lease while no server is left.
const WAIT_PERIOD: Duration = Duration::from_millis(20);

/// Environments that are divided evenly among several servers.
///
/// Row i with a seed is the same robot on any number of servers. A step is sent to all servers before the first reply is
/// awaited.
///
/// A server that is lost, or fails to execute a request, costs only its own rows. In that step they are `truncated` with
/// reward 0 and their last observation; their entries in `ended` have no reward terms, and [`ShardedVecEnv::lost`] names
/// them. After it they are held: their actions are ignored, and they return reward 0 and the last observation. Meanwhile a
/// thread requests a lease at the same server, then at the others, until one has room for all rows of the lost server. Then
/// each row starts a new episode with a seed that follows from its first seed, and returns the first observation, in every
/// autoreset mode. [`ShardedVecEnv::held`] is true in all these steps, also in the last: their transitions are no
/// experience. The rows stay on the new server.
pub struct ShardedVecEnv {
    options: ConnectOptions,
    shards: Vec<Shard>,
    spec: EnvSpec,
    batch: StepBatch,
    commands: AgentCommands,
    rows: Vec<Row>,
    held: Vec<bool>,
}

/// What is known of one environment, independent of its server.
#[derive(Clone, Debug)]
struct Row {
    seed: u64,
    /// True until an episode has started with the seed.
    seed_is_unused: bool,
    /// True from the start of an episode; without autoreset to its end.
    has_episode: bool,
    /// Policy steps of the episode; −1 if the next step only starts it.
    length: i64,
    episode_return: f32,
    /// Number of times that its server was lost.
    losses: u64,
    /// True from the loss of its server to the step that reports it.
    is_lost: bool,
}

impl ShardedVecEnv {
    /// Leases `options.num_envs` environments, divided among the servers at `endpoints`, which replace that of the options.
    ///
    /// An endpoint may be given several times: behind a router each lease is at the server with the most free environments.
    pub fn connect(options: &ConnectOptions, endpoints: &[String]) -> Result<Self, ClientError> {
        let (num_envs, servers) = (options.num_envs, endpoints.len());
        if servers == 0 || servers > num_envs {
            return Err(ClientError::Servers { servers, num_envs });
        }
        let at = |endpoint: &String| ConnectOptions { endpoint: endpoint.clone(), ..options.clone() };
        let mut shards: Vec<Shard> = Vec::new();
        for server in 0..servers {
            let rows = server * num_envs / servers..(server + 1) * num_envs / servers;
            let others = (0..servers).filter(|other| *other != server).map(|other| at(&endpoints[other]));
            let shard = Shard::connect(rows, std::iter::once(at(&endpoints[server])).chain(others).collect())?;
            let spec = |shard: &Shard| shard.env().map(|env| env.spec().clone());
            if let Some(first) = shards.first().filter(|first| spec(first) != spec(&shard)) {
                let endpoints = [first, &shard].map(|shard| shard.endpoint().to_owned());
                return Err(ClientError::OtherSpec { endpoints });
            }
            shards.push(shard);
        }
        let spec = shards[0].env().expect("it was leased").spec().clone();
        // Servers may have equal random streams for environments that a client does not seed.
        let row = || Row {
            seed: random_u64(),
            seed_is_unused: true,
            has_episode: false,
            length: 0,
            episode_return: 0.0,
            losses: 0,
            is_lost: false,
        };
        Ok(Self {
            batch: StepBatch::new(num_envs, &spec),
            rows: (0..num_envs).map(|_| row()).collect(),
            held: vec![false; num_envs],
            options: options.clone(),
            commands: AgentCommands::default(),
            shards,
            spec,
        })
    }

    /// Returns which environments were not stepped in the last step: one entry per environment.
    pub fn held(&self) -> &[bool] {
        &self.held
    }

    /// Returns the environments whose server was lost in the last step.
    pub fn lost(&self) -> Vec<usize> {
        let lost = |episode: &EndedEpisode| self.held[episode.env];
        self.batch.ended.iter().filter(|episode| lost(episode)).map(|episode| episode.env).collect()
    }

    /// Ends all leases at once.
    pub fn close(self) -> Result<(), ClientError> {
        // Every lease is closed; the first error is returned.
        self.shards.into_iter().map(Shard::close).fold(Ok(()), Result::and)
    }

    /// Fails if an action is not finite, or an environment that has a server has no episode.
    fn check_step(&self, actions: &[f32]) -> Result<(), EnvError> {
        let action_len = self.spec.action_len();
        let expected = self.rows.len() * action_len;
        if actions.len() != expected {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), expected });
        }
        if let Some(index) = actions.iter().position(|action| !action.is_finite()) {
            let (env, entry) = (index / action_len, self.spec.action_entry(index % action_len));
            return Err(EnvError::ActionNotFinite { env, entry, value: actions[index] });
        }
        let mut on_server =
            self.shards.iter().filter(|shard| shard.env().is_some()).flat_map(|shard| shard.rows.clone());
        on_server.find(|row| !self.rows[*row].has_episode).map_or(Ok(()), |env| Err(EnvError::NeedsReset { env }))
    }

    /// Sends a step to a shard.
    fn send(&mut self, shard: usize, actions: &[f32]) -> Result<(), EnvError> {
        let (rows, action_len) = (self.shards[shard].rows.clone(), self.spec.action_len());
        let (velocity, gait) = (self.commands.velocity.as_ref(), self.commands.gait.as_ref());
        let velocity = velocity.map(|commands| &commands[rows.clone()]);
        let gait = gait.map(|commands| &commands[rows.clone()]);
        let Some(env) = self.shards[shard].env_mut() else { return Ok(()) };
        // Another server may have taken over the environments since they were set.
        let sent = velocity.map_or(Ok(()), |commands| env.set_velocity_commands(commands));
        let sent = sent.and_then(|()| gait.map_or(Ok(()), |commands| env.set_gait_commands(commands)));
        let sent = sent.and_then(|()| env.send(&actions[rows.start * action_len..rows.end * action_len]));
        sent.or_else(|error| self.lose(shard, &error))
    }

    /// Waits for the step of a shard, if one was sent, and copies it into the batch.
    fn receive(&mut self, shard: usize, sent: Instant) -> Result<(), EnvError> {
        let rows = self.shards[shard].rows.clone();
        match self.shards[shard].receive(sent) {
            Ok(None) => {}
            Ok(Some(step)) => {
                merge(&mut self.batch, step, rows.start);
                self.held[rows].fill(false);
            }
            Err(error) => self.lose(shard, &error)?,
        }
        Ok(())
    }

    /// Starts to search for a new lease for the rows of a shard.
    fn lose(&mut self, shard: usize, error: &EnvError) -> Result<(), EnvError> {
        let rows = self.shards[shard].rows.clone();
        let (endpoint, num_envs) = (self.shards[shard].endpoint(), rows.len());
        tracing::warn!(endpoint, num_envs, %error, "robots lost, and held until a server has leased them again");
        for row in &mut self.rows[rows] {
            (row.is_lost, row.losses) = (true, row.losses + 1);
        }
        self.shards[shard].lose()
    }

    /// Starts the chosen episodes of a shard. Returns false if its server was lost.
    fn reset_shard(&mut self, shard: usize, is_chosen: impl Fn(usize) -> bool) -> Result<bool, EnvError> {
        let rows = self.shards[shard].rows.clone();
        let chosen: Vec<bool> = rows.clone().map(is_chosen).collect();
        let (seeds, is_unused): (Vec<u64>, Vec<bool>) =
            self.rows[rows.clone()].iter().map(|row| (row.seed, row.seed_is_unused)).unzip();
        if let Err(error) = self.shards[shard].reset(&chosen, &seeds, &is_unused) {
            return self.lose(shard, &error).map(|()| false);
        }
        let Some(env) = self.shards[shard].env() else { return Ok(false) };
        copy_rows(&mut self.batch.obs, rows.start, env.obs(), rows.len());
        copy_rows(&mut self.batch.critic_obs, rows.start, env.critic_obs(), rows.len());
        for row in rows.clone().filter(|row| chosen[row - rows.start]) {
            let Row { seed, losses, .. } = self.rows[row];
            self.rows[row] = Row {
                seed,
                losses,
                seed_is_unused: false,
                has_episode: true,
                length: 0,
                episode_return: 0.0,
                is_lost: false,
            };
        }
        Ok(true)
    }

    /// Starts episodes on a new lease of a lost shard, if one has been granted. Returns true if they have started.
    fn take_over(&mut self, shard: usize) -> Result<bool, EnvError> {
        if !self.shards[shard].take_over(&self.spec)? {
            return Ok(false);
        }
        for row in &mut self.rows[self.shards[shard].rows.clone()] {
            if !row.seed_is_unused {
                (row.seed, row.seed_is_unused) = (recovery_seed(row.seed, row.losses), true);
            }
        }
        let rows = self.shards[shard].rows.clone();
        tracing::info!(num_envs = rows.len(), first = rows.start, "robots leased again");
        let was_lost = self.rows[rows.start].is_lost;
        let has_started = self.reset_shard(shard, |_| true)?;
        if !has_started {
            // There is no new episode that could be truncated.
            self.rows[rows].iter_mut().for_each(|row| row.is_lost = was_lost);
        }
        Ok(has_started)
    }

    fn has_server(&self) -> bool {
        self.shards.iter().any(|shard| shard.env().is_some())
    }

    /// Starts episodes on all new leases. Returns the shards that they belong to.
    ///
    /// If no server is left, waits for a new lease, at most as long as connecting may take.
    fn recover(&mut self) -> Result<Vec<usize>, EnvError> {
        let since = Instant::now();
        loop {
            let mut started = Vec::new();
            for shard in 0..self.shards.len() {
                if self.take_over(shard)? {
                    started.push(shard);
                }
            }
            if self.has_server() {
                return Ok(started);
            }
            if since.elapsed() >= self.options.connect_timeout {
                let waited_s = since.elapsed().as_secs_f64();
                return Err(EnvError::Remote(Box::new(ClientError::NoServerLeft { waited_s })));
            }
            std::thread::sleep(WAIT_PERIOD);
        }
    }

    /// Ends the episodes of lost environments, and counts the steps of the others.
    fn end_step(&mut self) {
        let autoreset = self.options.autoreset;
        let has_final_obs = autoreset == AutoresetMode::SameStep;
        let row_of = |values: &[f32], env: usize, len: usize| {
            if has_final_obs { values[env * len..(env + 1) * len].to_vec() } else { Vec::new() }
        };
        for (env, row) in self.rows.iter_mut().enumerate() {
            if row.is_lost {
                self.batch.truncated[env] = true;
                self.batch.ended.push(EndedEpisode {
                    env,
                    length: row.length.max(0) as u32,
                    episode_return: row.episode_return,
                    final_obs: row_of(&self.batch.obs, env, self.spec.obs_len()),
                    final_critic_obs: row_of(&self.batch.critic_obs, env, self.spec.critic_obs_len()),
                    ..EndedEpisode::default()
                });
                row.is_lost = false;
            } else if !self.held[env] {
                (row.length, row.episode_return) = (row.length + 1, row.episode_return + self.batch.reward[env]);
            }
        }
        self.batch.ended.sort_by_key(|episode| episode.env);
        for episode in &self.batch.ended {
            let row = &mut self.rows[episode.env];
            row.length = if autoreset == AutoresetMode::NextStep { -1 } else { 0 };
            row.episode_return = 0.0;
            row.has_episode = autoreset != AutoresetMode::Disabled;
        }
    }
}

impl VecEnv for ShardedVecEnv {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.rows.len()
    }

    fn autoreset(&self) -> AutoresetMode {
        self.options.autoreset
    }

    /// Environments without a server start their episode when they have one, with the seed that is given here.
    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        request.check(self.num_envs())?;
        if let Some(seeds) = &request.seeds {
            for (env, row) in self.rows.iter_mut().enumerate().filter(|(env, _)| request.selects(*env)) {
                (row.seed, row.seed_is_unused) = (seeds[env], true);
            }
        }
        let started = self.recover()?;
        for shard in (0..self.shards.len()).filter(|shard| !started.contains(shard)) {
            let is_selected = self.shards[shard].rows.clone().any(|env| request.selects(env));
            if self.shards[shard].env().is_some() && is_selected {
                self.reset_shard(shard, |env| request.selects(env))?;
            }
        }
        Ok(&self.batch.obs)
    }

    fn obs(&self) -> &[f32] {
        &self.batch.obs
    }

    fn critic_obs(&self) -> &[f32] {
        &self.batch.critic_obs
    }

    fn set_velocity_commands(&mut self, commands: &[VelocityCommand]) -> Result<(), EnvError> {
        self.spec.check_velocity_commands(commands, self.num_envs())?;
        self.commands.velocity = Some(commands.to_vec());
        Ok(())
    }

    fn set_gait_commands(&mut self, commands: &[GaitCommand]) -> Result<(), EnvError> {
        self.spec.check_gait_commands(commands, self.num_envs())?;
        self.commands.gait = Some(commands.to_vec());
        Ok(())
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        self.check_step(actions)?;
        // These start an episode in this step, and get no action.
        let started = if self.has_server() { Vec::new() } else { self.recover()? };
        let sent = Instant::now();
        for shard in (0..self.shards.len()).filter(|shard| !started.contains(shard)) {
            self.send(shard, actions)?;
        }
        // While the others are stepped. A loss is reported before the next episode starts.
        for shard in 0..self.shards.len() {
            if !self.rows[self.shards[shard].rows.start].is_lost {
                self.take_over(shard)?;
            }
        }
        self.batch.ended.clear();
        self.batch.reward.fill(0.0);
        self.batch.terminated.fill(false);
        self.batch.truncated.fill(false);
        self.held.fill(true);
        for shard in 0..self.shards.len() {
            self.receive(shard, sent)?;
        }
        self.end_step();
        Ok(&self.batch)
    }

    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        let num_envs = self.num_envs();
        let shard = self.shards.iter().find(|shard| shard.rows.contains(&env));
        let shard = shard.ok_or(EnvError::EnvOutOfRange { env, num_envs })?;
        let lost = || EnvError::Remote(Box::new(ClientError::NoServerLeft { waited_s: 0.0 }));
        shard.env().ok_or_else(lost)?.scene(env - shard.rows.start)
    }
}
