//! `twinstep excite`: velocity commands with which the log of a walking robot tells most about unknown parameters.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::PathBuf;
use std::time::Instant;

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use twinstep_effects::{Effect, Scope};
use twinstep_excite::{CommandRanges, Criterion, Design, DesignOptions, Limits, Score, Unknowns, design};
use twinstep_identify::{CmaEs, EffectAtScope, FreeParameter};
use twinstep_model::{GaitCommand, VelocityCommand};
use twinstep_policy::Policy;
use twinstep_sim::{BatchRollout, SimConfig};

use crate::ambiguous_effects;
use crate::command_env::{CommandEnv, command_ranges};
use crate::exit::{CommandResult, Failure, Signals, input, other};
use crate::robot_file::analytic_model;

/// Limits of a run unless others are given.
pub const DEFAULT_LIMITS: Limits = Limits { room_m: 3.0, max_saturated: 0.05, max_rms_torque_nm: 15.0 };

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
#[derive(Clone, clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Args {
    /// Policy file of the task `walk` or `gait` (safetensors).
    pub policy: PathBuf,
    /// Effects whose parameters are sought, with scopes, as in `payload@base,coulomb_friction@calf`. `twinstep effects`
    /// lists them.
    #[arg(long, value_name = "EFFECTS", value_delimiter = ',', required_unless_present = "findings")]
    pub unknowns: Vec<EffectAtScope>,
    /// Output folder of `twinstep diagnose`: the unknowns are the causes that it could not tell apart, and the model is its
    /// corrected one.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["unknowns", "model"])]
    pub findings: Option<PathBuf>,
    /// Model file of the robot, with what is known of it. Default: the ideal Go2.
    #[arg(long, value_name = "FILE")]
    pub model: Option<PathBuf>,
    /// trace, d-optimal, a-optimal or qoed.
    #[arg(long, default_value = "d-optimal")]
    pub criterion: Criterion,
    /// Effects that matter for a-optimal and qoed. Default: all of --unknowns; for qoed those that random commands identify.
    #[arg(long, value_name = "EFFECTS", value_delimiter = ',')]
    pub of_interest: Vec<EffectAtScope>,
    /// Duration of the run [s].
    #[arg(long, value_name = "S", default_value_t = 25.0)]
    pub seconds: f64,
    /// Duration of a command [s].
    #[arg(long, value_name = "S", default_value_t = 5.0)]
    pub segment_s: f64,
    /// Number of command sequences to simulate.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub candidates: u32,
    /// Largest horizontal distance from the start [m].
    #[arg(long, value_name = "M", default_value_t = DEFAULT_LIMITS.room_m)]
    pub room: f64,
    /// Largest share of the steps in which a motor is at its torque limit.
    #[arg(long, value_name = "SHARE", default_value_t = DEFAULT_LIMITS.max_saturated)]
    pub max_saturated: f64,
    /// Largest root mean square of a motor's torque, which heats it [N·m].
    #[arg(long, value_name = "NM", default_value_t = DEFAULT_LIMITS.max_rms_torque_nm)]
    pub max_rms_torque: f64,
    /// Rate of the physics [Hz]. At 400 Hz a search takes 0.6 times the time, but the order of candidates correlates with that
    /// at 1000 Hz by 0.8 only. Default: 1000.
    #[arg(long, value_name = "HZ")]
    pub physics_hz: Option<u32>,
    /// Seed of the search and of the initial state.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Folder for the results.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Contents of `design.json`.
#[derive(Serialize)]
struct Report {
    criterion: String,
    seed: u64,
    simulated: usize,
    rejected: BTreeMap<&'static str, usize>,
    seconds: f64,
    design: ReportedScore,
    /// The random sequence with the median value.
    random: ReportedScore,
}

/// A sequence and what its log tells.
#[derive(Serialize)]
struct ReportedScore {
    value: f64,
    commands: Vec<VelocityCommand>,
    /// Of a policy of `gait`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    gaits: Vec<GaitCommand>,
    farthest_m: f64,
    rms_torque_nm: f64,
    saturated: f64,
    /// Standard deviation that log and prior leave, by parameter [prior std].
    remaining_std: Vec<(String, f64)>,
}

/// Designs the experiment, writes it, and says how to run it.
pub fn run(args: &Args) -> CommandResult {
    let designed = write_design(args, &Signals::listen()?);
    if matches!(designed, Ok(()) | Err(Failure::Interrupted)) {
        let (policy, path) = (args.policy.display(), args.out.join("commands.csv"));
        let path = path.display();
        println!("written to {path}; run it: twinstep run {policy} --commands {path} --log DIR");
    }
    designed
}

/// Designs the experiment, writes it, and prints what its log will tell.
pub fn write_design(args: &Args, signals: &Signals) -> CommandResult {
    args.check()?;
    if let Some(folder) = &args.findings {
        let unknowns = ambiguous_effects::read(folder)?;
        let model = Some(folder.join("extended.toml"));
        return write_design(&Args { unknowns, model, findings: None, ..args.clone() }, signals);
    }
    std::fs::create_dir_all(&args.out).map_err(|cause| {
        Failure::Input(miette::miette!("`--out` = {}: cannot create the folder: {cause}", args.out.display()))
    })?;
    let model = analytic_model(args.model.as_deref())?;
    let robot = model.robot_model().map_err(input)?;
    let unknowns = Unknowns::new(&model, &effects(&args.unknowns)).map_err(input)?;
    let (policy, _) = Policy::read(&args.policy).map_err(input)?;
    let options = args.options(&unknowns, command_ranges(&policy))?;
    let population = CmaEs::new(&vec![0.0; options.ranges.dim() * options.segments], 1.0).population();
    let sim = SimConfig { physics_hz: args.physics_hz, ..SimConfig::default() };
    let mut env = CommandEnv::new(&policy, &robot, sim, population, args.seed)?;
    let mut rollouts = BatchRollout::new(&robot, &sim).map_err(input)?;
    let since = Instant::now();
    let bar = progress_bar(args.candidates);
    let mut interrupted = false;
    let found = design(
        &unknowns,
        &options,
        &mut |sequences| env.simulate(&policy, sequences, args.seed),
        &mut rollouts,
        &mut |simulated, best| {
            bar.set_position(simulated as u64);
            bar.set_message(format!("best {best:.2}"));
            interrupted = !matches!(signals.check(), Ok(false));
            !interrupted
        },
    );
    bar.finish_and_clear();
    let found = found.map_err(input)?;
    let seconds = since.elapsed().as_secs_f64();
    let report = args.report(&found, &unknowns, seconds);
    for (name, text) in [
        ("commands.csv", found.best.sequence.to_csv()),
        ("design.json", serde_json::to_string_pretty(&report).map_err(other)?),
    ] {
        let path = args.out.join(name);
        twinstep_files::write(&path, text)
            .map_err(|cause| Failure::Input(miette::miette!("cannot write {}: {cause}", path.display())))?;
    }
    print!("{}", text(&report, &options));
    if interrupted { Err(Failure::Interrupted) } else { Ok(()) }
}

fn effects(list: &[EffectAtScope]) -> Vec<(&'static Effect, Scope)> {
    list.iter().map(|EffectAtScope(effect, scope)| (*effect, *scope)).collect()
}

fn progress_bar(candidates: u32) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} sequences, {per_sec}, ETA {eta}  {msg}");
    ProgressBar::new(u64::from(candidates)).with_style(style.expect("the template is valid"))
}

impl Args {
    /// Fails if a number is outside its range.
    fn check(&self) -> CommandResult {
        let numbers = [
            ("--seconds", self.seconds, 1.0, 600.0),
            ("--segment-s", self.segment_s, 0.1, 600.0),
            ("--room", self.room, 0.1, 1000.0),
            ("--max-saturated", self.max_saturated, 1e-6, 1.0),
            ("--max-rms-torque", self.max_rms_torque, 1.0, 100.0),
        ];
        for (name, value, low, high) in numbers {
            if !(low..=high).contains(&value) {
                return Err(Failure::Input(miette::miette!("`{name}` = {value} is outside {low} to {high}")));
            }
        }
        let segments = self.seconds / self.segment_s;
        if segments.round() < 1.0 || (segments - segments.round()).abs() > 1e-6 {
            return Err(Failure::Input(miette::miette!(
                "`--seconds` = {} is not a multiple of `--segment-s` = {}",
                self.seconds,
                self.segment_s
            )));
        }
        Ok(())
    }

    fn options(&self, unknowns: &Unknowns, ranges: CommandRanges) -> Result<DesignOptions, Failure> {
        let of_interest = effects(&self.of_interest);
        let names = |(effect, scope): &(&'static Effect, Scope)| format!("{}@{scope}", effect.name);
        if let Some(missing) = of_interest.iter().find(|one| !effects(&self.unknowns).contains(one)) {
            let unknowns: Vec<_> = effects(&self.unknowns).iter().map(names).collect();
            let (missing, unknowns) = (names(missing), unknowns.join(", "));
            return Err(Failure::Input(miette::miette!(
                "`--of-interest` = `{missing}` is not one of the unknowns: {unknowns}"
            )));
        }
        let is_of_interest = |index: &usize| {
            let parameter = &unknowns.parameters()[*index];
            of_interest.is_empty() || of_interest.contains(&(parameter.effect, parameter.scope))
        };
        let criterion = match &self.criterion {
            Criterion::AOptimal(_) => {
                Criterion::AOptimal((0..unknowns.parameters().len()).filter(is_of_interest).collect())
            }
            // Without a list, those that a random sequence identifies.
            Criterion::Qoed(_) if !of_interest.is_empty() => {
                Criterion::Qoed((0..unknowns.parameters().len()).filter(is_of_interest).collect())
            }
            criterion => criterion.clone(),
        };
        Ok(DesignOptions {
            segment_s: self.segment_s,
            segments: (self.seconds / self.segment_s).round() as usize,
            ranges,
            limits: Limits {
                room_m: self.room,
                max_saturated: self.max_saturated,
                max_rms_torque_nm: self.max_rms_torque,
            },
            criterion,
            candidates: self.candidates as usize,
            seed: self.seed,
        })
    }

    fn report(&self, found: &Design, unknowns: &Unknowns, seconds: f64) -> Report {
        let reported = |score: &Score| ReportedScore {
            value: score.value,
            commands: score.sequence.segments().iter().map(|segment| segment.velocity).collect(),
            gaits: score.sequence.segments().iter().filter_map(|segment| segment.gait).collect(),
            farthest_m: score.motion.farthest_m,
            rms_torque_nm: score.motion.rms_torque_nm,
            saturated: score.motion.saturated,
            remaining_std: unknowns
                .parameters()
                .iter()
                .map(FreeParameter::name)
                .zip(score.std.iter().copied())
                .collect(),
        };
        Report {
            criterion: self.criterion.name().to_owned(),
            seed: self.seed,
            simulated: found.simulated,
            rejected: found.rejected.clone(),
            seconds,
            design: reported(&found.best),
            random: reported(&found.random),
        }
    }
}

/// Returns the summary.
fn text(report: &Report, options: &DesignOptions) -> String {
    let Report { criterion, simulated, rejected, seconds, design, random, .. } = report;
    let limits: Vec<_> = rejected.iter().map(|(limit, count)| format!("{count} {limit}")).collect();
    let limits = if limits.is_empty() { "none".to_owned() } else { limits.join(", ") };
    let mut text = format!(
        "{simulated} sequences in {seconds:.0} s; outside the limits: {limits}\n\n{:<44}  design  random\n",
        "remaining standard deviation / prior"
    );
    for ((name, design), (_, random)) in design.remaining_std.iter().zip(&random.remaining_std) {
        let _ = writeln!(text, "{name:<44}  {design:>6.3}  {random:>6.3}");
    }
    let _ = writeln!(text, "{:<44}  {:>6.2}  {:>6.2}", criterion, design.value, random.value);
    let _ =
        writeln!(text, "{:<44}  {:>6.2}  {:>6.2}", "distance from the start [m]", design.farthest_m, random.farthest_m);
    let _ = writeln!(
        text,
        "{:<44}  {:>6.2}  {:>6.2}",
        "RMS torque of the most loaded motor [N·m]", design.rms_torque_nm, random.rms_torque_nm
    );
    let _ = writeln!(
        text,
        "`random` is the random sequence with the median value.\n\n  from     to      vx      vy      wz"
    );
    for (index, [vx, vy, wz]) in design.commands.iter().enumerate() {
        let start = index as f64 * options.segment_s;
        let _ = write!(text, "{start:>5.1}s {:>5.1}s  {vx:>6.2}  {vy:>6.2}  {wz:>6.2}", start + options.segment_s);
        if let Some([frequency, fr, rl, rr]) = design.gaits.get(index) {
            let _ = write!(text, "  {frequency:.2} Hz, phases {fr} {rl} {rr}");
        }
        text.push('\n');
    }
    text
}
