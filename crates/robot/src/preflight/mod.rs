//! Preflight: checks before a policy moves the robot, with a name, the evidence and a remedy for everything that is wrong.
//!
//! [`Preflight::step`] is called every 2 ms, like [`SafetyMachine::step`](crate::SafetyMachine::step), without clock and
//! network. It observes the robot, then moves one joint at a time by 0.1 rad, then the whole robot on its feet. Every
//! command is a [`SafeCommand`], and every [`Fault`] of the safety state machine ends the motions in damping. A finding
//! that makes a motion unsafe prevents it, and [`PreflightReport::left_out`] says which checks were not made.
//!
//! [`compare`] compares the contract of a policy with that of the robot, without the robot.
//!
//! | checked | how |
//! |---|---|
//! | interface, rate, checksum, clock, lost messages, remote | states that arrive in 1.2 s |
//! | other writers, built-in controller, battery, temperatures | states and services |
//! | accelerometer, quaternion, tilt at rest | gravity of both, 9.81 m/s² |
//! | order, sign, scale, zero of encoders; gains; velocity; torque | the motor's law τ = kp (q_command − q) − kd dq, fitted to a motion of each joint |
//! | order, sign, unit of gyroscope and quaternion | the rate of the quaternion is that of the gyroscope |
//! | frame of the IMU, exchanged legs, mirrored hips, zeros of calves | the plane of the four feet is horizontal |
//!
//! The zero of a thigh or hip that is wrong in commands and states alike is not seen, because the trunk hardly tilts with
//! it: 0.3 rad and 0.2 rad gave no finding. A robot that hangs shows nothing of the last two rows.

mod contract;
mod finding;
mod joint_test;
mod least_squares;
mod passive;
mod sample;
mod stance;

use std::time::Duration;

use twinstep_model::{Command, Joint, NUM_JOINTS, PerJoint, RobotModel};
use twinstep_unitree::LowState;

pub use contract::compare;
pub use finding::{Blocks, Finding, LeftOut};

use crate::command::{CommandLimits, SafeCommand};
use crate::config::{ConfigError, SafetyConfig};
use crate::fault::Fault;
use crate::input::Input;
use crate::monitor::Monitor;
use crate::reading::Reading;
use crate::state::State;
use crate::trajectory::Trajectory;
use joint_test::JointTest;
use passive::Observation;
use sample::{Sample, is_disturbed};

/// Time without commands [s].
const OBSERVE_S: f64 = 1.2;
/// Time after which a state counts for the rate; before, the connection begins [s].
const CONNECT_S: f64 = 0.2;
/// Time in damping before and after motions [s].
const DAMP_S: f64 = 0.2;
/// Time for which the robot is damped at the end [s], so that it lies when its commands cease.
const FINAL_DAMP_S: f64 = 1.5;
/// Number of times that each test is made, if this computer disturbs it.
const MAX_TESTS: usize = 5;
/// Why a test was left out that this computer disturbed each time.
const STOOD_STILL: &str = "this computer stood still meanwhile, each time: close other programs";
/// Time to the low stance and from it [s].
const RISE_S: f64 = 1.2;

/// What happened since the last step.
#[derive(Clone, Debug, Default)]
pub struct PreflightInput {
    /// Time on a monotonic clock.
    pub now: Duration,
    /// States of the robot that arrived since the last step, in their order, also damaged ones.
    pub states: Vec<LowState>,
    /// True if a state of another robot arrived since the last step.
    pub other_robot: bool,
    /// Number of other writers of `rt/lowcmd`.
    pub foreign_writers: usize,
    /// Name of the active built-in controller; `None` if it is released.
    pub controller: Option<String>,
    /// True while the operator asks for a stop.
    pub stop_requested: bool,
}

/// Result of a step.
#[derive(Clone, Debug)]
pub struct PreflightOutput {
    /// Command to send now; `None` while the robot is only observed and after the end.
    pub command: Option<SafeCommand>,
    /// What is being done.
    pub activity: Activity,
    /// The report, at the end.
    pub report: Option<PreflightReport>,
}

/// What preflight is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activity {
    /// Observes without commands.
    Observe,
    /// Damps the joints.
    Damp,
    /// Moves one joint.
    TestJoint(Joint),
    /// Rises to the low stance or lies down.
    Rise,
    /// Moves on its feet.
    TestStance,
    /// Has ended.
    Finished,
}

/// What preflight found.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PreflightReport {
    /// Everything that is wrong.
    pub findings: Vec<Finding>,
    /// Checks that were not made.
    pub left_out: Vec<LeftOut>,
    /// Fault that ended the motions.
    pub stopped_by: Option<Fault>,
}

/// The checks, stepped by their caller.
pub struct Preflight {
    robot: RobotModel,
    config: SafetyConfig,
    limits: CommandLimits,
    damping: SafeCommand,
    monitor: Monitor,
    phase: Phase,
    /// Start of the phase; `None` before the first step.
    since: Option<Duration>,
    observation: Observation,
    /// Positions of the last command [rad].
    q_command: PerJoint,
    /// Joints that moved too little: they are tested again on the feet.
    blocked: Vec<Joint>,
    /// Number of times that this computer disturbed the present test.
    disturbed_tests: usize,
    /// Pose in which the joints are tested [rad].
    pose: PerJoint,
    report: PreflightReport,
}

/// Activity with its data.
enum Phase {
    Observe,
    Damp { then: AfterDamping },
    TestJoint(JointTest),
    Rise(Trajectory),
    TestStance(Vec<Sample>),
    Lower(Trajectory),
    Finished,
}

/// What follows on damping.
#[derive(Clone, Copy)]
enum AfterDamping {
    Test,
    Finish,
}

impl Preflight {
    /// Returns the checks of a robot with this model.
    pub fn new(robot: &RobotModel, config: SafetyConfig) -> Result<Self, ConfigError> {
        config.check()?;
        let limits = CommandLimits::new(robot, &config);
        let damping = limits.check(&Command::hold(robot.control.default_pose_f32(), 0.0, config.damping_kd))?;
        Ok(Self {
            monitor: Monitor::new(robot, &config),
            q_command: damping.command().q,
            pose: damping.command().q,
            robot: robot.clone(),
            phase: Phase::Observe,
            since: None,
            blocked: Vec::new(),
            disturbed_tests: 0,
            observation: Observation::default(),
            report: PreflightReport::default(),
            damping,
            limits,
            config,
        })
    }

    /// Returns the command that damps the motors.
    pub(crate) fn damping(&self) -> SafeCommand {
        self.damping
    }

    /// Advances to `input.now`.
    pub fn step(&mut self, input: &PreflightInput) -> PreflightOutput {
        let since = *self.since.get_or_insert(input.now);
        let elapsed = input.now.saturating_sub(since).as_secs_f64();
        let sample = self.take_in(input);
        if !matches!(self.phase, Phase::Observe | Phase::Finished)
            && let Some(fault) = self.fault(input)
        {
            self.stop(fault, input.now);
            return self.output(Some(self.damping));
        }
        let command = self.advance(input, sample, elapsed);
        self.output(command)
    }

    fn output(&mut self, command: Option<SafeCommand>) -> PreflightOutput {
        if let Some(command) = command {
            self.q_command = command.command().q;
        }
        let finished = matches!(self.phase, Phase::Finished);
        PreflightOutput { command, activity: self.activity(), report: finished.then(|| self.report.clone()) }
    }

    fn activity(&self) -> Activity {
        match &self.phase {
            Phase::Observe => Activity::Observe,
            Phase::Damp { .. } => Activity::Damp,
            Phase::TestJoint(test) => Activity::TestJoint(test.joint),
            Phase::Rise(_) | Phase::Lower(_) => Activity::Rise,
            Phase::TestStance(_) => Activity::TestStance,
            Phase::Finished => Activity::Finished,
        }
    }

    /// Takes in the states, and returns the newest one that is not damaged.
    fn take_in(&mut self, input: &PreflightInput) -> Option<Sample> {
        let newest = input.states.iter().rev().find(|state| state.check_checksum().is_ok());
        let readings = input.states.iter().filter_map(|state| Reading::new(state).ok()).collect();
        self.monitor.update(&Input { readings, ..Self::surroundings(input) });
        newest.map(|state| Sample::new(state, input.now.as_secs_f64(), self.q_command))
    }

    /// Returns the input of the monitor without measurements.
    fn surroundings(input: &PreflightInput) -> Input {
        Input {
            other_robot: input.other_robot,
            foreign_writers: input.foreign_writers,
            controller_released: input.controller.is_none(),
            stop_requested: input.stop_requested,
            ..Input::quiet(input.now)
        }
    }

    fn fault(&self, input: &PreflightInput) -> Option<Fault> {
        let surroundings = Self::surroundings(input);
        let ending = matches!(self.phase, Phase::Damp { then: AfterDamping::Finish });
        let state = if ending { State::Fault } else { State::Ready };
        self.monitor.fault(state, &surroundings)
    }

    /// Ends the motions in damping.
    fn stop(&mut self, fault: Fault, now: Duration) {
        self.report.stopped_by = Some(fault);
        self.leave_out("everything after the stop", fault.to_string());
        self.enter(Phase::Damp { then: AfterDamping::Finish }, now);
    }

    fn leave_out(&mut self, check: &'static str, reason: String) {
        self.report.left_out.push(LeftOut { check, reason });
    }

    fn enter(&mut self, phase: Phase, now: Duration) {
        (self.phase, self.since) = (phase, Some(now));
    }

    /// Advances the phase, and returns the command.
    fn advance(&mut self, input: &PreflightInput, sample: Option<Sample>, elapsed: f64) -> Option<SafeCommand> {
        let now = input.now;
        match &mut self.phase {
            Phase::Observe => {
                self.observe(input, sample, elapsed);
                None
            }
            Phase::Damp { then } => {
                let then = *then;
                let is_end = matches!(then, AfterDamping::Finish);
                if elapsed >= if is_end { FINAL_DAMP_S } else { DAMP_S } {
                    self.after_damping(then, now);
                }
                (!matches!(self.phase, Phase::Finished)).then_some(self.damping)
            }
            Phase::TestJoint(test) => {
                if let Some(sample) = sample {
                    test.add(sample, elapsed);
                }
                if elapsed >= joint_test::DURATION_S {
                    self.end_joint_test(now);
                    return Some(self.safe(&joint_test::hold(&self.pose), now));
                }
                let joint = test.joint;
                let middle = joint_test::middle(self.pose[joint.index()], self.limits.range(joint));
                Some(self.safe(&joint_test::command(&self.pose, joint, middle, elapsed), now))
            }
            Phase::Rise(trajectory) | Phase::Lower(trajectory) => {
                trajectory.advance(Duration::from_millis(2));
                let pose = trajectory.pose();
                if trajectory.finished_for().is_some() {
                    self.end_motion(now);
                }
                Some(self.safe(&self.standing(pose), now))
            }
            Phase::TestStance(samples) => {
                samples.extend(sample);
                if elapsed >= stance::DURATION_S {
                    self.end_stance(now);
                }
                Some(self.safe(&self.standing(stance::pose(elapsed.min(stance::DURATION_S))), now))
            }
            Phase::Finished => None,
        }
    }

    fn observe(&mut self, input: &PreflightInput, sample: Option<Sample>, elapsed: f64) {
        let observation = &mut self.observation;
        observation.foreign_writers = observation.foreign_writers.max(input.foreign_writers);
        observation.other_robot |= input.other_robot;
        if elapsed < CONNECT_S {
            return;
        }
        observation.count(input.states.len(), elapsed - CONNECT_S - observation.seconds);
        observation.seconds = elapsed - CONNECT_S;
        observation.controller = input.controller.clone();
        for state in &input.states {
            observation.add(state);
        }
        observation.samples.extend(sample);
        if elapsed < OBSERVE_S {
            return;
        }
        if !observation.has_rate() {
            if self.repeats() {
                self.observation = Observation::default();
                return self.enter(Phase::Observe, input.now);
            }
            self.leave_out("rate of the states", STOOD_STILL.to_owned());
        }
        self.disturbed_tests = 0;
        self.report.findings = self.observation.findings(&self.robot, &self.config);
        match self.blocking() {
            Some((id, Blocks::Motion)) => {
                let reason = format!("`{id}` makes motions unsafe");
                for check in ["joints", "inertial measurement unit in motion", "legs against the trunk"] {
                    self.leave_out(check, reason.clone());
                }
                self.enter(Phase::Finished, input.now);
            }
            _ => self.enter(Phase::Damp { then: AfterDamping::Test }, input.now),
        }
    }

    /// Returns the finding that makes most motions unsafe.
    fn blocking(&self) -> Option<(&'static str, Blocks)> {
        let findings = self.report.findings.iter().map(|finding| (finding.id, finding.blocks));
        findings.filter(|(_, blocks)| *blocks != Blocks::Nothing).max_by_key(|(_, blocks)| *blocks)
    }

    fn after_damping(&mut self, then: AfterDamping, now: Duration) {
        match then {
            AfterDamping::Test => {
                let q = self.monitor.reading().map_or(self.q_command, |reading| reading.q);
                self.pose = self.limits.clamp(q);
                self.enter(Phase::TestJoint(JointTest::new(Joint::ALL[0])), now);
            }
            AfterDamping::Finish => self.enter(Phase::Finished, now),
        }
    }

    fn end_joint_test(&mut self, now: Duration) {
        let Phase::TestJoint(test) = &self.phase else { return };
        let joint = test.joint;
        if test.is_disturbed() {
            if self.repeats() {
                return self.enter(Phase::TestJoint(JointTest::new(joint)), now);
            }
            self.leave_out("motor, encoder and velocity of a joint", format!("{STOOD_STILL}; it was {joint}"));
        } else {
            let result = test.findings();
            if !result.moved {
                self.blocked.push(joint);
            }
            self.report.findings.extend(result.findings);
        }
        self.disturbed_tests = 0;
        let index = joint.index();
        let next = if index + 1 < NUM_JOINTS {
            Phase::TestJoint(JointTest::new(Joint::ALL[index + 1]))
        } else {
            self.report.findings = joint_test::merge_orders(std::mem::take(&mut self.report.findings));
            self.after_joints()
        };
        self.enter(next, now);
    }

    /// Returns the phase after the tests of the joints.
    fn after_joints(&mut self) -> Phase {
        let Some((id, _)) = self.blocking() else {
            let pose = self.limits.clamp(Joint::map_kinds(stance::STANCE[0], stance::STANCE[1], stance::STANCE[2]));
            return Phase::Rise(Trajectory::new(self.pose, vec![(pose, Duration::from_secs_f64(RISE_S))]));
        };
        let reason = format!("`{id}` makes standing unsafe");
        for check in ["inertial measurement unit in motion", "legs against the trunk"] {
            self.leave_out(check, reason.clone());
        }
        for joint in std::mem::take(&mut self.blocked) {
            self.leave_out("encoder and velocity of a joint", format!("{joint} moved too little while the robot lay"));
        }
        Phase::Damp { then: AfterDamping::Finish }
    }

    fn end_motion(&mut self, now: Duration) {
        let next = match self.phase {
            Phase::Rise(_) => Phase::TestStance(Vec::new()),
            _ => Phase::Damp { then: AfterDamping::Finish },
        };
        self.enter(next, now);
    }

    fn end_stance(&mut self, now: Duration) {
        let Phase::TestStance(samples) = &self.phase else { return };
        if is_disturbed(samples, stance::DURATION_S) {
            if self.repeats() {
                return self.enter(Phase::TestStance(Vec::new()), now);
            }
            for check in ["inertial measurement unit in motion", "legs against the trunk"] {
                self.leave_out(check, STOOD_STILL.to_owned());
            }
            return self.lower(now);
        }
        let of_joints = stance::joint_findings(samples, &self.blocked, &self.config);
        let of_trunk = stance::findings(samples, &self.robot);
        for (findings, left_out) in [of_joints, of_trunk] {
            self.report.findings.extend(findings);
            self.report.left_out.extend(left_out);
        }
        self.lower(now);
    }

    /// Returns true if a test that this computer disturbed is to be repeated.
    fn repeats(&mut self) -> bool {
        self.disturbed_tests += 1;
        self.disturbed_tests < MAX_TESTS
    }

    /// Lies down.
    fn lower(&mut self, now: Duration) {
        let crouch = self.limits.clamp(Joint::map_kinds(0.0, 1.36, -2.65));
        let lower = Trajectory::new(stance::pose(stance::DURATION_S), vec![(crouch, Duration::from_secs_f64(RISE_S))]);
        self.enter(Phase::Lower(lower), now);
    }

    /// Returns the command of a pose on the feet.
    fn standing(&self, q: PerJoint) -> Command {
        let gains = |kinds: [f32; 3]| Joint::map_kinds(kinds[0], kinds[1], kinds[2]);
        let zero = [0.0; NUM_JOINTS];
        let (kp, kd) = (gains(self.config.stand_kp), gains(self.config.stand_kd));
        Command { q: self.limits.clamp(q), dq: zero, tau_ff: zero, kp, kd }
    }

    /// Returns a command that is inside the limits; damping and the end of the motions if it is not.
    fn safe(&mut self, command: &Command, now: Duration) -> SafeCommand {
        self.limits.check(command).unwrap_or_else(|error| {
            self.stop(Fault::UnsafeCommand(error), now);
            self.damping
        })
    }
}
