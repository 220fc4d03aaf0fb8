//! Robots that are driven by an ensemble.

use rand::RngExt;
use twinstep_model::lanes::InstructionSet;
use twinstep_model::{
    Actuator, ActuatorSnapshot, BackendError, Command, JOINT_NAMES, ActuatorNetworkConfig, MemberSampling, NUM_JOINTS, PerJoint,
    RobotStates, Stream, EpistemicUncertainty, standard_normal, stream,
};

use crate::ensemble::Ensemble;
use crate::kernel::Heads;
use crate::networks::{MemberBatch, MemberSlot, networks};
use crate::scales::Normalisers;

/// The drives of many robots: from ξ as the encoders show it to torque, by a member of an ensemble a robot.
///
/// A robot's numbers depend on its own past and seed only: robot i of many has the bits of a single one, on any processor
/// and any number of threads.
pub struct ActuatorNetwork {
    networks: Box<dyn MemberBatch>,
    members: usize,
    draw: MemberSampling,
    sample: bool,
    /// Whether every member hears of every robot. A robot's slot is its index then.
    feed_all_members: bool,
    scales: Normalisers,
    /// Of normalised variances, as calibrated.
    variance_scale: f64,
    /// kp [N·m/rad] and kd [N·m·s/rad].
    gains: [f32; 2],
    /// Largest torque [N·m]; infinite where friction and rotor are in it.
    limits: PerJoint,
    robots: Vec<Robot>,
    /// The robots that each member drives, slot by slot, where not every member hears of all.
    robots_by_member: Vec<Vec<usize>>,
}

#[derive(Clone)]
struct Robot {
    random: Stream,
    member: usize,
    slot: usize,
}

/// What the drives remember of a robot.
struct NetworkSnapshot {
    random: Stream,
    member: usize,
    /// Of the member that drives it, or of all.
    states: Vec<Vec<f32>>,
}

impl ActuatorNetwork {
    /// Of `num_robots` robots, each with the seed 0. `uncertain` lets all members run, so that [`Uncertainty`] is known.
    pub(crate) fn new(
        ensemble: &Ensemble,
        settings: &ActuatorNetworkConfig,
        uncertain: bool,
        limits: PerJoint,
        num_robots: usize,
        instructions: InstructionSet,
    ) -> Self {
        let model = &ensemble.description;
        let all = uncertain || settings.draw == MemberSampling::PerStep;
        let idle = Robot { random: stream(0, "drives", 0), member: 0, slot: 0 };
        let mut this = Self {
            networks: networks(ensemble, instructions),
            members: model.members,
            draw: settings.draw,
            sample: settings.sample,
            feed_all_members: all,
            scales: model.scales,
            variance_scale: model.variance_scale,
            gains: model.gains[0].map(|gain| gain as f32),
            limits,
            robots: vec![idle; num_robots],
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

    /// The members that hear of a robot.
    fn fed_slots(&self, robot: usize) -> impl Iterator<Item = MemberSlot> + use<> {
        let Robot { member, slot, .. } = self.robots[robot];
        let members = if self.feed_all_members { 0..self.members } else { member..member + 1 };
        members.map(move |member| MemberSlot { member, slot })
    }

    /// Lets `member` drive a robot; where only it hears of it, what others remember is lost.
    fn reassign(&mut self, robot: usize, member: usize) {
        if self.feed_all_members {
            self.robots[robot].member = member;
        } else if self.robots[robot].member != member {
            self.unassign(robot);
            self.assign(robot, member);
        }
    }

    /// Takes a robot from its member; the last of the crew moves up, so that there are no holes.
    fn unassign(&mut self, robot: usize) {
        let Robot { member, slot, .. } = self.robots[robot];
        self.robots_by_member[member].swap_remove(slot);
        if let Some(last) = self.robots_by_member[member].get(slot) {
            let from = MemberSlot { member, slot: self.robots_by_member[member].len() };
            let memory = self.networks.state(from);
            self.networks.set_state(MemberSlot { member, slot }, &memory);
            self.robots[*last].slot = slot;
        }
    }

    fn assign(&mut self, robot: usize, member: usize) {
        let crew = &mut self.robots_by_member[member];
        (self.robots[robot].member, self.robots[robot].slot) = (member, crew.len());
        crew.push(robot);
        self.networks.grow(member, crew.len());
    }

    /// Fails unless the networks know what is commanded.
    fn check(&self, commands: &[Command], active: &[bool]) -> Result<(), BackendError> {
        let [kp, kd] = self.gains;
        for (robot, command) in commands.iter().enumerate().filter(|(robot, _)| active[*robot]) {
            let reason = |joint: usize| {
                let (given, name) = ([command.kp[joint], command.kd[joint]], JOINT_NAMES[joint]);
                if given != self.gains {
                    return format!("the networks know kp {kp} and kd {kd} only, {name} is commanded {given:?}");
                }
                format!("the networks have never heard of a feed-forward torque, {name} has {}", command.tau_ff[joint])
            };
            let known =
                |joint: &usize| command.kp[*joint] == kp && command.kd[*joint] == kd && command.tau_ff[*joint] == 0.0;
            if let Some(joint) = (0..NUM_JOINTS).find(|joint| !known(joint)) {
                return Err(BackendError::UnsupportedCommand { robot, reason: reason(joint) });
            }
        }
        Ok(())
    }

    /// ξ of a robot, normalised.
    fn errors(&self, command: &Command, q: &PerJoint, dq: &PerJoint) -> [[f32; 2]; NUM_JOINTS] {
        let [position, velocity] = self.scales.errors;
        std::array::from_fn(|joint| {
            [
                position.normalise(f64::from(command.q[joint]) - f64::from(q[joint])),
                velocity.normalise(f64::from(command.dq[joint]) - f64::from(dq[joint])),
            ]
        })
    }

    /// The torque that a robot's member has answered [N·m].
    fn torque(&mut self, robot: usize) -> PerJoint {
        let Robot { member, slot, random } = &mut self.robots[robot];
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
    fn torques(
        &mut self,
        commands: &[Command],
        active: &[bool],
        states: &RobotStates,
        tau: &mut [PerJoint],
    ) -> Result<(), BackendError> {
        self.check(commands, active)?;
        let robots = || (0..active.len()).filter(|robot| active[*robot]);
        for robot in robots() {
            if self.draw == MemberSampling::PerStep {
                self.robots[robot].member = self.robots[robot].random.random_range(0..self.members);
            }
            let errors = self.errors(&commands[robot], &states.q[robot], &states.dq[robot]);
            for place in self.fed_slots(robot) {
                self.networks.push_input(place, &errors, place.member == self.robots[robot].member);
            }
        }
        self.networks.advance(if self.sample { Heads::Both } else { Heads::Mean });
        for robot in robots() {
            tau[robot] = self.torque(robot);
        }
        Ok(())
    }

    fn reset(&mut self, robot: usize, seed: u64) {
        self.robots[robot].random = stream(seed, "drives", 0);
        if self.draw == MemberSampling::PerEpisode {
            let member = self.robots[robot].random.random_range(0..self.members);
            self.reassign(robot, member);
        }
        for place in self.fed_slots(robot) {
            self.networks.reset_state(place);
        }
    }

    fn snapshot(&self, robot: usize) -> ActuatorSnapshot {
        let Robot { random, member, .. } = self.robots[robot].clone();
        let states = self.fed_slots(robot).map(|place| self.networks.state(place)).collect();
        ActuatorSnapshot::new(NetworkSnapshot { random, member, states })
    }

    fn restore(&mut self, robot: usize, snapshot: &ActuatorSnapshot) {
        let NetworkSnapshot { random, member, states } = snapshot.get().expect("a snapshot of drives of the same ensemble");
        self.robots[robot].random = random.clone();
        self.reassign(robot, *member);
        for (place, memory) in self.fed_slots(robot).zip(states) {
            self.networks.set_state(place, memory);
        }
    }

    fn uncertainty(&mut self) -> Option<&mut dyn EpistemicUncertainty> {
        if self.feed_all_members { Some(self) } else { None }
    }
}

/// [`crate::disagreement`] of the members about the torque of the last drive period, mean over the joints (U2E equation 11).
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

    use super::*;
    use crate::ensemble::{EnsembleMetadata, JointEncoding};
    use crate::inference::Inference;
    use crate::scales::Normaliser;

    fn ensemble(members: usize) -> Ensemble {
        let scale = |mean, deviation| Normaliser { mean, std: deviation };
        Ensemble::untrained(EnsembleMetadata {
            members,
            hidden: 5,
            dt: 0.005,
            joints: JOINT_NAMES.map(str::to_owned).to_vec(),
            joint_input: JointEncoding::Identity,
            scales: Normalisers { errors: [scale(0.01, 0.1), scale(0.2, 2.0)], torque: scale(1.5, 10.0) },
            tau_sensor: TorqueSensor::MotorCurrent,
            gains: vec![[30.0, 0.75]; 12],
            variance_scale: 0.2,
            data_hash: String::new(),
            seed: 4,
        })
    }

    fn drives(members: usize, draw: MemberSampling, sample: bool, robots: usize) -> ActuatorNetwork {
        let settings = ActuatorNetworkConfig { ensemble: "".into(), draw, sample };
        let mut drives =
            ActuatorNetwork::new(&ensemble(members), &settings, false, [9.0; 12], robots, InstructionSet::best());
        (0..robots).for_each(|robot| drives.reset(robot, robot as u64));
        drives
    }

    /// Torques of robots that are all told and seen the same, row after row.
    fn torques(drives: &mut ActuatorNetwork, row: usize) -> Vec<PerJoint> {
        let robots = drives.robots.len();
        let mut tau = vec![[0.0; 12]; robots];
        let command = Command::hold([0.02 * row as f32; 12], 30.0, 0.75);
        drives
            .torques(&vec![command; robots], &vec![true; robots], &RobotStates::new(robots), &mut tau)
            .expect("known");
        tau
    }

    /// What each member expects of such a robot in a row.
    fn wanted(members: usize, row: usize) -> Vec<[crate::Gaussian; 12]> {
        let mut inference = Inference::new(&ensemble(members), 1);
        for row in 0..=row {
            inference.step(&[[[f64::from(0.02 * row as f32), 0.0]; 12]]);
        }
        (0..members).map(|member| inference.predictions(0, member)).collect()
    }

    /// Which member's means these are.
    fn member_of(tau: &PerJoint, members: &[[crate::Gaussian; 12]]) -> Option<usize> {
        let is = |member: &[crate::Gaussian; 12]| {
            member.iter().zip(tau).all(|(wanted, tau)| (wanted.mean as f32).clamp(-9.0, 9.0) == *tau)
        };
        members.iter().position(is)
    }

    #[test]
    fn one_member_drives_a_robot_until_it_is_placed_anew() {
        let mut drives = drives(3, MemberSampling::PerEpisode, false, 40);
        let first: Vec<_> = torques(&mut drives, 0).iter().map(|tau| member_of(tau, &wanted(3, 0))).collect();
        for row in 1..4 {
            let tau = torques(&mut drives, row);
            assert_eq!(tau.iter().map(|tau| member_of(tau, &wanted(3, row))).collect::<Vec<_>>(), first);
        }
        assert!((0..3).all(|member| first.contains(&Some(member))) && !first.contains(&None));
        // Placed anew one after the other, and so handed from member to member.
        (0..40).for_each(|robot| drives.reset(robot, 100 + robot as u64));
        let tau = torques(&mut drives, 0);
        let second: Vec<_> = tau.iter().map(|tau| member_of(tau, &wanted(3, 0))).collect();
        assert!(second != first && !second.contains(&None));
    }

    #[test]
    fn drawn_step_by_step_every_member_remembers_what_the_others_drove() {
        let mut drives = drives(3, MemberSampling::PerStep, false, 40);
        let mut seen = Vec::new();
        for row in 0..4 {
            let tau = torques(&mut drives, row);
            seen.push(tau.iter().map(|tau| member_of(tau, &wanted(3, row))).collect::<Vec<_>>());
        }
        assert!(seen.iter().all(|row| !row.contains(&None)) && seen[2] != seen[3]);
    }

    #[test]
    fn samples_have_the_members_mean_and_deviation() {
        const ROBOTS: usize = 4000;
        let mut drives = drives(1, MemberSampling::PerEpisode, true, ROBOTS);
        drives.limits = [f32::INFINITY; 12];
        let (tau, wanted) = (torques(&mut drives, 0), wanted(1, 0));
        for (joint, wanted) in wanted[0].iter().enumerate() {
            let of = |power: i32| tau.iter().map(|tau| (f64::from(tau[joint]) - wanted.mean).powi(power)).sum::<f64>();
            let (mean, variance) = (of(1) / ROBOTS as f64, of(2) / ROBOTS as f64);
            // Five standard errors.
            assert!(mean.abs() < 5.0 * (wanted.variance / ROBOTS as f64).sqrt(), "{joint}: {mean}");
            let error = 5.0 * (2.0 / ROBOTS as f64).sqrt();
            assert!((variance / wanted.variance - 1.0).abs() < error, "{joint}: {variance} {}", wanted.variance);
        }
    }

    #[test]
    fn torque_stays_within_the_motors_limit() {
        let mut drives = drives(1, MemberSampling::PerEpisode, true, 400);
        let tau = torques(&mut drives, 0);
        assert!(tau.iter().flatten().all(|tau| tau.abs() <= 9.0));
        assert!(tau.iter().flatten().any(|tau| tau.abs() == 9.0));
    }
}
