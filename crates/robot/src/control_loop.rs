//! The real-time loop: the one thread that writes `rt/lowcmd`.
//!
//! A state of the robot triggers a step of the [`SafetyMachine`]; a timer does if none arrives in time. The thread waits
//! for nothing else: what other threads ask of it is in a [`RobotHandle`], as is what it publishes for them. It sends the
//! commands itself ([`MotorLink`]). After a panic the [watchdog](crate::watchdog) damps the motors.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use twinstep_logs::RecordedTopic;
use twinstep_model::{Command, RobotModel};
use twinstep_unitree::{LowState, decode, encode};

use crate::config::{ConfigError, SafetyConfig};
use crate::dds::{Dds, DdsError, LOW_STATE, Reader, SPORT_MODE_STATE};
use crate::input::{Action, Client, Input, Output};
use crate::machine::SafetyMachine;
use crate::motor_link::MotorLink;
use crate::reading::Reading;
use crate::real_time_thread;
use crate::recorder::Recorder;
use crate::robot_handle::{Board, RobotHandle, Taken, TimedSample};
use crate::robot_writer::RobotWriter;
use crate::state::State;
use crate::timing::Timing;
use crate::watchdog::Watchdog;

/// Time after the last step at which the timer steps. States arrive every 2 ms; a step must not come just before one.
const TIMER: Duration = Duration::from_micros(2500);
/// Period of the robot's states, and of the commands after a panic.
const PERIOD: Duration = Duration::from_millis(2);
/// Time for which an armed robot is damped before the loop ends, so that it lies when its commands cease.
const FINAL_DAMPING: Duration = Duration::from_millis(1500);

/// Reasons why the loop cannot start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// The config is not allowed.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The domain or a topic cannot be used.
    #[error(transparent)]
    Dds(#[from] DdsError),
    /// The operating system could not start a thread.
    #[error("cannot start the thread of the control loop: {0}")]
    Thread(#[from] std::io::Error),
}

/// Starts the loop. It ends after [`RobotHandle::end`].
pub fn start(
    robot: &RobotModel,
    config: SafetyConfig,
    dds: &Dds,
    motors: MotorLink,
    handle: RobotHandle,
    recorder: Option<Recorder>,
) -> Result<JoinHandle<()>, StartError> {
    let machine = SafetyMachine::new(robot, config)?;
    let policy_dt = Duration::from_secs_f64(robot.control.policy_dt());
    let dds = dds.clone();
    let (ready, is_ready) = std::sync::mpsc::channel();
    let thread = real_time_thread::spawn("control", move || {
        let reader = |topic| dds.reader(topic, std::thread::current());
        let (reader, base_reader) = match (reader(LOW_STATE), reader(SPORT_MODE_STATE)) {
            (Ok(reader), Ok(base_reader)) => (reader, base_reader),
            (Err(error), _) | (_, Err(error)) => return drop(ready.send(Err(error))),
        };
        let _ = ready.send(Ok(()));
        let start = Instant::now();
        let mut control_loop = ControlLoop {
            machine,
            motors,
            reader,
            base_reader,
            robot: RobotWriter::default(),
            recorder,
            handle: handle.clone(),
            policy_dt,
            start,
            timing: Timing::default(),
            due: Duration::ZERO,
            last_step: None,
            last_command: None,
            last_tick: None,
            damping: None,
            client: Client::Absent,
            board: Board::default(),
        };
        if catch_unwind(AssertUnwindSafe(|| control_loop.run())).is_err() {
            control_loop.damp_after_panic();
        }
        control_loop.motors.disarm();
        drop(control_loop);
        handle.publish_end();
    })?;
    is_ready.recv().unwrap_or(Ok(()))?;
    Ok(thread)
}

/// Returns an action and what became of it as JSON.
fn step_record(action: &Action, output: &Output) -> Vec<u8> {
    // JSON has no number for NaN and infinity: they are null.
    serde_json::json!({
        "tick": output.tick,
        "for_tick": action.tick,
        "action": action.values,
        "applied": output.applied,
        "refused": output.action_refused.map(|refused| refused.to_string()),
        "missed_ticks": output.missed_ticks,
        "state": output.state.to_string(),
    })
    .to_string()
    .into_bytes()
}

struct ControlLoop {
    machine: SafetyMachine,
    motors: MotorLink,
    reader: Reader,
    /// Position and velocity of the base, from the built-in controller or a motion capture; only recorded.
    base_reader: Reader,
    robot: RobotWriter,
    recorder: Option<Recorder>,
    handle: RobotHandle,
    policy_dt: Duration,
    start: Instant,
    timing: Timing,
    /// Time at which the timer steps.
    due: Duration,
    /// Time of the last step.
    last_step: Option<Duration>,
    /// Time of the last command; `None` if none was sent since the robot was armed.
    last_command: Option<Duration>,
    /// Last tick, with the time of its first step.
    last_tick: Option<(u64, Duration)>,
    /// Time at which the damping before the end began.
    damping: Option<Duration>,
    /// The client at the last step at which it was known.
    client: Client,
    /// What is published next.
    board: Board,
}

impl ControlLoop {
    fn run(&mut self) {
        while !self.has_ended() {
            let states = self.take_states();
            let now = self.start.elapsed();
            let is_from_state = !states.is_empty();
            if !is_from_state && now < self.due {
                std::thread::park_timeout(self.due.saturating_sub(now));
                continue;
            }
            if let Some(last) = self.last_step {
                self.timing.lateness.add(now.saturating_sub(last + PERIOD));
            }
            if !is_from_state {
                self.timing.timer_lateness.add(now.saturating_sub(self.due));
            }
            self.step(now, &states);
            (self.last_step, self.due) = (Some(now), now + TIMER);
        }
    }

    /// Returns the states that have arrived since the last call, oldest first.
    fn take_states(&mut self) -> Vec<LowState> {
        let mut states = Vec::new();
        while let Some((payload, writer)) = self.reader.take_with_writer() {
            let now = self.start.elapsed();
            if !self.robot.accepts(writer, now, self.machine.state().is_moving()) {
                continue;
            }
            match decode::<LowState>(&payload) {
                Ok(state) => states.push(state),
                Err(error) => self.drop_state(&error),
            }
            self.record(RecordedTopic::State, payload);
        }
        while let Some(payload) = self.base_reader.take() {
            self.record(RecordedTopic::BaseState, payload);
        }
        if let Some(robot) = self.robot.robot() {
            self.handle.set_robot(robot);
        }
        states
    }

    fn drop_state(&mut self, error: &impl std::fmt::Display) {
        self.timing.bad_states += 1;
        tracing::debug!(%error, "state dropped");
    }

    fn step(&mut self, now: Duration, states: &[LowState]) {
        let mut readings = Vec::with_capacity(states.len());
        for state in states {
            match Reading::new(state) {
                Ok(reading) => readings.push(reading),
                Err(error) => self.drop_state(&error),
            }
        }
        let Taken { request, action, client, has_client } = self.handle.take();
        self.client = client.unwrap_or(self.client);
        let watchdog = if self.handle.has_panicked() { Watchdog::Missing } else { self.motors.watchdog(now) };
        let input = Input {
            now,
            readings,
            other_robot: self.robot.take_other(),
            foreign_writers: self.handle.foreign_writers(),
            watchdog,
            can_send: self.motors.can_send(),
            controller_released: self.handle.controller_released(),
            stop_requested: self.handle.take_stop() || self.damping.is_some(),
            request: request.and_then(|(_, request)| request.ok()),
            client: self.client,
            action: action.map(|(_, action)| action),
        };
        // The end of an episode is an event.
        if self.client == Client::EndsEpisode {
            self.client = if has_client { Client::Connected } else { Client::Absent };
        }
        let output = self.machine.step(&input);
        let reading = input.readings.last();
        if let (Some(reading), Some(command)) = (reading, &output.command) {
            let Command { q, kp, .. } = *command.command();
            self.handle.add_sample(|| TimedSample { at: now, reading: reading.clone(), q_cmd: q, kp: kp[0] });
        }
        self.send(&output, watchdog, now, reading.is_some());
        self.note_tick(&output, now);
        if let Some((number, action)) = action {
            self.record(RecordedTopic::Step, step_record(&action, &output));
            self.board.action_result = (number, output.action_refused);
        }
        if let Some((number, request)) = request {
            self.board.request_result = (number, request.err().or(output.request_refused));
        }
        if client.is_some() {
            self.board.has_client = has_client;
        }
        if let Some(reading) = input.readings.into_iter().next_back() {
            self.board.reading = Some((now, reading));
        }
        self.publish(&output, watchdog, now);
    }

    /// Publishes the state after a step. What cannot be published now is published after the next one.
    fn publish(&mut self, output: &Output, watchdog: Watchdog, now: Duration) {
        let board = &mut self.board;
        board.now = now;
        board.state = Some(output.state);
        board.fault = output.fault;
        board.tick = output.tick;
        board.missed_ticks = output.missed_ticks;
        board.applied = output.applied.unwrap_or_default();
        board.is_permitted = output.is_permitted;
        board.watchdog = watchdog;
        board.foreign_writers = self.handle.foreign_writers();
        board.controller_released = self.handle.controller_released();
        self.handle.publish(board);
    }

    /// Sends the command of a step. After a takeover the watchdog's commands alone count, until a new writer is armed.
    fn send(&mut self, output: &Output, watchdog: Watchdog, now: Duration, is_from_state: bool) {
        let Some(command) = output.command else {
            self.motors.disarm();
            self.last_command = None;
            return;
        };
        let has_lost_the_motors = watchdog == Watchdog::TookOver && output.state != State::Fault;
        if !self.motors.is_armed() || has_lost_the_motors {
            self.motors.arm(encode(&self.machine.damping().to_low_cmd()));
        }
        let motors = &mut self.motors;
        self.handle.with_readers(|readers| motors.set_readers(readers));
        // After a panic it only damps, until the watchdog, which misses its beats, takes over.
        let has_panicked = self.handle.has_panicked();
        let command = if has_panicked { self.machine.damping() } else { command };
        let payload = encode(&command.to_low_cmd());
        self.motors.send(&payload);
        if !has_panicked {
            self.motors.beat();
        }
        let sent = self.start.elapsed();
        self.record(RecordedTopic::Command, payload);
        if is_from_state {
            self.timing.latency.add(sent.saturating_sub(now));
        }
        if let Some(last) = self.last_command {
            self.timing.gaps.add(sent.saturating_sub(last));
        }
        self.last_command = Some(sent);
    }

    fn note_tick(&mut self, output: &Output, now: Duration) {
        self.timing.steps += 1;
        if self.last_tick.is_some_and(|(tick, _)| tick == output.tick) {
            return;
        }
        if let Some((tick, at)) = self.last_tick {
            let expected = self.policy_dt * (output.tick - tick) as u32;
            self.timing.tick_jitter.add(now.saturating_sub(at).abs_diff(expected));
        }
        self.last_tick = Some((output.tick, now));
        self.handle.publish_timing(&self.timing);
    }

    fn record(&mut self, topic: RecordedTopic, payload: Vec<u8>) {
        if let Some(recorder) = &self.recorder
            && !recorder.record(topic, self.start.elapsed(), payload)
        {
            self.timing.unrecorded += 1;
        }
    }

    /// Returns true if the loop may end: the robot is not armed, or was damped for a while.
    fn has_ended(&mut self) -> bool {
        if !self.handle.is_ending() {
            return false;
        }
        let now = self.start.elapsed();
        !self.machine.state().is_armed() || now.saturating_sub(*self.damping.get_or_insert(now)) > FINAL_DAMPING
    }

    /// Waits until the loop is to end, while the watchdog damps the motors.
    fn damp_after_panic(&mut self) {
        tracing::error!("the control loop failed: the watchdog damps the motors until the process ends");
        self.handle.publish_end();
        let since = Instant::now();
        while !self.handle.is_ending() || since.elapsed() < FINAL_DAMPING {
            std::thread::sleep(PERIOD);
        }
    }
}
