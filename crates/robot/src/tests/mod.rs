//! Tests of the safety state machine on an accelerated clock.

mod faults;
mod random;
mod transitions;

use std::time::Duration;

use twinstep_model::{Command, NUM_JOINTS, PerJoint, go2};
use twinstep_unitree::Remote;

use crate::{
    Action, Client, CommandLimits, Input, OperatorRequest, Output, Reading, SafetyConfig, SafetyMachine, State,
};

/// Period of the loop.
const DT: Duration = Duration::from_millis(2);

/// Machine with a robot that follows its commands, and surroundings in which nothing is wrong.
#[derive(Clone)]
struct Rig {
    machine: SafetyMachine,
    limits: CommandLimits,
    /// Input of the next step. Request and action are for one step, the rest stays.
    input: Input,
    /// True if states arrive.
    sends_states: bool,
    /// True if the clock in the states runs.
    clock_runs: bool,
    reading: Reading,
    output: Output,
    last_command: Option<Command>,
}

impl Rig {
    fn new() -> Self {
        let mut machine = SafetyMachine::new(&go2(), SafetyConfig::default()).expect("the default config");
        let input = Input::quiet(Duration::ZERO);
        let reading = Reading {
            tick: 0,
            q: lying(),
            dq: [0.0; NUM_JOINTS],
            tau: [0.0; NUM_JOINTS],
            temperature: [35; NUM_JOINTS],
            orientation: [1.0, 0.0, 0.0, 0.0],
            gyro: [0.0; 3],
            acc: [0.0, 0.0, 9.81],
            tilt: 0.0,
            voltage: 29.0,
            charge: 80,
            lost_messages: 0,
            remote: Some(Remote::default()),
        };
        let output = machine.step(&input);
        let limits = CommandLimits::new(&go2(), &SafetyConfig::default());
        Self { machine, limits, input, sends_states: true, clock_runs: true, reading, output, last_command: None }
    }

    /// Returns a rig in `state`, reached without a fault, except for [`State::Fault`].
    fn in_state(state: State) -> Self {
        let mut rig = Self::new();
        let path: &[(OperatorRequest, f64)] = match state {
            State::Disconnected => return rig,
            State::Observe => &[],
            State::Damp | State::Fault => &[(OperatorRequest::Arm, 0.1)],
            State::StandUp => &[(OperatorRequest::Arm, 0.1), (OperatorRequest::Stand, 0.5)],
            State::Ready | State::Run | State::Hold => &[(OperatorRequest::Arm, 0.1), (OperatorRequest::Stand, 4.0)],
            State::Sit => &[(OperatorRequest::Arm, 0.1), (OperatorRequest::Stand, 4.0), (OperatorRequest::Sit, 0.5)],
        };
        rig.run(1.2);
        for (request, seconds) in path {
            rig.request(*request);
            rig.run(*seconds);
        }
        match state {
            State::Run => rig.act([0.1; NUM_JOINTS]),
            State::Hold => {
                rig.act([0.1; NUM_JOINTS]);
                rig.run(0.1);
            }
            State::Fault => {
                rig.input.stop_requested = true;
                rig.step();
                rig.input.stop_requested = false;
                rig.run(0.1);
            }
            _ => {}
        }
        assert_eq!(rig.output.state, state, "{:?}", rig.output.fault);
        rig
    }

    /// Advances by one period of the loop, and checks what must hold in every state.
    fn step(&mut self) {
        let before = self.output.state;
        self.input.now += DT;
        self.reading.tick += if self.clock_runs { 2 } else { 0 };
        self.input.readings = if self.sends_states { vec![self.reading.clone()] } else { Vec::new() };
        self.output = self.machine.step(&self.input);
        (self.input.request, self.input.action) = (None, None);
        self.check(before);
        if let Some(command) = self.output.command {
            let command = *command.command();
            if command.kp[0] > 0.0 {
                self.reading.q = command.q;
            }
        }
    }

    fn check(&mut self, before: State) {
        let output = &self.output;
        assert_eq!(output.command.is_some(), output.state.is_armed(), "sends a command exactly if armed");
        assert_eq!(self.machine.state(), output.state);
        let Some(command) = output.command.map(|command| *command.command()) else {
            self.last_command = None;
            return;
        };
        assert!(self.limits.check(&command).is_ok(), "{command:?}");
        let (kp, kd) = (command.kp[0], command.kd[0]);
        if output.state.is_moving() {
            assert!(kp > 0.0);
        } else {
            assert_eq!((kp, kd, command.tau_ff, command.dq), (0.0, 3.0, [0.0; 12], [0.0; 12]), "only damping");
        }
        if let Some(last) = self.last_command.filter(|last| last.kp[0] > 0.0 && kp > 0.0) {
            let max = last.q.iter().zip(command.q).map(|(last, q)| (last - q).abs()).fold(0.0, f32::max);
            assert!(max < 0.5 + 1e-5, "{before} to {}: a jump of {max} rad", output.state);
        }
        self.last_command = Some(command);
    }

    /// Advances by a time without requests and actions.
    fn run(&mut self, seconds: f64) {
        for _ in 0..(seconds / DT.as_secs_f64()).round() as usize {
            self.step();
        }
    }

    fn request(&mut self, request: OperatorRequest) {
        self.input.request = Some(request);
        self.step();
    }

    /// Sends an action for the tick of the next step.
    fn act(&mut self, values: PerJoint) {
        self.input.action = Some(Action { tick: self.next_tick(), values });
        self.step();
    }

    /// Returns the tick of the next step.
    fn next_tick(&self) -> u64 {
        ((self.input.now + DT).as_millis() / 20) as u64
    }

    /// Sends one action for each tick.
    fn walk(&mut self, seconds: f64) {
        for step in 0..(seconds / DT.as_secs_f64()).round() as usize {
            if self.next_tick() > self.output.tick {
                self.act([0.3 * (step as f32 * 0.05).sin(); NUM_JOINTS]);
            } else {
                self.step();
            }
        }
    }

    /// Advances until `state`, and returns the time that it took [s].
    fn time_to(&mut self, state: State) -> f64 {
        let start = self.input.now;
        while self.output.state != state {
            self.step();
            assert!(self.input.now < start + Duration::from_secs(10), "stays in {}", self.output.state);
        }
        self.input.now.saturating_sub(start).as_secs_f64()
    }

    fn command(&self) -> Command {
        *self.output.command.expect("an armed robot").command()
    }
}

/// Pose of a robot that lies on its belly. The calves are at their ends, outside the limits of commands [rad].
fn lying() -> PerJoint {
    twinstep_model::Joint::map_kinds(0.0, 1.3, -2.72)
}
