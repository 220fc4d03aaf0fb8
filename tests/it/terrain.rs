//! Rough terrain: robots stand on it, and server and client have the same heights.

use glam::{Quat, Vec3};
use twinstep_client::{ConnectOptions, RemoteVecEnv};
use twinstep_env_server::{Config, EnvFactory, SimEnvFactory};
use twinstep_envs::{TaskConfig, TaskEnv, TaskEnvConfig, Walk, WalkConfig};
use twinstep_model::{
    AutoresetMode, Backend, Command, Ground, InitialState, NUM_LEGS, Pose, ResetRequest, Scene, SceneShape, ShapeKind,
    Simulator, VecEnv, body_poses, frames, go2,
};
use twinstep_policy::{Policy, PolicyRunner};
use twinstep_sim::{BatchBackend, CourseTerrain, Engine, RapierBackend, RoughTerrain, SimConfig, StepTerrain, Terrain};

use twinstep_tests::python::root;

use crate::remote::{self, config, start};

fn rough(height_m: f32, cell_m: f32, seed: u64) -> Terrain {
    Terrain::Rough(RoughTerrain { height_m, cell_m, size_m: 20.0, seed })
}

/// Constructor of a backend.
type Make<B> = fn(SimConfig) -> B;

fn rapier(config: SimConfig) -> RapierBackend {
    RapierBackend::new(go2(), SimConfig { engine: Engine::Rapier, ..config }, 1).unwrap()
}

fn batch(config: SimConfig) -> BatchBackend {
    BatchBackend::new(go2(), config, 1).unwrap()
}

fn backend<B: Simulator>(make: Make<B>, terrain: Terrain, clearance: f32) -> B {
    let q = go2().control.default_pose_f32();
    let mut backend = make(SimConfig { terrain, threads: 1, ..SimConfig::default() });
    let initial_state = InitialState::standing_on(&backend.ground(), backend.robot(), q, clearance);
    backend.reset(&[(0, initial_state)]).unwrap();
    backend
}

fn foot_centres(backend: &impl Simulator) -> [Vec3; NUM_LEGS] {
    let (robot, states) = (backend.robot(), backend.states());
    let world_from_base = Pose {
        position: Vec3::from(states.truth.base_position[0]),
        rotation: frames::world_from_base(states.measured.orientation[0]),
    };
    let poses = body_poses(robot, world_from_base, &states.measured.q[0]);
    std::array::from_fn(|leg| poses[3 + 3 * leg].transform(robot.shapes.foot_centre.as_vec3()))
}

/// Returns the signed distance of each foot sphere from the nearest point of the ground [m].
fn foot_gaps(backend: &impl Simulator, ground: &Ground) -> [f32; NUM_LEGS] {
    foot_centres(backend).map(|centre| {
        let around = (-30..=30).flat_map(|x| (-30..=30).map(move |y| (x as f32 / 1000.0, y as f32 / 1000.0)));
        let distance = around
            .map(|(dx, dy)| Vec3::new(dx, dy, ground.height(centre.x + dx, centre.y + dy) - centre.z).length())
            .fold(f32::INFINITY, f32::min);
        let side = if centre.z < ground.height(centre.x, centre.y) { -1.0 } else { 1.0 };
        side * distance - backend.robot().shapes.foot_radius as f32
    })
}

/// Returns a backend whose robot has stood for 10 s.
fn stood<B: Simulator>(make: Make<B>, terrain: Terrain) -> B {
    let mut backend = backend(make, terrain, 0.01);
    let hold = Command::hold(go2().control.default_pose_f32(), 60.0, 2.0);
    backend.step(&[hold], &[true], 2000).unwrap();
    backend
}

#[test]
fn robot_stands_with_its_feet_on_rough_ground() {
    stands_on_its_feet(rapier, |seed| rough(0.05, 0.25, seed));
    stands_on_its_feet(batch, |seed| rough(0.05, 0.25, seed));
}

#[test]
fn robot_stands_with_its_feet_on_steps() {
    let steps = |seed| Terrain::Steps(StepTerrain { height_m: 0.03, tread_m: 0.3, size_m: 4.0, seed });
    stands_on_its_feet(rapier, steps);
    stands_on_its_feet(batch, steps);
}

fn stands_on_its_feet<B: Simulator>(make: Make<B>, terrain: fn(u64) -> Terrain) {
    for seed in 1..=3 {
        let backend = stood(make, terrain(seed));
        let (gaps, states) = (foot_gaps(&backend, &backend.ground()), backend.states());
        for (gap, force) in gaps.iter().zip(states.truth.foot_force[0]) {
            assert!(*gap > -0.005, "seed {seed}: a foot is {gap} m in the ground");
            assert!((force > 0.0) == (*gap < 0.001), "seed {seed}: {gap} m from the ground with {force} N");
        }
        assert!(!states.truth.body_contact[0], "seed {seed}");
        assert!(frames::projected_gravity(states.measured.orientation[0]).z < -0.98, "seed {seed}");
    }
}

#[test]
fn robot_on_its_side_lies_on_its_hips_in_both_engines() {
    // Its hips reach 17.25 cm to the side; its thighs and knees 15.4 cm.
    for height in [height_on_the_side(rapier), height_on_the_side(batch)] {
        assert!((0.165..0.175).contains(&height), "{height} m");
    }
}

/// Returns the height of the base of a robot that was dropped on its right side from 1 cm [m].
fn height_on_the_side<B: Simulator>(make: Make<B>) -> f32 {
    let mut backend = make(SimConfig { threads: 1, ..SimConfig::default() });
    let mut q = go2().control.default_pose_f32();
    for hip in [0, 3, 6, 9] {
        q[hip] = 0.0;
    }
    let turned = Quat::from_rotation_x(std::f32::consts::FRAC_PI_2);
    let lies = InitialState::turned_at(&Ground::FLAT, backend.robot(), q, 0.01, [0.0; 3], turned);
    backend.reset(&[(0, lies)]).unwrap();
    backend.step(&[Command::hold(q, 60.0, 2.0)], &[true], 400).unwrap();
    backend.states().truth.base_position[0][2]
}

#[test]
fn foot_forces_on_gentle_terrain_equal_the_weight() {
    check_foot_forces(rapier);
    check_foot_forces(batch);
}

fn check_foot_forces<B: Simulator>(make: Make<B>) {
    let weight = go2().total_mass() as f32 * 9.81;
    for seed in 1..=3 {
        // The forces are normal to the ground. On triangles of slope 0.1 their sum is up to 0.5 % less than the weight.
        let force: f32 = stood(make, rough(0.02, 0.25, seed)).states().truth.foot_force[0].iter().sum();
        assert!((force / weight - 1.0).abs() < 0.01, "seed {seed}: {force} N on the feet, weight {weight} N");
    }
}

#[test]
fn dropped_robot_does_not_fall_through_the_terrain() {
    // rapier's height field is a surface without volume: after a fall from 1 m, a foot may penetrate while it is
    // pressed. In the batch engine only the corners of the trunk have contacts, so a ridge may penetrate the trunk from
    // below.
    does_not_fall_through(rapier, -0.15, 0.03);
    does_not_fall_through(batch, 0.005, 0.0);
}

fn does_not_fall_through<B: Simulator>(make: Make<B>, min_foot_from_1_m: f32, min_trunk: f32) {
    for (seed, height, min_foot) in [(1, 0.1, 0.01), (2, 0.5, 0.01), (3, 1.0, min_foot_from_1_m)] {
        let mut backend = backend(make, rough(0.1, 0.2, seed), height);
        let ground = backend.ground();
        let pose = go2().control.default_pose_f32();
        let (mut lowest_trunk, mut lowest_foot) = (f32::INFINITY, f32::INFINITY);
        for period in 0..1000 {
            let kick = std::array::from_fn(|j| pose[j] + 0.5 * ((period / 20 * 12 + j) as f32 * 2.4).sin());
            backend.step(&[Command::hold(kick, 60.0, 1.0)], &[true], 1).unwrap();
            let [x, y, z] = backend.states().truth.base_position[0];
            lowest_trunk = lowest_trunk.min(z - ground.height(x, y));
            let feet = foot_centres(&backend).map(|centre| centre.z - ground.height(centre.x, centre.y));
            lowest_foot = feet.into_iter().fold(lowest_foot, f32::min);
        }
        assert!(lowest_trunk > min_trunk, "dropped from {height} m: the trunk was {lowest_trunk} m above the ground");
        assert!(lowest_foot > min_foot, "dropped from {height} m: a foot was {lowest_foot} m above the ground");
    }
}

fn course(stairs_m: [f32; 2], levels: u32) -> Terrain {
    Terrain::Course(CourseTerrain { stairs_m: Some(stairs_m), levels, seed: 1, ..CourseTerrain::default() })
}

/// Robots of a policy that does not know stairs run against them; no foot may get into a face.
#[test]
fn foot_that_is_driven_against_stairs_stays_outside_of_them() {
    let (policy, _) = Policy::read(root().join("data/policies/walk_robust.safetensors")).unwrap();
    let sim = SimConfig { terrain: course([0.2; 2], 1), threads: 1, ..SimConfig::default() };
    let walk = Walk::new(WalkConfig { min_base_height_m: Some(-10.0), ..WalkConfig::default() }, &go2(), true).unwrap();
    let settings = TaskEnvConfig::new(AutoresetMode::SameStep, 1);
    let mut env = TaskEnv::new(BatchBackend::new(go2(), sim, 8).unwrap(), walk, settings).unwrap();
    env.set_velocity_commands(&[[0.8, 0.0, 0.0]; 8]).unwrap();
    let mut obs = env.reset(&ResetRequest::seeded(1, 8)).unwrap().to_vec();
    let (mut runner, mut actions) = (PolicyRunner::new(&policy), vec![0.0; 8 * 12]);
    let ground = env.backend().ground();
    let (mut lowest, mut farthest, patches) = (f32::INFINITY, 0.0f32, ground.patches.unwrap());
    for _ in 0..400 {
        runner.run(&obs, &mut actions);
        obs.copy_from_slice(&env.step(&actions).unwrap().obs);
        for robot in 0..8 {
            let scene = env.scene(robot).unwrap();
            let ([x, y, ..], [middle_x, middle_y]) = (scene.pose[0], patches.centre(0, robot % 2));
            farthest = farthest.max((x - middle_x).abs().max((y - middle_y).abs()));
            for [x, y, z] in foot_centres_of(&scene) {
                lowest = lowest.min(z - ground.height(x, y));
            }
        }
    }
    assert!(lowest > 0.0, "the centre of a foot was {lowest} m from above the ground");
    assert!(farthest > 0.8, "no robot has reached a step: {farthest} m");
}

/// Returns the centres of the feet in a scene [m].
fn foot_centres_of(scene: &Scene) -> Vec<[f32; 3]> {
    let feet = scene.shapes.iter().filter(|shape| shape.kind == ShapeKind::Sphere && shape.body > 0);
    let centre = |shape: &SceneShape| {
        let [x, y, z, qw, qx, qy, qz] = scene.pose[shape.body as usize];
        let world_from_body = Pose { position: Vec3::new(x, y, z), rotation: Quat::from_xyzw(qx, qy, qz, qw) };
        let [x, y, z, ..] = shape.offset;
        world_from_body.transform(Vec3::new(x, y, z)).to_array()
    };
    feet.map(centre).collect()
}

#[test]
fn settings_of_a_walk_on_a_course_are_refused_for_tasks_that_do_not_have_them() {
    let of_factory = |text: &str| {
        let config = Config::parse(text, "server.toml").unwrap();
        SimEnvFactory::new(config).err().map(|error| error.to_string()).unwrap_or_default()
    };
    let sim = "[sim]\nterrain = { course = { stairs_m = [0.1, 0.1], seed = 1 } }\n[task]\n";
    assert!(of_factory(&format!("{sim}name = \"jump\"")).contains("`sim.terrain` = course with the task `jump`"));
    assert_eq!(of_factory(&format!("{sim}name = \"gait\"")), "");
    for task in ["gait", "jump", "track", "attitude"] {
        let text = format!("[task]\nname = \"{task}\"\nwalk = {{ frames = 2 }}");
        let error = Config::parse(&text, "server.toml").unwrap_err().to_string();
        assert!(error.contains("frames` = 2 is not allowed: 1; others are for the task `walk`"), "{task}: {error}");
    }
}

#[test]
fn robots_start_on_the_patches_of_a_course_and_stand_there() {
    let config = Config {
        sim: SimConfig { terrain: course([0.1, 0.2], 2), ..SimConfig::default() },
        ..config(TaskConfig::default())
    };
    let mut env = SimEnvFactory::new(config).unwrap().build(6, AutoresetMode::NextStep, None).unwrap();
    env.reset(&ResetRequest::seeded(1, 6)).unwrap();
    let (ground, level) = (course([0.1, 0.2], 2).ground(), env.mean_level().unwrap());
    assert!((0.0..=1.0).contains(&level), "{level}");
    for _ in 0..50 {
        assert!(!env.step(&[0.0; 72]).unwrap().terminated.contains(&true), "a standing robot does not fall");
    }
    let patches = ground.patches.unwrap();
    for robot in 0..6 {
        let [x, y, z, ..] = env.scene(robot).unwrap().pose[0];
        let at = |level: usize| patches.centre(level, robot % 2);
        let nearest = (0..2).map(|level| (at(level)[0] - x).hypot(at(level)[1] - y)).fold(f32::INFINITY, f32::min);
        assert!(nearest < 0.1, "robot {robot} is {nearest} m from the middle of its patch");
        assert!((0.25..0.4).contains(&(z - ground.height(x, y))), "robot {robot}: {z}");
    }
}

#[test]
fn robot_outside_the_height_field_stands_on_level_ground() {
    stands_outside_the_height_field(rapier);
    stands_outside_the_height_field(batch);
}

fn stands_outside_the_height_field<B: Simulator>(make: Make<B>) {
    let mut backend = backend(make, rough(0.05, 0.25, 1), 0.0);
    let q = go2().control.default_pose_f32();
    let initial_state = InitialState { base_position: [10.5, -3.0, 0.34], ..InitialState::at_rest(0.34, q) };
    backend.reset(&[(0, initial_state)]).unwrap();
    backend.step(&[Command::hold(q, 60.0, 2.0)], &[true], 400).unwrap();
    assert!(
        (0.27..0.33).contains(&backend.states().truth.base_position[0][2]),
        "{:?}",
        backend.states().truth.base_position[0]
    );
}

const CONFIG: &str = "
[sim]
terrain = { rough = { height_m = 0.08, cell_m = 0.25, size_m = 30.0, seed = 7 } }
";

#[test]
fn server_sends_the_heights_around_the_robot() {
    let file = Config::parse(CONFIG, "server.toml").unwrap();
    let terrain = file.sim.terrain;
    let (server, endpoint) = start(&Config { sim: file.sim, ..config(TaskConfig::default()) });
    let mut env = RemoteVecEnv::connect(&ConnectOptions::new(&endpoint, 2)).unwrap();
    env.reset(&ResetRequest::seeded(1, 2)).unwrap();
    for _ in 0..50 {
        assert!(!env.step(&[0.0; 24]).unwrap().terminated.contains(&true), "a standing robot does not fall");
    }
    let scene = env.scene(1).unwrap();
    let (sent, whole) = (scene.ground.height_field.unwrap(), terrain.ground());
    assert_eq!(sent.cell_size(), 0.25);
    assert!(sent.shape().iter().all(|count| (64..=68).contains(count)), "8 m to each side: {:?}", sent.shape());
    let [x, y, z, ..] = scene.pose[0];
    for (dx, dy) in [(0.0, 0.0), (1.3, -0.7), (-3.1, 2.2)] {
        assert!((sent.height(x + dx, y + dy) - whole.height(x + dx, y + dy)).abs() < 1e-5);
    }
    assert!(
        (0.25..0.42).contains(&(z - whole.height(x, y))),
        "the trunk is {} m above the ground",
        z - whole.height(x, y)
    );
    assert!(sent.heights().iter().any(|height| *height > 0.07));
    server.shutdown();
}

#[test]
fn server_rejects_invalid_terrain_before_it_starts() {
    for (text, expected) in [
        (
            "[sim]\nterrain = { rough = { height_m = 9.0, cell_m = 0.25, seed = 7 } }",
            "`sim.terrain.rough.height_m` = 9",
        ),
        ("[sim]\nterrain = { rough = { height_m = 0.1, cell_m = 0.0, seed = 7 } }", "`sim.terrain.rough.cell_m` = 0"),
    ] {
        let config = Config::parse(text, "server.toml").unwrap();
        let error = SimEnvFactory::new(config).err().unwrap().to_string();
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn walk_on_a_steep_slope_starts_with_the_feet_on_the_ground() {
    let mut config = config(TaskConfig::default());
    config.sim.terrain = Terrain::SlopeRad(0.3);
    remote::walk(&mut config).reset_joint_noise_rad = 0.0;
    let mut env = SimEnvFactory::new(config).unwrap().build(1, AutoresetMode::NextStep, None).unwrap();
    env.reset(&ResetRequest::default()).unwrap();
    let up = Ground { normal: [-0.3f32.sin(), 0.0, 0.3f32.cos()], ..Ground::FLAT }.up();
    let scene = env.scene(0).unwrap();
    let feet = scene.shapes.iter().filter(|shape| shape.kind == ShapeKind::Sphere && shape.body > 0).map(|shape| {
        let [x, y, z, qw, qx, qy, qz] = scene.pose[shape.body as usize];
        let world_from_body = Pose { position: Vec3::new(x, y, z), rotation: Quat::from_xyzw(qx, qy, qz, qw) };
        let [x, y, z, ..] = shape.offset;
        up.dot(world_from_body.transform(Vec3::new(x, y, z))) - shape.size[0]
    });
    let gaps: Vec<f32> = feet.collect();
    assert!(gaps.len() == 4 && gaps.iter().all(|gap| (0.0..0.025).contains(gap)), "{gaps:?}");
}
