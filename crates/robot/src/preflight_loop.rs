//! Preflight on the robot's DDS topics, in real time.

use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use twinstep_model::RobotModel;
use twinstep_unitree::{LowState, decode, encode};

use crate::config::SafetyConfig;
use crate::control_loop::StartError;
use crate::dds::{Dds, LOW_CMD, LOW_STATE, Reader, Writer};
use crate::preflight::{Activity, Preflight, PreflightInput, PreflightReport};
use crate::real_time_thread;
use crate::robot_handle::RobotHandle;

/// Time after the last step at which the next one is made if no state arrives.
const TIMER: Duration = Duration::from_micros(2500);
/// Time for which states arrive before they are looked at.
const SETTLING: Duration = Duration::from_millis(500);
/// Time after which no state will arrive any more.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time for which the robot is damped before its commands cease, so that it lies.
const FINAL_DAMPING: Duration = Duration::from_millis(1500);

/// What happens during preflight.
#[derive(Debug)]
pub enum Event {
    /// Something else is being done.
    Activity(Activity),
    /// Preflight has ended.
    Report(PreflightReport),
}

/// Starts preflight on its own thread. `handle` is that of the [`crate::watch`], and stops it.
pub fn start(
    robot: &RobotModel,
    config: SafetyConfig,
    dds: &Dds,
    handle: RobotHandle,
) -> Result<Receiver<Event>, StartError> {
    let mut preflight = Preflight::new(robot, config)?;
    let (events, received) = channel();
    let dds = dds.clone();
    let (ready, is_ready) = channel();
    real_time_thread::spawn("preflight", move || {
        let reader = match dds.reader(LOW_STATE, std::thread::current()) {
            Ok(reader) => reader,
            Err(error) => return drop(ready.send(Err(error))),
        };
        let _ = ready.send(Ok(()));
        wait_for_states(&reader, &handle);
        let (start, mut due) = (Instant::now(), Duration::ZERO);
        let (mut writer, mut activity, mut stopped_at) = (None, None, None);
        loop {
            let mut states = Vec::new();
            while let Some(payload) = reader.take() {
                states.extend(decode::<LowState>(&payload).ok());
            }
            let now = start.elapsed();
            if states.is_empty() && now < due {
                std::thread::park_timeout(due.saturating_sub(now));
                continue;
            }
            due = now + TIMER;
            if handle.is_ending() {
                stopped_at.get_or_insert(now);
            }
            let controller = (!handle.controller_released()).then(|| "the built-in controller".to_owned());
            let foreign_writers = handle.foreign_writers();
            let stop_requested = stopped_at.is_some();
            let input = PreflightInput { now, states, foreign_writers, controller, stop_requested };
            let output = preflight.step(&input);
            send(&dds, &mut writer, output.command.map(|command| encode(&command.to_low_cmd())));
            if activity != Some(output.activity) {
                activity = Some(output.activity);
                let _ = events.send(Event::Activity(output.activity));
            }
            let is_over = stopped_at.is_some_and(|at| now.saturating_sub(at) > FINAL_DAMPING);
            if let Some(report) = output.report {
                let _ = events.send(Event::Report(report));
                return;
            }
            if is_over {
                return;
            }
        }
    })?;
    is_ready.recv().unwrap_or(Ok(()))?;
    Ok(received)
}

/// Waits until states have arrived for a while, or none arrives at all: finding the robot takes up to a second.
fn wait_for_states(reader: &Reader, handle: &RobotHandle) {
    let (start, mut first) = (Instant::now(), None);
    while !handle.is_ending() {
        while reader.take().is_some() {
            first.get_or_insert_with(Instant::now);
        }
        if first.is_some_and(|first| first.elapsed() > SETTLING) || (first.is_none() && start.elapsed() > PATIENCE) {
            return;
        }
        std::thread::park_timeout(SETTLING);
    }
}

/// Sends a command. The writer exists while there are commands.
fn send(dds: &Dds, writer: &mut Option<Writer>, payload: Option<Vec<u8>>) {
    let Some(payload) = payload else {
        *writer = None;
        return;
    };
    if writer.is_none() {
        match dds.writer(LOW_CMD, 1) {
            Ok(new) => *writer = Some(new),
            Err(error) => tracing::error!(%error, "commands cannot be sent"),
        }
    }
    if let Some(writer) = writer {
        writer.write(payload);
    }
}
