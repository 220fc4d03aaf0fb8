//! The control process of a robot is ended or suspended in each state.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use rand::RngExt;
use twinstep_model::stream;

use super::probe::Probe;
use super::{Row, in_state};

/// What ends or suspends the process. `MEM` is a limit of its memory, below what it has.
const CAUSES: [&str; 9] = ["HUP", "INT", "TERM", "QUIT", "KILL", "ABRT", "STOP", "TSTP", "MEM"];
const STATES: [&str; 5] = ["damp", "stand_up", "ready", "run", "sit"];
/// Time for which the robot is watched afterwards.
const WATCHED: Duration = Duration::from_millis(1900);

/// Time after which commands show that the process goes on.
const LATE: Duration = Duration::from_millis(1800);

/// What became of a robot.
struct Case {
    cause: &'static str,
    /// Time from the last command that holds a joint to the first damping [ms]; `None` in the state `damp`.
    delay_ms: Option<f64>,
    /// Lateness of a sleeping thread meanwhile [ms].
    lateness_ms: f64,
    dampings: usize,
    /// The process has survived and commands the robot without a pause, as a process does that needs no more memory.
    goes_on: bool,
}

/// Makes `count` cases: causes, states and targets in turn, in the order of a seed.
pub fn run(program: &Path, count: usize, seed: u64, progress: &dyn Fn(&str)) -> Vec<Row> {
    let mut cases = Vec::new();
    let mut failures = Vec::new();
    let mut random = stream(seed, "safety::signals", 0);
    for index in 0..count {
        let cause = CAUSES[index % CAUSES.len()];
        let state = STATES[random.random_range(0..STATES.len())];
        let (to_group, twice) = (random.random_bool(0.5), random.random_bool(0.5));
        match case(program, cause, state, to_group, twice) {
            Ok(case) => {
                progress(&format!("{cause} in {state}: {:?} ms, {} dampings", case.delay_ms, case.dampings));
                cases.push(case);
            }
            Err(error) => failures.push(format!("{cause} in {state}: {error}")),
        }
    }
    let mut rows: Vec<Row> = CAUSES.iter().filter_map(|cause| row(cause, &cases)).collect();
    let standing = cases.iter().filter(|case| case.dampings == 0 && !case.goes_on).count();
    rows.push(Row {
        what: "left standing".to_owned(),
        found: format!("{standing} of {}; not tried {}: {}", cases.len(), failures.len(), failures.join("; ")),
        is_met: standing == 0 && failures.is_empty(),
    });
    rows
}

fn row(cause: &str, cases: &[Case]) -> Option<Row> {
    let cases: Vec<&Case> = cases.iter().filter(|case| case.cause == cause).collect();
    if cases.is_empty() {
        return None;
    }
    let worst = |value: &dyn Fn(&Case) -> f64| cases.iter().map(|case| value(case)).fold(0.0, f64::max);
    let goes_on = cases.iter().filter(|case| case.goes_on).count();
    let fewest = cases.iter().filter(|case| !case.goes_on).map(|case| case.dampings).min().unwrap_or(0);
    let delay = worst(&|case| case.delay_ms.unwrap_or(0.0));
    let excess = worst(&|case| case.delay_ms.unwrap_or(0.0) - case.lateness_ms);
    let limit = if matches!(cause, "STOP" | "TSTP") { 60.0 } else { 40.0 };
    Some(Row {
        what: format!("{cause}, {} cases", cases.len()),
        found: format!(
            "{goes_on} survive and command on; damping at most {delay:.1} ms after the last command, {excess:.1} ms in excess \
             of the sleeping thread; at least {fewest} damping commands"
        ),
        is_met: delay <= limit && (fewest >= 50 || goes_on == cases.len()),
    })
}

fn case(program: &Path, cause: &'static str, state: &str, to_group: bool, twice: bool) -> Result<Case, String> {
    let mut pair = in_state(program, state)?;
    let probe = Probe::start(pair.domain)?;
    let since = Instant::now();
    while probe.count_since(since) < 50 {
        if since.elapsed() > Duration::from_secs(5) {
            return Err("the probe receives no commands".to_owned());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    if !pair.state().starts_with(state) && state != "sit" && state != "stand_up" {
        return Err(format!("it is in `{}`", pair.state()));
    }
    let sent = Instant::now();
    for _ in 0..=usize::from(twice) {
        send(pair.robot.id(), cause, to_group)?;
    }
    std::thread::sleep(WATCHED);
    probe.end();
    let Some((damping, dampings)) = probe.damping_after(sent) else {
        let (gap, lateness) = probe.gaps(sent, sent + WATCHED);
        let goes_on = gap < lateness + Duration::from_millis(50) && probe.count_since(sent + LATE) > 0;
        return Ok(Case { cause, delay_ms: None, lateness_ms: 0.0, dampings: 0, goes_on });
    };
    let last = probe.last_holding();
    let lateness_ms = 1e3 * probe.lateness(sent, damping).as_secs_f64();
    let delay_ms = last.map(|last| 1e3 * damping.saturating_duration_since(last).as_secs_f64());
    Ok(Case { cause, delay_ms, lateness_ms, dampings, goes_on: false })
}

/// Sends a signal to the process or to its group, or limits its memory.
fn send(id: u32, cause: &str, to_group: bool) -> Result<(), String> {
    let status = if cause == "MEM" {
        Command::new("prlimit").args(["--pid", &id.to_string(), "--as=1000000"]).status()
    } else {
        let target = if to_group { format!("-{id}") } else { id.to_string() };
        Command::new("kill").args(["-s", cause, "--", &target]).status()
    };
    // A second signal may find no process.
    status.map(drop).map_err(|error| error.to_string())
}
