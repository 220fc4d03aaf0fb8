//! Row-by-row inference with all members, for many robots.

use twinstep_model::NUM_JOINTS;
use twinstep_simd::InstructionSet;

use crate::ensemble::{Ensemble, Gaussian};
use crate::kernel::Heads;
use crate::member_batch::{MemberBatch, MemberSlot, member_batch};
use crate::normaliser::Normalisers;

/// Evaluates an ensemble row by row, for applications without a simulator.
///
/// All joints are computed in parallel in the widest registers of the processor. The outputs of a joint depend only on
/// its own history, and are bitwise equal on every processor.
pub struct Inference {
    networks: Box<dyn MemberBatch>,
    members: usize,
    num_robots: usize,
    scales: Normalisers,
    variance_scale: f64,
}

impl Inference {
    /// Creates the inference for `num_robots` robots, with network states of zero.
    pub fn new(ensemble: &Ensemble, num_robots: usize) -> Self {
        Self::with(ensemble, num_robots, InstructionSet::best())
    }

    /// Creates the inference like [`Inference::new`] on a given instruction set.
    ///
    /// # Panics
    /// If the processor does not support the instruction set.
    pub fn with(ensemble: &Ensemble, num_robots: usize, instructions: InstructionSet) -> Self {
        let model = &ensemble.description;
        let mut networks = member_batch(ensemble, instructions);
        (0..model.members).for_each(|member| networks.grow(member, num_robots));
        let (scales, variance_scale) = (model.scales, model.variance_scale);
        Self { networks, members: model.members, num_robots, scales, variance_scale }
    }

    /// Advances every robot by one row.
    ///
    /// `errors` contains ξ = [q_cmd − q, dq_cmd − dq] [rad, rad/s] of each joint, in the order of
    /// [`twinstep_model::Joint::ALL`].
    ///
    /// # Panics
    /// If the number of entries is not the number of robots.
    pub fn step(&mut self, errors: &[[[f64; 2]; NUM_JOINTS]]) {
        assert_eq!(errors.len(), self.num_robots, "one entry per robot");
        let [position, velocity] = self.scales.inputs;
        for (slot, errors) in errors.iter().enumerate() {
            let errors = errors.map(|[q, dq]| [position.normalise(q), velocity.normalise(dq)]);
            for member in 0..self.members {
                self.networks.push_input(MemberSlot { member, slot }, &errors, true);
            }
        }
        self.networks.advance(Heads::Both);
    }

    /// Returns the last prediction of a member for the torques of a robot.
    pub fn predictions(&self, robot: usize, member: usize) -> [Gaussian; NUM_JOINTS] {
        let [means, variances] = self.networks.output(MemberSlot { member, slot: robot });
        let scale = self.scales.torque;
        let variance_scale = self.variance_scale * scale.std * scale.std;
        std::array::from_fn(|joint| Gaussian {
            mean: scale.mean + scale.std * f64::from(means[joint]),
            variance: variance_scale * f64::from(variances[joint]),
        })
    }

    /// Returns [`crate::epistemic_uncertainty`] of the last predictions, mean over the joints, per robot [nat].
    pub fn epistemic_uncertainty(&self) -> Vec<f32> {
        let mut found = vec![0.0; self.num_robots];
        self.networks.disagreement(self.variance_scale as f32, &mut found);
        found
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use proptest::prelude::*;
    use twinstep_logs::TorqueSensor;
    use twinstep_model::JOINT_NAMES;

    use super::*;
    use crate::data::Sequence;
    use crate::epistemic_uncertainty::epistemic_uncertainty;
    use crate::metadata::{EnsembleMetadata, JointEncoding};
    use crate::network::Network;
    use crate::normaliser::Normaliser;
    use crate::sequences::SequenceDataset;

    fn ensemble(members: usize, hidden: usize, joint_input: JointEncoding) -> Ensemble {
        let scale = |mean, std| Normaliser { mean, std };
        Ensemble::untrained(EnsembleMetadata {
            members,
            hidden,
            dt: 0.005,
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            joint_input,
            input: crate::NetworkInput::default(),
            target: crate::NetworkTarget::default(),
            scales: Normalisers { inputs: [scale(0.02, 0.1), scale(-0.3, 2.5)], torque: scale(0.0, 1.0) },
            tau_sensor: TorqueSensor::MotorCurrent,
            gains: vec![[30.0, 0.75]; 12],
            variance_scale: 1.3,
            data_hash: String::new(),
            seed: 3,
        })
    }

    /// Returns ξ of a joint in a sinusoidal motion with occasional steps.
    fn error(robot: usize, joint: usize, row: usize) -> [f64; 2] {
        let phase = (row as f64).mul_add(0.07 + 0.003 * joint as f64, robot as f64);
        let jump = if (row + 13 * joint) % 97 < 9 { 0.4 } else { 0.0 };
        [0.15 * phase.sin() + jump, 3.0 * phase.cos() - 2.0 * jump]
    }

    fn row(robots: std::ops::Range<usize>, row: usize) -> Vec<[[f64; 2]; NUM_JOINTS]> {
        robots.map(|robot| std::array::from_fn(|joint| error(robot, joint, row))).collect()
    }

    fn check_against_burn(joint_input: JointEncoding, hidden: usize) {
        const ROWS: usize = 1000;
        let ensemble = ensemble(2, hidden, joint_input);
        let run = |joint: usize| Sequence {
            log: 0,
            joint,
            after_reset: true,
            inputs: (0..ROWS).map(|row| error(1, joint, row)).collect(),
            torques: vec![0.0; ROWS],
        };
        let runs: Vec<Sequence> = (0..NUM_JOINTS).map(run).collect();
        let model = &ensemble.description;
        let batch = SequenceDataset::whole(runs.iter(), model).batch(&(0..NUM_JOINTS).collect::<Vec<_>>());
        let of_member = |weights| Network::new(model.shape(), weights, &Device::flex()).outputs(&batch);
        let expected: Vec<_> = ensemble.members.iter().map(of_member).collect();
        // The second robot, whose joints are in two blocks.
        let mut inference = Inference::with(&ensemble, 3, InstructionSet::best());
        for time in 0..ROWS {
            inference.step(&row(0..3, time));
            for (member, expected) in expected.iter().enumerate() {
                let answer = inference.networks.output(MemberSlot { member, slot: 1 });
                for (found, expected) in answer.iter().zip(expected) {
                    for (joint, found) in found.iter().enumerate() {
                        let expected = expected[time * NUM_JOINTS + joint];
                        assert!((found - expected).abs() < 1e-5, "row {time}, joint {joint}: {found} {expected}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_thousand_rows_agree_with_burn() {
        check_against_burn(JointEncoding::Pooled, 32);
        check_against_burn(JointEncoding::Kind, 7);
        check_against_burn(JointEncoding::Identity, 8);
    }

    #[test]
    fn epistemic_uncertainty_agrees_with_the_scalar_function() {
        let ensemble = ensemble(6, 16, JointEncoding::Kind);
        let mut inference = Inference::new(&ensemble, 5);
        for time in 0..40 {
            inference.step(&row(0..5, time));
        }
        for (robot, found) in inference.epistemic_uncertainty().into_iter().enumerate() {
            let members: Vec<_> = (0..6).map(|member| inference.predictions(robot, member)).collect();
            let of_joint = |joint: usize| {
                let (means, variances): (Vec<_>, Vec<_>) =
                    members.iter().map(|member| (member[joint].mean, member[joint].variance)).unzip();
                epistemic_uncertainty(&means, &variances)
            };
            let expected = (0..NUM_JOINTS).map(of_joint).sum::<f64>() / NUM_JOINTS as f64;
            assert!((f64::from(found) - expected).abs() < 1e-6, "{found} {expected}");
            assert!(expected > 1e-3, "{expected}");
        }
    }

    #[test]
    fn single_member_has_no_epistemic_uncertainty() {
        let mut inference = Inference::new(&ensemble(1, 4, JointEncoding::Pooled), 2);
        inference.step(&row(0..2, 0));
        assert_eq!(inference.epistemic_uncertainty(), [0.0, 0.0]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn outputs_are_bitwise_equal_for_any_register_and_batch(
            robots in 1usize..9, hidden in 1usize..20, rows in 1usize..30, kind: bool
        ) {
            let ensemble = ensemble(2, hidden, if kind { JointEncoding::Kind } else { JointEncoding::Identity });
            let bits = |robots: std::ops::Range<usize>, instructions| {
                let mut inference = Inference::with(&ensemble, robots.len(), instructions);
                (0..rows).for_each(|time| inference.step(&row(robots.clone(), time)));
                let last = robots.len() - 1;
                let answers = [0, 1].map(|member| inference.networks.output(MemberSlot { member, slot: last }));
                (answers.map(|answer| answer.map(|numbers| numbers.map(f32::to_bits))),
                    inference.epistemic_uncertainty()[last].to_bits())
            };
            let alone = bits(robots - 1..robots, InstructionSet::PORTABLE);
            for instructions in InstructionSet::available() {
                prop_assert_eq!(bits(0..robots, instructions), alone);
            }
        }
    }
}
