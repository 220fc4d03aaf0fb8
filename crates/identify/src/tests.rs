//! Tests of search and refinement with a simulator in which the optimum has a closed form.

use nalgebra::DMatrix;
use proptest::prelude::*;
use twinstep_effects::{CATALOGUE, Effect, EffectEntry, ModelFile, Scope, Target};
use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
use twinstep_model::{BaseMount, Precision, RobotModel, RobotStates, Rollout, RolloutRequest, go2};

use crate::experiment::Experiment;
use crate::global_search::GlobalSearch;
use crate::identify::{IdentifyOptions, Stage, identify};
use crate::least_squares::{Differences, LeastSquaresProblem};
use crate::local_search::local_search;
use crate::parameter::{FreeParameter, drop_unidentifiable, free_parameters, initial_coordinate, with_values};
use crate::refine::{DAMPING_FACTORS, SIMULATOR_MISMATCH_STD, covariance, information, refine};
use crate::window::WindowConfig;

const ROWS: usize = 400;
const RATE_HZ: f64 = 200.0;
/// Viscous friction [N·m·s/rad] and Coulomb friction [N·m] of the robot.
const TRUTH: [f64; 2] = [0.25, 0.6];

/// Positions that are linear in the two frictions of the first joint: 1 mrad per standard deviation of the prior.
fn position([viscous, coulomb]: [f64; 2], row: usize) -> f64 {
    let row = row as f64;
    0.01 * viscous * (0.7 * row).sin() + 0.004 * coulomb * (0.31 * row).cos()
}

struct Linear;

impl Rollout for Linear {
    fn run(&mut self, jobs: &[RolloutRequest], _: Precision) -> Vec<RobotStates> {
        let play = |job: &RolloutRequest| {
            let joint = &job.robot.joints[0];
            let mut states = RobotStates::new(job.commands.len() + 1);
            for (row, q) in states.measured.q.iter_mut().enumerate() {
                q[0] = position([joint.viscous_friction, joint.coulomb_friction], row) as f32;
            }
            states
        };
        jobs.iter().map(play).collect()
    }
}

/// As [`Linear`], with a ripple of the friction: contact events make a cost as rough.
struct Rough;

impl Rollout for Rough {
    fn run(&mut self, jobs: &[RolloutRequest], precision: Precision) -> Vec<RobotStates> {
        let rough = |job: &RolloutRequest| {
            let mut robot = job.robot.clone();
            let joint = &mut robot.joints[0];
            joint.viscous_friction += 0.02 * (300.0 * joint.viscous_friction).sin();
            joint.coulomb_friction += 0.05 * (110.0 * joint.coulomb_friction).sin();
            robot
        };
        let robots: Vec<RobotModel> = jobs.iter().map(rough).collect();
        let jobs: Vec<_> = jobs.iter().zip(&robots).map(|(job, robot)| RolloutRequest { robot, ..*job }).collect();
        Linear.run(&jobs, precision)
    }
}

fn named(name: &str) -> &'static Effect {
    Effect::named(name).expect("in the catalogue")
}

fn experiment() -> Experiment {
    experiment_with_base(BaseMount::Fixed)
}

fn experiment_with_base(base: BaseMount) -> Experiment {
    let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..ROWS).map(of).collect());
    let columns = [
        column("t", &|row| row as f64 / RATE_HZ),
        column("q_FL_hip", &|row| position(TRUTH, row)),
        column("q_cmd_FL_hip", &|_| 0.0),
        column("kp", &|_| 25.0),
        column("kd", &|_| 0.6),
        column("quat_w", &|_| 1.0),
        column("pos_z", &|_| 0.0),
        column("vel_x", &|_| 0.0),
    ];
    let mut meta = Meta::new(RATE_HZ, TorqueSensor::None, vec![Segment { name: "one".to_owned(), base }]);
    meta.noise.insert("q_FL_hip".to_owned(), 1e-4);
    let log = Log::new(meta, columns).expect("a log");
    Experiment::new(&log, &go2(), WindowConfig::IDENTIFICATION).expect("an experiment")
}

/// Calls `ask` with the problem of finding both frictions of the first joint.
fn with_problem<R>(ask: impl FnOnce(&LeastSquaresProblem, Vec<f64>) -> R) -> R {
    let scope = "FL_hip".parse::<Scope>().expect("a scope");
    let effects = [(named("viscous_friction"), scope), (named("coulomb_friction"), scope)];
    let (file, unknowns) = free_parameters(&ModelFile::default(), &effects).expect("no conflict");
    let experiments = [experiment()];
    let begin = unknowns.iter().map(|unknown| initial_coordinate(&file, unknown)).collect();
    let (tolerances, precision) = (None, Precision::Double);
    let (file, unknowns, experiments) = (&file, &unknowns[..], &experiments[..]);
    ask(&LeastSquaresProblem { file, unknowns, experiments, residual_scale: &[], tolerances, precision }, begin)
}

#[test]
fn refinement_converges_to_the_truth_up_to_the_pull_of_the_prior() {
    with_problem(|task, begin| {
        let found = refine(task, &mut Linear, &DAMPING_FACTORS, begin, |_| true);
        let here = task.linearise(&mut Linear, &found).expect("finite");
        let information = information(&here);
        for (index, truth) in TRUTH.iter().enumerate() {
            let unknown = &task.unknowns[index];
            // A linear problem: the estimate is the mean of truth and prior mean, weighted by their information.
            let pull = (unknown.prior[0] - truth) / information[(index, index)];
            assert!((found[index] - truth - pull).abs() < 0.01 * unknown.prior[1], "{} for {truth}", found[index]);
        }
    });
}

#[test]
fn local_search_finds_a_lower_cost_where_a_refinement_of_a_rough_cost_has_stopped() {
    with_problem(|task, _| {
        let begin = vec![TRUTH[0] + 0.06, TRUTH[1] - 0.2];
        let cost = |point: &[f64]| {
            let residuals = task.residuals(&mut Rough, &[point.to_vec()]).remove(0).expect("finite");
            task.cost(&residuals, point)
        };
        let refined = refine(task, &mut Rough, &DAMPING_FACTORS, begin, |_| true);
        let uncertainty = DMatrix::from_diagonal_element(2, 2, 0.25);
        let found = local_search(task, &mut Rough, &refined, &uncertainty, 1, |_| true);
        let [before, after] = [&refined, &found].map(|point| cost(point));
        assert!(after < 0.2 * before, "{before} at {refined:?}, {after} at {found:?}");
    });
}

#[test]
fn one_sided_differences_agree_with_central_ones_and_step_inwards_from_a_bound() {
    with_problem(|task, begin| {
        let high = task.unknowns[0].coordinate_bounds()[1];
        for point in [begin.clone(), vec![high, begin[1]]] {
            let central = task.linearise(&mut Linear, &point).expect("finite").jacobian;
            let found = task.linearise_by(Differences::OneSided, &mut Linear, &point).expect("finite").jacobian;
            let error = (&found - &central).norm() / central.norm();
            assert!(error < 1e-6, "{error} at {point:?}: the robot of this test is linear");
        }
    });
}

#[test]
fn refinement_stops_when_it_is_told_to() {
    with_problem(|task, begin| {
        let mut steps = 0;
        refine(task, &mut Linear, &DAMPING_FACTORS, begin.clone(), |_| {
            steps += 1;
            false
        });
        assert_eq!(steps, 1);
    });
}

#[test]
fn covariance_of_white_residuals_is_the_inverse_information_and_correlation_increases_it() {
    with_problem(|task, begin| {
        let mut here = task.linearise(&mut Linear, &begin).expect("finite");
        let count = here.residuals.len();
        let inverse = information(&here).cholesky().expect("positive definite").inverse();
        // A sign for each row, and for each ten rows.
        let sign = |index: usize| if (index * 7919 % 101).is_multiple_of(2) { 1.0 } else { -1.0 };
        let std = |here: &crate::least_squares::Linearisation, rows_per_block: usize| {
            let blocks: Vec<usize> = (0..count).map(|row| row / rows_per_block).collect();
            covariance(here, &blocks, &[]).expect("positive definite")[(0, 0)].sqrt()
        };
        here.residuals.iter_mut().enumerate().for_each(|(row, residual)| *residual = sign(row));
        let white = std(&here, 1);
        let expected = (inverse[(0, 0)] + SIMULATOR_MISMATCH_STD.powi(2)).sqrt();
        assert!((white / expected - 1.0).abs() < 0.2, "{white}, {expected} expected");
        let jacobian = here.jacobian.clone();
        here.residuals.iter_mut().enumerate().for_each(|(row, residual)| *residual = 3.0 * jacobian[(row, 0)].signum());
        assert!(std(&here, 50) > 2.0 * white, "residuals that follow the derivative are a model error");
    });
}

#[test]
fn covariance_includes_the_effect_of_nuisance_parameters() {
    with_problem(|task, begin| {
        let here = task.linearise(&mut Linear, &begin).expect("finite");
        let blocks: Vec<usize> = (0..here.residuals.len()).collect();
        let without = covariance(&here, &blocks, &[]).expect("positive definite");
        let error: Vec<f64> = here.jacobian.column(0).iter().copied().collect();
        let with = covariance(&here, &blocks, &[error]).expect("positive definite");
        // The error moves the estimate by one standard deviation of the prior, less the pull of the prior.
        assert!((with[(0, 0)] - without[(0, 0)] - 1.0).abs() < 0.1, "{} {}", with[(0, 0)], without[(0, 0)]);
    });
}

#[test]
fn without_generations_there_are_gradient_steps_only() {
    let scope = "FL_hip".parse::<Scope>().expect("a scope");
    let effects = [(named("viscous_friction"), scope), (named("coulomb_friction"), scope)];
    let stages = |generations: usize| {
        let mut stages = Vec::new();
        let options = IdentifyOptions { generations, force: true, ..IdentifyOptions::default() };
        let experiments = [experiment_with_base(BaseMount::Floating)];
        identify(&ModelFile::default(), &effects, &experiments, &mut Linear, &options, &mut |stage, _, _| {
            stages.push(stage);
            true
        })
        .expect("identified");
        stages.dedup();
        stages
    };
    assert_eq!(stages(0), [Stage::Identifiability, Stage::Refinement]);
    assert_eq!(stages(30), [Stage::Identifiability, Stage::GlobalSearch, Stage::Refinement, Stage::LocalSearch]);
}

#[test]
fn interrupted_global_search_continues_as_if_it_had_not_been_interrupted() {
    with_problem(|task, begin| {
        let new = || GlobalSearch::new("frictions".to_owned(), task, begin.clone(), &mut Linear);
        let mut whole = new();
        assert!(!whole.run(task, &mut Linear, 40, 3, |_, _| true), "not interrupted");
        let mut parts = new();
        assert!(parts.run(task, &mut Linear, 40, 3, |generation, _| generation < 2), "interrupted");
        let text = serde_json::to_string(&parts).expect("serialised");
        let mut parts: GlobalSearch = serde_json::from_str(&text).expect("read back");
        parts.run(task, &mut Linear, 40, 3, |_, _| true);
        assert_eq!(parts, whole);
        for (index, truth) in TRUTH.iter().enumerate() {
            let error = (whole.best[index] - truth).abs() / task.unknowns[index].prior[1];
            assert!(error < 0.1, "{} for {truth}", whole.best[index]);
        }
    });
}

#[test]
fn residual_scale_of_a_quantity_is_its_rms_in_units_of_noise() {
    with_problem(|task, begin| {
        let scale = task.estimate_residual_scale(&mut Linear, &begin);
        let residuals = task.residuals(&mut Linear, std::slice::from_ref(&begin)).remove(0).expect("finite");
        let rms = (residuals.iter().map(|residual| residual * residual).sum::<f64>() / residuals.len() as f64).sqrt();
        assert!(rms > 1.0 && scale.iter().all(|scale| (scale - rms).abs() < 1e-9), "{rms} {scale:?}");
    });
}

#[test]
fn added_entries_without_an_identifiable_parameter_are_dropped() {
    let scope = "FL_hip".parse::<Scope>().expect("a scope");
    let effects = [(named("viscous_friction"), scope), (named("coulomb_friction"), scope)];
    let (mut file, unknowns) = free_parameters(&ModelFile::default(), &effects).expect("no conflict");
    drop_unidentifiable(&mut file, &ModelFile::default(), &unknowns, &[false, true]);
    let left: Vec<_> = file.effects.iter().map(|entry| entry.effect.name).collect();
    assert_eq!(left, ["coulomb_friction"]);
}

#[test]
fn parameters_of_effects_that_a_model_already_has_belong_to_their_own_entries() {
    let (payload, saturation) = (named("payload"), named("torque_saturation"));
    let known = [("hip", 20.0), ("thigh", 25.0), ("calf", 30.0)].map(|(scope, kappa)| {
        let scope: Scope = scope.parse().expect("a scope");
        EffectEntry::new(saturation, scope, vec![kappa]).expect("an allowed value")
    });
    let effects: Vec<_> =
        std::iter::once((payload, Scope::Base)).chain(known.iter().map(|entry| (saturation, entry.scope))).collect();
    let model = ModelFile { effects: known.to_vec(), ..ModelFile::default() };
    let (file, unknowns) = free_parameters(&model, &effects).expect("no conflict");
    let found: Vec<f64> =
        unknowns.iter().map(|unknown| unknown.value(initial_coordinate(&file, unknown)).round()).collect();
    assert_eq!(found, [0.0, 0.0, 0.0, 0.0, 20.0, 25.0, 30.0]);
}

#[test]
fn search_starts_from_the_values_of_an_earlier_model() {
    let scope = "FL_hip".parse::<Scope>().expect("a scope");
    let effects = [(named("viscous_friction"), scope), (named("coulomb_friction"), scope)];
    let entry = |index: usize, value: f64| EffectEntry::new(effects[index].0, scope, vec![value]).expect("allowed");
    let earlier = ModelFile { effects: vec![entry(0, 0.2), entry(1, 0.5)], ..ModelFile::default() };
    let with_one = ModelFile { effects: vec![entry(1, 0.5)], ..ModelFile::default() };
    let values = |start: Option<ModelFile>| {
        let options = IdentifyOptions { start, ..IdentifyOptions::default() };
        // Interrupted before the search.
        let mut stop = |_, _, _| false;
        let found = identify(&ModelFile::default(), &effects, &[experiment()], &mut Linear, &options, &mut stop);
        found.expect("a linear robot").findings.iter().map(|finding| finding.value).collect::<Vec<_>>()
    };
    let found = values(Some(earlier));
    assert!((found[0] - 0.2).abs() < 1e-9 && (found[1] - 0.5).abs() < 1e-9, "{found:?}");
    let found = values(Some(with_one));
    assert!(found[0] == 0.0 && (found[1] - 0.5).abs() < 1e-9, "the other starts with no effect: {found:?}");
    assert_eq!(values(None), [0.0, 0.0]);
}

/// Returns the free parameters of an effect on its widest scope.
fn parameters_of(effect: &'static Effect) -> (ModelFile, Vec<FreeParameter>) {
    let scope = match effect.target {
        Target::Joints | Target::Supply => Scope::All,
        Target::Bodies | Target::Imu => Scope::Base,
        Target::Ground => Scope::Ground,
    };
    free_parameters(&ModelFile::default(), &[(effect, scope)]).expect("no conflict")
}

proptest! {
    #[test]
    fn coordinates_of_every_parameter_round_trip(index in 0..CATALOGUE.len(), share in 0.01f64..0.99) {
        let (file, unknowns) = parameters_of(CATALOGUE[index]);
        let inside = |[low, high]: [f64; 2]| low + share * (high - low);
        let coordinates: Vec<f64> = unknowns.iter().map(|unknown| inside(unknown.coordinate_bounds())).collect();
        let moved = with_values(&file, &unknowns, &coordinates);
        for (unknown, coordinate) in unknowns.iter().zip(&coordinates) {
            let [low, high] = unknown.coordinate_bounds();
            prop_assert!(low < high && unknown.prior[1] > 0.0);
            let value = unknown.value(*coordinate);
            prop_assert!((unknown.coordinate(value) - coordinate).abs() <= 1e-9 * coordinate.abs().max(1.0));
            prop_assert!((initial_coordinate(&moved, unknown) - coordinate).abs() <= 1e-9 * coordinate.abs().max(1.0));
        }
    }
}

#[test]
fn prior_of_a_parameter_is_its_central_95_percent() {
    for effect in CATALOGUE.into_iter().filter(|effect| !effect.replaces_body()) {
        for unknown in parameters_of(effect).1 {
            let [mean, std] = unknown.prior;
            let parameter = effect.parameters.iter().find(|one| unknown.parameter_name.starts_with(one.name));
            let [low, high] = parameter.expect("its own").prior_range;
            let ends = [mean - 1.96 * std, mean + 1.96 * std];
            // A limit has its prior on the inverse, which is 0 for no effect.
            let expected = if unknown.neutral.is_infinite() { [0.0, 1.0 / low] } else { [low, high] };
            let tolerance = 1e-3 * (expected[1] - expected[0]);
            assert!((0..2).all(|end| (ends[end] - expected[end]).abs() < tolerance), "{}: {ends:?}", unknown.name());
        }
    }
}

#[test]
fn information_contains_the_prior() {
    with_problem(|task, begin| {
        let mut here = task.linearise(&mut Linear, &begin).expect("finite");
        here.jacobian = DMatrix::zeros(here.jacobian.nrows(), 2);
        assert_eq!(information(&here), DMatrix::identity(2, 2));
    });
}
