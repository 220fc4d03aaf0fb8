//! `twinstep excite`: velocity commands with which the log of a walking robot tells most about unknown parameters.

use std::path::PathBuf;

use twinstep_excite::{Criterion, Limits};
use twinstep_identify::EffectAtScope;
use twinstep_workflows::design::DEFAULT_LIMITS;
use twinstep_workflows::{DesignOptions, Observer, design};

use crate::exit::{CommandResult, Failure};

/// Choose velocity commands with which the log of a run tells most about unknown parameters
/// (SPI-Active).
///
/// A policy of `walk` or `gait` follows candidate commands in the batch engine, on the robot of the
/// model file: velocities, and with `gait` also step frequencies and the four gaits. Each run gives
/// the Fisher information of its log about the parameters of --unknowns, in units of sensor noise
/// and prior. CMA-ES searches for the commands with the largest criterion among those that keep the
/// limits:
///
///   trace       sum over the parameters, as if the others were known (SPI-Active)
///   d-optimal   expected gain in information; what cannot be separated counts once
///   a-optimal   smallest remaining variance of the effects of --of-interest; the others are nuisance
///   qoed        expected gain in information about the effects of --of-interest, after the others were eliminated;
///               without a list, about what random commands identify
///
/// DIR receives commands.csv, for `twinstep run --commands`, and design.json. Ctrl-C ends the
/// search and writes the best commands so far.
///
/// Example: `twinstep excite data/policies/walk.safetensors --unknowns
/// payload@base,coulomb_friction@calf --out design`, `twinstep run data/policies/walk.safetensors
/// --commands design/commands.csv --log log`, and `twinstep identify log --effects
/// payload@base,coulomb_friction@calf`
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Args {
    /// Policy file of the task `walk` or `gait` (safetensors).
    policy: PathBuf,
    /// Effects whose parameters are sought, with scopes, as in `payload@base,coulomb_friction@calf`. `twinstep effects`
    /// lists them.
    #[arg(long, value_name = "EFFECTS", value_delimiter = ',', required_unless_present = "findings")]
    unknowns: Vec<EffectAtScope>,
    /// Output folder of `twinstep diagnose`: the unknowns are the causes that it could not tell apart, and the model is its
    /// corrected one.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["unknowns", "model"])]
    findings: Option<PathBuf>,
    /// Model file of the robot, with what is known of it. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    model: Option<PathBuf>,
    /// trace, d-optimal, a-optimal or qoed.
    #[arg(long, default_value = "d-optimal")]
    criterion: Criterion,
    /// Effects that matter for a-optimal and qoed. Default: all of --unknowns; for qoed those that random commands identify.
    #[arg(long, value_name = "EFFECTS", value_delimiter = ',')]
    of_interest: Vec<EffectAtScope>,
    /// Duration of the run [s].
    #[arg(long, value_name = "S", default_value_t = 25.0)]
    seconds: f64,
    /// Duration of a command [s].
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    segment_s: f64,
    /// Number of command sequences to simulate.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    candidates: u32,
    /// Largest horizontal distance from the start [m].
    #[arg(long, value_name = "M", default_value_t = DEFAULT_LIMITS.room_m)]
    room: f64,
    /// Largest share of the steps in which a motor is at its torque limit.
    #[arg(long, value_name = "SHARE", default_value_t = DEFAULT_LIMITS.max_saturated)]
    max_saturated: f64,
    /// Largest root mean square of a motor's torque, which heats it [N·m].
    #[arg(long, value_name = "NM", default_value_t = DEFAULT_LIMITS.max_rms_torque_nm)]
    max_rms_torque: f64,
    /// Rate of the physics [Hz]. At 400 Hz a search takes 0.6 times the time, but the order of candidates correlates with that
    /// at 1000 Hz by 0.8 only. Default: 1000.
    #[arg(long, value_name = "HZ")]
    physics_hz: Option<u32>,
    /// Seed of the search and of the initial state.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for the results.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Designs the experiment, writes it, and says how to run it.
pub fn run(args: &Args) -> CommandResult {
    let designed = design(&args.options(), &Observer::terminal()?)?;
    print!("{}", designed.report.table(args.segment_s));
    let (policy, path) = (args.policy.display(), designed.commands.display());
    println!("written to {path}; run it: twinstep run {policy} --commands {path} --log DIR");
    if designed.is_interrupted { Err(Failure::Interrupted) } else { Ok(()) }
}

impl Args {
    fn options(&self) -> DesignOptions {
        DesignOptions {
            findings: self.findings.clone(),
            model: self.model.clone(),
            criterion: self.criterion.clone(),
            of_interest: self.of_interest.clone(),
            seconds: self.seconds,
            segment_s: self.segment_s,
            candidates: self.candidates,
            limits: Limits {
                room_m: self.room,
                max_saturated: self.max_saturated,
                max_rms_torque_nm: self.max_rms_torque,
            },
            physics_hz: self.physics_hz,
            seed: self.seed,
            ..DesignOptions::new(&self.policy, self.unknowns.clone(), &self.out)
        }
    }
}
