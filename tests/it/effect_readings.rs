//! Comparison of sensor effects, and of effects that depend on logged channels, with their definitions.

use glam::Vec3;
use twinstep_identify::{Experiment, WindowConfig};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{
    BaseMount, Command, InitialState, PerJoint, Precision, RobotModel, RobotStates, Rollout, RolloutRequest, Simulator,
    go2,
};
use twinstep_sim::SimConfig;

use crate::effect_bodies::{batch, config, pose, rapier, run, with};

const CALF: usize = 2;

fn check_gyroscope<B: Simulator>(backend: impl Fn(&RobotModel, SimConfig, InitialState) -> B) {
    let biased = [("gyro_bias", "base", &[0.3, -0.2, 0.1][..]), ("gyro_bias", "base", &[0.1, 0.0, 0.0])];
    let initial_state = InitialState { base_angular_velocity: [1.0, 0.5, -0.8], ..InitialState::at_rest(3.0, pose()) };
    let [mut biased, mut ideal] =
        [with(&go2(), &biased), go2()].map(|robot| backend(&robot, config(BaseMount::Floating, 1000), initial_state));
    for _ in 0..20 {
        run(&mut biased, &Command::hold(pose(), 30.0, 0.75), 0.02);
        run(&mut ideal, &Command::hold(pose(), 30.0, 0.75), 0.02);
        assert_eq!(biased.measured().orientation, ideal.measured().orientation);
        let [measured, exact] = [&biased, &ideal].map(|one| Vec3::from(one.measured().gyro[0]));
        assert!((measured - exact - Vec3::new(0.4, -0.2, 0.1)).length() < 1e-6, "{measured}, without bias {exact}");
    }
}

#[test]
fn gyro_bias_shifts_the_reading_and_does_not_change_the_motion() {
    check_gyroscope(batch);
    check_gyroscope(rapier);
}

/// Records the derating factors and returns a torque that grows by 0.1 N·m per actuator period.
#[derive(Default)]
struct DeratingRecorder(Vec<PerJoint>);

impl Rollout for DeratingRecorder {
    fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
        self.0 = jobs[0].derating.to_vec();
        let mut states = RobotStates::new(jobs[0].commands.len() + 1);
        for (entry, tau) in states.measured.tau.iter_mut().enumerate().skip(1) {
            *tau = [0.1 * (entry - 1) as f32; 12];
        }
        vec![states]
    }
}

/// Returns the residuals [standard deviations] and the derating factors for a log of the FL calf at 200 Hz.
///
/// The supply voltage falls from 30 to 24 V and the temperature rises from 30 to 90 °C. The logged torque is delayed by
/// `delay` periods.
fn residuals_and_derating(robot: &RobotModel, delay: f64) -> (Vec<f64>, Vec<PerJoint>) {
    let rows = 60;
    let column = |of: &dyn Fn(f64) -> f64| (0..rows).map(|row| of(f64::from(row))).collect::<Vec<_>>();
    let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
    let columns = [
        ("t", column(&|row| 0.005 * row)),
        ("kp", column(&|_| 30.0)),
        ("kd", column(&|_| 0.75)),
        ("q_FL_calf", column(&|_| 0.0)),
        ("q_cmd_FL_calf", column(&|_| 0.0)),
        ("tau_measured_FL_calf", column(&|row| 0.1 * (row - delay))),
        ("battery_V", column(&|row| 30.0 - 0.1 * row)),
        ("temp_FL_calf", column(&|row| 30.0 + row)),
    ];
    let log = Log::new(
        Meta::new(200.0, TorqueSensor::MotorCurrent, segments),
        columns.map(|(name, cells)| (name.to_owned(), cells)),
    );
    let mut simulator = DeratingRecorder::default();
    let experiment =
        Experiment::new(&log.unwrap(), robot, WindowConfig::EVALUATION).unwrap().filter_rows(|row| row >= 10);
    let residuals = experiment.residuals(&mut simulator, std::slice::from_ref(robot), Precision::Double);
    (residuals.into_iter().next().unwrap(), simulator.0)
}

#[test]
fn torque_sensor_delay_shifts_the_logged_torque() {
    for (delay, periods) in [(0.0, 0.0), (0.01, 2.0), (0.0065, 1.3)] {
        let robot = with(&go2(), &[("torque_sensor_delay", "all", &[delay])]);
        let (residuals, _) = residuals_and_derating(&robot, periods);
        let largest = residuals.iter().fold(0.0f64, |largest, residual| largest.max(residual.abs()));
        assert!(largest < 1e-3, "{delay} s: a residual of {largest} standard deviations");
    }
    let (residuals, _) = residuals_and_derating(&go2(), 2.0);
    assert!(residuals.iter().any(|residual| residual.abs() > 0.1), "{residuals:?}");
}

#[test]
fn supply_sag_and_thermal_derating_reduce_torque_by_their_laws() {
    let robot = with(&go2(), &[("supply_sag", "all", &[1.7]), ("thermal_derating", "FL_calf", &[0.004, 40.0])]);
    for (row, factors) in residuals_and_derating(&robot, 0.0).1.iter().enumerate() {
        let row = row as f64;
        let cold = ((30.0 - 0.1 * row) / 30.0).powf(1.7);
        let hot = cold * (1.0 - 0.004 * (row - 10.0).max(0.0));
        let [calf, thigh] = [CALF, CALF - 1].map(|joint| f64::from(factors[joint]));
        assert!((calf - hot).abs() < 1e-6 && (thigh - cold).abs() < 1e-6, "row {row}: {calf} {thigh}");
    }
}
