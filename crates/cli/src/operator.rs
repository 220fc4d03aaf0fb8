//! What the operator at the robot's host types, and what the robot answers.

use std::io::BufRead;
use std::sync::mpsc::channel;
use std::time::Duration;

use twinstep_robot::watchdog::Watchdog;
use twinstep_robot::{Board, Histogram, OperatorRequest, RobotHandle, Timing};

use crate::line_printer::print_line;

/// Time in which the control loop takes in a request.
const ANSWER_TIME: Duration = Duration::from_millis(500);

/// What the operator can type.
pub const HELP: &str = "\
arm      send damping to the motors, and forget the last fault
stand    move to the standing pose; clients may then act
sit      move to the crouched pose, then damping
damp     damping at once
disarm   stop sending commands
go       let the client act again after a fault
release  release the robot's built-in controller
stop     damping at once, as a fault
status   state, temperatures, battery, timing
timing   how punctual the control loop is, as JSON
quit     damp, then end";

/// Reads requests from stdin until it closes or `quit`. `stop` and `quit` are executed by the thread that reads; the others
/// are, and all answers are printed, by another one.
pub fn listen(handle: &RobotHandle) -> std::io::Result<()> {
    let (requests, received) = channel::<(String, u64)>();
    let (reader, worker) = (handle.clone(), handle.clone());
    std::thread::Builder::new().name("requests".to_owned()).spawn(move || {
        for (request, stops) in received {
            print_line(&answer(&worker, &request, stops));
        }
    })?;
    std::thread::Builder::new().name("stdin".to_owned()).spawn(move || {
        // The robot stays as it is when stdin closes; signals still end it.
        // A line that is no text is a request that is not known.
        for line in std::io::stdin().lock().split(b'\n').map_while(Result::ok) {
            let line = String::from_utf8_lossy(&line);
            stop_at_once(&reader, line.trim());
            if !matches!(line.trim(), "" | "quit") {
                let _ = requests.send((line.trim().to_owned(), reader.num_stops()));
            }
        }
    })?;
    Ok(())
}

/// Executes `stop` and `quit`, which wait for no answer.
pub fn stop_at_once(handle: &RobotHandle, request: &str) {
    match request {
        "stop" => handle.stop(),
        "quit" => {
            handle.stop();
            handle.end();
        }
        _ => {}
    }
}

/// Executes a request that was made after `stops` stops, and returns the answer, which begins with `ok` or `error`.
pub fn answer(handle: &RobotHandle, request: &str, stops: u64) -> String {
    let request = match request {
        "arm" => OperatorRequest::Arm,
        "stand" => OperatorRequest::Stand,
        "sit" => OperatorRequest::Sit,
        "damp" => OperatorRequest::Damp,
        "disarm" => OperatorRequest::Disarm,
        "go" => OperatorRequest::Go,
        "release" => {
            handle.release_controller();
            return "ok release".to_owned();
        }
        // It was executed when it was read.
        "stop" => return "ok stop".to_owned(),
        "status" => return status(handle),
        "timing" => return format!("ok {}", timing_json(&handle.timing())),
        "help" => return format!("ok help\n{HELP}"),
        _ => return format!("error `{request}` is not known; possible:\n{HELP}"),
    };
    let name = format!("{request:?}").to_lowercase();
    match handle.request(request, stops, ANSWER_TIME) {
        Ok(()) => format!("ok {name}"),
        Err(refused) => format!("error {name}: {refused}"),
    }
}

/// Returns the state of the robot in a line.
pub fn state_line(board: &Board) -> String {
    let state = board.state.map_or_else(|| "starting".to_owned(), |state| state.to_string());
    board.fault.map_or_else(|| format!("state {state}"), |fault| format!("state {state}: {fault}"))
}

fn timing_json(timing: &Timing) -> serde_json::Value {
    let times = |histogram: &Histogram| {
        let ms = |time: Duration| 1e3 * time.as_secs_f64();
        serde_json::json!({
            "count": histogram.count(),
            "p50_ms": ms(histogram.quantile(0.5)),
            "p99_ms": ms(histogram.quantile(0.99)),
            "max_ms": ms(histogram.max()),
            "above_10_ms": histogram.count_above(Duration::from_millis(10)),
        })
    };
    serde_json::json!({
        "state_to_command": times(&timing.latency),
        "lateness": times(&timing.lateness),
        "timer_lateness": times(&timing.timer_lateness),
        "tick_jitter": times(&timing.tick_jitter),
        "gaps": times(&timing.gaps),
        "bad_states": timing.bad_states,
        "unrecorded": timing.unrecorded,
    })
}

/// Returns whether a client has the robot, and may act.
fn client_text(board: &Board) -> &'static str {
    match (board.has_client, board.is_permitted) {
        (false, _) => "no",
        (true, true) => "yes",
        (true, false) => "waits for `go`",
    }
}

/// Returns what the watchdog does, in a word.
pub fn watchdog_text(watchdog: Watchdog) -> &'static str {
    match watchdog {
        Watchdog::Missing => "GONE",
        Watchdog::Idle => "ready",
        Watchdog::Guarding => "guards",
        Watchdog::TookOver => "TOOK OVER",
    }
}

fn status(handle: &RobotHandle) -> String {
    let (board, timing) = (handle.board(), handle.timing());
    let mut lines = vec![state_line(&board)];
    if let Some((_, reading)) = &board.reading {
        let hottest = reading.temperature.iter().max().copied().unwrap_or_default();
        lines.push(format!(
            "battery {} %, {:.1} V; hottest motor {hottest} °C; tilt {:.0}°",
            reading.charge,
            reading.voltage,
            reading.tilt.to_degrees()
        ));
    }
    let controller = if board.controller_released { "released" } else { "not released" };
    lines.push(format!(
        "built-in controller {controller}; other writers {}; client {}; watchdog {}",
        board.foreign_writers,
        client_text(&board),
        watchdog_text(board.watchdog),
    ));
    let ms = |time: Duration| 1e3 * time.as_secs_f64();
    lines.push(format!(
        "steps {}; state to command p50 {:.3} p99 {:.3} ms; loop late p99 {:.3} ms; tick jitter p99 {:.3} ms; \
         longest gap {:.2} ms; bad states {}; unrecorded {}",
        timing.steps,
        ms(timing.latency.quantile(0.5)),
        ms(timing.latency.quantile(0.99)),
        ms(timing.lateness.quantile(0.99)),
        ms(timing.tick_jitter.quantile(0.99)),
        ms(timing.gaps.max()),
        timing.bad_states,
        timing.unrecorded,
    ));
    lines.join("\n")
}
