//! Pushes, noise of the observation and command delay in the task `walk`.

use twinstep_envs::{OBS_LEN, ObservationNoise, Randomisation, TaskEnv, TaskEnvConfig, Walk, WalkConfig};
use twinstep_model::{AutoresetMode, ResetRequest, StepBatch, VecEnv, go2};
use twinstep_sim::{BatchBackend, SimConfig};

const ROBOTS: usize = 3;
/// Steps before the first push, after 1 s.
const STEPS_TO_PUSH: usize = 49;

/// Returns the steps of robots with the seeds from `seed` on, whose actions are a small oscillation.
fn steps(randomise: Randomisation, seed: u64, robots: usize, steps: usize) -> Vec<StepBatch> {
    let backend = BatchBackend::new(go2(), SimConfig { threads: 1, ..SimConfig::default() }, robots).unwrap();
    let walk = Walk::new(WalkConfig::default(), &go2(), true).unwrap();
    let autoreset = AutoresetMode::NextStep;
    let settings = TaskEnvConfig { randomise, ..TaskEnvConfig::new(autoreset, 0) };
    let mut env = TaskEnv::new(backend, walk, settings).unwrap();
    env.reset(&ResetRequest::seeded(seed, robots)).unwrap();
    (0..steps).map(|step| env.step(&vec![0.2 * (0.5 * step as f32).sin(); 12 * robots]).unwrap().clone()).collect()
}

#[test]
fn robots_move_alike_until_the_first_push() {
    let pushes = Randomisation { push_m_s: [0.5, 0.5], push_interval_s: [1.0, 1.0], ..Randomisation::default() };
    let (calm, pushed) =
        (steps(Randomisation::default(), 7, ROBOTS, STEPS_TO_PUSH + 1), steps(pushes, 7, ROBOTS, STEPS_TO_PUSH + 1));
    assert_eq!(calm[..STEPS_TO_PUSH], pushed[..STEPS_TO_PUSH]);
    let [calm, pushed] = [&calm, &pushed].map(|steps| &steps[STEPS_TO_PUSH].critic_obs);
    for (calm, pushed) in calm.as_chunks::<11>().0.iter().zip(pushed.as_chunks::<11>().0) {
        // The feet brake the robot within the step.
        let change = (calm[0] - pushed[0]).hypot(calm[1] - pushed[1]);
        assert!((0.2..0.55).contains(&change), "{change} m/s");
    }
}

#[test]
fn noise_changes_the_observation_but_not_the_motion() {
    let noise = ObservationNoise {
        angular_velocity_rad_s: 0.2,
        gravity: 0.05,
        joint_position_rad: 0.01,
        joint_velocity_rad_s: 1.5,
        ..ObservationNoise::default()
    };
    let exact = steps(Randomisation::default(), 7, ROBOTS, 20);
    let noisy = steps(Randomisation { noise, ..Randomisation::default() }, 7, ROBOTS, 20);
    for (exact, noisy) in exact.iter().zip(&noisy) {
        assert_eq!((&exact.critic_obs, &exact.reward), (&noisy.critic_obs, &noisy.reward));
        let errors = exact.obs.iter().zip(&noisy.obs).map(|(exact, noisy)| (exact - noisy).abs());
        for (index, error) in errors.enumerate() {
            let limit = match index % OBS_LEN {
                0..3 => 0.2,
                3..6 => 0.05,
                9..21 => 0.01,
                21..33 => 1.5,
                _ => 0.0,
            };
            assert!(error <= limit + 1e-5, "entry {}: {error}", index % OBS_LEN);
        }
    }
}

#[test]
fn command_that_is_delayed_by_a_step_moves_the_joints_a_step_later() {
    let delay = Randomisation { command_delay_ms: [20.0, 20.0], ..Randomisation::default() };
    let (prompt, delayed) = (steps(Randomisation::default(), 7, 1, 2), steps(delay, 7, 1, 2));
    // The robot is still in the air, so that only the command moves its joints.
    let q = |steps: &[StepBatch], step: usize| steps[step].obs[9..21].to_vec();
    let difference = |one: &[f32], other: &[f32]| -> f32 {
        one.iter().zip(other).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max)
    };
    assert!(difference(&q(&delayed, 1), &q(&prompt, 0)) < 1e-4);
    assert!(difference(&q(&prompt, 1), &q(&prompt, 0)) > 0.01);
}

#[test]
fn row_of_a_batch_is_the_single_environment_of_its_seed() {
    let randomise = Randomisation {
        mass_scale: [0.85, 1.15],
        command_delay_ms: [0.0, 20.0],
        push_m_s: [0.0, 0.5],
        push_interval_s: [0.1, 0.3],
        noise: ObservationNoise { joint_velocity_rad_s: 1.5, ..ObservationNoise::default() },
        ..Randomisation::default()
    };
    let batch = steps(randomise, 7, ROBOTS, 30);
    for robot in 0..ROBOTS {
        let single = steps(randomise, 7 + robot as u64, 1, 30);
        for (batch, single) in batch.iter().zip(&single) {
            assert_eq!(batch.obs[robot * OBS_LEN..][..OBS_LEN], single.obs);
        }
    }
}
