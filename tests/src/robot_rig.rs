//! A fake Go2 under the safety state machine, on an accelerated clock.

use std::time::Duration;

use twinstep_model::{Backend, BaseMount, PerJoint, RobotModel, go2};
use twinstep_robot::fake::{FakeConfig, FakeRobot};
use twinstep_robot::{Action, Input, OperatorRequest, Output, Reading, SafetyConfig, SafetyMachine, State};
use twinstep_sim::{BatchBackend, SimConfig};
use twinstep_unitree::{LowState, decode, encode};

/// Time between two steps.
pub const PERIOD: Duration = Duration::from_millis(2);
/// Time between two ticks of the policy [ms].
pub const TICK_MS: u64 = 20;
/// Action of the clients that have no other [action scale].
const SMALL_ACTION: PerJoint = [0.1; 12];

/// Returns a Go2 with actuators at the rate of the real one, and with friction in its gears.
pub fn robot_at_500_hz() -> RobotModel {
    let mut robot = go2();
    (robot.control.actuator_hz, robot.control.decimation) = (500.0, 10);
    for joint in &mut robot.joints {
        joint.coulomb_friction = 0.3;
    }
    robot
}

/// Returns a simulation of one robot on flat ground.
pub fn backend(robot: RobotModel, base: BaseMount) -> Box<dyn Backend> {
    let config = SimConfig { threads: 1, base, ..SimConfig::default() };
    Box::new(BatchBackend::new(robot, config, 1).expect("the default settings are valid"))
}

/// Returns a fake robot that lies on the ground.
pub fn fake_robot(config: FakeConfig) -> FakeRobot {
    FakeRobot::new(backend(robot_at_500_hz(), BaseMount::Floating), config).expect("the settings of tests are valid")
}

/// Returns the settings of a fake robot whose built-in controller was released.
pub fn released() -> FakeConfig {
    FakeConfig { controller_active: false, ..FakeConfig::default() }
}

/// A fake robot under the safety state machine: each step is 2 ms, and takes as long as the processor needs.
///
/// Messages are encoded and decoded as on the network.
pub struct Rig {
    /// The fake robot.
    pub robot: FakeRobot,
    /// Input of the next step. Its request and its action are used once.
    pub input: Input,
    /// Output of the last step.
    pub output: Output,
    /// Last message on `rt/lowstate`.
    pub last_state: Option<LowState>,
    /// Number of messages on `rt/lowstate`.
    pub num_states: usize,
    machine: SafetyMachine,
}

impl Default for Rig {
    fn default() -> Self {
        Self::new(released())
    }
}

impl Rig {
    /// Returns a rig with a client, whose robot sent no state yet.
    pub fn new(config: FakeConfig) -> Self {
        let machine = SafetyMachine::new(&robot_at_500_hz(), SafetyConfig::default());
        let mut machine = machine.expect("the default settings are valid");
        let input = Input::quiet(Duration::ZERO);
        let output = machine.step(&input);
        Self { robot: fake_robot(config), machine, input, output, last_state: None, num_states: 0 }
    }

    /// Returns a rig in a state that a healthy robot reaches: not in `disconnected` or `fault`.
    ///
    /// In `run` the last step had an action, and in `hold` the third one is missing.
    pub fn in_state(state: State) -> Self {
        let mut rig = Self::default();
        rig.run(1.2);
        if state != State::Observe {
            rig.request(OperatorRequest::Arm);
            rig.run(0.1);
        }
        if !matches!(state, State::Observe | State::Damp) {
            rig.request(OperatorRequest::Stand);
            rig.run(if state == State::StandUp { 1.5 } else { 3.5 });
        }
        match state {
            State::Run => rig.run_with_actions(0.5),
            State::Hold => {
                rig.run_with_actions(0.5);
                while rig.output.state == State::Run {
                    rig.step();
                }
            }
            State::Sit => {
                rig.request(OperatorRequest::Sit);
                rig.run(0.5);
            }
            _ => {}
        }
        assert_eq!(rig.output.state, state, "{:?} {:?}", rig.output.fault, rig.output.request_refused);
        rig
    }

    /// Advances by 2 ms.
    pub fn step(&mut self) {
        self.input.now += PERIOD;
        let states = self.robot.step().expect("the simulation has one robot");
        self.input.readings.clear();
        for state in &states {
            let state: LowState = decode(&encode(state)).expect("an encoded message");
            self.input.readings.extend(Reading::new(&state).ok());
            (self.last_state, self.num_states) = (Some(state), self.num_states + 1);
        }
        self.input.foreign_writers = usize::from(self.robot.wants_foreign_writer());
        self.input.controller_released = self.robot.sport_state().is_none();
        self.output = self.machine.step(&self.input);
        (self.input.request, self.input.action) = (None, None);
        if let Some(command) = &self.output.command {
            // Refused messages are in the robot's statistics.
            let _ = self.robot.receive(&encode(&command.to_low_cmd()));
        }
    }

    /// Advances by a time [s].
    pub fn run(&mut self, seconds: f64) {
        for _ in 0..(seconds * 500.0).round() as usize {
            self.step();
        }
    }

    /// Advances by a time [s] with a small action in each tick.
    pub fn run_with_actions(&mut self, seconds: f64) {
        for _ in 0..(seconds * 500.0).round() as usize {
            if self.tick_begins() {
                self.act(SMALL_ACTION);
            }
            self.step();
        }
    }

    /// Returns the tick of the next step.
    pub fn next_tick(&self) -> u64 {
        (self.input.now + PERIOD).as_millis() as u64 / TICK_MS
    }

    /// Returns true if the next step is the first of its tick.
    pub fn tick_begins(&self) -> bool {
        ((self.input.now + PERIOD).as_millis() as u64).is_multiple_of(TICK_MS)
    }

    /// Sends an action for the present tick with the next step [action scale].
    pub fn act(&mut self, values: PerJoint) {
        self.act_for(self.next_tick(), values);
    }

    /// Sends an action for a tick with the next step [action scale].
    pub fn act_for(&mut self, tick: u64, values: PerJoint) {
        self.input.action = Some(Action { tick, values });
    }

    /// Advances by 2 ms with a request of the operator, which must be accepted.
    pub fn request(&mut self, request: OperatorRequest) {
        self.input.request = Some(request);
        self.step();
        assert_eq!(self.output.request_refused, None);
    }

    /// Injects a fault, such as `heat FL_calf 90`.
    pub fn inject(&mut self, line: &str) {
        let fault = line.parse().unwrap_or_else(|error| panic!("{error}"));
        self.robot.inject(fault).expect("the simulation has one robot");
    }

    /// Returns the height of the base [m].
    pub fn height(&self) -> f32 {
        self.robot.backend().ground_truth().expect("the robot is simulated").base_position[0][2]
    }
}
