//! `twinstep watchdog`: the process that damps the motors when the control loop of `twinstep robot` stops.

use std::io::Write;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use signal_hook::consts::{SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGTSTP, SIGUSR1, SIGUSR2};

use crate::exit::{CommandResult, other};

/// Guard the motors of `twinstep robot`, which starts this command itself.
#[derive(clap::Args)]
pub struct Args {
    /// Address of the network interface to the robot.
    address: IpAddr,
    /// Time without a command of the control loop after which the motors are damped [ms].
    timeout_ms: u64,
}

/// Guards the motors until the control loop ends. No signal ends it that can be caught.
pub fn run(args: &Args) -> CommandResult {
    for signal in [SIGHUP, SIGINT, SIGQUIT, SIGTERM, SIGTSTP, SIGUSR1, SIGUSR2] {
        signal_hook::flag::register(signal, Arc::default()).map_err(other)?;
    }
    // When memory runs out, the system ends another process. Only root may ask for it.
    let score = std::fs::File::options().write(true).open("/proc/self/oom_score_adj");
    let _ = score.and_then(|mut score| score.write_all(b"-1000"));
    twinstep_robot::watchdog::run(args.address, Duration::from_millis(args.timeout_ms)).map_err(other)
}
