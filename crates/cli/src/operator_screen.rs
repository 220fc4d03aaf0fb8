//! The operator's screen: state, measurements and timing of the robot, and a key for each request.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::time::Duration;

use ratatui::Frame;
use ratatui::Terminal;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Style, Stylize};
use ratatui::termion::screen::IntoAlternateScreen;
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Row, Table};
use twinstep_model::{Joint, PerJoint};
use twinstep_robot::{Board, Reading, RobotHandle, State, Timing};

use crate::exit::{CommandResult, Failure, other};
use crate::key_terminal::KeyTerminal;
use crate::log_writer::ScreenLog;
use crate::operator;
use crate::write_only_backend::WriteOnlyBackend;

/// Keys with what they stand for.
const KEYS: [(u8, &str); 8] = [
    (b'r', "release"),
    (b'a', "arm"),
    (b's', "stand"),
    (b't', "sit"),
    (b'd', "damp"),
    (b'x', "disarm"),
    (b'g', "go"),
    (b' ', "stop"),
];
/// Width of the bar of a torque, for the limit of its joint.
const BAR: usize = 20;
/// Motor temperatures from which a number is yellow, and red [°C].
const WARM: [u8; 2] = [60, 75];
/// Period of the pictures.
const FRAME: Duration = Duration::from_millis(100);
/// Interval at which the end is looked for.
const TICK: Duration = Duration::from_millis(20);
/// Longest time that the last picture may take.
const LAST_FRAME: Duration = Duration::from_millis(300);

/// What the screen shows.
struct View<'a> {
    /// Endpoint or policy.
    place: &'a str,
    board: &'a Board,
    timing: &'a Timing,
    /// Ids of the clients.
    clients: &'a [String],
    /// Torque limits of the joints [N·m].
    torque_limits: &'a PerJoint,
    /// Answers and log messages, newest last.
    messages: &'a [String],
}

/// Returns true if a person sits at this process's terminal.
pub fn is_possible() -> bool {
    std::io::stdin().is_terminal() && std::io::stdout().is_terminal()
}

/// Shows the screen and executes the operator's keys until `q`, a signal or the end of the control loop.
///
/// One thread reads the keys and never writes; `stop` and `quit` take effect there. One executes the other requests, and one
/// draws: it may wait for a terminal that stands still.
pub fn run(
    handle: &RobotHandle,
    torque_limits: PerJoint,
    place: &str,
    clients: impl Fn() -> Vec<String> + Send + 'static,
) -> CommandResult {
    let keys = Arc::new(KeyTerminal::open().map_err(other)?);
    let log = Arc::new(ScreenLog::begin());
    let (requests, received) = channel();
    start("keys", {
        let (handle, keys) = (handle.clone(), Arc::clone(&keys));
        move || read_keys(&handle, &keys, &requests)
    })?;
    start("requests", {
        let (handle, log) = (handle.clone(), Arc::clone(&log));
        move || {
            for (request, stops) in received {
                log.add(&operator::answer(&handle, request, stops));
            }
        }
    })?;
    let (drawn, has_drawn) = channel::<()>();
    start("screen", {
        let (handle, log, place) = (handle.clone(), Arc::clone(&log), place.to_owned());
        move || {
            let _drawn = drawn;
            if let Err(error) = show(&handle, &torque_limits, &place, &clients, &log) {
                tracing::warn!(%error, "the screen is not shown");
            }
        }
    })?;
    while !handle.is_ending() && !handle.has_ended() {
        std::thread::sleep(TICK);
    }
    let has_failed = !handle.is_ending();
    handle.stop();
    // A screen that stands still is left as it is.
    let _ = has_drawn.recv_timeout(LAST_FRAME);
    keys.close();
    log.end();
    if has_failed {
        return Err(Failure::Other(miette::miette!("the control loop failed; the watchdog damps the motors")));
    }
    Ok(())
}

fn start(name: &str, task: impl FnOnce() + Send + 'static) -> Result<(), Failure> {
    std::thread::Builder::new().name(name.to_owned()).spawn(task).map(drop).map_err(other)
}

/// Reads keys until the end of the process.
fn read_keys(handle: &RobotHandle, keys: &KeyTerminal, requests: &Sender<(&'static str, u64)>) {
    let mut bytes = [0; 16];
    while let Ok(read) = keys.read(&mut bytes) {
        for key in read {
            let request = KEYS.iter().find(|(letter, _)| letter == key).map(|(_, request)| *request);
            operator::stop_at_once(handle, if *key == b'q' { "quit" } else { request.unwrap_or_default() });
            if let Some(request) = request {
                let _ = requests.send((request, handle.num_stops()));
            }
        }
    }
}

/// Draws the screen until the robot is to end, or the control loop has ended.
fn show(
    handle: &RobotHandle,
    torque_limits: &PerJoint,
    place: &str,
    clients: &dyn Fn() -> Vec<String>,
    log: &ScreenLog,
) -> std::io::Result<()> {
    let screen = std::io::stdout().into_alternate_screen()?;
    let mut terminal = Terminal::new(WriteOnlyBackend::new(screen))?;
    terminal.clear()?;
    while !handle.is_ending() && !handle.has_ended() {
        let (board, timing, clients, messages) = (handle.board(), handle.timing(), clients(), log.lines());
        let view =
            View { place, board: &board, timing: &timing, clients: &clients, torque_limits, messages: &messages };
        terminal.draw(|frame| draw(frame, &view))?;
        std::thread::sleep(FRAME);
    }
    Ok(())
}

fn draw(frame: &mut Frame, view: &View) {
    let areas =
        Layout::vertical([Constraint::Length(6), Constraint::Length(14), Constraint::Min(3), Constraint::Length(1)]);
    let [summary, joints, messages, keys] = areas.areas(frame.area());
    frame.render_widget(Paragraph::new(summary_lines(view)), summary);
    match &view.board.reading {
        Some((_, reading)) => frame.render_widget(joint_table(reading, view.torque_limits), joints),
        None => frame.render_widget(Paragraph::new("\n  no states arrive: is the robot on, is the cable in?"), joints),
    }
    let first = view.messages.len().saturating_sub(messages.height.into());
    let lines: Vec<Line> = view.messages[first..].iter().map(|text| Line::raw(text.as_str())).collect();
    frame.render_widget(Paragraph::new(lines), messages);
    frame.render_widget(Paragraph::new(key_line()), keys);
}

fn summary_lines(view: &View) -> Vec<Line<'static>> {
    let (board, timing) = (view.board, view.timing);
    let state = board.state.map_or_else(|| "starting".to_owned(), |state| state.to_string());
    let fault = board.fault.map_or_else(String::new, |fault| fault.to_string());
    let client = match view.clients {
        [] => "none".to_owned(),
        clients if board.is_permitted => clients.join(", "),
        clients => format!("{} waits for `go`", clients.join(", ")),
    };
    let controller = if board.controller_released { "released" } else { "ACTIVE" };
    let sensors = board.reading.as_ref().map_or_else(String::new, |(_, reading)| sensor_text(reading));
    vec![
        Line::from(vec![
            Span::raw("state "),
            Span::styled(format!(" {state} "), state_style(board.state)),
            Span::styled(format!("  {fault}"), Style::new().fg(Color::Red)),
        ]),
        Line::raw(format!("client {client}   {}   tick {}, missed {}", view.place, board.tick, board.missed_ticks)),
        Line::raw(format!(
            "watchdog {}   built-in controller {controller}   other writers {}",
            operator::watchdog_text(board.watchdog),
            board.foreign_writers
        )),
        Line::raw(sensors),
        Line::raw(timing_text(timing)),
        Line::styled(recording_text(timing), Style::new().fg(Color::Red)),
    ]
}

/// Returns a warning if messages are missing in the recording.
fn recording_text(timing: &Timing) -> String {
    match timing.unrecorded {
        0 => String::new(),
        missing => format!("RECORDING INCOMPLETE: {missing} messages are missing; is the disk full?"),
    }
}

fn timing_text(timing: &Timing) -> String {
    let ms = |time: Duration| 1e3 * time.as_secs_f64();
    format!(
        "ms, p99: state to command {:.2}   loop late {:.2}   tick jitter {:.2}   longest gap {:.1}   bad states {}",
        ms(timing.latency.quantile(0.99)),
        ms(timing.lateness.quantile(0.99)),
        ms(timing.tick_jitter.quantile(0.99)),
        ms(timing.gaps.max()),
        timing.bad_states,
    )
}

fn sensor_text(reading: &Reading) -> String {
    let remote = if reading.remote.is_some() { "received" } else { "LOST" };
    format!(
        "battery {} %, {:.1} V   tilt {:.0}°   remote control {remote}",
        reading.charge,
        reading.voltage,
        reading.tilt.to_degrees()
    )
}

fn state_style(state: Option<State>) -> Style {
    let style = Style::new().fg(Color::Black).bold();
    match state {
        None | Some(State::Disconnected | State::Observe) => style.bg(Color::Gray),
        Some(State::Ready | State::Run) => style.bg(Color::Green),
        Some(State::Damp | State::StandUp | State::Hold | State::Sit) => style.bg(Color::Yellow),
        Some(State::Fault) => style.bg(Color::Red),
    }
}

fn joint_table(reading: &Reading, limits: &PerJoint) -> Table<'static> {
    let rows = Joint::ALL.map(|joint| {
        let index = joint.index();
        let (tau, celsius) = (reading.tau[index], reading.temperature[index]);
        let share = (tau.abs() / limits[index]).clamp(0.0, 1.0);
        let filled = (share * BAR as f32).round() as usize;
        let bar = format!("{}{}", "█".repeat(filled), "·".repeat(BAR - filled));
        let heat = match celsius {
            celsius if celsius >= WARM[1] => Color::Red,
            celsius if celsius >= WARM[0] => Color::Yellow,
            _ => Color::Reset,
        };
        Row::new(vec![
            Span::raw(joint.name()),
            Span::raw(format!("{:+.3}", reading.q[index])),
            Span::raw(format!("{:+.2}", reading.dq[index])),
            Span::raw(format!("{tau:+.1}")),
            Span::styled(bar, Style::new().fg(if share > 0.9 { Color::Red } else { Color::Cyan })),
            Span::styled(format!("{celsius}"), Style::new().fg(heat)),
        ])
    });
    let widths = [9, 8, 11, 9, BAR as u16, 6].map(Constraint::Length);
    let names = ["joint", "q [rad]", "dq [rad/s]", "tau [Nm]", "of its limit", "°C"];
    Table::new(rows, widths).header(Row::new(names).bold())
}

fn key_line() -> Line<'static> {
    let key = |(letter, request): (u8, &str)| match letter {
        b' ' => vec![Span::raw("space ").bold(), Span::raw(format!("{}   ", request.to_uppercase())).red()],
        _ => vec![Span::raw(format!("{} ", letter as char)).bold(), Span::raw(format!("{request}   "))],
    };
    let quit = [Span::raw("q ").bold(), Span::raw("damp and end")];
    Line::from(KEYS.into_iter().flat_map(key).chain(quit).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use ratatui::backend::TestBackend;
    use twinstep_robot::Fault;

    use super::*;

    fn drawn(board: &Board, messages: &[String]) -> String {
        let mut terminal = Terminal::new(TestBackend::new(110, 26)).expect("a terminal");
        let (timing, torque_limits) = (Timing::default(), twinstep_model::go2().torque_limits());
        let clients = ["agent-7".to_owned()];
        let place = "tcp/127.0.0.1:7447";
        let view = View { place, board, timing: &timing, clients: &clients, torque_limits: &torque_limits, messages };
        terminal.draw(|frame| draw(frame, &view)).expect("a frame");
        terminal.backend().to_string()
    }

    fn reading() -> Reading {
        Reading {
            tick: 0,
            q: [0.5; 12],
            dq: [0.0; 12],
            tau: [-11.85; 12],
            temperature: [41; 12],
            orientation: [1.0, 0.0, 0.0, 0.0],
            gyro: [0.0; 3],
            acc: [0.0, 0.0, 9.81],
            tilt: 0.1,
            voltage: 28.6,
            charge: 77,
            lost_messages: 0,
            remote: None,
        }
    }

    #[test]
    fn screen_has_state_fault_client_sensors_joints_and_keys() {
        let fault = Some(Fault::StopRequested);
        let reading = Some((Duration::ZERO, reading()));
        let board = Board { state: Some(State::Fault), fault, reading, tick: 1234, ..Board::default() };
        let messages: Vec<String> = (0..9).map(|number| format!("message {number}")).collect();
        let text = drawn(&board, &messages);
        for part in [
            "fault",
            "stopped on request",
            "agent-7",
            "tick 1234",
            "controller ACTIVE",
            "77 %, 28.6 V",
            "tilt 6°",
            "remote control LOST",
            "RR_calf",
            "+0.500",
            "-11.9",
            "41",
            "message 8",
            "space STOP",
            "q damp and end",
        ] {
            assert!(text.contains(part), "`{part}` is missing:\n{text}");
        }
        let hip = text.lines().find(|line| line.contains("FL_hip")).expect("a joint");
        assert_eq!(hip.matches('█').count(), 10, "half of its limit of 23.7 N·m: {hip}");
        assert!(!text.contains("message 0"), "the newest messages are shown:\n{text}");
    }

    #[test]
    fn robot_without_states_has_a_hint() {
        assert!(drawn(&Board::default(), &[]).contains("is the cable in?"));
    }
}
