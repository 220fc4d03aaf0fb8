//! Where robots land, of a policy of the task `jump`.

use glam::{Quat, Vec3};
use serde::Serialize;
use twinstep_envs::{GroundPose, JumpConfig, WalkConfig};
use twinstep_model::{EnvError, EnvSpec, PerLeg, RobotModel, Scene};

use crate::tracking::ground_pose;
use crate::{Measure, Step, share_up};

/// Simulated time of a jump with the recovery after it [s].
pub const JUMP_S: f64 = 3.0;
/// Normal force above which a foot touches the ground [N].
const CONTACT_FORCE_THRESHOLD: f32 = 1.0;
/// Time without contact of any foot after which a robot is in flight [s].
const MIN_AIR_TIME: f64 = 0.06;
/// Acceleration of gravity [m/s²].
const GRAVITY: f32 = 9.81;
/// Distance from the target within which a landing is a success [m].
const SUCCESS_DISTANCE: f64 = 0.05;

/// Landings of all robots for one target.
#[derive(Debug, Serialize)]
pub struct Landings {
    /// The target relative to the start: forward [m], left [m], yaw [rad].
    pub target: [f32; 3],
    /// Share of the robots that jumped and landed.
    pub landed: f64,
    /// Share of the robots that did not fall.
    pub up: f64,
    /// L_jump: mean of |x_land − x_target| of those that landed (U2E, eq. 16) [m].
    pub l_jump: f64,
    /// Mean of x_land − x_target [m].
    pub mean_error: f64,
    /// Mean distance of the landing from the target [m].
    pub distance: f64,
    /// Mean angle between the landing and the target [rad].
    pub yaw_error: f64,
    /// Share of the robots that landed within 5 cm of the target.
    pub within_5_cm: f64,
    /// Mean of the angle that the base turns from the first step in flight to the landing, positive to the left [rad].
    pub flight_turn: f64,
    /// Mean of the time in flight [s].
    pub flight_s: f64,
    /// Mean of the highest clearance of the lowest foot [m].
    pub clearance: f64,
}

/// Measures one jump of each robot to one target.
///
/// The landing is the pose of the base at the first contact of a foot after all feet were off the ground for at least 60
/// ms, from the drawn poses: it is independent of the task's own. Robots start at the origin.
pub struct Jumping {
    robot: RobotModel,
    target: [f32; 3],
    dt: f32,
    jumpers: Vec<Jumper>,
}

impl Jumping {
    /// Returns the settings of the task at both ends and in the middle of the ranges of its targets, once if all are one target.
    /// Episodes end by falls only.
    pub fn tasks(trained: &JumpConfig) -> Vec<JumpConfig> {
        let at = |share: f32| {
            let point = |[low, high]: [f32; 2]| [low + share * (high - low); 2];
            JumpConfig {
                target_x_m: point(trained.target_x_m),
                target_y_m: point(trained.target_y_m),
                target_yaw_rad: point(trained.target_yaw_rad),
                phase_s: trained.phase_s,
                walk: WalkConfig { max_episode_s: 1e6, ..JumpConfig::default().walk },
                ..JumpConfig::default()
            }
        };
        let mut tasks = [0.0, 0.5, 1.0].map(at).to_vec();
        tasks.dedup();
        tasks
    }

    /// Prepares the measure of jumps of the task's only target.
    pub fn new(spec: &EnvSpec, num_envs: usize, robot: &RobotModel, task: &JumpConfig) -> Self {
        let target = [task.target_x_m[0], task.target_y_m[0], task.target_yaw_rad[0]];
        let jumpers = vec![Jumper::default(); num_envs];
        Self { robot: robot.clone(), target, dt: spec.policy_dt as f32, jumpers }
    }
}

impl Measure for Jumping {
    type Found = Landings;

    fn add(&mut self, step: &mut Step<'_>) -> Result<(), EnvError> {
        for robot in step.robots() {
            self.jumpers[robot].add(&step.scene(robot)?, &self.robot, self.dt);
        }
        Ok(())
    }

    fn found(self, has_fallen: &[bool]) -> Landings {
        landings(self.target, &self.jumpers, share_up(has_fallen))
    }
}

/// A robot between start and landing.
#[derive(Clone, Debug, Default)]
struct Jumper {
    /// True once a foot has touched the ground: the drop at the start is no jump.
    has_stood: bool,
    /// The last samples without contact, the newest last; the time in the air is their number.
    in_air: Vec<Sample>,
    landing: Option<Landing>,
}

/// Landing of a robot, and the flight before it.
#[derive(Clone, Copy, Debug)]
struct Landing {
    pose: GroundPose,
    /// Angle that the base turns from the first step in flight to the landing, positive to the left [rad].
    flight_turn: f32,
    /// Time in flight [s].
    flight_s: f32,
    /// Highest clearance of the lowest foot [m].
    clearance: f32,
}

/// Base and feet of a robot after a policy step.
#[derive(Clone, Copy, Debug)]
struct Sample {
    base: GroundPose,
    /// Distance of each foot from the ground [m].
    clearance: PerLeg,
}

impl Jumper {
    fn add(&mut self, scene: &Scene, robot: &RobotModel, dt: f32) {
        if self.landing.is_some() {
            return;
        }
        let touches =
            scene.contact_force.as_ref().is_none_or(|force| force.iter().any(|force| *force > CONTACT_FORCE_THRESHOLD));
        if !touches {
            if self.has_stood {
                self.in_air.push(sample(scene, robot));
            }
            return;
        }
        self.has_stood = true;
        let air_time = self.in_air.len() as f32 * dt;
        if let [.., before, last] = &self.in_air[..]
            && f64::from(air_time) > MIN_AIR_TIME - 1e-4
        {
            let lowest = |sample: &Sample| sample.clearance.iter().copied().fold(f32::INFINITY, f32::min);
            let clearance = self.in_air.iter().map(lowest).fold(0.0, f32::max);
            let pose = touchdown(before, last, dt);
            let [_, _, flight_turn] = pose.relative_to(self.in_air[0].base);
            self.landing = Some(Landing { pose, flight_turn, flight_s: air_time, clearance });
        }
        self.in_air.clear();
    }
}

/// Returns the pose of the base at the first contact after two samples in flight, `dt` [s] apart.
fn touchdown(before: &Sample, last: &Sample, dt: f32) -> GroundPose {
    let time_to_ground = |leg: usize| {
        let velocity = (last.clearance[leg] - before.clearance[leg]) / dt - 0.5 * GRAVITY * dt;
        let fall = velocity * velocity + 2.0 * GRAVITY * last.clearance[leg].max(0.0);
        ((velocity + fall.sqrt()) / GRAVITY).clamp(0.0, dt)
    };
    let share = (0..4).map(time_to_ground).fold(dt, f32::min) / dt;
    let [_, _, turned] = last.base.relative_to(before.base);
    GroundPose {
        x: last.base.x + share * (last.base.x - before.base.x),
        y: last.base.y + share * (last.base.y - before.base.y),
        yaw: last.base.yaw + share * turned,
    }
}

fn sample(scene: &Scene, robot: &RobotModel) -> Sample {
    let clearance = std::array::from_fn(|leg| {
        let [x, y, z, qw, qx, qy, qz] = scene.pose[3 * leg + 3];
        let calf = Quat::from_xyzw(qx, qy, qz, qw);
        let foot = Vec3::new(x, y, z) + calf * robot.shapes.foot_centre.as_vec3();
        foot.z - robot.shapes.foot_radius as f32 - scene.ground.height(foot.x, foot.y)
    });
    Sample { base: ground_pose(scene), clearance }
}

fn landings(target: [f32; 3], jumpers: &[Jumper], up: f64) -> Landings {
    let goal = GroundPose { x: target[0], y: target[1], yaw: target[2] };
    let landed: Vec<_> = jumpers.iter().filter_map(|jumper| jumper.landing).collect();
    let share = |count: usize| count as f64 / jumpers.len() as f64;
    let mean = |value: &dyn Fn(&Landing) -> f32| {
        landed.iter().map(|landing| f64::from(value(landing))).sum::<f64>() / landed.len() as f64
    };
    let distance = |pose: &GroundPose| (pose.x - goal.x).hypot(pose.y - goal.y);
    let is_near = |pose: &GroundPose| f64::from(distance(pose)) < SUCCESS_DISTANCE;
    Landings {
        target,
        landed: share(landed.len()),
        up,
        l_jump: mean(&|landing| (landing.pose.x - goal.x).abs()),
        mean_error: mean(&|landing| landing.pose.x - goal.x),
        distance: mean(&|landing| distance(&landing.pose)),
        yaw_error: mean(&|landing| landing.pose.relative_to(goal)[2].abs()),
        within_5_cm: share(landed.iter().filter(|landing| is_near(&landing.pose)).count()),
        flight_turn: mean(&|landing| landing.flight_turn),
        flight_s: mean(&|landing| landing.flight_s),
        clearance: mean(&|landing| landing.clearance),
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, Pose, go2};

    use super::*;

    #[test]
    fn touchdown_between_two_steps_is_where_the_first_foot_falls_to_the_ground() {
        // Forward at 1.5 m/s, falling at 1 m/s in the middle between the samples; the lowest foot is 15 mm high.
        let sample = |time: f32, height: f32| Sample {
            base: GroundPose { x: 1.5 * time, y: 0.0, yaw: 2.0 * time },
            clearance: [height, height + 0.02, height + 0.05, height + 0.01],
        };
        let landing = touchdown(&sample(0.0, 0.035), &sample(0.02, 0.015), 0.02);
        // 0.015 = 1.0981 t + 4.905 t², so t = 0.01289 s.
        assert!((landing.x - 1.5 * 0.03289).abs() < 1e-4 && (landing.yaw - 2.0 * 0.03289).abs() < 1e-4, "{landing:?}");
    }

    #[test]
    fn targets_are_both_ends_and_the_middle_of_the_ranges_or_the_only_target() {
        let yaw = |target_yaw_rad| {
            Jumping::tasks(&JumpConfig { target_yaw_rad, target_x_m: [0.0, 0.0], ..JumpConfig::default() })
        };
        let turns: Vec<f32> = yaw([-2.0, 1.0]).iter().map(|task| task.target_yaw_rad[0]).collect();
        assert_eq!(turns, [-2.0, -0.5, 1.0]);
        assert_eq!(yaw([2.356, 2.356]).len(), 1);
    }

    #[test]
    fn turn_in_flight_is_that_since_the_first_step_in_the_air() {
        let robot = go2();
        let q = robot.control.default_pose_f32();
        let scene = |yaw: f32, height: f32, force: f32| {
            let base = Pose { position: Vec3::new(0.0, 0.0, 0.3 + height), rotation: Quat::from_rotation_z(yaw) };
            Scene { contact_force: Some(vec![force; 4]), ..Scene::new(&robot, base, &q, &Ground::FLAT) }
        };
        let mut jumper = Jumper::default();
        // 2.4 rad on the ground, then 0.1 rad in each step in the air, beyond an angle of π.
        jumper.add(&scene(0.0, 0.0, 40.0), &robot, 0.02);
        jumper.add(&scene(2.4, 0.0, 40.0), &robot, 0.02);
        for step in 0_u8..10 {
            jumper.add(&scene(2.5 + 0.1 * f32::from(step), 0.3, 0.0), &robot, 0.02);
        }
        jumper.add(&scene(3.5, 0.0, 80.0), &robot, 0.02);
        let landing = jumper.landing.expect("landed");
        assert!((landing.flight_turn - 1.0).abs() < 1e-4 && (landing.flight_s - 0.2).abs() < 1e-4, "{landing:?}");
    }

    #[test]
    fn robots_that_never_jump_or_fall_are_counted() {
        let pose = GroundPose { x: 0.55, y: 0.0, yaw: 0.1 };
        let landing = |pose| Some(Landing { pose, flight_turn: 0.0, flight_s: 0.3, clearance: 0.1 });
        let jumpers = [
            Jumper { landing: landing(pose), ..Jumper::default() },
            Jumper::default(),
            Jumper::default(),
            Jumper { landing: landing(GroundPose { x: 0.61, ..pose }), ..Jumper::default() },
        ];
        let landings = landings([0.6, 0.0, 0.0], &jumpers, share_up(&[false, false, true, false]));
        assert_eq!((landings.landed, landings.up, landings.within_5_cm), (0.5, 0.75, 0.25));
        assert!((landings.l_jump - 0.03).abs() < 1e-6 && (landings.mean_error + 0.02).abs() < 1e-6);
    }
}
