//! Profile likelihood along each parameter of a fit.
//!
//! Oscillating loops and backlash create many local minima. Derivatives indicate neither the global minimum nor the
//! range of neighbouring minima that are almost as good.

use twinstep_model::{RobotModel, Rollout};

use super::cross_validation::FitProblem;
use super::residual_data::ResidualData;
use super::residual_power::evident_channels;
use super::scan::log_likelihood_gain;

/// Distances of the points from the estimate, in both directions [prior std].
const STEPS: [f64; 9] = [0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8];
/// Decrease of the log-likelihood at the ends of a 95 % interval [nat]: half the 95 % quantile of χ² with one degree of
/// freedom.
pub const LOG_LIKELIHOOD_DROP_95: f64 = 1.92;
/// Log-likelihood gain of a point from which the refinement is restarted [nat].
const MIN_RESTART_GAIN: f64 = 3.0;
/// Maximum number of restarts.
const MAX_RESTARTS: usize = 4;

/// Point of the profile along one parameter.
struct ProfilePoint {
    unknown: usize,
    coordinate: f64,
    /// Log-likelihood gain over the estimate [nat].
    gain: f64,
}

/// Refines a fit, and restarts from points of the profile with higher likelihood. Returns the best point [coordinates].
pub fn refine_with_restarts(fit: &FitProblem, evidence: &ResidualData, simulator: &mut dyn Rollout) -> Vec<f64> {
    let mut fit = fit.clone();
    let mut best = fit.solve(&evidence.fit_rows, simulator);
    for _ in 0..MAX_RESTARTS {
        fit.initial_point.clone_from(&best);
        let places = places(&fit, evidence, simulator);
        let Some(better) = places.iter().max_by(|one, other| one.gain.total_cmp(&other.gain)) else { break };
        if better.gain < MIN_RESTART_GAIN {
            break;
        }
        best[better.unknown] = better.coordinate;
        fit.initial_point.clone_from(&best);
        let descended = fit.solve(&evidence.fit_rows, simulator);
        if gains(&fit, std::slice::from_ref(&descended), evidence, simulator)[0] > 0.0 {
            best = descended;
        }
    }
    best
}

/// Returns the profile-likelihood interval of each parameter: points with a drop of less than
/// [`LOG_LIKELIHOOD_DROP_95`] [coordinates].
pub fn profile_intervals(fit: &FitProblem, evidence: &ResidualData, simulator: &mut dyn Rollout) -> Vec<[f64; 2]> {
    let mut ends: Vec<[f64; 2]> = fit.initial_point.iter().map(|coordinate| [*coordinate; 2]).collect();
    for ProfilePoint { unknown, coordinate, gain } in places(fit, evidence, simulator) {
        if gain > -LOG_LIKELIHOOD_DROP_95 {
            let [low, high] = &mut ends[unknown];
            (*low, *high) = (low.min(coordinate), high.max(coordinate));
        }
    }
    ends
}

/// Evaluates the profile along each parameter, in both directions from the initial point of `fit`.
fn places(fit: &FitProblem, evidence: &ResidualData, simulator: &mut dyn Rollout) -> Vec<ProfilePoint> {
    let mut places = Vec::new();
    for (index, unknown) in fit.unknowns.iter().enumerate() {
        let [low, high] = unknown.coordinate_bounds();
        for step in STEPS.into_iter().flat_map(|step| [-step, step]) {
            let coordinate = (fit.initial_point[index] + step * unknown.prior[1]).clamp(low, high);
            places.push(ProfilePoint { unknown: index, coordinate, gain: 0.0 });
        }
    }
    let point = |place: &ProfilePoint| {
        let mut point = fit.initial_point.clone();
        point[place.unknown] = place.coordinate;
        point
    };
    let points: Vec<Vec<f64>> = places.iter().map(point).collect();
    for (place, gain) in places.iter_mut().zip(gains(fit, &points, evidence, simulator)) {
        place.gain = gain;
    }
    places
}

/// Returns the log-likelihood gain of `points` over the initial point of `fit` [nat]; −∞ if a robot is not valid.
fn gains(fit: &FitProblem, points: &[Vec<f64>], evidence: &ResidualData, simulator: &mut dyn Rollout) -> Vec<f64> {
    let robot = |point: &[f64]| fit.model(point).robot_model().ok();
    let all: Vec<Option<RobotModel>> =
        std::iter::once(&fit.initial_point).chain(points).map(|point| robot(point)).collect();
    let robots: Vec<RobotModel> = all.iter().flatten().cloned().collect();
    let mut left = evidence.residual_powers(simulator, &robots, false).into_iter();
    let mut left = all.iter().map(|robot| robot.as_ref().and_then(|_| left.next()));
    let Some(here) = left.next().flatten() else { return vec![f64::NEG_INFINITY; points.len()] };
    let channels = || evident_channels(fit.unknowns.iter().map(|unknown| unknown.effect.target));
    let gain = |left| log_likelihood_gain(evidence, &left, &here, channels());
    left.map(|left| left.map_or(f64::NEG_INFINITY, gain)).collect()
}

#[cfg(test)]
mod tests {
    use twinstep_effects::ModelFile;
    use twinstep_effects::{Effect, Scope};
    use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
    use twinstep_model::BaseMount;
    use twinstep_model::{Joint, Precision, RobotStates, RolloutRequest, go2};

    use super::super::hypothesis::Hypothesis;
    use super::*;
    use twinstep_identify::window::WindowConfig;

    const RATE_HZ: f64 = 200.0;
    /// Rows of a window of [`WindowConfig::DIAGNOSIS`].
    const WINDOW: usize = 400;
    const TRUTH: f64 = 0.3;
    /// Distance between neighbouring local minima [N·m·s].
    const VALLEY: f64 = 0.06;

    /// Returns an oscillation whose phase error is proportional to the error of the friction.
    ///
    /// The residual has a local minimum every [`VALLEY`], with a depth that decreases with the distance from the truth.
    fn position(friction: f64, row: usize) -> f64 {
        let phase = std::f64::consts::TAU * (friction - TRUTH) / VALLEY;
        0.02 * (0.7 * row as f64 + phase).sin() + 0.1 * (friction - TRUTH)
    }

    struct Ringing;

    impl Rollout for Ringing {
        fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
            let play = |job: &RolloutRequest| {
                let mut states = RobotStates::new(job.commands.len() + 1);
                for (row, q) in states.measured.q.iter_mut().enumerate() {
                    q[0] = position(job.robot.joints[0].viscous_friction, row) as f32;
                }
                states
            };
            jobs.iter().map(play).collect()
        }
    }

    fn evidence() -> ResidualData {
        let rows = 5 * WINDOW;
        let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..rows).map(of).collect());
        let columns = [
            column("t", &|row| row as f64 / RATE_HZ),
            // The first row of a window is the last row of the previous one.
            column("q_FL_hip", &|row| position(TRUTH, if row == 0 { 0 } else { (row - 1) % WINDOW + 1 })),
            column("q_cmd_FL_hip", &|_| 0.0),
            column("kp", &|_| 25.0),
            column("kd", &|_| 0.6),
        ];
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let log = Log::new(Meta::new(RATE_HZ, TorqueSensor::None, segments), columns).expect("a log");
        ResidualData::new(vec![log], &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
    }

    fn fit(from: f64) -> FitProblem {
        let effect = Effect::named("viscous_friction").expect("an effect of the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![from] };
        FitProblem::new(&ModelFile::default(), &[hypothesis]).expect("a fit")
    }

    #[test]
    fn restart_leaves_a_local_minimum() {
        let (evidence, fit) = (evidence(), fit(TRUTH + VALLEY));
        let stuck = fit.solve(&evidence.fit_rows, &mut Ringing)[0];
        assert!((stuck - TRUTH - VALLEY).abs() < 0.2 * VALLEY, "the refinement converges to {stuck}");
        let found = refine_with_restarts(&fit, &evidence, &mut Ringing)[0];
        assert!((found - TRUTH).abs() < 0.05 * VALLEY, "{found}");
    }

    #[test]
    fn profile_interval_excludes_the_neighbouring_minimum() {
        let [low, high] = profile_intervals(&fit(TRUTH), &evidence(), &mut Ringing)[0];
        assert!((low..=high).contains(&TRUTH) && high - low < VALLEY, "{low} to {high}");
    }
}
