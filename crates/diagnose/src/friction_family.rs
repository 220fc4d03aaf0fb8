//! Friction and inertia of all joints fitted together, for logs in which single causes leave much unexplained.
//!
//! Every joint of a real robot has some viscous friction, some Coulomb friction and a rotor. A search that adds one
//! cause at a time names a wrong one first: a delay, or a spring, that is none once the three laws are fitted together.
//! Here the search begins with the three laws by joint type, removes those without evidence, and goes on from there.

use twinstep_effects::{Effect, ModelFile, Scope};
use twinstep_identify::refine::information;
use twinstep_model::{Joint, JointKind, NUM_JOINTS, Rollout};

use super::DiagnoseError;
use super::backward_elimination::{self, evidence_beside_others};
use super::cross_validation::{Accepted, CandidateFit, FitProblem, cross_validate, cross_validate_together};
use super::forward_selection::{ForwardSelection, THRESHOLD};
use super::hypothesis::Hypothesis;
use super::residual_data::ResidualData;
use super::residual_power::{STANCE, TORQUE};
use super::residual_rows::PRECISION;

/// Laws that every joint has.
const LAWS: [&str; 3] = ["viscous_friction", "coulomb_friction", "armature"];
/// Size of a law at which its fit begins, relative to the end of its prior range.
const INITIAL_SHARE: f64 = 0.1;
/// Log-likelihood from which a law stays, and from which a joint differs from the others of its type [nat].
///
/// Less than for other causes: it is known that every joint has these laws.
const LEAST_EVIDENCE: f64 = THRESHOLD / 3.0;
/// Maximum number of joints whose friction differs from that of their type.
const MOST_JOINTS: usize = 8;
/// Share of the single causes' log-likelihood gain that the three laws alone must reach for the search to go on.
const LEAST_SHARE: f64 = 0.5;
/// Number of joints with the largest residuals that are tried.
const TRIED_JOINTS: usize = 4;
/// Power above noise that single causes may leave, relative to that of the given model, without a fit of the family.
const UNEXPLAINED_FRACTION: f64 = 0.05;
/// Root mean square of the positions' residuals that single causes may leave [rad], of robots that hang and of others: two
/// engines with the same laws differ by less.
const UNEXPLAINED_RAD: [f64; 2] = [0.004, 0.008];

/// Replaces the causes of a search by those of a search that begins with the friction family, if the first leaves much
/// unexplained and the second has the higher cross-validated likelihood.
pub fn extend(search: &mut ForwardSelection) -> Result<(), DiagnoseError> {
    if !leaves_much(search) {
        return Ok(());
    }
    (search.progress)("fitting the friction of all joints together")?;
    let (single, model, view) = (search.accepted.clone(), search.model.clone(), search.view);
    let (baseline, gains) = (search.baseline.clone(), search.joint_gains.clone());
    let before = together(search);
    let laws = JointKind::ALL.into_iter().flat_map(|kind| of_scope(Scope::Kind(kind)));
    search.accepted = laws.map(|hypothesis| (unscored(hypothesis), Vec::new())).collect();
    if together(search) > LEAST_SHARE * before {
        search.refit();
        eliminate_without_evidence(search);
        search.merge_all_scopes();
        add_joints_that_differ(search)?;
        search.merge_all_scopes();
        search.run()?;
        backward_elimination::eliminate(search)?;
        eliminate_without_evidence(search);
        evidence_beside_others(search)?;
    }
    // Gains that were added since are part of the model with which `together` compares.
    let added = search.joint_gains.as_ref().filter(|_| gains.is_none()).map_or(0.0, |gains| gains.score);
    if together(search) + added <= before {
        (search.accepted, search.model, search.view) = (single, model, view);
        (search.baseline, search.joint_gains) = (baseline, gains);
    }
    Ok(())
}

/// Returns the three laws on a scope, small.
fn of_scope(scope: Scope) -> impl Iterator<Item = Hypothesis> {
    LAWS.into_iter().map(move |name| {
        let effect = Effect::named(name).expect("an effect of the catalogue");
        Hypothesis { effect, scope, values: vec![INITIAL_SHARE * effect.parameters[0].prior_range[1]] }
    })
}

fn unscored(hypothesis: Hypothesis) -> CandidateFit {
    CandidateFit { hypothesis, score: 0.0, gain: 0.0, explained_fraction: 0.0, threshold: LEAST_EVIDENCE }
}

/// Returns true if the given model lacks something at most joints, and the causes leave more than
/// [`UNEXPLAINED_FRACTION`] and [`UNEXPLAINED_RAD`] of it, in rows with a fixed base, if there are any.
fn leaves_much(search: &mut ForwardSelection) -> bool {
    let evidence = &search.views[search.view].evidence;
    let robots = [&search.baseline, &search.model].map(|model| model.robot_model().expect("fitted within its bounds"));
    let left = evidence.residual_powers(search.simulator, &robots, true);
    // Mean squares above noise by joint [rad²].
    let [given, now] = [0, 1].map(|model: usize| {
        let of = |joint: usize| {
            let both = [joint, STANCE + joint];
            let rows: f64 = both.iter().flat_map(|channel| left[model].counts[*channel]).sum();
            let excess: f64 = both.iter().map(|channel| left[model].channel_excess(*channel)).sum();
            (rows > 0.0).then(|| excess / rows * evidence.fit_rows.position_std(joint).powi(2))
        };
        (0..NUM_JOINTS).filter_map(of).collect::<Vec<f64>>()
    });
    let hangs = left[0].counts[..TORQUE].iter().flatten().any(|count| *count > 0.0);
    let least = UNEXPLAINED_RAD[usize::from(!hangs)].powi(2);
    let affected = given.iter().filter(|square| **square > least).count();
    let [before, after] = [&given, &now].map(|squares| squares.iter().sum::<f64>() / squares.len().max(1) as f64);
    4 * affected >= 3 * given.len() && after > least && after > UNEXPLAINED_FRACTION * before
}

/// Returns the cross-validated log-likelihood gain of all causes of a search [nat].
fn together(search: &mut ForwardSelection) -> f64 {
    let hypotheses = current(&search.accepted);
    let evidence = &search.views[search.view].evidence;
    cross_validate_together(evidence, &search.baseline, &hypotheses, search.simulator)
}

fn current(accepted: &Accepted) -> Vec<Hypothesis> {
    accepted.iter().map(|(best, _)| best.hypothesis.clone()).collect()
}

/// Removes causes that are too small, and those without which the likelihood of the linearised model is almost as high,
/// one after the other.
fn eliminate_without_evidence(search: &mut ForwardSelection) {
    loop {
        let evidence = &search.views[search.view].evidence;
        let hypotheses = current(&search.accepted);
        let drops = likelihood_drops(evidence, &search.baseline, &hypotheses, search.simulator);
        let worth = |place: usize| {
            let stays = hypotheses[place].exceeds_min_size() && hypotheses[place].is_plausible();
            if stays { drops[place] } else { 0.0 }
        };
        let weakest = (0..hypotheses.len()).min_by(|one, other| worth(*one).total_cmp(&worth(*other)));
        let Some(weakest) = weakest.filter(|place| worth(*place) < LEAST_EVIDENCE) else { return };
        search.accepted.remove(weakest);
        search.refit();
    }
}

/// Returns by how much the log-likelihood falls without each cause, if the others are refitted, in the model that is
/// linearised at the fit [nat]: half of `x² / Var x` for a cause of one number.
fn likelihood_drops(
    evidence: &ResidualData,
    baseline: &ModelFile,
    hypotheses: &[Hypothesis],
    simulator: &mut dyn Rollout,
) -> Vec<f64> {
    let Some(fit) = FitProblem::new(baseline, hypotheses) else { return vec![0.0; hypotheses.len()] };
    let covariance = fit.with_problem(&evidence.fit_rows, simulator, PRECISION, |task, simulator| {
        information(&task.linearise(simulator, &fit.initial_point)?).try_inverse()
    });
    let Some(covariance) = covariance else { return vec![0.0; hypotheses.len()] };
    let rows = evidence.correlation_rows(0);
    let mut first = 0;
    let drop = |hypothesis: &Hypothesis| {
        let own = first..first + hypothesis.values.len();
        first = own.end;
        let of = |index: usize| {
            let unknown = &fit.unknowns[index];
            let size = (fit.initial_point[index] - unknown.coordinate(unknown.neutral)) / unknown.prior[1];
            0.5 * size * size / (covariance[(index, index)] * rows)
        };
        own.map(of).fold(0.0, f64::max)
    };
    hypotheses.iter().map(drop).collect()
}

/// Adds friction at single joints that differ from the others of their type, the best first.
fn add_joints_that_differ(search: &mut ForwardSelection) -> Result<(), DiagnoseError> {
    for _ in 0..MOST_JOINTS {
        let evidence = &search.views[search.view].evidence;
        let left = evidence.residual_power(search.simulator, &search.model.robot_model()?);
        let mut joints = Joint::ALL.to_vec();
        joints.sort_by(|one, other| left.channel_excess(other.index()).total_cmp(&left.channel_excess(one.index())));
        let known = current(&search.accepted);
        let tried = joints.into_iter().take(TRIED_JOINTS).flat_map(|joint| of_scope(Scope::Joint(joint)));
        let tried = tried.filter(|one| known.iter().all(|other| other.name() != one.name()));
        let mut found: Option<CandidateFit> = None;
        for hypothesis in tried {
            (search.progress)(&format!("fitting {}; causes: {}", hypothesis.name(), known.len()))?;
            let trial = cross_validate(evidence, &search.model, &left, &hypothesis, search.simulator);
            let better = |trial: &CandidateFit| found.as_ref().is_none_or(|found| trial.score > found.score);
            found = trial.filter(|trial| trial.hypothesis.exceeds_min_size()).filter(better).or(found);
        }
        let Some(found) = found.filter(|found| found.score >= LEAST_EVIDENCE) else { break };
        search.accepted.push((CandidateFit { threshold: LEAST_EVIDENCE, ..found }, Vec::new()));
        search.refit();
    }
    Ok(())
}
