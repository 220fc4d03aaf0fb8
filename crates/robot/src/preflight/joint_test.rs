//! Test of one joint: a small motion about its position, and what its motor and encoder made of it.

use std::f32::consts::TAU;

use twinstep_model::{Command, Joint, PerJoint};

use super::finding::{Blocks, Finding};
use super::least_squares::{Estimate, centred, least_squares};
use super::sample::{Sample, is_disturbed, without_gaps};

/// Amplitude of the motion [rad].
pub(super) const AMPLITUDE: f32 = 0.1;
/// Position and velocity gains of the two parts of a test [N·m/rad], [N·m·s/rad].
const GAINS: [[f32; 2]; 2] = [[25.0, 1.0], [45.0, 2.0]];
/// Time in which the joint goes to the middle of its motion [s].
const APPROACH_S: f64 = 0.15;
/// Time of each part [s], one period of its slow and four of its fast component.
const PART_S: f64 = 0.4;
/// Frequencies of the motion [Hz], with their shares of the amplitude. Two, so that position, velocity and command
/// are independent of each other.
const COMPONENTS: [(f32, f32); 2] = [(2.5, 0.6), (10.0, 0.4)];
/// Duration of a test [s].
pub(super) const DURATION_S: f64 = APPROACH_S + 2.0 * PART_S;
/// A joint whose position varies less was blocked, or its encoder is dead [rad].
const MIN_MOTION: f32 = 0.003;
/// Motion from which the velocity is compared with it [rad].
const MIN_VELOCITY_MOTION: f32 = 0.006;
/// Smallest part of the motion that follows neither from the command nor from the velocity [rad]. Below it the noise of
/// the encoder makes its scale look wrong.
const MIN_INDEPENDENT_MOTION: f64 = 0.005;
/// Longest delay of the states that is tried, in states.
const MAX_DELAY: usize = 6;
/// Largest relative standard error of a law that is judged.
const MAX_ERROR: f64 = 0.06;
/// Variation of a position that no live encoder has, because of its noise [rad].
const DEAD: f32 = 1e-5;

/// The motor's law τ = a q_command + b q + c dq.
#[derive(Clone, Copy, Debug)]
struct Law {
    a: f64,
    b: f64,
    c: f64,
}

/// Gains of the joints that are not tested [N·m/rad], [N·m·s/rad].
const HOLD_GAINS: [f32; 2] = [20.0, 2.0];

/// Returns the command that holds a pose [rad].
pub(super) fn hold(pose: &PerJoint) -> Command {
    Command::hold(*pose, HOLD_GAINS[0], HOLD_GAINS[1])
}

/// Returns the command of the tested joint `elapsed` seconds after the start, the other joints held at `pose`.
pub(super) fn command(pose: &PerJoint, joint: Joint, middle: f32, elapsed: f64) -> Command {
    let mut command = hold(pose);
    let start = pose[joint.index()];
    let index = joint.index();
    let part = part(elapsed);
    let [kp, kd] = GAINS[part.unwrap_or(0)];
    (command.kp[index], command.kd[index]) = (kp, kd);
    command.q[index] = match part {
        None => start + (elapsed / APPROACH_S).min(1.0) as f32 * (middle - start),
        Some(part) => middle + AMPLITUDE * motion((elapsed - APPROACH_S - part as f64 * PART_S) as f32),
    };
    command
}

fn motion(time: f32) -> f32 {
    COMPONENTS.iter().map(|(frequency, share)| share * (TAU * frequency * time).sin()).sum()
}

/// Returns the part of the test at this time; `None` during the approach.
fn part(elapsed: f64) -> Option<usize> {
    (elapsed >= APPROACH_S).then_some(usize::from(elapsed >= APPROACH_S + PART_S))
}

/// Samples of a test, those of each part apart.
#[derive(Clone, Debug)]
pub(super) struct JointTest {
    pub joint: Joint,
    gains: Vec<[f32; 2]>,
    parts: Vec<Vec<Sample>>,
}

/// What a test showed.
pub(super) struct TestResult {
    pub findings: Vec<Finding>,
    /// False if the joint moved too little to compare its encoder and velocity with the motion.
    pub moved: bool,
}

impl JointTest {
    pub fn new(joint: Joint) -> Self {
        Self { joint, gains: GAINS.to_vec(), parts: vec![Vec::new(); GAINS.len()] }
    }

    /// Returns the test of a joint in one part, with these gains.
    pub fn of_samples(joint: Joint, gains: [f32; 2], samples: Vec<Sample>) -> Self {
        Self { joint, gains: vec![gains], parts: vec![samples] }
    }

    /// Takes in a state, `elapsed` seconds after the start of the test.
    pub fn add(&mut self, sample: Sample, elapsed: f64) {
        if let Some(part) = part(elapsed) {
            self.parts[part].push(sample);
        }
    }

    /// Returns true if this computer stood still during so much of the test that it has to be repeated.
    pub fn is_disturbed(&self) -> bool {
        self.parts.iter().any(|part| is_disturbed(part, PART_S))
    }

    /// Returns the index of the last part, with the highest gains.
    fn last(&self) -> usize {
        self.parts.len() - 1
    }

    /// Returns the commanded position gain of a part.
    fn kp(&self, part: usize) -> f64 {
        f64::from(self.gains[part][0])
    }

    /// Returns what is wrong with the joint.
    pub fn findings(&self) -> TestResult {
        let index = self.joint.index();
        let response = |part| self.response(part, self.joint);
        let gains: Vec<_> = (0..self.parts.len()).map(|part| response(part) / self.kp(part)).collect();
        let certain = |finding| TestResult { findings: vec![finding], moved: true };
        let own = gains[self.last()];
        if own.abs() < 0.3 {
            return certain(self.no_answer());
        }
        let spread = self.spread(|sample| sample.q[index]);
        if spread < DEAD {
            return certain(self.encoder_dead(spread));
        }
        if let Some(finding) = self.gain_finding(&gains) {
            return certain(finding);
        }
        let Some(law) = self.certain_law() else {
            return TestResult { findings: self.offset_finding().into_iter().collect(), moved: false };
        };
        let moved = spread >= MIN_VELOCITY_MOTION;
        let velocity = if moved { self.velocity_finding() } else { None };
        TestResult { findings: self.encoder_finding(law).into_iter().chain(velocity).collect(), moved }
    }

    /// Returns the response of a joint's torque to the command of the tested joint [N·m/rad].
    fn response(&self, part: usize, joint: Joint) -> f64 {
        let index = joint.index();
        let alone = || self.fit(part, joint, |q_command, _, _| [q_command]).map_or(0.0, |estimate| estimate.values[0]);
        if self.spread(|sample| sample.q[index]) < MIN_MOTION {
            return alone();
        }
        self.law(part, joint).map_or_else(alone, |estimate| estimate.values[0])
    }

    fn law(&self, part: usize, joint: Joint) -> Option<Estimate<3>> {
        self.fit(part, joint, |q_command, q, dq| [q_command, q, dq])
    }

    /// Fits the torque of a joint at the delay of the states that explains it best.
    fn fit<const N: usize>(
        &self,
        part: usize,
        joint: Joint,
        regressors: impl Fn(f64, f64, f64) -> [f64; N],
    ) -> Option<Estimate<N>> {
        let at = |delay| least_squares(&centred(self.rows(part, joint, delay, &regressors)));
        (0..=MAX_DELAY).filter_map(at).min_by(|first, second| first.variance.total_cmp(&second.variance))
    }

    /// Returns the law in the last part; `None` if it is not determined well.
    fn certain_law(&self) -> Option<Law> {
        let Estimate { values: [a, b, c], errors, variance } = self.law(self.last(), self.joint)?;
        let independent = (variance / self.parts[self.last()].len() as f64).sqrt() / errors[1];
        let is_exact = errors[0].max(errors[1]) < MAX_ERROR * b.abs().max(self.kp(self.last()));
        // The motion of an encoder with a small scale looks small.
        let scale = (a / b).abs().min(1.0);
        let is_certain = is_exact && independent >= MIN_INDEPENDENT_MOTION * scale;
        is_certain.then_some(Law { a, b, c })
    }

    /// Returns regressors and torque of each state, with the command of `delay` states before. A state's torque follows
    /// from the position in the state before it.
    fn rows<const N: usize>(
        &self,
        part: usize,
        joint: Joint,
        delay: usize,
        regressors: impl Fn(f64, f64, f64) -> [f64; N],
    ) -> Vec<([f64; N], f64)> {
        let (tested, index) = (self.joint.index(), joint.index());
        let row = |samples: &[Sample], at: usize| {
            let (command, before, now) = (&samples[at - delay], &samples[at - 1], &samples[at]);
            let values = [command.q_command[tested], before.q[index], before.dq[index]].map(f64::from);
            (regressors(values[0], values[1], values[2]), f64::from(now.tau[index]))
        };
        let rows = |samples: &[Sample]| (delay.max(1)..samples.len()).map(|at| row(samples, at)).collect::<Vec<_>>();
        without_gaps(&self.parts[part]).into_iter().flat_map(rows).collect()
    }

    /// Returns the standard deviation of a quantity in the last part.
    fn spread(&self, value: impl Fn(&Sample) -> f32) -> f32 {
        let samples = &self.parts[self.last()];
        let count = samples.len().max(1) as f32;
        let mean = samples.iter().map(&value).sum::<f32>() / count;
        (samples.iter().map(|sample| (value(sample) - mean).powi(2)).sum::<f32>() / count).sqrt()
    }

    fn no_answer(&self) -> Finding {
        let joint = self.joint;
        let answer = |other| self.response(self.last(), other).abs();
        let others = Joint::ALL.into_iter().filter(|other| *other != joint);
        let strongest = others.max_by(|a, b| answer(*a).total_cmp(&answer(*b))).unwrap_or(joint);
        let (expected, found) = (self.kp(self.last()), answer(strongest));
        if found > 0.5 * expected {
            let evidence = format!(
                "a motion of {joint} changed the torque of {strongest} by {found:.0} N·m/rad and its own by {:.0}; {expected} \
                 were commanded to {joint}",
                answer(joint)
            );
            let what = format!("the command of {joint} reaches {strongest}");
            let remedy = "the robot's motors are FR, FL, RR, RL; order commands and states with one table";
            return Finding::new("joint_order", what, evidence, remedy).blocking(Blocks::Stance);
        }
        let evidence = format!(
            "its torque changed by {:.1} N·m/rad of commanded motion instead of {expected}; it moved by {:.4} rad",
            answer(joint),
            self.spread(|sample| sample.q[joint.index()])
        );
        let what = format!("the motor of {joint} does not execute its commands");
        let remedy = "check the motor's power, cable and error code; restart the robot";
        Finding::new("motor_unresponsive", what, evidence, remedy).blocking(Blocks::Stance)
    }

    fn encoder_dead(&self, spread: f32) -> Finding {
        let tau = self.spread(|sample| sample.tau[self.joint.index()]);
        let evidence = format!("its position varied by {spread:.1e} rad while its torque varied by {tau:.1} N·m");
        let what = format!("the encoder of {} does not change", self.joint);
        let remedy = "check the encoder's cable; replace the motor";
        Finding::new("encoder_dead", what, evidence, remedy).blocking(Blocks::Stance)
    }

    /// A motor with the wrong sign of its torque, old gains or another stiffness. `gains` are those of each part, divided
    /// by the commanded ones.
    fn gain_finding(&self, gains: &[f64]) -> Option<Finding> {
        let joint = self.joint;
        let kp = (0..gains.len()).map(|part| self.kp(part));
        let found = kp.clone().zip(gains).map(|(kp, gain)| format!("{:.0}", kp * gain)).collect::<Vec<_>>();
        let commanded = kp.map(|kp| format!("{kp:.0}")).collect::<Vec<_>>();
        let evidence = format!(
            "its torque rises by {} N·m per radian of its command; kp = {} was commanded",
            found.join(" and "),
            commanded.join(" and ")
        );
        let finding = |id, what, remedy| Some(Finding::new(id, what, evidence, remedy).blocking(Blocks::Stance));
        let (first, last) = (gains[0], gains[gains.len() - 1]);
        if first < 0.0 && last < 0.0 {
            let what = format!("the estimated torque of {joint} has the wrong sign");
            finding("torque_sign", what, "change the sign of `tau_est` where it is read")
        } else if gains.len() > 1 && last / first < MAX_STALE_RATIO {
            let what = format!("the motor of {joint} does not take new gains");
            finding("gains_stale", what, "send kp and kd in every message, and restart the motor")
        } else if !(0.75..1.3).contains(&last) {
            let what = format!("the motor of {joint} has {:.0} % of the commanded stiffness", 100.0 * last);
            finding("motor_gain", what, "check scale and unit of the gains, and the motor's torque constant")
        } else {
            None
        }
    }

    /// An encoder with the wrong sign, scale or zero.
    fn encoder_finding(&self, Law { a, b, c }: Law) -> Option<Finding> {
        let joint = self.joint;
        let evidence = format!(
            "the motor's torque is {a:.1} q_command {b:+.1} q {c:+.2} dq; kp = {} was commanded",
            self.kp(self.last())
        );
        let finding = |id, what, remedy| Some(Finding::new(id, what, evidence, remedy).blocking(Blocks::Stance));
        let scale = -a / b;
        if scale < 0.0 {
            let what = format!("the encoder of {joint} has the wrong sign");
            finding("encoder_sign", what, "change the sign of q and dq where they are read")
        } else if !(0.8..1.25).contains(&scale) {
            let what = format!("the encoder of {joint} shows {scale:.2} times its motion");
            finding("encoder_scale", what, "check the gear ratio and the unit of its position")
        } else {
            self.offset_finding()
        }
    }

    /// A position that is reported with an offset which the motor does not use.
    fn offset_finding(&self) -> Option<Finding> {
        let [kp, kd] = self.gains[self.last()].map(f64::from);
        let rows = self.rows(self.last(), self.joint, 0, |q_command, q, dq| [q_command - q, dq]);
        let error = rows.iter().map(|([error, dq], tau)| tau - kp * error + kd * dq).sum::<f64>();
        let offset = error / (kp * rows.len() as f64);
        (offset.abs() > MAX_OFFSET).then(|| {
            let evidence =
                format!("its mean torque is that of a position {offset:.3} rad below the one that it reports");
            let what = format!("the encoder of {} is wrong by {offset:+.2} rad", self.joint);
            let remedy = "remove the offset where the position is read, or calibrate the joint's zero";
            Finding::new("encoder_offset", what, evidence, remedy).blocking(Blocks::Stance)
        })
    }

    /// Compares the reported velocity with the change of the reported position.
    fn velocity_finding(&self) -> Option<Finding> {
        let index = self.joint.index();
        let rows: Vec<_> = self
            .parts
            .iter()
            .flat_map(|part| without_gaps(part))
            .flat_map(|part| {
                part.windows(VELOCITY_WINDOW + 1).map(|window| {
                    let change = window[VELOCITY_WINDOW].q[index] - window[0].q[index];
                    let steps = window.windows(2);
                    let integral = steps.map(|pair| {
                        0.5 * f64::from(pair[0].dq[index] + pair[1].dq[index]) * (pair[1].time - pair[0].time)
                    });
                    ([f64::from(change)], integral.sum::<f64>())
                })
            })
            .collect();
        let [scale] = least_squares(&rows)?.values;
        let evidence = format!("the integral of its velocity is {scale:.2} times the change of its position");
        let finding =
            |id, what, remedy| Some(Finding::new(id, what, evidence.clone(), remedy).blocking(Blocks::Stance));
        if scale < 0.0 {
            let what = format!("the velocity of {} has the wrong sign", self.joint);
            finding("velocity_sign", what, "change the sign of dq where it is read")
        } else if !(0.75..1.3).contains(&scale) {
            let what = format!("the velocity of {} is {scale:.2} times the true one", self.joint);
            finding("velocity_scale", what, "check the unit and the gear ratio of dq")
        } else {
            None
        }
    }
}

/// Number of states over which a velocity is integrated: long beside the noise, short beside the motion.
const VELOCITY_WINDOW: usize = 8;
/// A motor whose gain, divided by the commanded one, falls by this factor while kp rises by 1.8 keeps its gains.
const MAX_STALE_RATIO: f64 = 0.75;
/// Largest offset between reported and used position [rad].
const MAX_OFFSET: f64 = 0.05;

/// Returns findings in which exchanged legs are one finding, not one for each of their joints.
pub(super) fn merge_orders(findings: Vec<Finding>) -> Vec<Finding> {
    let (orders, mut others): (Vec<_>, Vec<_>) = findings.into_iter().partition(|finding| finding.id == "joint_order");
    if let Some((first, rest)) = orders.split_first() {
        let mut merged = first.clone();
        for finding in rest {
            merged.what = format!("{}; {}", merged.what, finding.what);
        }
        others.push(merged);
    }
    others
}

/// Returns the middle of a joint's motion, so that it stays inside the limits of commands [rad].
pub(super) fn middle(q: f32, [low, high]: [f32; 2]) -> f32 {
    q.clamp(low + AMPLITUDE, high - AMPLITUDE)
}
