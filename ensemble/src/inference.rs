//! All members row by row, for many robots at once.

use twinstep_model::NUM_JOINTS;
use twinstep_model::lanes::InstructionSet;

use crate::ensemble::{Ensemble, Gaussian};
use crate::kernel::Heads;
use crate::networks::{MemberBatch, MemberSlot, networks};
use crate::scales::Normalisers;

/// An ensemble that hears robots row after row: for who has commands and encoders, but no simulator.
///
/// It computes in the processor's widest registers, all joints side by side. A joint's numbers depend on its own past only,
/// and have the same bits on every processor.
pub struct Inference {
    networks: Box<dyn MemberBatch>,
    members: usize,
    num_robots: usize,
    scales: Normalisers,
    variance_scale: f64,
}

impl Inference {
    /// `num_robots` robots whose past is unseen.
    pub fn new(ensemble: &Ensemble, num_robots: usize) -> Self {
        Self::with(ensemble, num_robots, InstructionSet::best())
    }

    /// As [`Inference::new`], with these instructions.
    ///
    /// # Panics
    /// If the processor lacks them.
    pub fn with(ensemble: &Ensemble, num_robots: usize, instructions: InstructionSet) -> Self {
        let model = &ensemble.description;
        let mut networks = networks(ensemble, instructions);
        (0..model.members).for_each(|member| networks.grow(member, num_robots));
        let (scales, variance_scale) = (model.scales, model.variance_scale);
        Self { networks, members: model.members, num_robots, scales, variance_scale }
    }

    /// The next row of every robot: ξ = [q_cmd − q, dq_cmd − dq] [rad, rad/s] of each joint in the order of
    /// [`twinstep_model::Joint::ALL`].
    ///
    /// # Panics
    /// Unless there is one entry a robot.
    pub fn step(&mut self, errors: &[[[f64; 2]; NUM_JOINTS]]) {
        assert_eq!(errors.len(), self.num_robots, "one entry a robot");
        let [position, velocity] = self.scales.errors;
        for (slot, errors) in errors.iter().enumerate() {
            let errors = errors.map(|[q, dq]| [position.normalise(q), velocity.normalise(dq)]);
            for member in 0..self.members {
                self.networks.push_input(MemberSlot { member, slot }, &errors, true);
            }
        }
        self.networks.advance(Heads::Both);
    }

    /// What a member says of a robot's torques now.
    pub fn predictions(&self, robot: usize, member: usize) -> [Gaussian; NUM_JOINTS] {
        let [means, variances] = self.networks.output(MemberSlot { member, slot: robot });
        let scale = self.scales.torque;
        let variance_scale = self.variance_scale * scale.std * scale.std;
        std::array::from_fn(|joint| Gaussian {
            mean: scale.mean + scale.std * f64::from(means[joint]),
            variance: variance_scale * f64::from(variances[joint]),
        })
    }

    /// [`crate::disagreement`] of the members, mean over the joints, one entry a robot [nat].
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
    use crate::ensemble::{EnsembleMetadata, JointEncoding};
    use crate::euf::epistemic_uncertainty;
    use crate::network::Network;
    use crate::scales::Normaliser;
    use crate::windows::SequenceDataset;

    fn ensemble(members: usize, hidden: usize, joint_input: JointEncoding) -> Ensemble {
        let scale = |mean, deviation| Normaliser { mean, std: deviation };
        Ensemble::untrained(EnsembleMetadata {
            members,
            hidden,
            dt: 0.005,
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            joint_input,
            scales: Normalisers { errors: [scale(0.02, 0.1), scale(-0.3, 2.5)], torque: scale(0.0, 1.0) },
            tau_sensor: TorqueSensor::MotorCurrent,
            gains: vec![[30.0, 0.75]; 12],
            variance_scale: 1.3,
            data_hash: String::new(),
            seed: 3,
        })
    }

    /// Motion of a joint that swings and now and then jumps.
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
            joint,
            after_reset: true,
            errors: (0..ROWS).map(|row| error(1, joint, row)).collect(),
            torques: vec![0.0; ROWS],
        };
        let runs: Vec<Sequence> = (0..NUM_JOINTS).map(run).collect();
        let model = &ensemble.description;
        let batch = SequenceDataset::whole(runs.iter(), model).batch(&(0..NUM_JOINTS).collect::<Vec<_>>());
        let of_member = |weights| Network::new(model.shape(), weights, &Device::flex()).outputs(&batch);
        let wanted: Vec<_> = ensemble.members.iter().map(of_member).collect();
        // Not the first robot, so that its joints lie across two blocks.
        let mut inference = Inference::with(&ensemble, 3, InstructionSet::best());
        for time in 0..ROWS {
            inference.step(&row(0..3, time));
            for (member, wanted) in wanted.iter().enumerate() {
                let answer = inference.networks.output(MemberSlot { member, slot: 1 });
                for (found, wanted) in answer.iter().zip(wanted) {
                    for (joint, found) in found.iter().enumerate() {
                        let wanted = wanted[time * NUM_JOINTS + joint];
                        assert!((found - wanted).abs() < 1e-5, "row {time}, joint {joint}: {found} {wanted}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_thousand_rows_are_burns() {
        check_against_burn(JointEncoding::Pooled, 32);
        check_against_burn(JointEncoding::Kind, 7);
        check_against_burn(JointEncoding::Identity, 8);
    }

    #[test]
    fn disagreement_is_the_exact_functions() {
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
            let wanted = (0..NUM_JOINTS).map(of_joint).sum::<f64>() / NUM_JOINTS as f64;
            assert!((f64::from(found) - wanted).abs() < 1e-6, "{found} {wanted}");
            assert!(wanted > 1e-3, "{wanted}");
        }
    }

    #[test]
    fn one_member_agrees_with_itself() {
        let mut inference = Inference::new(&ensemble(1, 4, JointEncoding::Pooled), 2);
        inference.step(&row(0..2, 0));
        assert_eq!(inference.epistemic_uncertainty(), [0.0, 0.0]);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn a_robots_bits_are_the_same_in_any_register_and_any_company(
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
            let alone = bits(robots - 1..robots, InstructionSet::Baseline);
            for instructions in InstructionSet::available() {
                prop_assert_eq!(bits(0..robots, instructions), alone);
            }
        }
    }
}
