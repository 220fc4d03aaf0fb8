//! Two policies on the same robots.

use serde::{Deserialize, Serialize};

use crate::task_error::RobotError;

/// Task errors of the robots under the policy before and after, in pairs: the same robot and the same commands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// Error before and after of each robot that has one under both policies; what a robot did after a fall does not count.
    pub errors: Vec<[f64; 2]>,
    /// Number of robots that fell, before and after.
    pub falls: [usize; 2],
    /// Mean error, before and after.
    pub mean: [f64; 2],
    /// Share of the mean error that is gone.
    pub reduction: f64,
    /// Interval that holds 90 % of the reductions of single robots.
    pub interval: [f64; 2],
}

impl Comparison {
    /// Compares the errors of robots, each under the policy before and after. `None` if none has an error under both.
    pub fn new(pairs: &[[RobotError; 2]]) -> Option<Self> {
        let both = |[before, after]: &[RobotError; 2]| Some([before.error?, after.error?]);
        let errors: Vec<[f64; 2]> = pairs.iter().filter_map(both).collect();
        if errors.is_empty() {
            return None;
        }
        let falls = [0, 1].map(|policy| pairs.iter().filter(|pair| pair[policy].has_fallen).count());
        let count = errors.len() as f64;
        let mean = [0, 1].map(|policy| errors.iter().map(|pair| pair[policy]).sum::<f64>() / count);
        let mut single: Vec<f64> = errors.iter().map(|[before, after]| reduction(*before, *after)).collect();
        single.sort_by(f64::total_cmp);
        let interval = [0.05, 0.95].map(|share| quantile(&single, share));
        Some(Self { errors, falls, mean, reduction: reduction(mean[0], mean[1]), interval })
    }

    /// Returns true if the policy after is the better one: fewer robots fall, or as many and the error is smaller.
    pub fn is_better(&self) -> bool {
        let [falls_before, falls_after] = self.falls;
        falls_after < falls_before || (falls_after == falls_before && self.reduction > 0.0)
    }
}

fn reduction(before: f64, after: f64) -> f64 {
    if before > 0.0 { 1.0 - after / before } else { 0.0 }
}

/// Returns a quantile of sorted values by linear interpolation; 0 if there are none.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return 0.0 };
    let place = share * last as f64;
    let (low, high) = (place.floor() as usize, place.ceil() as usize);
    sorted[low] + (sorted[high] - sorted[low]) * (place - low as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(before: f64, after: f64) -> [RobotError; 2] {
        [before, after].map(|error| RobotError { error: Some(error), has_fallen: false })
    }

    #[test]
    fn half_of_the_error_is_a_reduction_of_one_half() {
        let found = Comparison::new(&[pair(0.2, 0.1), pair(0.4, 0.2)]).expect("errors");
        assert!((found.reduction - 0.5).abs() < 1e-12 && found.is_better());
        assert!(found.interval.iter().all(|bound| (bound - 0.5).abs() < 1e-12));
    }

    #[test]
    fn policy_with_which_more_robots_fall_is_not_better() {
        let fell = RobotError { error: Some(0.01), has_fallen: true };
        let found = Comparison::new(&[pair(0.2, 0.1), [pair(0.2, 0.1)[0], fell]]).expect("errors");
        assert_eq!(found.falls, [0, 1]);
        assert!(found.reduction > 0.0 && !found.is_better());
    }

    #[test]
    fn robots_that_fall_at_once_are_no_comparison() {
        let fell = RobotError { error: None, has_fallen: true };
        assert_eq!(Comparison::new(&[[fell; 2]]), None);
    }

    #[test]
    fn interval_holds_the_middle_of_the_robots() {
        let pairs: Vec<_> = (0..=100).map(|index| pair(1.0, f64::from(index) / 100.0)).collect();
        let [low, high] = Comparison::new(&pairs).expect("errors").interval;
        assert!((low - 0.05).abs() < 1e-9 && (high - 0.95).abs() < 1e-9, "{low} {high}");
    }
}
