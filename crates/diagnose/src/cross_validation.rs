//! A trial: one hypothesis fitted to one fold and judged on the other, in full simulation.

use twinstep_effects::{Effect, Scope};
use twinstep_effects::ModelFile;
use twinstep_model::{Precision, RobotModel, Rollout};

use super::residual_data::ResidualData;
use super::hypothesis::{Hypothesis, selection_penalty};
use super::residual_power::{CHANNELS, ResidualPower};
use super::residual_rows::{PRECISION, ResidualRows};
use twinstep_identify::refine::refine;
use twinstep_identify::least_squares::LeastSquaresProblem;
use twinstep_identify::parameter::{FreeParameter, initial_coordinate, free_parameters, with_values};

/// Most steps of a descent: the scan has found the valley.
const STEPS: usize = 6;
/// A step that lowers the cost by a smaller share ends it.
const SETTLED: f64 = 1e-3;

/// What came of a hypothesis.
#[derive(Clone, Debug)]
pub struct CandidateFit {
    /// With values fitted to everything.
    pub hypothesis: Hypothesis,
    /// Evidence on held-out blocks, less the price of choosing and of its parameters [nats].
    pub score: f64,
    /// 1 − RMSE after / RMSE before on the held-out residuals where it acts.
    pub gain: f64,
    /// Share of the power above noise that it explains, in the channels where it acts.
    pub explained_fraction: f64,
}

/// Model and unknowns of effects on top of `model`, and where a descent begins: at `hypothesis` for the last of them.
#[derive(Clone)]
pub struct FitProblem {
    /// The model with an entry for each effect.
    pub file: ModelFile,
    /// Their numbers.
    pub unknowns: Vec<FreeParameter>,
    /// Where a descent begins [coordinates].
    pub initial_point: Vec<f64>,
}

impl FitProblem {
    /// Of `hypotheses`, all at once.
    pub fn new(model: &ModelFile, hypotheses: &[Hypothesis]) -> Option<Self> {
        let effects: Vec<(&'static Effect, Scope)> = hypotheses.iter().map(|one| (one.effect, one.scope)).collect();
        let (file, unknowns) = free_parameters(model, &effects).ok()?;
        let values: Vec<f64> = hypotheses.iter().flat_map(|one| one.values.iter().copied()).collect();
        // Where nothing is known of a value it begins where there is none of it.
        let begin = unknowns
            .iter()
            .zip(&values)
            .map(|(unknown, value)| if value.is_finite() { unknown.coordinate(*value) } else { initial_coordinate(&file, unknown) });
        Some(Self { initial_point: begin.collect(), file, unknowns })
    }

    /// The numbers that follow `rows` best.
    pub fn solve(&self, rows: &ResidualRows, simulator: &mut dyn Rollout) -> Vec<f64> {
        let (mut steps, mut last) = (0, f64::INFINITY);
        self.with_problem(rows, simulator, PRECISION, |task, simulator| {
            refine(task, simulator, self.initial_point.clone(), |cost| {
                steps += 1;
                let settled = last - cost < SETTLED * cost;
                last = cost;
                steps < STEPS && !settled
            })
        })
    }

    /// Hands on what is asked of `rows`, weighted as the beginning lets expect.
    pub fn with_problem<R>(
        &self,
        rows: &ResidualRows,
        simulator: &mut dyn Rollout,
        precision: Precision,
        ask: impl FnOnce(&LeastSquaresProblem, &mut dyn Rollout) -> R,
    ) -> R {
        let (file, unknowns, experiments) = (&self.file, &self.unknowns[..], &rows.experiments[..]);
        let tolerances = rows.tolerances.as_ref();
        let task = LeastSquaresProblem { file, unknowns, experiments, residual_scale: &[], tolerances, precision };
        let spread = task.estimate_residual_scale(simulator, &self.initial_point);
        let tolerances = tolerances.and_then(|tolerances| tolerances.rescaled(&spread));
        ask(&LeastSquaresProblem { residual_scale: &spread, tolerances: tolerances.as_ref(), ..task }, simulator)
    }

    /// The model with these numbers.
    pub fn model(&self, point: &[f64]) -> ModelFile {
        with_values(&self.file, &self.unknowns, point)
    }
}

/// Tries `hypothesis` on top of `model`, which leaves `before`.
pub fn cross_validate(
    evidence: &ResidualData,
    model: &ModelFile,
    before: &ResidualPower,
    hypothesis: &Hypothesis,
    simulator: &mut dyn Rollout,
) -> Option<CandidateFit> {
    let fit = FitProblem::new(model, std::slice::from_ref(hypothesis))?;
    let points = [0, 1].map(|fold| fit.solve(&evidence.folds[fold], simulator));
    let whole: Vec<f64> = points[0].iter().zip(&points[1]).map(|(one, other)| 0.5 * (one + other)).collect();
    let models = [fit.model(&points[0]), fit.model(&points[1]), fit.model(&whole)];
    let robots: Vec<RobotModel> = models.iter().map(|model| model.robot_model().ok()).collect::<Option<_>>()?;
    let left = evidence.residual_powers(simulator, &robots, false);
    // Fitted to one fold, judged on the other.
    let judged = |channel: usize| {
        let rows = evidence.correlation_rows(channel);
        left[0].log_likelihood_gain(before, channel, 1, rows) + left[1].log_likelihood_gain(before, channel, 0, rows)
    };
    let tolerated: f64 = left[..2].iter().map(|left| 0.5 * left.tolerated_gain(before)).sum();
    let evidence_nats: f64 = (0..CHANNELS).map(judged).sum::<f64>() + tolerated;
    let parameters = 0.5 * fit.unknowns.len() as f64 * 200f64.ln();
    let held_out = |channel: usize| left[0].sums[channel][1] + left[1].sums[channel][0];
    let acts: Vec<usize> = (0..CHANNELS).filter(|channel| judged(*channel) > 1.0).collect();
    let [then, now] = [
        acts.iter().map(|channel| before.sums[*channel].iter().sum::<f64>()).sum::<f64>(),
        acts.iter().map(|channel| held_out(*channel)).sum::<f64>(),
    ];
    let above = |left: &ResidualPower| {
        let tolerated = if tolerated > 1.0 { left.tolerated_excess() } else { 0.0 };
        acts.iter().map(|channel| left.channel_excess(*channel)).sum::<f64>() + tolerated
    };
    let [above, left_above] = [above(before), above(&left[2])];
    let values = fit.unknowns.iter().zip(&whole).map(|(unknown, coordinate)| unknown.value(*coordinate)).collect();
    Some(CandidateFit {
        hypothesis: Hypothesis { values, ..hypothesis.clone() },
        score: evidence_nats - selection_penalty(hypothesis.scope) - parameters,
        gain: if then > 0.0 { 1.0 - (now / then).sqrt() } else { 0.0 },
        explained_fraction: if above > 0.0 { 1.0 - left_above / above } else { 0.0 },
    })
}
