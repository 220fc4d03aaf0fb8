//! Robots in the browser: the processor time of a page, and what a page costs a training.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_learning::{PpoConfig, Trainer};
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv, go2};
use twinstep_policy::{Collector, StepCollector};
use twinstep_viewer::{Frame, Hub, MAX_ROBOTS, RobotFrame, SceneInfo, WatchedVecEnv, WebServer};

use crate::Measurement;
use crate::error::{BenchError, Interrupted, check, failed};
use crate::remote_training::PHYSICS_HZ;
use crate::throughput::{WINDOWS, measure as pace, median_of};

/// Number of robots of the training.
const TRAINED_ROBOTS: usize = 1024;

/// Measures a page of 64 robots that stand still, and a training with and without an open page.
pub fn measure(window_s: f64, interrupted: Interrupted) -> Result<Vec<Measurement>, BenchError> {
    let mut env = robots(MAX_ROBOTS)?;
    let (hub, _server) = open_page(env.as_mut())?;
    let mut shares = Vec::new();
    for _ in 0..WINDOWS {
        check(interrupted)?;
        shares.push(100.0 * share_of_a_core(window_s, env.as_ref(), &hub)?);
    }
    let config = PpoConfig { num_envs: TRAINED_ROBOTS, total_steps: u64::MAX, ..PpoConfig::default() };
    let (hub, _server) = open_page(env.as_mut())?;
    let mut watched = trainer(&config, Some(&hub))?;
    let mut alone = trainer(&config, None)?;
    let mut ratios = Vec::new();
    for _ in 0..WINDOWS {
        check(interrupted)?;
        let ours = pace(window_s, || watched.iterate().map(drop).map_err(failed))?;
        let reference = pace(window_s, || alone.iterate().map(drop).map_err(failed))?;
        ratios.push(ours.per_second / reference.per_second);
    }
    let ratio = median_of(ratios);
    Ok(vec![
        Measurement {
            case: "page of 64 robots at 30 frames/s, with its reader".to_owned(),
            value: median_of(shares),
            unit: "% of a core",
            reference: None,
            ratio: None,
        },
        Measurement {
            case: format!("training whose page is read, {TRAINED_ROBOTS} envs"),
            value: 100.0 * (1.0 - ratio),
            unit: "% slower",
            reference: Some("the same training without a page".to_owned()),
            ratio: Some(ratio),
        },
    ])
}

fn robots(count: usize) -> Result<Box<dyn VecEnv>, BenchError> {
    let mut config = Config::default();
    config.server.envs = count;
    config.sim.physics_hz = Some(PHYSICS_HZ);
    config.sim.threads = 1;
    let factory = SimEnvFactory::new(config).map_err(failed)?;
    let mut env = factory.build(count, AutoresetMode::SameStep, None).map_err(failed)?;
    env.reset(&ResetRequest::default()).map_err(failed)?;
    Ok(env)
}

/// Serves a page of robots like these, and reads it without drawing.
fn open_page(env: &mut dyn VecEnv) -> Result<(Arc<Hub>, WebServer), BenchError> {
    let scene = SceneInfo::new("bench", &env.scene(0).map_err(failed)?, &go2());
    let hub = Arc::new(Hub::new(scene));
    let server = WebServer::start(([127, 0, 0, 1], 0).into(), None, Arc::clone(&hub)).map_err(failed)?;
    let mut page =
        TcpStream::connect(server.url().trim_start_matches("http://").trim_end_matches('/')).map_err(failed)?;
    page.write_all(b"GET /frames HTTP/1.1\r\nHost: localhost\r\n\r\n").map_err(failed)?;
    std::thread::spawn(move || {
        let mut buffer = vec![0; 1 << 16];
        while matches!(page.read(&mut buffer), Ok(1..)) {}
    });
    while hub.pages() == 0 {
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok((hub, server))
}

/// Returns the processor time of this process while it shows the robots, divided by the time.
fn share_of_a_core(window_s: f64, env: &dyn VecEnv, hub: &Hub) -> Result<f64, BenchError> {
    let (since, before) = (Instant::now(), processor_s()?);
    while since.elapsed().as_secs_f64() < window_s {
        if hub.is_due() {
            let scenes = (0..env.num_envs()).map(|robot| env.scene(robot));
            let robots: Vec<RobotFrame> = scenes
                .map(|scene| scene.map(|scene| RobotFrame::of_scene(&scene)))
                .collect::<Result<_, _>>()
                .map_err(failed)?;
            hub.publish(&Frame { robots, ..Frame::default() });
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok((processor_s()? - before) / since.elapsed().as_secs_f64())
}

/// Returns the processor time of this process [s], from Linux.
fn processor_s() -> Result<f64, BenchError> {
    let tasks = std::fs::read_dir("/proc/self/task").map_err(failed)?;
    let own = |path: std::path::PathBuf| {
        let text = std::fs::read_to_string(path.join("schedstat")).unwrap_or_default();
        text.split(' ').next().and_then(|nanoseconds| nanoseconds.parse::<f64>().ok()).unwrap_or(0.0)
    };
    Ok(tasks.filter_map(|task| Some(own(task.ok()?.path()))).sum::<f64>() / 1e9)
}

fn trainer(config: &PpoConfig, hub: Option<&Arc<Hub>>) -> Result<Trainer, BenchError> {
    let mut collectors: Vec<Box<dyn Collector>> = Vec::new();
    for group in 0..config.groups {
        let env = robots(config.num_envs / config.groups)?;
        let env: Box<dyn VecEnv> = match hub {
            Some(hub) if group == 0 => Box::new(WatchedVecEnv::new(env, Arc::clone(hub))),
            _ => env,
        };
        collectors.push(Box::new(StepCollector(env)));
    }
    let mut trainer = Trainer::new(config.clone(), collectors, None, 1).map_err(failed)?;
    // The first iterations allocate the arrays.
    trainer.iterate().map_err(failed)?;
    Ok(trainer)
}
