//! The promise of a diagnosis: by how much the extended model reduces the position error of a motion, before it is measured.
//!
//! Robots are drawn from the intervals of the extended model, and each takes the place of the real one: it is simulated on the commands
//! of the motion, beside the given and the extended model. What the extended model leaves in the rows to which it was fitted is added to
//! both errors, as it is in one of their blocks, because a model that lacks something there lacks it in other motions, too.

use std::collections::BTreeMap;

use twinstep_effects::{ModelFile, RobotSampler};
use twinstep_identify::evaluate::position_errors;
use twinstep_logs::Log;
use twinstep_model::{RobotModel, Rollout, stream};

use super::findings::{Promise, Reduction};
use super::{DiagnoseError, ExperimentError};

/// Robots that are drawn.
const DRAWS: usize = 24;
/// Blocks of the fitted rows whose errors are compared.
const BLOCKS: usize = 8;

/// Rows and errors of a joint.
type JointErrors = Vec<(usize, f64)>;
/// Errors of each joint.
type Errors = Vec<JointErrors>;

/// Predicts the reduction on the held-out rows of logs, and compares it with what is found there; `None` if no positions are compared.
///
/// `names` are those of the joints. `say` gets the step, and ends the prediction by an error.
pub fn promise(
    logs: &[Log],
    held_out: &[Vec<bool>],
    (given, extended): (&RobotModel, &ModelFile),
    names: &[String],
    simulator: &mut dyn Rollout,
    say: &mut dyn FnMut(&str) -> Result<(), DiagnoseError>,
) -> Result<Option<Promise>, DiagnoseError> {
    let corrected = extended.robot_model()?;
    let Ok(sampler) = RobotSampler::new(extended.clone()) else { return Ok(None) };
    let mut errors = |robot: &RobotModel, is_held_out: bool| -> Result<Vec<Errors>, ExperimentError> {
        let of = |(log, held_out): (&Log, &Vec<bool>)| {
            Ok(position_errors(log, robot, simulator, |row| held_out[row] == is_held_out)?.to_vec())
        };
        logs.iter().zip(held_out).map(of).collect()
    };
    let left = errors(&corrected, false)?;
    let [before, after] = [errors(given, true)?, errors(&corrected, true)?];
    let measured = [&before, &after].map(|errors| joints(errors, None));
    if measured[0].iter().all(|squares| squares.count == 0.0) || joints(&left, None).iter().all(|one| one.count == 0.0)
    {
        return Ok(None);
    }
    let mut random = stream(0, "promise", 0);
    let mut draws: Vec<[Vec<Squares>; 2]> = Vec::new();
    for draw in 0..DRAWS {
        say("predicting the gain")?;
        let drawn = errors(&sampler.sample(&mut random), true)?;
        let floor = joints(&left, Some(draw % BLOCKS));
        draws.push([&before, &after].map(|model| {
            let differences = joints(&differences(model, &drawn), None);
            differences.iter().zip(&floor).map(|(one, floor)| one.above(floor)).collect()
        }));
    }
    let reduction = |of: &dyn Fn(&[Squares]) -> Squares| {
        let mut all: Vec<f64> = draws.iter().map(|draw| 1.0 - of(&draw[1]).root() / of(&draw[0]).root()).collect();
        all.sort_by(f64::total_cmp);
        let found = 1.0 - of(&measured[1]).root() / of(&measured[0]).root();
        Reduction { predicted: quantile(&all, 0.5), interval: [quantile(&all, 0.05), quantile(&all, 0.95)], found }
    };
    let by_joint = (0..names.len()).filter(|joint| measured[0][*joint].count > 0.0);
    let by_joint: BTreeMap<String, Reduction> =
        by_joint.map(|joint| (names[joint].clone(), reduction(&|squares| squares[joint]))).collect();
    Ok(Some(Promise { all: reduction(&|squares| squares.iter().fold(Squares::default(), Squares::plus)), by_joint }))
}

/// Sum of squares, and their number.
#[derive(Clone, Copy, Debug, Default)]
struct Squares {
    sum: f64,
    count: f64,
}

impl Squares {
    fn plus(self, other: &Self) -> Self {
        Self { sum: self.sum + other.sum, count: self.count + other.count }
    }

    fn root(self) -> f64 {
        (self.sum / self.count.max(1.0)).sqrt().max(1e-9)
    }

    /// Returns the squares with the mean of others added to each.
    fn above(&self, floor: &Self) -> Self {
        Self { sum: self.sum + self.count * floor.sum / floor.count.max(1.0), count: self.count }
    }
}

/// Returns the squares of each joint in all rows, or in one of the blocks.
fn joints(errors: &[Errors], block: Option<usize>) -> Vec<Squares> {
    let of_joint = |joint: usize| {
        let of_log = |errors: &Errors| {
            let rows = &errors[joint];
            let range =
                block.map_or(0..rows.len(), |block| block * rows.len() / BLOCKS..(block + 1) * rows.len() / BLOCKS);
            let rows = &rows[range];
            Squares { sum: rows.iter().map(|(_, error)| error * error).sum(), count: rows.len() as f64 }
        };
        errors.iter().map(of_log).fold(Squares::default(), |sum, one| sum.plus(&one))
    };
    (0..errors.first().map_or(0, Vec::len)).map(of_joint).collect()
}

/// Returns how a simulation differs from another one of the same rows.
fn differences(one: &[Errors], other: &[Errors]) -> Vec<Errors> {
    let of_log = |(one, other): (&Errors, &Errors)| {
        let of_joint = |(one, other): (&JointErrors, &JointErrors)| {
            one.iter().zip(other).map(|((row, one), (_, other))| (*row, one - other)).collect()
        };
        one.iter().zip(other).map(of_joint).collect()
    };
    one.iter().zip(other).map(of_log).collect()
}

/// Returns a quantile of sorted values.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (below, part) = (place.floor() as usize, place.fract());
    sorted[below] + part * (sorted[(below + 1).min(sorted.len() - 1)] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_is_in_both_errors() {
        let rows = |errors: &[f64]| errors.iter().copied().enumerate().collect::<Vec<_>>();
        let mut errors: Errors = vec![Vec::new(); 4];
        errors[3] = rows(&[3.0, -3.0, 3.0, -3.0, 3.0, -3.0, 3.0, -3.0]);
        let mut floor: Errors = vec![Vec::new(); 4];
        floor[3] = rows(&[4.0; 16]);
        let [errors, floor] = [joints(&[errors], None), joints(&[floor], Some(7))];
        assert_eq!(floor[3].count, 2.0);
        assert!((errors[3].above(&floor[3]).root() - 5.0).abs() < 1e-12);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
    }
}
