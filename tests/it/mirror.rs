//! The mirror image of a walk is a walk: what `train.symmetry` assumes, in the batch engine.

use twinstep_envs::tasks::walk_config::CommandRanges;
use twinstep_envs::{TaskEnv, TaskEnvConfig, Walk, WalkConfig, trot};
use twinstep_learning::Mirror;
use twinstep_model::{AutoresetMode, ResetRequest, VecEnv, go2};
use twinstep_sim::{BatchBackend, SimConfig, Terrain};

/// Frames of the observation.
const FRAMES: usize = 3;

/// Returns one robot that starts in its default pose on a slope ahead, with a fixed velocity command.
fn robot(command: [f32; 3]) -> TaskEnv<BatchBackend, Walk> {
    let [x, y, yaw] = command.map(|value| [value; 2]);
    let config = WalkConfig {
        command: CommandRanges { linear_velocity_x: x, linear_velocity_y: y, angular_velocity_z: yaw },
        standing_probability: 0.0,
        reset_joint_noise_rad: 0.0,
        frames: FRAMES,
        critic_heights: true,
        ..WalkConfig::default()
    };
    let backend =
        BatchBackend::new(go2(), SimConfig { terrain: Terrain::SlopeRad(0.1), threads: 1, ..SimConfig::default() }, 1)
            .unwrap();
    let settings = TaskEnvConfig::new(AutoresetMode::SameStep, 1);
    TaskEnv::new(backend, Walk::new(config, &go2(), true).unwrap(), settings).unwrap()
}

#[test]
fn mirrored_actions_give_mirrored_observations_and_the_same_reward() {
    let (mut one, mut other) = (robot([0.5, 0.3, 0.7]), robot([0.5, -0.3, -0.7]));
    let observations = Mirror::of_observations(one.spec()).unwrap();
    let actions = Mirror::of_actions(one.spec()).unwrap();
    for env in [&mut one, &mut other] {
        env.reset(&ResetRequest::seeded(1, 1)).unwrap();
    }
    for step in 0..25 {
        // A trot that also turns the hips, so that left and right differ.
        let mut action = trot::action(step as f32 * 0.02);
        for (leg, hip) in action.iter_mut().step_by(3).enumerate() {
            *hip = 0.2 * (0.5 * step as f32 + leg as f32).sin();
        }
        let mut mirrored = [0.0; 12];
        actions.apply(&action, &mut mirrored);
        let (batch, image) = (one.step(&action).unwrap(), other.step(&mirrored).unwrap());
        let row = [&batch.obs[..], &batch.critic_obs].concat();
        let expected = {
            let mut expected = vec![0.0; row.len()];
            observations.apply(&row, &mut expected);
            expected
        };
        let image_row = [&image.obs[..], &image.critic_obs].concat();
        for (index, (value, expected)) in image_row.iter().zip(&expected).enumerate() {
            // The order of the legs in the sums differs, and contacts amplify the rounding. Forces are in N.
            let forces = 45 * FRAMES + 7..45 * FRAMES + 11;
            let bound = if forces.contains(&index) { 2.0 } else { 0.02 };
            assert!((value - expected).abs() < bound, "step {step}, entry {index}: {value} {expected}");
        }
        assert!((batch.reward[0] - image.reward[0]).abs() < 1e-3, "step {step}");
    }
}

#[test]
fn mirror_image_of_the_mirror_image_is_the_vector() {
    let env = robot([0.0; 3]);
    let mirror = Mirror::of_observations(env.spec()).unwrap();
    let entries = env.spec().obs_len() + env.spec().critic_obs_len();
    let vector: Vec<f32> = (0..entries).map(|entry| entry as f32 + 1.0).collect();
    let (mut once, mut twice) = (vec![0.0; entries], vec![0.0; entries]);
    mirror.apply(&vector, &mut once);
    mirror.apply(&once, &mut twice);
    assert_eq!(twice, vector);
    assert_ne!(once, vector);
}
