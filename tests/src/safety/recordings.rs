//! Recordings of robots whose process is killed at a random moment.

use std::path::Path;
use std::time::{Duration, Instant};

use rand::RngExt;
use twinstep_logs::Log;
use twinstep_model::stream;

use super::{Row, in_state_of, pair_on};
use crate::process::Process;
use crate::robot_pair::next_domain;

/// Kills `count` recordings; one fake robot sends all the states.
pub fn run(program: &Path, count: usize, seed: u64, progress: &dyn Fn(&str)) -> Result<Vec<Row>, String> {
    let domain = next_domain();
    let arguments = ["fake-robot", "--until-stdin-closes", "--released", "--domain", &domain.to_string()];
    let fake = Process::start(program, &arguments.map(str::to_owned))?;
    fake.line(Duration::from_secs(20)).ok_or("no fake robot")?;
    let folder = tempfile::tempdir().map_err(|error| error.to_string())?;
    let mut random = stream(seed, "safety::recordings", 0);
    let (mut read, mut worst, mut failures) = (0, 0.0_f64, Vec::new());
    for index in 0..count {
        let file = folder.path().join(format!("{index}.mcap"));
        let mut robot = pair_on(program, domain, &["--record", file.to_str().unwrap_or_default()])?;
        in_state_of(&mut robot, "damp")?;
        let since = Instant::now();
        std::thread::sleep(Duration::from_millis(random.random_range(1200..3000)));
        robot.kill();
        let recorded = since.elapsed().as_secs_f64();
        match Log::open(&file) {
            Ok(log) => {
                read += 1;
                let seconds = log.t().last().copied().unwrap_or(0.0) - log.t().first().copied().unwrap_or(0.0);
                worst = worst.max(recorded - seconds);
            }
            Err(error) => failures.push(error.to_string()),
        }
        progress(&format!("recording {index}: worst loss {worst:.2} s"));
        let _ = std::fs::remove_file(&file);
        // The watchdog damps the robot for 1.5 s.
        std::thread::sleep(Duration::from_millis(300));
    }
    drop(fake);
    Ok(vec![Row {
        what: format!("{count} recordings killed"),
        found: format!("{read} are read, at most {worst:.2} s before the end are lost; {failures:?}"),
        is_met: read == count && worst <= 1.0,
    }])
}
