//! Actuators simulated with an ensemble.

use rand::RngExt;
use twinstep_effects::{ActuatorNetworkConfig, MemberSampling};
use twinstep_model::{
    Actuator, ActuatorMode, ActuatorSnapshot, BackendError, Command, EpistemicUncertainty, JOINT_NAMES, Measured,
    NUM_JOINTS, PerJoint, Stream, standard_normal, stream,
};
use twinstep_simd::InstructionSet;

use crate::ensemble::Ensemble;
use crate::kernel::Heads;
use crate::member_batch::{MemberBatch, MemberSlot, member_batch};
use crate::normaliser::Normalisers;

/// Actuators of many robots, simulated with an ensemble. One member computes the torques of a robot, or all of them.
///
/// The input is computed from commands and encoder readings. The torques of a robot depend only on its own history and seed.
/// They are bitwise equal to those of a single robot, on any processor and for any number of threads.
pub struct ActuatorNetwork {
    networks: Box<dyn MemberBatch>,
    members: usize,
    draw: MemberSampling,
    sample: bool,
    /// True if every member receives the inputs of every robot. The slot of a robot is then its index.
    feed_all_members: bool,
    combination: Combination,
    mode: ActuatorMode,
    /// Time step of the networks [actuator periods], at least 1.
    periods: f64,
    scales: Normalisers,
    /// Calibrated factor of the normalised variances.
    variance_scale: f64,
    /// kp [N·m/rad] and kd [N·m·s/rad] of the training data; `None` if the torque that was asked for is the input.
    gains: Option<[f32; 2]>,
    /// Maximum torque [N·m]; infinite if the torque includes friction and rotor inertia.
    limits: PerJoint,
    robots: Vec<Robot>,
    /// Robots of each member, by slot. Empty if `feed_all_members`.
    robots_by_member: Vec<Vec<usize>>,
}

/// Which members compute the torque of a robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Combination {
    /// One member at a time.
    OneMember,
    /// One member at a time; the others receive the same inputs, as [`EpistemicUncertainty`] requires.
    OneMemberOfAll,
    /// The mean of all members, the best prediction.
    Mean,
}

/// How an ensemble is used by robots.
pub(crate) struct NetworkUse {
    pub combination: Combination,
    pub mode: ActuatorMode,
    /// Maximum torque of each joint [N·m].
    pub limits: PerJoint,
    /// Actuator period of the robots [s].
    pub actuator_dt: f64,
}

#[derive(Clone)]
struct Robot {
    random: Stream,
    member: usize,
    slot: usize,
    /// Time until the networks are due [actuator periods]. They are due below half a period.
    until_due: f64,
    /// The last torque of the networks [N·m].
    torque: PerJoint,
}

/// Actuator state of one robot.
struct NetworkSnapshot {
    random: Stream,
    member: usize,
    until_due: f64,
    torque: PerJoint,
    /// State of the robot's member, or of all members if `feed_all_members`.
    states: Vec<Vec<f32>>,
}

impl ActuatorNetwork {
    /// Creates the actuators of `num_robots` robots, each with the seed 0.
    pub(crate) fn new(
        ensemble: &Ensemble,
        settings: &ActuatorNetworkConfig,
        NetworkUse { combination, mode, limits, actuator_dt }: NetworkUse,
        num_robots: usize,
        instructions: InstructionSet,
    ) -> Self {
        let model = &ensemble.description;
        let all = combination != Combination::OneMember || settings.draw == MemberSampling::PerStep;
        let initial = Robot { random: stream(0, "drives", 0), member: 0, slot: 0, until_due: 0.0, torque: [0.0; 12] };
        let mut this = Self {
            networks: member_batch(ensemble, instructions),
            members: model.members,
            draw: settings.draw,
            sample: settings.sample,
            feed_all_members: all,
            combination,
            mode,
            periods: (model.dt / actuator_dt).max(1.0),
            scales: model.scales,
            variance_scale: model.variance_scale,
            gains: model.gains.first().map(|gains| gains.map(|gain| gain as f32)),
            limits,
            robots: vec![initial; num_robots],
            robots_by_member: vec![Vec::new(); model.members],
        };
        for robot in 0..num_robots {
            this.robots[robot].slot = robot;
            if !all {
                this.assign(robot, 0);
            }
        }
        for member in 0..if all { this.members } else { 0 } {
            this.networks.grow(member, num_robots);
        }
        for robot in 0..num_robots {
            this.reset(robot, 0);
        }
        this
    }

    /// Returns the slots that receive the inputs of a robot.
    fn fed_slots(&self, robot: usize) -> impl Iterator<Item = MemberSlot> + use<> {
        let Robot { member, slot, .. } = self.robots[robot];
        let members = if self.feed_all_members { 0..self.members } else { member..member + 1 };
        members.map(move |member| MemberSlot { member, slot })
    }

    /// Assigns a robot to `member`. The states of its previous member are lost unless `feed_all_members`.
    fn reassign(&mut self, robot: usize, member: usize) {
        if self.feed_all_members {
            self.robots[robot].member = member;
        } else if self.robots[robot].member != member {
            self.unassign(robot);
            self.assign(robot, member);
        }
    }

    /// Removes a robot from its member. The member's last robot moves to the free slot.
    fn unassign(&mut self, robot: usize) {
        let Robot { member, slot, .. } = self.robots[robot];
        self.robots_by_member[member].swap_remove(slot);
        if let Some(last) = self.robots_by_member[member].get(slot) {
            let from = MemberSlot { member, slot: self.robots_by_member[member].len() };
            let state = self.networks.state(from);
            self.networks.set_state(MemberSlot { member, slot }, &state);
            self.robots[*last].slot = slot;
        }
    }

    fn assign(&mut self, robot: usize, member: usize) {
        let robots = &mut self.robots_by_member[member];
        (self.robots[robot].member, self.robots[robot].slot) = (member, robots.len());
        robots.push(robot);
        self.networks.grow(member, robots.len());
    }

    /// Checks that the commands have the gains of the training data and no feed-forward torque, unless the networks serve
    /// all gains.
    fn check(&self, commands: &[Command], active: &[bool]) -> Result<(), BackendError> {
        let Some(gains @ [kp, kd]) = self.gains else { return Ok(()) };
        for (robot, command) in commands.iter().enumerate().filter(|(robot, _)| active[*robot]) {
            let reason = |joint: usize| {
                let (given, name) = ([command.kp[joint], command.kd[joint]], JOINT_NAMES[joint]);
                if given != gains {
                    return format!("the actuator network supports only kp {kp} and kd {kd}; {name} has {given:?}");
                }
                format!("the actuator network does not support `tau_ff`; {name} has {}", command.tau_ff[joint])
            };
            let is_supported =
                |joint: &usize| command.kp[*joint] == kp && command.kd[*joint] == kd && command.tau_ff[*joint] == 0.0;
            if let Some(joint) = (0..NUM_JOINTS).find(|joint| !is_supported(joint)) {
                return Err(BackendError::UnsupportedCommand { robot, reason: reason(joint) });
            }
        }
        Ok(())
    }

    /// Returns the normalised input of the networks of a robot.
    fn inputs(&self, command: &Command, q: &PerJoint, dq: &PerJoint) -> [[f32; 2]; NUM_JOINTS] {
        let [first, second] = self.scales.inputs;
        std::array::from_fn(|joint| {
            let at = |values: &PerJoint| f64::from(values[joint]);
            let [q_error, dq_error] = [at(&command.q) - at(q), at(&command.dq) - at(dq)];
            let input = match self.gains {
                Some(_) => [q_error, dq_error],
                None => [at(&command.kp) * q_error + at(&command.kd) * dq_error + at(&command.tau_ff), at(dq)],
            };
            [first.normalise(input[0]), second.normalise(input[1])]
        })
    }

    /// Returns the mean torque of all members of a robot, from their last outputs [N·m].
    fn mean_torque(&self, robot: usize) -> PerJoint {
        let mut sum = [0.0; NUM_JOINTS];
        for slot in self.fed_slots(robot) {
            let [means, _] = self.networks.output(slot);
            sum.iter_mut().zip(means).for_each(|(sum, mean)| *sum += f64::from(mean) / self.members as f64);
        }
        let scale = self.scales.torque;
        std::array::from_fn(|joint| {
            let limit = self.limits[joint];
            ((scale.mean + scale.std * sum[joint]) as f32).clamp(-limit, limit)
        })
    }

    /// Returns the torque of a robot, from the last output of its member [N·m].
    fn torque(&mut self, robot: usize) -> PerJoint {
        if self.combination == Combination::Mean {
            return self.mean_torque(robot);
        }
        let Robot { member, slot, random, .. } = &mut self.robots[robot];
        let [means, variances] = self.networks.output(MemberSlot { member: *member, slot: *slot });
        let scale = self.scales.torque;
        std::array::from_fn(|joint| {
            let mut normalised = f64::from(means[joint]);
            if self.sample {
                normalised += (self.variance_scale * f64::from(variances[joint])).sqrt() * standard_normal(random);
            }
            let limit = self.limits[joint];
            ((scale.mean + scale.std * normalised) as f32).clamp(-limit, limit)
        })
    }
}

impl Actuator for ActuatorNetwork {
    fn mode(&self) -> ActuatorMode {
        self.mode
    }

    fn torques(
        &mut self,
        commands: &[Command],
        active: &[bool],
        measured: &Measured,
        tau: &mut [PerJoint],
    ) -> Result<(), BackendError> {
        self.check(commands, active)?;
        let robots = || (0..active.len()).filter(|robot| active[*robot]);
        let due: Vec<bool> = self.robots.iter().map(|robot| robot.until_due < 0.5).collect();
        for robot in robots().filter(|robot| due[*robot]) {
            if self.draw == MemberSampling::PerStep {
                self.robots[robot].member = self.robots[robot].random.random_range(0..self.members);
            }
            let inputs = self.inputs(&commands[robot], &measured.q[robot], &measured.dq[robot]);
            for slot in self.fed_slots(robot) {
                let is_used = self.combination == Combination::Mean || slot.member == self.robots[robot].member;
                self.networks.push_input(slot, &inputs, is_used);
            }
        }
        self.networks.advance(if self.sample { Heads::Both } else { Heads::Mean });
        for robot in robots() {
            if due[robot] {
                self.robots[robot].torque = self.torque(robot);
                self.robots[robot].until_due += self.periods;
            }
            self.robots[robot].until_due -= 1.0;
            tau[robot] = self.robots[robot].torque;
        }
        Ok(())
    }

    fn reset(&mut self, robot: usize, seed: u64) {
        self.robots[robot].random = stream(seed, "drives", 0);
        (self.robots[robot].until_due, self.robots[robot].torque) = (0.0, [0.0; NUM_JOINTS]);
        if self.draw == MemberSampling::PerEpisode {
            let member = self.robots[robot].random.random_range(0..self.members);
            self.reassign(robot, member);
        }
        for slot in self.fed_slots(robot) {
            self.networks.reset_state(slot);
        }
    }

    fn snapshot(&self, robot: usize) -> ActuatorSnapshot {
        let Robot { random, member, until_due, torque, .. } = self.robots[robot].clone();
        let states = self.fed_slots(robot).map(|slot| self.networks.state(slot)).collect();
        ActuatorSnapshot::new(NetworkSnapshot { random, member, until_due, torque, states })
    }

    fn restore(&mut self, robot: usize, snapshot: &ActuatorSnapshot) {
        let NetworkSnapshot { random, member, until_due, torque, states } =
            snapshot.get().expect("a snapshot of the same ensemble");
        self.robots[robot].random = random.clone();
        (self.robots[robot].until_due, self.robots[robot].torque) = (*until_due, *torque);
        self.reassign(robot, *member);
        for (slot, state) in self.fed_slots(robot).zip(states) {
            self.networks.set_state(slot, state);
        }
    }

    fn uncertainty(&mut self) -> Option<&mut dyn EpistemicUncertainty> {
        if self.feed_all_members { Some(self) } else { None }
    }
}

/// [`crate::epistemic_uncertainty`] of the last actuator period's torques, mean over the joints [nat] (U2E, eq. 11).
impl EpistemicUncertainty for ActuatorNetwork {
    fn evaluate(&mut self, active: &[bool], uncertainty: &mut [f32]) {
        self.networks.evaluate_all();
        let mut found = vec![0.0; active.len()];
        self.networks.disagreement(self.variance_scale as f32, &mut found);
        for robot in (0..active.len()).filter(|robot| active[*robot]) {
            uncertainty[robot] = found[robot];
        }
    }
}

#[cfg(test)]
mod tests {
    use twinstep_logs::TorqueSensor;
    use twinstep_model::{ActuatorTap, RobotStates};

    use super::*;
    use crate::inference::Inference;
    use crate::metadata::{EnsembleMetadata, JointEncoding};
    use crate::network_input::{NetworkInput, NetworkTarget};
    use crate::normaliser::Normaliser;

    fn ensemble(members: usize) -> Ensemble {
        let scale = |mean, std| Normaliser { mean, std };
        Ensemble::untrained(EnsembleMetadata {
            members,
            hidden: 5,
            dt: 0.005,
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            joint_input: JointEncoding::Identity,
            input: NetworkInput::Errors,
            target: NetworkTarget::Torque,
            scales: Normalisers { inputs: [scale(0.01, 0.1), scale(0.2, 2.0)], torque: scale(1.5, 10.0) },
            tau_sensor: TorqueSensor::MotorCurrent,
            gains: vec![[30.0, 0.75]; 12],
            variance_scale: 0.2,
            data_hash: String::new(),
            seed: 4,
        })
    }

    fn used(actuator_dt: f64) -> NetworkUse {
        let (combination, mode) = (Combination::OneMember, ActuatorMode::Replace(ActuatorTap::Current));
        NetworkUse { combination, mode, limits: [9.0; 12], actuator_dt }
    }

    fn actuators(members: usize, draw: MemberSampling, sample: bool, robots: usize) -> ActuatorNetwork {
        let settings = ActuatorNetworkConfig { draw, sample, ..ActuatorNetworkConfig::default() };
        let mut actuators =
            ActuatorNetwork::new(&ensemble(members), &settings, used(0.005), robots, InstructionSet::best());
        (0..robots).for_each(|robot| actuators.reset(robot, robot as u64));
        actuators
    }

    /// Returns the torques of robots that have equal commands and states.
    fn torques(actuators: &mut ActuatorNetwork, row: usize) -> Vec<PerJoint> {
        let robots = actuators.robots.len();
        let mut tau = vec![[0.0; 12]; robots];
        let command = Command::hold([0.02 * row as f32; 12], 30.0, 0.75);
        actuators
            .torques(&vec![command; robots], &vec![true; robots], &RobotStates::new(robots).measured, &mut tau)
            .expect("supported commands");
        tau
    }

    /// Returns the predictions of each member for such a robot.
    fn expected(members: usize, row: usize) -> Vec<[crate::Gaussian; 12]> {
        let mut inference = Inference::new(&ensemble(members), 1);
        for row in 0..=row {
            inference.step(&[[[f64::from(0.02 * row as f32), 0.0]; 12]]);
        }
        (0..members).map(|member| inference.predictions(0, member)).collect()
    }

    /// Returns the member whose means are `tau`.
    fn member_of(tau: &PerJoint, members: &[[crate::Gaussian; 12]]) -> Option<usize> {
        let is = |member: &[crate::Gaussian; 12]| {
            member.iter().zip(tau).all(|(expected, tau)| (expected.mean as f32).clamp(-9.0, 9.0) == *tau)
        };
        members.iter().position(is)
    }

    #[test]
    fn per_episode_sampling_keeps_the_member_until_the_reset() {
        let mut actuators = actuators(3, MemberSampling::PerEpisode, false, 40);
        let first: Vec<_> = torques(&mut actuators, 0).iter().map(|tau| member_of(tau, &expected(3, 0))).collect();
        for row in 1..4 {
            let tau = torques(&mut actuators, row);
            assert_eq!(tau.iter().map(|tau| member_of(tau, &expected(3, row))).collect::<Vec<_>>(), first);
        }
        assert!((0..3).all(|member| first.contains(&Some(member))) && !first.contains(&None));
        // Resets reassign the robots to other members, one after another.
        (0..40).for_each(|robot| actuators.reset(robot, 100 + robot as u64));
        let tau = torques(&mut actuators, 0);
        let second: Vec<_> = tau.iter().map(|tau| member_of(tau, &expected(3, 0))).collect();
        assert!(second != first && !second.contains(&None));
    }

    #[test]
    fn per_step_sampling_keeps_the_states_of_all_members() {
        let mut actuators = actuators(3, MemberSampling::PerStep, false, 40);
        let mut members = Vec::new();
        for row in 0..4 {
            let tau = torques(&mut actuators, row);
            members.push(tau.iter().map(|tau| member_of(tau, &expected(3, row))).collect::<Vec<_>>());
        }
        assert!(members.iter().all(|row| !row.contains(&None)) && members[2] != members[3]);
    }

    #[test]
    fn samples_have_the_mean_and_variance_of_the_member() {
        const ROBOTS: usize = 4000;
        let mut actuators = actuators(1, MemberSampling::PerEpisode, true, ROBOTS);
        actuators.limits = [f32::INFINITY; 12];
        let (tau, expected) = (torques(&mut actuators, 0), expected(1, 0));
        for (joint, expected) in expected[0].iter().enumerate() {
            let of =
                |power: i32| tau.iter().map(|tau| (f64::from(tau[joint]) - expected.mean).powi(power)).sum::<f64>();
            let (mean, variance) = (of(1) / ROBOTS as f64, of(2) / ROBOTS as f64);
            // Tolerance: five standard errors.
            assert!(mean.abs() < 5.0 * (expected.variance / ROBOTS as f64).sqrt(), "{joint}: {mean}");
            let error = 5.0 * (2.0 / ROBOTS as f64).sqrt();
            assert!((variance / expected.variance - 1.0).abs() < error, "{joint}: {variance} {}", expected.variance);
        }
    }

    #[test]
    fn networks_are_evaluated_at_their_own_rate_and_hold_the_torque_in_between() {
        let settings = ActuatorNetworkConfig::default();
        let mut fast = ActuatorNetwork::new(&ensemble(1), &settings, used(0.002), 1, InstructionSet::best());
        fast.reset(0, 3);
        let held: Vec<PerJoint> = (0..10).map(|_| torques(&mut fast, 1)[0]).collect();
        let changes: Vec<usize> = (1..10).filter(|row| held[*row] != held[row - 1]).collect();
        // A step of 5 ms is two and a half periods of 2 ms.
        assert_eq!(changes, [3, 5, 8]);
    }

    #[test]
    fn mean_of_all_members_is_the_best_prediction() {
        let settings = ActuatorNetworkConfig::default();
        let mean = NetworkUse { combination: Combination::Mean, limits: [f32::INFINITY; 12], ..used(0.005) };
        let mut actuators = ActuatorNetwork::new(&ensemble(3), &settings, mean, 1, InstructionSet::best());
        let (found, members) = (torques(&mut actuators, 0)[0], expected(3, 0));
        for (joint, found) in found.iter().enumerate() {
            let mean = members.iter().map(|member| member[joint].mean / 3.0).sum::<f64>();
            assert!((f64::from(*found) - mean).abs() < 1e-5, "{joint}: {found} {mean}");
        }
    }

    #[test]
    fn torque_is_clipped_to_the_limit() {
        let mut actuators = actuators(1, MemberSampling::PerEpisode, true, 400);
        let tau = torques(&mut actuators, 0);
        assert!(tau.iter().flatten().all(|tau| tau.abs() <= 9.0));
        assert!(tau.iter().flatten().any(|tau| tau.abs() == 9.0));
    }
}
