//! Robots that walk with a policy, in the browser.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use twinstep_agent::{BoundPolicy, LoadedPolicy, PolicyInput, read_contract};
use twinstep_effects::ControlTable;
use twinstep_env_server::{Config, EnvFactory, ServerConfig, SimEnvFactory};
use twinstep_envs::TaskConfig;
use twinstep_measures::CourseWalking;
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv};
use twinstep_sim::{CourseTerrain, Engine, SimConfig, Terrain};
use twinstep_viewer::{Frame, Hub, PageRequest, Playback, RobotFrame, SceneInfo};

use twinstep_workflows::Observer;

use crate::exit::{CommandResult, Failure, input, other};
use crate::ground_arg::{self, GroundArg};
use crate::serve::engine;
use crate::velocity_input;
use crate::web_view::PageArgs;

/// Time without a page or while paused between two looks at the requests.
const IDLE: Duration = Duration::from_millis(20);
/// Slowest and fastest speed.
const SPEEDS: [f64; 2] = [0.05, 4.0];
/// Policy steps between two frames of a file.
const STEPS_PER_FRAME: usize = 2;
/// Velocity forward that is commanded on a course until the page has another one [m/s].
const COURSE_SPEED: f32 = 0.5;
/// Largest push [m/s].
const MAX_PUSH: f32 = 3.0;

/// Options of robots that walk with a policy.
#[derive(clap::Args)]
pub struct WalkArgs {
    /// Mapping of a policy of another program (TOML), as for `twinstep run`.
    #[arg(long, value_name = "FILE")]
    mapping: Option<PathBuf>,
    /// Number of robots that walk with a policy, 1 to 64.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    robots: u16,
    /// Physics engine of a policy: batch, rapier or mujoco.
    #[arg(long, value_parser = engine, default_value = "batch")]
    engine: Engine,
    /// Ground under a policy of `walk`: slope [rad], stairs, obstacles, wave or rough [m], such as stairs=0.15; repeat it for several.
    #[arg(long, value_name = "KIND=SIZE", value_parser = ground_arg::ground)]
    ground: Vec<GroundArg>,
    /// Seed of the robots of a policy.
    #[arg(long, default_value_t = 0)]
    seed: u64,
}

/// Simulates the robots until a signal.
pub fn run(path: &Path, model: Option<&Path>, args: &WalkArgs, page: &PageArgs, observer: &Observer) -> CommandResult {
    let (mut walk, scene) = start(path, model, args)?;
    let page = page.open(scene)?;
    walk.run(page.hub(), observer)
}

/// Returns the first seconds.
pub fn motion(
    path: &Path,
    model: Option<&Path>,
    args: &WalkArgs,
    seconds: f64,
    observer: &Observer,
) -> Result<(SceneInfo, Vec<Frame>), Failure> {
    let (mut walk, scene) = start(path, model, args)?;
    let mut frames = vec![walk.frame()?];
    while frames.last().is_some_and(|frame| frame.time < seconds) && !observer.check()? {
        for _ in 0..STEPS_PER_FRAME {
            walk.step()?;
        }
        frames.push(walk.frame()?);
    }
    Ok((scene, frames))
}

/// Puts the robots at their start.
fn start(path: &Path, model: Option<&Path>, args: &WalkArgs) -> Result<(PolicyWalk, SceneInfo), Failure> {
    let robots = usize::from(args.robots);
    let read = || LoadedPolicy::read(path, args.mapping.as_deref()).map_err(input);
    let policy = read()?;
    // A policy of this program states its gains; those of another one are in its mapping, and a model file has its own.
    let contract = policy.spec().filter(|_| model.is_none()).and_then(|_| read_contract(path).ok());
    let course = ground_arg::course(&args.ground);
    let factory = factory(&policy, contract, model, args, course)?;
    let mut env = factory.build(robots, AutoresetMode::SameStep, Some(u32::MAX)).map_err(input)?;
    let load = || read()?.bind(env.spec()).map_err(input);
    let policies = (0..robots).map(|_| load()).collect::<Result<Vec<_>, _>>()?;
    env.reset(&ResetRequest::seeded(args.seed, robots)).map_err(other)?;
    let plural = if robots == 1 { "" } else { "s" };
    let title = format!("policy {} on {robots} simulated robot{plural}", path.display());
    let scene = SceneInfo {
        is_interactive: true,
        velocity_bounds: env.spec().observation_field("velocity_command").map(|_| velocity_input::limits()),
        ..SceneInfo::new(title, &env.scene(0).map_err(other)?, factory.robot())
    };
    let scene = scene.with_reward_terms(&env.spec().reward_terms);
    // The whole course, of which the scene of a robot has a part.
    let scene = match course {
        Some(course) => scene.with_ground(&Terrain::Course(course).ground()),
        None => scene,
    };
    let walk = PolicyWalk { env, policies, command: None, is_paused: false, speed: 1.0, steps: 0, falls: 0 };
    Ok((walk, scene))
}

/// Returns the factory of the environments of the policy's task.
fn factory(
    policy: &LoadedPolicy,
    control: Option<ControlTable>,
    model: Option<&Path>,
    args: &WalkArgs,
    course: Option<CourseTerrain>,
) -> Result<SimEnvFactory, Failure> {
    let mut task = policy.spec().and_then(TaskConfig::of_policy).unwrap_or_default();
    if let (TaskConfig::Walk(trained), Some(_)) = (&task, course) {
        task = TaskConfig::Walk(CourseWalking::task(trained, COURSE_SPEED));
    }
    let terrain = course.map_or(Terrain::Flat, Terrain::Course);
    let config = Config {
        task,
        control,
        server: ServerConfig { model: model.map(Path::to_owned), envs: args.robots.into(), ..ServerConfig::default() },
        sim: SimConfig { engine: args.engine, threads: 1, terrain, ..SimConfig::default() },
        ..Config::default()
    };
    config.check().map_err(input)?;
    SimEnvFactory::new(config).map(SimEnvFactory::estimating_uncertainty).map_err(input)
}

struct PolicyWalk {
    env: Box<dyn VecEnv>,
    policies: Vec<BoundPolicy>,
    /// Velocity command of the page; `None` while the task has its own.
    command: Option<[f32; 3]>,
    is_paused: bool,
    speed: f64,
    steps: u64,
    falls: u64,
}

impl PolicyWalk {
    fn run(&mut self, hub: &Hub, observer: &Observer) -> CommandResult {
        let mut due = Instant::now();
        while !observer.check()? {
            for request in hub.take_requests() {
                self.obey(request)?;
            }
            if let Some((_, velocity)) = hub.take_velocity() {
                self.steer(velocity);
            }
            if hub.is_due() {
                hub.publish(&self.frame()?);
            }
            if self.is_paused || hub.pages() == 0 {
                std::thread::sleep(IDLE);
                due = Instant::now();
                continue;
            }
            self.step()?;
            due += Duration::from_secs_f64(self.env.spec().policy_dt / self.speed);
            // A slow computer plays slower, and does not catch up.
            let now = Instant::now();
            if now.saturating_duration_since(due) > IDLE {
                due = now;
            }
            std::thread::sleep(due.saturating_duration_since(now));
        }
        Ok(())
    }

    fn obey(&mut self, request: PageRequest) -> CommandResult {
        match request {
            PageRequest::Pause(is_paused) => self.is_paused = is_paused,
            PageRequest::Speed(speed) if speed.is_finite() => self.speed = speed.clamp(SPEEDS[0], SPEEDS[1]),
            PageRequest::Push { robot, velocity } if velocity.iter().all(|part| part.is_finite()) => {
                // The page may know robots that there are not.
                let _ = self.env.push(robot, velocity.map(|part| part.clamp(-MAX_PUSH, MAX_PUSH)));
            }
            PageRequest::Reset => {
                self.env.reset(&ResetRequest::default()).map_err(other)?;
                self.policies.iter_mut().for_each(BoundPolicy::reset);
            }
            PageRequest::Speed(_) | PageRequest::Push { .. } | PageRequest::Seek(_) | PageRequest::Velocity(_) => {}
        }
        Ok(())
    }

    fn steer(&mut self, command: [f32; 3]) {
        // One that is outside the bounds changes nothing.
        if self.env.set_velocity_commands(&vec![command; self.policies.len()]).is_ok() {
            self.command = Some(command);
        }
    }

    fn step(&mut self) -> CommandResult {
        let spec = self.env.spec();
        let (obs_len, critic_len) = (spec.obs_len(), spec.critic_obs_len());
        let mut actions = Vec::with_capacity(self.policies.len() * spec.action_len());
        for (robot, policy) in self.policies.iter_mut().enumerate() {
            let obs = &self.env.obs()[robot * obs_len..(robot + 1) * obs_len];
            let critic_obs = &self.env.critic_obs()[robot * critic_len..(robot + 1) * critic_len];
            let action = policy.action(&PolicyInput { obs, critic_obs }).map_err(other)?;
            actions.extend(action.iter().map(|value| value.clamp(-1.0, 1.0)));
        }
        let batch = self.env.step(&actions).map_err(other)?;
        self.falls += batch.terminated.iter().filter(|fell| **fell).count() as u64;
        let ended: Vec<usize> = (0..self.policies.len()).filter(|robot| batch.done(*robot)).collect();
        for robot in ended {
            self.policies[robot].reset();
        }
        self.steps += 1;
        Ok(())
    }

    fn frame(&self) -> Result<Frame, Failure> {
        let scene = |robot| self.env.scene(robot).map(|scene| RobotFrame::of_scene(&scene));
        let robots = (0..self.policies.len()).map(scene).collect::<Result<Vec<_>, _>>().map_err(other)?;
        let curves = vec![("falls".to_owned(), self.falls as f64)];
        let time = self.steps as f64 * self.env.spec().policy_dt;
        let playback = Some(Playback { duration: None, is_paused: self.is_paused, speed: self.speed });
        Ok(Frame { time, robots, curves, playback })
    }
}
