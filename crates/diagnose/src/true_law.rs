//! How evident a known effect is in a log: the log-likelihood gain of its true law.

use twinstep_effects::{EffectEntry, ModelFile};
use twinstep_identify::window::WindowConfig;
use twinstep_logs::Log;
use twinstep_model::{RobotModel, Rollout};

use super::DiagnoseError;
use super::fit_problem::FitProblem;
use super::hypothesis::Hypothesis;
use super::residual_data::ResidualData;
use super::residual_power::{ResidualPower, evident_channels};

/// Returns the log-likelihood gain of `law` on top of `known`, which is everything else that is known about the robot: the larger
/// of that with its true values and that with values fitted to the logs, at least 0 [nat].
///
/// Positions of joints and base are simulated in windows of the logs, which are short if the robot of `known` fails to track the joints in
/// long ones; torques are computed from measured states. The gain is infinite if the simulation diverges without the law, or the law cannot
/// be fitted.
pub fn true_law_gain(
    logs: Vec<Log>,
    known: &ModelFile,
    law: &EffectEntry,
    simulator: &mut dyn Rollout,
) -> Result<f64, DiagnoseError> {
    let robot = known.robot_model()?;
    let mut evidence = ResidualData::new(logs.clone(), &robot, WindowConfig::DIAGNOSIS)?;
    let left = evidence.residual_power(simulator, &robot);
    if left.diverged() {
        return Ok(f64::INFINITY);
    }
    if evidence.fails_to_track(&left) {
        evidence = ResidualData::new(logs, &robot, WindowConfig::SHORT)?;
    }
    evidence.set_nuisance_model(&robot, simulator);
    let hypothesis = Hypothesis { effect: law.effect, scope: law.scope, values: law.values.clone() };
    let Some(fit) = FitProblem::new(known, std::slice::from_ref(&hypothesis)) else { return Ok(f64::INFINITY) };
    let fitted = fit.solve(&evidence.fit_rows, simulator);
    let models = [known.clone(), fit.model(&fit.initial_point), fit.model(&fitted)];
    let robots = models.iter().map(ModelFile::robot_model).collect::<Result<Vec<RobotModel>, _>>()?;
    let left = evidence.residual_powers(simulator, &robots);
    let channels = || evident_channels([law.effect.target]);
    let gain = |now: &ResidualPower| {
        let of = |channel: usize| {
            let rows = evidence.correlation_rows(channel);
            [0, 1].map(|fold| now.log_likelihood_gain(&left[0], channel, fold, rows)).iter().sum::<f64>()
        };
        channels().map(of).sum::<f64>() + now.tolerated_gain(&left[0])
    };
    Ok(left[1..].iter().map(gain).fold(0.0, f64::max))
}

#[cfg(test)]
mod tests {
    use twinstep_effects::{Effect, Scope};
    use twinstep_logs::{Meta, Segment, TorqueSensor};
    use twinstep_model::{BaseMount, Joint, Precision, RobotStates, RolloutRequest};

    use super::*;

    /// Standard deviation of the measured positions [rad].
    const NOISE: f64 = 0.001;

    /// Positions that are proportional to the viscous friction of the first joint.
    struct Linear;

    fn position(viscous: f64, row: usize) -> f64 {
        0.05 * viscous * (0.11 * row as f64).sin()
    }

    impl Rollout for Linear {
        fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
            let play = |job: &RolloutRequest| {
                let friction = job.robot.joints[0].viscous_friction;
                let mut states = RobotStates::new(job.commands.len() + 1);
                let rows = states.measured.q.iter_mut().enumerate();
                rows.for_each(|(row, q)| q[0] = position(friction, row) as f32);
                states
            };
            jobs.iter().map(play).collect()
        }
    }

    /// Returns a log of 20 s in the air of a robot with this viscous friction.
    fn log(viscous: f64) -> Log {
        const ROWS: usize = 4000;
        const WINDOW: usize = 400;
        let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..ROWS).map(of).collect());
        let noise = |row: usize| 3.46 * NOISE * ((row * 7919 % 1009) as f64 / 1009.0 - 0.5);
        // The first row of a window is the last row of the previous one.
        let in_window = |row: usize| if row == 0 { 0 } else { (row - 1) % WINDOW + 1 };
        let columns = [
            column("t", &|row| row as f64 / 200.0),
            column("q_FL_hip", &|row| position(viscous, in_window(row)) + noise(row)),
            column("dq_FL_hip", &|row| 0.3 * (0.11 * in_window(row) as f64).cos()),
            column("q_cmd_FL_hip", &|_| 0.0),
            column("kp", &|_| 25.0),
            column("kd", &|_| 0.6),
        ];
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let mut meta = Meta::new(200.0, TorqueSensor::None, segments);
        meta.noise.insert("q_FL_hip".to_owned(), NOISE);
        Log::new(meta, columns).expect("a log")
    }

    /// Returns the gain of a viscous friction of `stated` at one joint of a robot with 0.4, of whose leg a friction of `known` is
    /// known [nat].
    fn gain(known: f64, stated: f64) -> f64 {
        let effect = Effect::named("viscous_friction").expect("in the catalogue");
        let joint = Joint::ALL[0];
        let entry = |scope, value| EffectEntry::new(effect, scope, vec![value]).expect("allowed");
        let known = ModelFile { effects: vec![entry(Scope::Leg(joint.leg), known)], ..ModelFile::default() };
        true_law_gain(vec![log(0.4)], &known, &entry(Scope::Joint(joint), stated), &mut Linear).expect("a gain")
    }

    #[test]
    fn large_error_of_the_friction_is_evident_and_a_tiny_one_is_not() {
        assert!(gain(0.3, 0.4) > 50.0, "{}", gain(0.3, 0.4));
        assert!((0.0..2.0).contains(&gain(0.399, 0.4)), "{}", gain(0.399, 0.4));
    }

    /// Two simulators of a law differ: its true value need not be the best.
    #[test]
    fn law_is_refitted() {
        assert!(gain(0.3, 0.2) > 0.99 * gain(0.3, 0.4), "{} {}", gain(0.3, 0.2), gain(0.3, 0.4));
    }
}
