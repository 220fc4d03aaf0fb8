//! Velocity commands with which the log of a walking robot tells most about unknown parameters.

use std::path::PathBuf;
use std::time::Instant;

use twinstep_effects::{Effect, Scope};
use twinstep_excite::{
    CommandRanges, Criterion, DesignOptions as SearchOptions, Limits, Unknowns, design as search_commands,
};
use twinstep_identify::{CmaEs, EffectAtScope};
use twinstep_policy::Policy;
use twinstep_sim::{BatchRollout, SimConfig};

use crate::ambiguous_effects;
use crate::command_env::{CommandEnv, command_ranges};
use crate::design_report::DesignReport;
use crate::failure::{Failure, input, other};
use crate::observer::Observer;
use crate::robot_file::analytic_model;

/// Limits of a run unless others are given.
pub const DEFAULT_LIMITS: Limits = Limits { room_m: 3.0, max_saturated: 0.05, max_rms_torque_nm: 15.0 };

/// Settings of [`design`].
#[derive(Clone, Debug)]
pub struct DesignOptions {
    /// Policy file of the task `walk` or `gait` (safetensors).
    pub policy: PathBuf,
    /// Effects whose parameters are sought, with scopes.
    pub unknowns: Vec<EffectAtScope>,
    /// Output folder of a diagnosis, whose ambiguous causes are the unknowns, in place of `unknowns` and `model`.
    pub findings: Option<PathBuf>,
    /// Model file of the robot, with what is known of it. `None`: the ideal Go2.
    pub model: Option<PathBuf>,
    /// Criterion of the search.
    pub criterion: Criterion,
    /// Effects that matter for a-optimal and qoed. Empty: all unknowns; for qoed those that random commands identify.
    pub of_interest: Vec<EffectAtScope>,
    /// Duration of the run [s].
    pub seconds: f64,
    /// Duration of a command [s].
    pub segment_s: f64,
    /// Number of command sequences to simulate.
    pub candidates: u32,
    /// Limits of the run.
    pub limits: Limits,
    /// Rate of the physics [Hz]. `None`: that of the batch engine.
    pub physics_hz: Option<u32>,
    /// Seed of the search and of the initial state.
    pub seed: u64,
    /// Folder for the results.
    pub out: PathBuf,
}

/// Result of [`design`].
#[derive(Clone, Debug)]
pub struct Designed {
    /// What the log will tell.
    pub report: DesignReport,
    /// File of the commands (CSV).
    pub commands: PathBuf,
    /// True if it was interrupted: the commands are the best so far.
    pub is_interrupted: bool,
}

/// Designs the velocity commands of a run, and writes them (SPI-Active, section 3.3).
///
/// ```no_run
/// use twinstep_workflows::{DesignOptions, Observer, design};
///
/// let unknowns = vec!["payload@base".parse().expect("an effect")];
/// let options = DesignOptions::new("data/policies/walk.safetensors", unknowns, "design");
/// let designed = design(&options, &Observer::silent())?;
/// print!("{}", designed.report.table(options.segment_s));
/// # Ok::<(), twinstep_workflows::Failure>(())
/// ```
pub fn design(options: &DesignOptions, observer: &Observer) -> Result<Designed, Failure> {
    options.check()?;
    if let Some(folder) = &options.findings {
        let unknowns = ambiguous_effects::read(folder)?;
        let model = Some(folder.join("extended.toml"));
        return design(&DesignOptions { unknowns, model, findings: None, ..options.clone() }, observer);
    }
    std::fs::create_dir_all(&options.out).map_err(|cause| {
        Failure::Input(miette::miette!("`--out` = {}: cannot create the folder: {cause}", options.out.display()))
    })?;
    let model = analytic_model(options.model.as_deref())?;
    let robot = model.robot_model().map_err(input)?;
    let unknowns = Unknowns::new(&model, &effects(&options.unknowns)).map_err(input)?;
    let (policy, _) = Policy::read(&options.policy).map_err(input)?;
    let search = options.search(&unknowns, command_ranges(&policy))?;
    let population = CmaEs::new(&vec![0.0; search.ranges.dim() * search.segments], 1.0).population();
    let sim = SimConfig { physics_hz: options.physics_hz, ..SimConfig::default() };
    let mut env = CommandEnv::new(&policy, &robot, sim, population, options.seed)?;
    let mut rollouts = BatchRollout::new(&robot, &sim).map_err(input)?;
    let since = Instant::now();
    let template = "{bar:30} {pos}/{len} sequences, {per_sec}, ETA {eta}  {msg}";
    let bar = observer.bar(u64::from(options.candidates), template);
    let mut is_interrupted = false;
    let found = search_commands(
        &unknowns,
        &search,
        &mut |sequences| env.simulate(&policy, sequences, options.seed),
        &mut rollouts,
        &mut |simulated, best| {
            bar.set_position(simulated as u64);
            bar.set_message(format!("best {best:.2}"));
            is_interrupted = !matches!(observer.check(), Ok(false));
            !is_interrupted
        },
    );
    bar.finish_and_clear();
    let found = found.map_err(input)?;
    let seconds = since.elapsed().as_secs_f64();
    let report = DesignReport::new(options.criterion.name(), options.seed, &found, &unknowns, seconds);
    for (name, text) in [
        ("commands.csv", found.best.sequence.to_csv()),
        ("design.json", serde_json::to_string_pretty(&report).map_err(other)?),
    ] {
        let path = options.out.join(name);
        twinstep_files::write(&path, text)
            .map_err(|cause| Failure::Input(miette::miette!("cannot write {}: {cause}", path.display())))?;
    }
    Ok(Designed { report, commands: options.out.join("commands.csv"), is_interrupted })
}

fn effects(list: &[EffectAtScope]) -> Vec<(&'static Effect, Scope)> {
    list.iter().map(|EffectAtScope(effect, scope)| (*effect, *scope)).collect()
}

impl DesignOptions {
    /// Returns the options of a run of 25 s with five commands.
    pub fn new(policy: impl Into<PathBuf>, unknowns: Vec<EffectAtScope>, out: impl Into<PathBuf>) -> Self {
        Self {
            policy: policy.into(),
            unknowns,
            findings: None,
            model: None,
            criterion: Criterion::DOptimal,
            of_interest: Vec::new(),
            seconds: 25.0,
            segment_s: 5.0,
            candidates: 1000,
            limits: DEFAULT_LIMITS,
            physics_hz: None,
            seed: 1,
            out: out.into(),
        }
    }

    /// Fails if a number is outside its range.
    fn check(&self) -> Result<(), Failure> {
        let numbers = [
            ("--seconds", self.seconds, 1.0, 600.0),
            ("--segment-s", self.segment_s, 0.1, 600.0),
            ("--room", self.limits.room_m, 0.1, 1000.0),
            ("--max-saturated", self.limits.max_saturated, 1e-6, 1.0),
            ("--max-rms-torque", self.limits.max_rms_torque_nm, 1.0, 100.0),
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

    fn search(&self, unknowns: &Unknowns, ranges: CommandRanges) -> Result<SearchOptions, Failure> {
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
        Ok(SearchOptions {
            segment_s: self.segment_s,
            segments: (self.seconds / self.segment_s).round() as usize,
            ranges,
            limits: self.limits,
            criterion,
            candidates: self.candidates as usize,
            seed: self.seed,
        })
    }
}
