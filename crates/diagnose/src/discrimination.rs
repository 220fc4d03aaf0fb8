//! Discrimination between two hypotheses: expected log-likelihood ratio of a motion, and log-likelihood ratio of a log.

use twinstep_effects::ModelFile;
use twinstep_effects::{Effect, Scope};
use twinstep_logs::{Log, Meta, TorqueSensor};
use twinstep_model::{
    BaseMount, FIXED_BASE_HEIGHT, Ground, InitialState, JOINT_NAMES, Precision, RobotModel, Rollout, RolloutRequest,
};

use super::fit_problem::FitProblem;
use super::hypothesis::Hypothesis;
use super::residual_data::ResidualData;
use super::residual_power::{CHANNELS, ResidualPower};
use super::residual_rows::PRECISION;
use crate::excitation::ExcitationTrajectory;
use twinstep_identify::ExperimentError;
use twinstep_identify::experiment::estimated_torque;
use twinstep_identify::least_squares::LeastSquaresProblem;
use twinstep_identify::window::WindowConfig;
use twinstep_logs::replay::{command, joint_commands};

/// Fractions of the Gauss–Newton step that are tried, because the residuals are not linear.
const STEPS: [f64; 4] = [0.0, 0.25, 0.5, 1.0];

/// Two hypotheses on top of a common model.
#[derive(Clone, Debug)]
pub struct HypothesisPair {
    model: ModelFile,
    sides: [Hypothesis; 2],
}

impl HypothesisPair {
    /// Creates a pair of two effects on top of `model`, each with its scope and values.
    pub fn new(model: ModelFile, sides: [(&'static Effect, Scope, Vec<f64>); 2]) -> Self {
        Self { model, sides: sides.map(|(effect, scope, values)| Hypothesis { effect, scope, values }) }
    }

    /// Returns the effects of both hypotheses.
    pub fn effects(&self) -> [&'static Effect; 2] {
        self.sides.each_ref().map(|side| side.effect)
    }

    /// Returns the names of the hypotheses, as in `armature@calf`.
    pub fn names(&self) -> [String; 2] {
        self.sides.each_ref().map(Hypothesis::name)
    }

    /// Returns the expected log-likelihood ratio of the true hypothesis to the other for `motion` [nat].
    ///
    /// It is the mean of both cases. The other hypothesis is refitted, so that only the difference that it cannot
    /// imitate counts. `like` determines the measured channels and their noise. Returns `None` if a simulation fails.
    pub fn expected_log_likelihood_ratio(
        &self,
        motion: &ExcitationTrajectory,
        like: &Log,
        simulator: &mut dyn Rollout,
    ) -> Option<f64> {
        let [one, other] = &self.sides;
        let nats = [(one, other), (other, one)].map(|(truth, rival)| {
            let robot = self.robot(truth)?;
            let log = simulated(motion, &robot, like, simulator)?;
            let evidence = ResidualData::new(vec![log], &robot, WindowConfig::DIAGNOSIS).ok()?;
            Some(expected_gain(&evidence, &gauss_newton_refit(&self.fit(rival)?, &evidence, simulator)?))
        });
        Some(0.5 * (nats[0]? + nats[1]?))
    }

    /// Returns the log-likelihood ratio of the first hypothesis to the second on `log` [nat], both fitted to it.
    pub fn log_likelihood_ratio(&self, log: Log, simulator: &mut dyn Rollout) -> Result<f64, ExperimentError> {
        let robot = self.model.robot_model().expect("a model that was given is a robot");
        let evidence = ResidualData::new(vec![log], &robot, WindowConfig::DIAGNOSIS)?;
        let [one, other] = self.sides.each_ref().map(|side| {
            let fit = self.fit(side).expect("an effect of the catalogue goes on top of any model");
            let point = fit.solve(&evidence.fit_rows, simulator);
            let robot = fit.model(&point).robot_model().expect("fitted within its bounds");
            evidence.residual_power(simulator, &robot)
        });
        let gain = |channel, fold| one.log_likelihood_gain(&other, channel, fold, evidence.correlation_rows(channel));
        Ok((0..CHANNELS).map(|channel| gain(channel, 0) + gain(channel, 1)).sum())
    }

    fn robot(&self, side: &Hypothesis) -> Option<RobotModel> {
        let fit = self.fit(side)?;
        fit.model(&fit.initial_point).robot_model().ok()
    }

    fn fit(&self, side: &Hypothesis) -> Option<FitProblem> {
        FitProblem::new(&self.model, std::slice::from_ref(side))
    }
}

/// Returns the residual power of the alternative hypothesis after one Gauss–Newton step of its parameters.
fn gauss_newton_refit(fit: &FitProblem, evidence: &ResidualData, simulator: &mut dyn Rollout) -> Option<ResidualPower> {
    let task = LeastSquaresProblem {
        file: &fit.file,
        unknowns: &fit.unknowns,
        experiments: &evidence.fit_rows.experiments,
        residual_scale: &[],
        tolerances: None,
        precision: PRECISION,
    };
    let here = LeastSquaresProblem { precision: Precision::Double, ..task }.linearise(simulator, &fit.initial_point)?;
    let step = here.jacobian.clone().svd(true, true).solve(&-here.residuals, 1e-9).ok()?;
    let moved = |part: f64| {
        let moved: Vec<f64> =
            task.to_prior_units(&fit.initial_point).zip(step.iter()).map(|(now, step)| now + part * step).collect();
        fit.model(&task.from_prior_units(&moved)).robot_model().ok()
    };
    let robots: Vec<RobotModel> = STEPS.into_iter().filter_map(moved).collect();
    let left = evidence.residual_powers(simulator, &robots).into_iter().filter(|left| !left.diverged());
    left.min_by(|one, other| expected_gain(evidence, one).total_cmp(&expected_gain(evidence, other)))
}

/// Returns the expected log-likelihood ratio [nat] of the true model to the alternative, for noisy data with these
/// residuals.
fn expected_gain(evidence: &ResidualData, left: &ResidualPower) -> f64 {
    let of = |channel: usize| -> f64 {
        let rows = evidence.correlation_rows(channel);
        let folds = left.sums[channel].into_iter().zip(left.counts[channel]).filter(|(_, count)| *count > 0.0);
        // Power 1 is that of the noise, which remains in both models.
        folds.map(|(sum, count)| 0.5 * count / rows * (sum / count).ln_1p()).sum()
    };
    (0..CHANNELS).map(of).sum()
}

/// Simulates a motion of `robot` without noise, and returns a log with the channels and the noise metadata of `like`.
///
/// Returns `None` if the simulation diverges.
fn simulated(
    motion: &ExcitationTrajectory,
    robot: &RobotModel,
    like: &Log,
    simulator: &mut dyn Rollout,
) -> Option<Log> {
    let commanded = motion.motion(robot);
    let joints = joint_commands(&commanded).ok()?;
    let commands: Vec<_> = (0..commanded.rows()).map(|row| command(robot, &joints, row)).collect();
    let pose = robot.control.default_pose_f32();
    let held = motion.base == BaseMount::Fixed;
    let start = if held {
        InitialState::at_rest(FIXED_BASE_HEIGHT as f32, pose)
    } else {
        InitialState::standing_on(&Ground::FLAT, robot, pose, 0.0)
    };
    let states = simulator
        .run(
            &[RolloutRequest { robot, base: motion.base, start, history: &[], commands: &commands, derating: &[] }],
            Precision::Double,
        )
        .remove(0);
    let mut meta = Meta { noise: like.meta().noise.clone(), ..commanded.meta().clone() };
    let mut columns: Vec<_> = commanded.channels().map(|(name, cells)| (name.to_owned(), cells.to_vec())).collect();
    columns.push(("t".to_owned(), commanded.t().to_vec()));
    let mut channel = |name: String, of: &dyn Fn(usize) -> f32| {
        columns.push((name, (0..commands.len()).map(|row| f64::from(of(row))).collect()));
    };
    for (joint, name) in JOINT_NAMES.into_iter().enumerate() {
        channel(format!("q_{name}"), &|row| states.measured.q[row][joint]);
        if like.dq(name).is_some() {
            channel(format!("dq_{name}"), &|row| states.measured.dq[row][joint]);
        }
        if like.tau_measured(name).is_some() {
            // Also for an output sensor: the additional information that it has is not assumed.
            meta.tau_sensor = TorqueSensor::MotorCurrent;
            channel(format!("tau_measured_{name}"), &|row| {
                estimated_torque(&states, robot, joint, row, row + 1) as f32
            });
        }
    }
    if !held {
        for (axis, letter) in ["x", "y", "z"].into_iter().enumerate() {
            channel(format!("pos_{letter}"), &|row| states.truth.base_position[row][axis]);
            channel(format!("vel_{letter}"), &|row| states.truth.base_linear_velocity[row][axis]);
            channel(format!("gyro_{letter}"), &|row| states.measured.gyro[row][axis]);
        }
        for (part, letter) in ["w", "x", "y", "z"].into_iter().enumerate() {
            channel(format!("quat_{letter}"), &|row| states.measured.orientation[row][part]);
        }
    }
    Log::new(meta, columns).ok()
}
