//! The real-time loop: the one thread that writes `rt/lowcmd`.
//!
//! A state of the robot triggers a step of the [`SafetyMachine`]; a timer does if none arrives in time. The thread waits
//! for nothing else: what other threads ask of it is in a [`RobotHandle`], and what it tells them too. A panic in it
//! ends in damping.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use twinstep_logs::RecordedTopic;
use twinstep_model::{Command, RobotModel};
use twinstep_unitree::{LowState, decode, encode};

use crate::command::SafeCommand;
use crate::config::{ConfigError, SafetyConfig};
use crate::dds::{Dds, DdsError, LOW_CMD, LOW_STATE, Reader, SPORT_MODE_STATE, Writer};
use crate::input::{Action, Input, Output};
use crate::machine::SafetyMachine;
use crate::reading::Reading;
use crate::real_time_thread;
use crate::recorder::Recorder;
use crate::robot_handle::{RobotHandle, Taken, TimedSample};
use crate::timing::Timing;

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
            dds,
            reader,
            base_reader,
            writer: None,
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
        };
        if catch_unwind(AssertUnwindSafe(|| control_loop.run())).is_err() {
            control_loop.damp_after_panic();
        }
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
    dds: Dds,
    reader: Reader,
    /// Position and velocity of the base, from the built-in controller or a motion capture; only recorded.
    base_reader: Reader,
    /// Exists while the robot is armed.
    writer: Option<Writer>,
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
}

impl ControlLoop {
    fn run(&mut self) {
        while !self.has_ended() {
            let received = self.newest_state();
            let now = self.start.elapsed();
            if received.is_none() && now < self.due {
                std::thread::park_timeout(self.due.saturating_sub(now));
                continue;
            }
            if let Some(last) = self.last_step {
                self.timing.lateness.add(now.saturating_sub(last + PERIOD));
            }
            if received.is_none() {
                self.timing.timer_lateness.add(now.saturating_sub(self.due));
            }
            self.step(now, received);
            (self.last_step, self.due) = (Some(now), now + TIMER);
        }
    }

    /// Returns the newest state of those that have arrived since the last call, or `None`.
    fn newest_state(&mut self) -> Option<LowState> {
        let mut newest = None;
        while let Some(payload) = self.reader.take() {
            match decode::<LowState>(&payload) {
                Ok(state) => newest = Some(state),
                Err(error) => {
                    self.timing.bad_states += 1;
                    tracing::debug!(%error, "state dropped");
                }
            }
            self.record(RecordedTopic::State, payload);
        }
        while let Some(payload) = self.base_reader.take() {
            self.record(RecordedTopic::BaseState, payload);
        }
        newest
    }

    fn step(&mut self, now: Duration, state: Option<LowState>) {
        let reading = state.and_then(|state| match Reading::new(&state) {
            Ok(reading) => Some(reading),
            Err(error) => {
                self.timing.bad_states += 1;
                tracing::debug!(%error, "state dropped");
                None
            }
        });
        let Taken { request, action, client, has_client } = self.handle.take();
        let input = Input {
            now,
            reading,
            foreign_writers: self.handle.foreign_writers(),
            controller_released: self.handle.controller_released(),
            stop_requested: self.handle.take_stop() || self.damping.is_some(),
            request,
            client,
            action: action.map(|(_, action)| action),
        };
        let output = self.machine.step(&input);
        let is_from_state = input.reading.is_some();
        if let (Some(reading), Some(command)) = (&input.reading, &output.command) {
            let Command { q, kp, .. } = *command.command();
            self.handle.add_sample(|| TimedSample { at: now, reading: reading.clone(), q_cmd: q, kp: kp[0] });
        }
        self.send(output.command, now, is_from_state);
        self.note_tick(&output, now);
        if let Some((_, action)) = action {
            self.record(RecordedTopic::Step, step_record(&action, &output));
        }
        self.handle.publish(now, &output, input.reading, |board| {
            if let Some((number, _)) = action {
                board.action_result = (number, output.action_refused);
            }
            if request.is_some() {
                (board.requests, board.request_refused) = (board.requests + 1, output.request_refused);
            }
            board.has_client = has_client;
        });
    }

    fn send(&mut self, command: Option<SafeCommand>, now: Duration, is_from_state: bool) {
        let Some(command) = command else {
            (self.writer, self.last_command) = (None, None);
            return;
        };
        if self.writer.is_none() {
            match self.dds.writer(LOW_CMD, 1) {
                Ok(writer) => self.writer = Some(writer),
                Err(error) => tracing::error!(%error, "commands cannot be sent"),
            }
        }
        let payload = encode(&command.to_low_cmd());
        self.record(RecordedTopic::Command, payload.clone());
        if let Some(writer) = &self.writer {
            writer.write(payload);
        }
        let sent = self.start.elapsed();
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

    /// Sends damping until the loop is to end. The state machine is not used any more: its panic may come again.
    fn damp_after_panic(&mut self) {
        tracing::error!("the control loop failed: damping until the process ends");
        self.handle.publish_end();
        let Some(writer) = &self.writer else { return };
        let since = Instant::now();
        while !self.handle.is_ending() || since.elapsed() < FINAL_DAMPING {
            writer.write(encode(&self.machine.damping().to_low_cmd()));
            std::thread::sleep(PERIOD);
        }
    }
}
