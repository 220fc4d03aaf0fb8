//! Threshold of the log-likelihood gain, from the log itself: what the best of all hypotheses gains if none is true.
//!
//! The residuals of the model with the best candidate are divided into the blocks of the folds, and each block is
//! multiplied by +1 or −1 at random. Amplitudes, correlation times and outliers stay as they are; what all blocks have
//! in common, as the trace of a cause would, is destroyed. Every hypothesis is then fitted to one fold and evaluated on
//! the other, as in the search, with the residual's derivative in place of a simulation. The threshold is a quantile of
//! the largest gain, separately for effects on joints, on bodies and sensors, and on the ground: what a robot that trots
//! shows of the ground varies more than what a hanging joint shows of its friction.
//!
//! Sign changes of blocks: the wild cluster bootstrap (Cameron, Gelbach and Miller 2008). Residuals of the full model:
//! ter Braak 1992.

use rand::RngExt;
use rayon::prelude::*;
use twinstep_effects::{CATALOGUE, Effect, ModelFile, Probes, Scope, Target};
use twinstep_model::{Joint, Rollout, stream};

use super::cross_validation::parameter_penalty;
use super::hypothesis::{relative_size, selection_penalty, with_effect};
use super::residual_data::{BlockProducts, ResidualData};
use super::residual_power::{CHANNELS, STANCE, TORQUE, WRENCH, evident_channels};

/// Number of draws.
const DRAWS: u64 = 499;
/// Probability that the best hypothesis of a class exceeds its threshold in a log in which none is true.
const FALSE_ALARM_RATE: f64 = 0.01;
/// Lowest threshold of any effect [nat].
pub const LOWEST_THRESHOLD: f64 = 10.0;
/// Lowest thresholds by class [nat]: contact laws differ between any two engines in all blocks alike.
const LOWEST: [f64; CLASSES] = [LOWEST_THRESHOLD, 2.0 * LOWEST_THRESHOLD, 100.0];
/// Size of an effect whose difference is the derivative, relative to its prior range: at most.
const LARGEST_STEP: f64 = 0.25;
/// Maximum number of probes of one effect.
const PROBES: usize = 3;
/// Seed of the signs.
const SEED: u64 = 1;

/// Number of classes of effects.
const CLASSES: usize = 3;

/// Derivative of the residuals in one direction.
struct Direction {
    products: usize,
    class: usize,
    /// Each scope with the channels in which it shows the effect.
    scopes: Vec<(Scope, Vec<usize>)>,
    num_values: usize,
    /// Least size of a cause, in units of the difference.
    least: f64,
    /// True if the size can be negative.
    two_sided: bool,
}

/// Thresholds of the log-likelihood gain [nat].
#[derive(Clone, Copy, Debug)]
pub struct Thresholds([f64; CLASSES]);

impl Thresholds {
    /// Returns the threshold of an effect [nat].
    pub fn of(&self, effect: &Effect) -> f64 {
        self.0[class(effect.target)]
    }
}

fn class(target: Target) -> usize {
    match target {
        Target::Joints | Target::Supply => 0,
        Target::Bodies | Target::Imu => 1,
        Target::Ground => 2,
    }
}

/// Returns the thresholds for candidates of which `model` contains the best.
pub fn thresholds(evidence: &ResidualData, model: &ModelFile, simulator: &mut dyn Rollout) -> Thresholds {
    let Ok(robot) = model.robot_model() else { return Thresholds(LOWEST) };
    let (mut robots, mut directions) = (Vec::new(), Vec::new());
    for effect in CATALOGUE.into_iter().filter(|effect| evidence.has_required_torque(effect)) {
        let scopes = scopes(effect, evidence);
        for values in small_probes(effect).into_iter().filter(|_| !scopes.is_empty()) {
            if let Some(probe) =
                with_effect(model, effect, Scope::All, &values).ok().and_then(|file| file.robot_model().ok())
            {
                let channels =
                    |scope: Scope| evident_channels([effect.target]).filter(|channel| shows(scope, *channel)).collect();
                directions.push(Direction {
                    products: robots.len(),
                    class: class(effect.target),
                    scopes: scopes.iter().map(|scope| (*scope, channels(*scope))).collect(),
                    num_values: effect.num_values(),
                    least: effect.search.min_share / relative_size(effect, &values).max(f64::MIN_POSITIVE),
                    two_sided: is_two_sided(effect),
                });
                robots.push(probe);
            }
        }
    }
    let products = evidence.block_products(simulator, &robot, &robots);
    let largest = |draw: u64| {
        let random = &mut stream(SEED, "null distribution", draw);
        let signs: Vec<f64> =
            (0..products.num_blocks).map(|_| if random.random_bool(0.5) { 1.0 } else { -1.0 }).collect();
        let flipped = FlippedSums::new(&products, &signs);
        let mut gains = [0.0; CLASSES];
        for direction in &directions {
            for (scope, channels) in &direction.scopes {
                let gain = flipped.score(evidence, direction, *scope, channels);
                gains[direction.class] = gain.max(gains[direction.class]);
            }
        }
        gains
    };
    let gains: Vec<[f64; CLASSES]> = (0..DRAWS).into_par_iter().map(largest).collect();
    Thresholds(std::array::from_fn(|class| {
        let mut gains: Vec<f64> = gains.iter().map(|gains| gains[class]).collect();
        gains.sort_by(f64::total_cmp);
        let index = ((1.0 - FALSE_ALARM_RATE) * gains.len() as f64) as usize;
        gains[index.min(gains.len() - 1)].max(LOWEST[class])
    }))
}

/// Returns the scopes on which diagnosis looks for an effect.
fn scopes(effect: &Effect, evidence: &ResidualData) -> Vec<Scope> {
    let whole_log = !matches!(effect.search.whole_log_probes, Probes::None);
    if whole_log && !evidence.has_free_parts() {
        return Vec::new();
    }
    match effect.target {
        Target::Joints => Scope::of_joints(),
        Target::Supply => vec![Scope::All],
        Target::Bodies | Target::Imu => vec![Scope::Base],
        Target::Ground => vec![Scope::Ground],
    }
}

/// Returns true if an effect can act in either direction.
fn is_two_sided(effect: &Effect) -> bool {
    let parameter = &effect.parameters[0];
    let [low, high] = parameter.prior_range;
    low < parameter.no_effect_value && parameter.no_effect_value < high
}

/// Returns the smallest probes of an effect, at which its residual is nearly proportional to its size.
fn small_probes(effect: &Effect) -> Vec<Vec<f64>> {
    let whole_log = effect.probe_values(effect.search.whole_log_probes);
    let probes = if whole_log.is_empty() { effect.probe_values(effect.search.probes) } else { whole_log };
    let size = |values: &Vec<f64>| relative_size(effect, values);
    let mut small: Vec<Vec<f64>> = probes.iter().filter(|values| size(values) <= LARGEST_STEP).cloned().collect();
    if small.is_empty() {
        small.extend(probes.into_iter().min_by(|one, other| size(one).total_cmp(&size(other))));
    }
    small.reverse();
    small.truncate(PROBES);
    small
}

/// Sums over the blocks of a fold, with the signs of a draw.
struct FlippedSums<'a> {
    products: &'a BlockProducts,
    /// Products of residual and derivative, by direction, channel and fold.
    cross: Vec<[[f64; 2]; CHANNELS]>,
}

impl<'a> FlippedSums<'a> {
    fn new(products: &'a BlockProducts, signs: &[f64]) -> Self {
        let of = |direction: &Vec<Vec<[f64; 2]>>| {
            std::array::from_fn(|channel| {
                let mut sums = [0.0; 2];
                for (block, ([cross, _], sign)) in direction[channel].iter().zip(signs).enumerate() {
                    sums[products.fold_of_block[block]] += sign * cross;
                }
                sums
            })
        };
        Self { products, cross: products.directions.iter().map(of).collect() }
    }

    /// Returns the cross-validated log-likelihood gain of a direction on a scope, minus its penalties [nat].
    fn score(&self, evidence: &ResidualData, direction: &Direction, scope: Scope, channels: &[usize]) -> f64 {
        let index = direction.products;
        let power = |channel: usize, fold: usize| self.products.reference[channel][fold];
        let slope = |channel: usize, fold: usize| self.products.slopes[index][channel][fold];
        let size = |fold: usize| {
            let (mut cross, mut squares) = (0.0, 0.0);
            for channel in channels.iter().copied() {
                let [count, sum] = power(channel, fold);
                let variance = (sum / count.max(1.0)).max(1.0);
                cross += self.cross[index][channel][fold] / variance;
                squares += slope(channel, fold) / variance;
            }
            let size = if squares > 0.0 { -cross / squares } else { 0.0 };
            if direction.two_sided { size } else { size.max(0.0) }
        };
        let sizes = [size(0), size(1)];
        // The search rejects causes that are too small, whatever they gain.
        if (0.5 * (sizes[0] + sizes[1])).abs() < direction.least {
            return 0.0;
        }
        let gain = |channel: usize, fold: usize| {
            let [count, before] = power(channel, fold);
            let size = sizes[1 - fold];
            let after = before + 2.0 * size * self.cross[index][channel][fold] + size * size * slope(channel, fold);
            if count == 0.0 {
                return 0.0;
            }
            0.5 * count / evidence.correlation_rows(channel) * ((before + 1e-9) / (after.max(0.0) + 1e-9)).ln()
        };
        let nats: f64 = channels.iter().map(|channel| gain(*channel, 0) + gain(*channel, 1)).sum();
        nats - selection_penalty(scope) - parameter_penalty(direction.num_values)
    }
}

/// Returns true if an effect on this scope is compared in this channel: of its own joints, or, for base and ground, all.
fn shows(scope: Scope, channel: usize) -> bool {
    let joint = match channel {
        channel if channel < 2 * TORQUE => channel % TORQUE,
        channel if (STANCE..WRENCH).contains(&channel) => channel - STANCE,
        _ => return scope.joints() == 0,
    };
    scope.joints() == 0 || scope.contains(Joint::ALL[joint])
}

#[cfg(test)]
mod tests {
    use twinstep_identify::window::WindowConfig;
    use twinstep_logs::{Log, Meta, Segment, TorqueSensor};
    use twinstep_model::{BaseMount, Precision, RobotStates, RolloutRequest, go2};

    use super::*;
    use crate::cross_validation::cross_validate;
    use crate::hypothesis::Hypothesis;

    /// Rows of a block, which is a window of [`WindowConfig::DIAGNOSIS`].
    const BLOCK: usize = 400;
    /// Standard deviation of the measured positions [rad].
    const NOISE: f64 = 0.001;

    /// Positions of the first joint that are proportional to its viscous friction.
    struct Linear;

    fn position(friction: f64, row: usize) -> f64 {
        0.05 * friction * (0.11 * row as f64).sin()
    }

    impl Rollout for Linear {
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

    /// Returns the data of a robot whose friction differs from block to block.
    fn data(friction: impl Fn(usize) -> f64) -> ResidualData {
        let rows = 20 * BLOCK;
        let column = |name: &str, of: &dyn Fn(usize) -> f64| (name.to_owned(), (0..rows).map(of).collect());
        let noise = |row: usize| 3.46 * NOISE * ((row * 7919 % 1009) as f64 / 1009.0 - 0.5);
        // The first row of a window is the last row of the previous one.
        let in_window = |row: usize| if row == 0 { 0 } else { (row - 1) % BLOCK + 1 };
        let columns = [
            column("t", &|row| row as f64 / 200.0),
            column("q_FL_hip", &|row| position(friction(row.saturating_sub(1) / BLOCK), in_window(row)) + noise(row)),
            column("q_cmd_FL_hip", &|_| 0.0),
            column("kp", &|_| 25.0),
            column("kd", &|_| 0.6),
        ];
        let segments = vec![Segment { name: "air".to_owned(), base: BaseMount::Fixed }];
        let mut meta = Meta::new(200.0, TorqueSensor::None, segments);
        meta.noise.insert("q_FL_hip".to_owned(), NOISE);
        let log = Log::new(meta, columns).expect("a log");
        ResidualData::new(vec![log], &go2(), WindowConfig::DIAGNOSIS).expect("an experiment")
    }

    /// Returns the score of viscous friction, and its threshold.
    fn score_and_threshold(data: &ResidualData) -> [f64; 2] {
        let effect = Effect::named("viscous_friction").expect("in the catalogue");
        let hypothesis = Hypothesis { effect, scope: Scope::Joint(Joint::ALL[0]), values: vec![0.1] };
        let before = data.residual_power(&mut Linear, &go2());
        let model = ModelFile::default();
        let found = cross_validate(data, &model, &before, &hypothesis, &mut Linear).expect("a robot");
        let with_best = with_effect(&model, effect, Scope::All, &found.hypothesis.values).expect("allowed");
        [found.score, thresholds(data, &with_best, &mut Linear).of(effect)]
    }

    #[test]
    fn noise_needs_the_lowest_threshold_and_does_not_reach_it() {
        let [score, threshold] = score_and_threshold(&data(|_| 0.0));
        assert!(threshold == LOWEST_THRESHOLD && score < threshold, "{score} {threshold}");
    }

    #[test]
    fn friction_that_all_blocks_have_in_common_exceeds_the_threshold() {
        let [score, threshold] = score_and_threshold(&data(|_| 0.4));
        assert!(score > 5.0 * threshold, "{score} {threshold}");
    }

    #[test]
    fn error_that_differs_from_block_to_block_does_not_exceed_its_threshold() {
        // Friction in half of the blocks and its opposite in the others: what a wrong contact law may leave.
        let signs = [1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0];
        let [score, threshold] = score_and_threshold(&data(|block| 0.4 * signs[block % 8]));
        assert!(threshold > 2.0 * LOWEST_THRESHOLD && score < threshold, "{score} {threshold}");
    }
}
