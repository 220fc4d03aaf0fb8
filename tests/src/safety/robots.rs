//! Another robot on the domain, a replayed recording, a robot that restarts.

use std::path::Path;
use std::time::{Duration, Instant};

use super::other_interface::state_from_other_interface;
use super::{Row, in_state, pair};
use crate::process::Process;
use crate::robot_pair::RobotPair;

/// Makes each case `repeats` times.
pub fn run(program: &Path, repeats: usize) -> Vec<Row> {
    type Case = (&'static str, fn(&Path) -> Result<f64, String>, &'static str, f64);
    let cases: [Case; 4] = [
        (
            "a second robot appears while the first one stands",
            second_robot,
            "commands that the second one executed",
            0.0,
        ),
        ("a second robot is there before arming", armed_beside_another, "commands that it executed", 0.0),
        (
            "an old state in the robot's name: nothing happens if it comes from another interface, a fault if from its own",
            state_from_other_interface,
            "ms to the fault",
            100.0,
        ),
        ("the robot restarts while it stands", restart, "ms to the fault", 100.0),
    ];
    cases
        .iter()
        .map(|(what, case, unit, limit)| {
            let results: Vec<Result<f64, String>> = (0..repeats).map(|_| case(program)).collect();
            let times: Vec<f64> = results.iter().filter_map(|result| result.as_ref().ok().copied()).collect();
            let worst = times.iter().copied().fold(0.0, f64::max);
            let failures: Vec<&String> = results.iter().filter_map(|result| result.as_ref().err()).collect();
            Row {
                what: (*what).to_owned(),
                found: format!(
                    "{} of {repeats} as it should be; {unit}: at most {worst:.0}; {failures:?}",
                    times.len()
                ),
                is_met: times.len() == repeats && worst <= *limit,
            }
        })
        .collect()
}

/// Time in which DDS discovers a participant.
const DISCOVERY: Duration = Duration::from_secs(15);

fn other(program: &Path, domain: u16) -> Result<(Process, Instant), String> {
    let arguments = ["fake-robot", "--until-stdin-closes", "--released", "--domain", &domain.to_string()];
    let fake = Process::start(program, &arguments.map(str::to_owned))?;
    fake.line(Duration::from_secs(20)).ok_or("no second robot")?;
    Ok((fake, Instant::now()))
}

/// Returns the time until the fault, whose text contains `name` [ms].
fn time_to(pair: &mut RobotPair, since: Instant, name: &str) -> Result<f64, String> {
    pair.wait_for("fault", DISCOVERY)?;
    let ms = 1e3 * since.elapsed().as_secs_f64();
    if pair.state().contains(name) { Ok(ms) } else { Err(pair.state().to_owned()) }
}

/// Returns the number of commands that the second robot has executed, in place of a time.
fn second_robot(program: &Path) -> Result<f64, String> {
    let mut pair = in_state(program, "ready")?;
    let (mut second, since) = other(program, pair.domain)?;
    time_to(&mut pair, since, "rt/lowstate")?;
    second.write_line("statistics")?;
    let answer = second.line(Duration::from_secs(5)).ok_or("the second robot does not answer")?;
    let statistics: serde_json::Value = serde_json::from_str(&answer).map_err(|error| error.to_string())?;
    statistics["accepted"].as_f64().ok_or(answer)
}

/// Arming has to be refused once the second robot is discovered; nothing is sent to it before.
fn armed_beside_another(program: &Path) -> Result<f64, String> {
    let mut pair = pair(program, &[])?;
    pair.wait_for("observe", Duration::from_secs(20))?;
    let (mut second, _) = other(program, pair.domain)?;
    std::thread::sleep(DISCOVERY);
    let answer = pair.operator("arm")?;
    second.write_line("statistics")?;
    let statistics = second.line(Duration::from_secs(5)).ok_or("the second robot does not answer")?;
    let is_refused = answer.starts_with("error") && answer.contains("rt/lowstate");
    if is_refused && statistics.contains("\"accepted\":0,") { Ok(0.0) } else { Err(format!("{answer} {statistics}")) }
}

fn restart(program: &Path) -> Result<f64, String> {
    let mut pair = in_state(program, "ready")?;
    let since = Instant::now();
    pair.fake.kill();
    time_to(&mut pair, since, "old")
}
