//! Which feet stand, from the sensors of a log.

use crate::Log;
use crate::statistics::{quantile, quantum};

/// Noise of a force in the air [standard deviations].
const NOISE: f64 = 3.0;
/// Share of a foot's highest force up to which its lowest one is that of a foot in the air.
const MAX_OFFSET_SHARE: f64 = 0.5;
/// Difference of two low quantiles, as a share of the range of the forces, above which they are not those of a foot in the air: they hardly
/// differ, and those of a foot that always stands do.
const MAX_STEP_SHARE: f64 = 0.02;
/// Quantiles of the forces: of the noise of a foot in the air, two of its forces, and of the highest. A few wrong readings do not count.
const QUANTILES: [f64; 4] = [0.001, 0.05, 0.1, 0.9];

impl Log {
    /// Returns whether a foot touches the ground in each row, from `contact` or `foot_force`, `None` in rows without a reading. Returns `None`
    /// if the log has neither. Contacts of all feet that are zeros, and forces of a foot that are, were not measured.
    ///
    /// A force above its noise is a contact, if it is also above this share of the foot's highest force. Forces whose noise the log does not
    /// state may be raw counts of the robot, which have an offset: that of a foot in the air.
    pub fn contacts(&self, foot: &str, share: f64) -> Option<Vec<Option<bool>>> {
        let above = |cells: &[f64], threshold: f64| -> Vec<Option<bool>> {
            cells.iter().map(|cell| cell.is_finite().then_some(*cell > threshold)).collect()
        };
        let has_contact =
            |(name, cells): (&str, &[f64])| name.starts_with("contact_") && cells.iter().any(|cell| *cell > 0.5);
        if let Some(cells) = self.channel(&format!("contact_{foot}")).filter(|_| self.channels().any(has_contact)) {
            return Some(above(cells, 0.5));
        }
        let forces = self.channel(&format!("foot_force_{foot}"))?;
        if forces.iter().all(|force| *force == 0.0 || force.is_nan()) {
            return None;
        }
        let mut sorted: Vec<f64> = forces.iter().copied().filter(|force| force.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        let quantile = |fraction: f64| quantile(&sorted, fraction);
        let [lowest, low, higher, high] = QUANTILES.map(quantile);
        let (lowest, low, higher, high) = (lowest?, low?, higher?, high?);
        if let Some(noise) = self.noise(&format!("foot_force_{foot}")).filter(|noise| *noise > 0.0) {
            return Some(above(forces, (NOISE * noise).max(share * high)));
        }
        if low > MAX_OFFSET_SHARE * high || higher - low > MAX_STEP_SHARE * (high - low) {
            return Some(above(forces, share * high));
        }
        let noise = (2.0 * (higher - lowest)).max(quantum(forces).unwrap_or(0.0));
        Some(above(forces, low + noise.max(share * (high - low))))
    }
}

#[cfg(test)]
mod tests {
    use twinstep_model::{standard_normal, stream};

    use super::*;
    use crate::{Gain, Meta, Segment, TorqueSensor};

    /// Returns whether a foot touches the ground in each row of a log with this channel.
    fn contacts_of(name: &str, cells: Vec<f64>, share: f64) -> Option<Vec<Option<bool>>> {
        let segment = Segment { name: "walk".to_owned(), base: twinstep_model::BaseMount::Floating };
        let mut meta = Meta::new(100.0, TorqueSensor::None, vec![segment]);
        (meta.kp, meta.kd) = (Some(Gain::Uniform(20.0)), Some(Gain::Uniform(0.5)));
        let zeros = vec![0.0; cells.len()];
        let t = (0..cells.len()).map(|row| row as f64 * 0.01).collect();
        let columns = [("t", t), ("q_knee", zeros.clone()), ("q_cmd_knee", zeros), (name, cells)];
        let log = Log::new(meta, columns.map(|(name, cells)| (name.to_owned(), cells))).expect("a log");
        log.contacts("FL", share)
    }

    /// Returns the same for cells that repeat, with noise.
    fn touches(share: f64, name: &str, cells: [f64; 6], noise: f64) -> Option<Vec<Option<bool>>> {
        let mut random = stream(1, "force noise", 0);
        let cells = (0..600).map(|row| cells[row % 6] + noise * standard_normal(&mut random)).collect();
        contacts_of(name, cells, share)
    }

    /// Returns the share of rows that are as expected.
    fn share_right(name: &str, cells: [f64; 6], noise: f64) -> f64 {
        let found = touches(0.0, name, cells, noise).expect("contacts");
        let expected = [false, true, true, false, true, false];
        let right = found.iter().enumerate().filter(|(row, found)| **found == Some(expected[row % 6])).count();
        right as f64 / found.len() as f64
    }

    #[test]
    fn feet_touch_the_ground_by_contact_by_force_and_by_counts_with_an_offset() {
        assert_eq!(share_right("contact_FL", [0.0, 1.0, 1.0, 0.0, 1.0, 0.0], 0.0), 1.0);
        for (forces, noise) in [([0.0, 61.0, 58.0, 0.0, 12.0, 0.0], 0.5), ([21.0, 95.0, 90.0, 21.0, 40.0, 21.0], 1.0)] {
            let share = share_right("foot_force_FL", forces, noise);
            assert!(share > 0.95, "{forces:?}: {share}");
        }
    }

    /// A hopping robot is in the air most of the time.
    #[test]
    fn a_foot_that_is_rarely_on_the_ground_touches_it_then() {
        let forces = |row: usize| if row % 50 < 3 { 200.0 } else { 0.0 };
        let found = contacts_of("foot_force_FL", (0..600).map(forces).collect(), 0.0).expect("contacts");
        assert!(found.iter().enumerate().all(|(row, touches)| *touches == Some(row % 50 < 3)));
    }

    #[test]
    fn a_small_force_is_a_contact_only_without_a_share() {
        let forces = [0.0, 61.0, 58.0, 0.0, 4.0, 0.0];
        let [any, large] = [0.0, 0.15].map(|share| touches(share, "foot_force_FL", forces, 0.0).expect("forces")[4]);
        assert_eq!([any, large], [Some(true), Some(false)]);
    }

    #[test]
    fn a_foot_that_always_stands_has_no_offset_and_zeros_are_no_readings() {
        let always = touches(0.0, "foot_force_FL", [60.0, 70.0, 65.0, 62.0, 61.0, 66.0], 1.0).expect("forces");
        assert!(always.iter().all(|touches| *touches == Some(true)));
        assert_eq!(touches(0.0, "foot_force_FL", [0.0; 6], 0.0), None);
        assert_eq!(touches(0.0, "contact_FL", [0.0; 6], 0.0), None);
    }
}
