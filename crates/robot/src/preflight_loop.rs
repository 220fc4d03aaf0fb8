//! Preflight on the robot's DDS topics, in real time.

use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use twinstep_model::RobotModel;
use twinstep_unitree::{LowState, decode, encode};

use crate::command::SafeCommand;
use crate::config::SafetyConfig;
use crate::control_loop::StartError;
use crate::dds::{Dds, LOW_STATE, Reader};
use crate::motor_link::MotorLink;
use crate::preflight::{Activity, Preflight, PreflightInput, PreflightReport};
use crate::real_time_thread;
use crate::robot_handle::RobotHandle;
use crate::robot_writer::RobotWriter;
use crate::watchdog::Watchdog;

/// Time after the last step at which the next one is made if no state arrives.
const TIMER: Duration = Duration::from_micros(2500);
/// Time for which states arrive before they are looked at.
const SETTLING: Duration = Duration::from_millis(500);
/// Time after which no state will arrive any more.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time after a stop in which preflight damps the robot and reports.
const MAX_ENDING: Duration = Duration::from_millis(2500);

/// Time after the first command, in which preflight only damps, from which the watchdog has to guard the motors.
const MAX_ARMING: Duration = Duration::from_millis(150);

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
    mut motors: MotorLink,
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
        let (mut activity, mut stopped_at, mut armed_at) = (None, None, None);
        let mut robot = RobotWriter::default();
        loop {
            let mut states = Vec::new();
            while let Some((payload, writer)) = reader.take_with_writer() {
                if robot.accepts(writer, start.elapsed(), armed_at.is_some()) {
                    states.extend(decode::<LowState>(&payload).ok());
                }
            }
            if let Some(robot) = robot.robot() {
                handle.set_robot(robot);
            }
            let now = start.elapsed();
            if states.is_empty() && now < due {
                std::thread::park_timeout(due.saturating_sub(now));
                continue;
            }
            due = now + TIMER;
            let is_guarded = motors.watchdog(now) == Watchdog::Guarding && motors.can_send();
            let is_late = armed_at.is_some_and(|at: Duration| now.saturating_sub(at) > MAX_ARMING);
            if handle.is_ending() || handle.has_panicked() || (is_late && !is_guarded) {
                stopped_at.get_or_insert(now);
            }
            let controller = (!handle.controller_released()).then(|| "the built-in controller".to_owned());
            let foreign_writers = handle.foreign_writers();
            let stop_requested = stopped_at.is_some();
            let other_robot = robot.take_other();
            let input = PreflightInput { now, states, other_robot, foreign_writers, controller, stop_requested };
            let output = preflight.step(&input);
            if output.command.is_some() {
                armed_at.get_or_insert(now);
            }
            send(&mut motors, output.command, preflight.damping(), &handle);
            if activity != Some(output.activity) {
                activity = Some(output.activity);
                let _ = events.send(Event::Activity(output.activity));
            }
            let is_over = stopped_at.is_some_and(|at| now.saturating_sub(at) > MAX_ENDING);
            if let Some(report) = output.report {
                motors.disarm();
                let _ = events.send(Event::Report(report));
                return;
            }
            if is_over {
                motors.disarm();
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

/// Sends a command. The robot is armed while there are commands.
fn send(motors: &mut MotorLink, command: Option<SafeCommand>, damping: SafeCommand, handle: &RobotHandle) {
    let Some(command) = command else { return motors.disarm() };
    if !motors.is_armed() {
        motors.arm(encode(&damping.to_low_cmd()));
    }
    handle.with_readers(|readers| motors.set_readers(readers));
    // After a panic it only damps, until the watchdog, which misses its beats, takes over.
    let has_panicked = handle.has_panicked();
    motors.send(&encode(&if has_panicked { damping } else { command }.to_low_cmd()));
    if !has_panicked {
        motors.beat();
    }
}
