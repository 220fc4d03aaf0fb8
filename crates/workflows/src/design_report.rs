//! What the log of a designed run will tell.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde::Serialize;
use twinstep_excite::{Design, Score, Unknowns};
use twinstep_identify::FreeParameter;
use twinstep_model::{GaitCommand, VelocityCommand};

/// Contents of `design.json`.
#[derive(Clone, Debug, Serialize)]
pub struct DesignReport {
    /// Name of the criterion.
    pub criterion: String,
    /// Seed of the search.
    pub seed: u64,
    /// Number of sequences that were simulated.
    pub simulated: usize,
    /// Number of sequences outside each limit.
    pub rejected: BTreeMap<&'static str, usize>,
    /// Duration of the search [s].
    pub seconds: f64,
    /// The best sequence.
    pub design: ReportedScore,
    /// The random sequence with the median value.
    pub random: ReportedScore,
}

/// A sequence and what its log tells.
#[derive(Clone, Debug, Serialize)]
pub struct ReportedScore {
    /// Value of the criterion.
    pub value: f64,
    /// Velocity command of each segment.
    pub commands: Vec<VelocityCommand>,
    /// Of a policy of `gait`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub gaits: Vec<GaitCommand>,
    /// Largest distance from the start [m].
    pub farthest_m: f64,
    /// Root mean square torque of the most loaded motor [N·m].
    pub rms_torque_nm: f64,
    /// Share of the steps in which a motor is at its torque limit.
    pub saturated: f64,
    /// Standard deviation that log and prior leave, by parameter [prior std].
    pub remaining_std: Vec<(String, f64)>,
}

impl DesignReport {
    pub(crate) fn new(criterion: &str, seed: u64, found: &Design, unknowns: &Unknowns, seconds: f64) -> Self {
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
        Self {
            criterion: criterion.to_owned(),
            seed,
            simulated: found.simulated,
            rejected: found.rejected.clone(),
            seconds,
            design: reported(&found.best),
            random: reported(&found.random),
        }
    }

    /// Returns the summary of segments of this length [s].
    pub fn table(&self, segment_s: f64) -> String {
        let Self { criterion, simulated, rejected, seconds, design, random, .. } = self;
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
        let _ = writeln!(
            text,
            "{:<44}  {:>6.2}  {:>6.2}",
            "distance from the start [m]", design.farthest_m, random.farthest_m
        );
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
            let start = index as f64 * segment_s;
            let _ = write!(text, "{start:>5.1}s {:>5.1}s  {vx:>6.2}  {vy:>6.2}  {wz:>6.2}", start + segment_s);
            if let Some([frequency, fr, rl, rr]) = design.gaits.get(index) {
                let _ = write!(text, "  {frequency:.2} Hz, phases {fr} {rl} {rr}");
            }
            text.push('\n');
        }
        text
    }
}
