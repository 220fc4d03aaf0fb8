//! `twinstep spi-active`: collect, identify, design, collect, identify, report, as one resumable command.

use std::path::PathBuf;

use twinstep_workflows::{Observer, spi_active};

use crate::exit::CommandResult;

/// Identify a robot with the two stages of SPI-Active: ordinary commands first, then designed ones.
///
/// The policy walks the robot at the endpoint, simulated or real. The folder of CONFIG, without its
/// extension, receives:
///
///   1-random    random velocity commands, their log, and the model that is identified from it
///   2-active    commands designed with that model, their log, and the model that is identified from both logs,
///               starting from the model before
///   3-active    and so on, as often as `rounds` says
///   held-out    random commands whose log is not used for identification: the models are compared on it
///   report.md   parameters with intervals, errors on the held-out log, robot time and falls
///
/// The same command continues after Ctrl-C or a crash: what a stage has completed is kept, and a
/// log that was interrupted is recorded again. The robot walks without a question as soon as a
/// stage needs a log, `room_m` around where it then stands.
///
/// CONFIG (TOML); `policy` and `unknowns` are required, the others have these defaults:
///
///   policy = "data/policies/walk.safetensors"
///   unknowns = ["payload@base", "coulomb_friction@calf"]   as of `twinstep identify --effects`
///   endpoint = "tcp/127.0.0.1:7447"
///   method = "d-optimal"      trace, d-optimal, qoed, or random: the later stages are like the first (SPI-Random)
///   of_interest = []          unknowns that matter for qoed; default: what random commands identify
///   rounds = 1                number of stages after the first
///   seconds = 25.0            duration of each log
///   segment_s = 5.0           duration of a command
///   candidates = 1000         command sequences that a design simulates
///   room_m = 3.0              largest distance from the start
///   fast = false              step a simulated robot as fast as it answers
///   seed = 1
///   robot, zenoh              as of `twinstep run`; without a default
///   model                     model file to start from; default: the ideal Go2
///
/// Example: `twinstep serve --envs 1 --model hidden.toml` and, in another terminal, `twinstep
/// spi-active spi.toml`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
#[allow(clippy::doc_link_with_quotes, reason = "it is TOML")]
pub struct Args {
    /// Config file (TOML).
    config: PathBuf,
}

/// Runs the stages that are not complete.
pub fn run(args: &Args) -> CommandResult {
    print!("{}", spi_active(&args.config, &Observer::terminal()?)?);
    println!("\nwritten to {}", args.config.with_extension("").join("report.md").display());
    Ok(())
}
