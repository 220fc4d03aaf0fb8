//! Another robot on the domain, a replayed recording, a robot that restarts.

use std::path::Path;
use std::time::{Duration, Instant};

use super::{Row, in_state, pair};
use crate::process::Process;
use crate::robot_pair::RobotPair;

/// Makes each case `repeats` times.
pub fn run(program: &Path, repeats: usize) -> Vec<Row> {
    let cases: [(&str, fn(&Path) -> Result<f64, String>); 3] = [
        ("a second robot appears while the first one stands", second_robot),
        ("a second robot is there before arming", armed_beside_another),
        ("the robot restarts while it stands", restart),
    ];
    cases
        .iter()
        .map(|(what, case)| {
            let results: Vec<Result<f64, String>> = (0..repeats).map(|_| case(program)).collect();
            let times: Vec<f64> = results.iter().filter_map(|result| result.as_ref().ok().copied()).collect();
            let worst = times.iter().copied().fold(0.0, f64::max);
            let failures: Vec<&String> = results.iter().filter_map(|result| result.as_ref().err()).collect();
            Row {
                what: (*what).to_owned(),
                found: format!(
                    "{} of {repeats} named, at most {worst:.0} ms after the first state; {failures:?}",
                    times.len()
                ),
                is_met: times.len() == repeats && worst <= 100.0,
            }
        })
        .collect()
}

fn other(program: &Path, domain: u16) -> Result<(Process, Instant), String> {
    let arguments = ["fake-robot", "--until-stdin-closes", "--released", "--domain", &domain.to_string()];
    let fake = Process::start(program, &arguments.map(str::to_owned))?;
    fake.line(Duration::from_secs(20)).ok_or("no second robot")?;
    Ok((fake, Instant::now()))
}

/// Returns the time until the fault, whose text contains `name` [ms].
fn time_to(pair: &mut RobotPair, since: Instant, name: &str) -> Result<f64, String> {
    pair.wait_for("fault", Duration::from_secs(5))?;
    let ms = 1e3 * since.elapsed().as_secs_f64();
    if pair.state().contains(name) { Ok(ms) } else { Err(pair.state().to_owned()) }
}

fn second_robot(program: &Path) -> Result<f64, String> {
    let mut pair = in_state(program, "ready")?;
    let (_second, since) = other(program, pair.domain)?;
    // Its states are received once its writer is discovered; `ready` is printed with the first one.
    time_to(&mut pair, since, "rt/lowstate")
}

fn armed_beside_another(program: &Path) -> Result<f64, String> {
    let mut pair = pair(program, &[])?;
    pair.wait_for("observe", Duration::from_secs(20))?;
    let (_second, since) = other(program, pair.domain)?;
    std::thread::sleep(Duration::from_millis(300));
    let answer = pair.operator("arm")?;
    let _ = since;
    if answer.starts_with("error") && answer.contains("rt/lowstate") { Ok(0.0) } else { Err(answer) }
}

fn restart(program: &Path) -> Result<f64, String> {
    let mut pair = in_state(program, "ready")?;
    let since = Instant::now();
    pair.fake.kill();
    time_to(&mut pair, since, "old")
}
