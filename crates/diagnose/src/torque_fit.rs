//! Fit of one cause to torques, with other causes unchanged.

use twinstep_effects::{EffectEntry, ModelFile, Scope};
use twinstep_model::RobotModel;

use super::hypothesis::selection_penalty;
use super::joint_slots::JointSlots;
use super::profile_likelihood::LOG_LIKELIHOOD_DROP_95;
use super::reporting::{SIMULATOR_MISMATCH_REL_STD, TWO_SIDED_95};
use super::residual_power::{ResidualPower, TORQUE};
use twinstep_identify::parameter::{FreeParameter, free_parameters};

/// First and last step of the coordinate descent [prior std].
const STEPS: [f64; 2] = [0.2, 0.01];
/// Distances from the estimate at which the end of an interval is searched [prior std].
const PROFILE_STEPS: [f64; 14] = [0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0];

/// Cross-validated cause.
#[derive(Clone)]
pub struct TorqueCandidate {
    /// The cause with the mean of the values fitted to either fold.
    pub entry: EffectEntry,
    /// Cross-validated log-likelihood gain, minus the penalties for its scope and its parameters [nat].
    pub score: f64,
    /// 1 − RMSE after / RMSE before, cross-validated.
    pub gain: f64,
    /// Fraction of the power above noise that it explains.
    pub explains: f64,
    /// Alternative hypotheses.
    pub others: Vec<TorqueCandidate>,
}

/// Fit of a cause on top of others.
pub struct TorqueFit<'a> {
    slots: &'a JointSlots,
    others: &'a [EffectEntry],
    cause: &'a EffectEntry,
    unknowns: Vec<FreeParameter>,
    begin: Vec<f64>,
    before: ResidualPower,
}

impl<'a> TorqueFit<'a> {
    /// Creates the fit of `cause` on top of `others`, which starts at the values of `cause`.
    pub fn new(slots: &'a JointSlots, others: &'a [EffectEntry], cause: &'a EffectEntry) -> Option<Self> {
        let (_, unknowns) = free_parameters(&ModelFile::default(), &[(cause.effect, cause.scope)]).ok()?;
        let begin = unknowns.iter().zip(&cause.values).map(|(unknown, value)| unknown.coordinate(*value)).collect();
        let before = slots.residual_powers(&[slots.robot(others)?]).remove(0);
        Some(Self { slots, others, cause, unknowns, begin, before })
    }

    /// Returns the cause with the values of `point`.
    pub fn entry_at(&self, point: &[f64]) -> EffectEntry {
        let values = self.unknowns.iter().zip(point).map(|(unknown, coordinate)| unknown.value(*coordinate)).collect();
        EffectEntry { values, ..self.cause.clone() }
    }

    /// Returns the point with the largest log-likelihood gain on `folds`, by coordinate descent.
    ///
    /// The step is halved if no step along a single parameter improves the point.
    pub fn coordinate_descent(&self, folds: &[usize]) -> Vec<f64> {
        let [mut step, last] = STEPS;
        let mut point = self.begin.clone();
        let mut most = self.nats(std::slice::from_ref(&point), folds)[0];
        while step > last {
            let tries: Vec<Vec<f64>> = (0..point.len())
                .flat_map(|index| [-step, step].map(|step| (index, step)))
                .map(|(index, step)| self.moved(&point, index, step))
                .collect();
            let found = self.nats(&tries, folds);
            let best = (0..tries.len()).max_by(|one, other| found[*one].total_cmp(&found[*other]));
            match best.filter(|best| found[*best] > most) {
                Some(best) => (point, most) = (tries[best].clone(), found[best]),
                None => step *= 0.5,
            }
        }
        point
    }

    /// Fits the cause to one fold and evaluates it on the other. Returns `None` if the actuators are not valid.
    pub fn cross_validated(&self) -> Option<TorqueCandidate> {
        let [one, other] = [0, 1].map(|fold| self.coordinate_descent(&[fold]));
        let middle = one.iter().zip(&other).map(|(one, other)| 0.5 * (one + other)).collect();
        let points = [one, other, middle];
        let robots: Vec<RobotModel> = points.iter().map(|point| self.robot(point)).collect::<Option<_>>()?;
        let left = self.slots.residual_powers(&robots);
        let scope = self.cause.scope;
        let evidence: f64 =
            [(0, 1), (1, 0)].map(|(of, on)| nats(self.slots, scope, &left[of], &self.before, &[on])).iter().sum();
        let sums = |left: [&ResidualPower; 2]| -> f64 {
            self.slots.of(scope).map(|seat| left[0].sums[TORQUE + seat][1] + left[1].sums[TORQUE + seat][0]).sum()
        };
        let [then, now] = [sums([&self.before; 2]), sums([&left[0], &left[1]])];
        let [above, still] = [&self.before, &left[2]].map(|left| excess(self.slots, scope, left));
        Some(TorqueCandidate {
            entry: self.entry_at(&points[2]),
            score: evidence - selection_penalty(scope) - 0.5 * self.unknowns.len() as f64 * 200f64.ln(),
            gain: if then > 0.0 { 1.0 - (now / then).sqrt() } else { 0.0 },
            explains: if above > 0.0 { 1.0 - still / above } else { 0.0 },
            others: Vec::new(),
        })
    }

    /// Returns the 95 % intervals of the values.
    ///
    /// Each is the profile-likelihood interval, widened to at least the mismatch between simulators.
    pub fn intervals(&self) -> Vec<[f64; 2]> {
        let most = self.nats(std::slice::from_ref(&self.begin), &[0, 1])[0];
        let end = |index: usize, side: f64| {
            let points: Vec<Vec<f64>> =
                PROFILE_STEPS.iter().map(|step| self.moved(&self.begin, index, side * step)).collect();
            let found = self.nats(&points, &[0, 1]);
            let first = (0..points.len()).find(|place| most - found[*place] > LOG_LIKELIHOOD_DROP_95);
            points[first.unwrap_or(points.len() - 1)][index]
        };
        let interval = |index: usize| {
            let (here, unknown) = (self.begin[index], &self.unknowns[index]);
            let least = TWO_SIDED_95 * SIMULATOR_MISMATCH_REL_STD * (here - unknown.coordinate(unknown.neutral)).abs();
            let ends = [end(index, -1.0).min(here - least), end(index, 1.0).max(here + least)];
            let [one, other] = ends.map(|end| unknown.value(end));
            [one.min(other), one.max(other)]
        };
        (0..self.unknowns.len()).map(interval).collect()
    }

    fn moved(&self, point: &[f64], index: usize, step: f64) -> Vec<f64> {
        let (mut point, unknown) = (point.to_vec(), &self.unknowns[index]);
        let [low, high] = unknown.coordinate_bounds();
        point[index] = (point[index] + step * unknown.prior[1]).clamp(low, high);
        point
    }

    fn robot(&self, point: &[f64]) -> Option<RobotModel> {
        self.slots.robot(&[self.others, &[self.entry_at(point)]].concat())
    }

    /// Returns the log-likelihood gain of points over the model without the cause [nat].
    fn nats(&self, points: &[Vec<f64>], folds: &[usize]) -> Vec<f64> {
        let robots: Vec<Option<RobotModel>> = points.iter().map(|point| self.robot(point)).collect();
        let built: Vec<RobotModel> = robots.iter().flatten().cloned().collect();
        let mut left = self.slots.residual_powers(&built).into_iter();
        let scope = self.cause.scope;
        let found = |robot: &Option<RobotModel>| {
            let left = robot.as_ref().and_then(|_| left.next());
            left.map_or(f64::NEG_INFINITY, |left| nats(self.slots, scope, &left, &self.before, folds))
        };
        robots.iter().map(found).collect()
    }
}

/// Returns the log-likelihood gain of `now` over `before` on a scope [nat].
pub fn nats(slots: &JointSlots, scope: Scope, now: &ResidualPower, before: &ResidualPower, folds: &[usize]) -> f64 {
    let rows = slots.rows_in_one();
    let of =
        |seat: usize| folds.iter().map(|fold| now.log_likelihood_gain(before, TORQUE + seat, *fold, rows)).sum::<f64>();
    slots.of(scope).map(of).sum()
}

/// Returns the power above noise on a scope.
pub fn excess(slots: &JointSlots, scope: Scope, left: &ResidualPower) -> f64 {
    slots.of(scope).map(|seat| left.channel_excess(TORQUE + seat)).sum()
}
