//! What can be wrong with a log that is to be learnt from, or with a file of an ensemble.

use std::path::PathBuf;

/// Why there is no ensemble.
#[derive(Debug, thiserror::Error)]
pub enum EnsembleError {
    /// No torque was measured.
    #[error(
        "{log} has no measured torque: columns `tau_measured_<joint>`, and `tau_sensor` in meta.json that says where"
    )]
    NoTorque {
        /// The log.
        log: String,
    },
    /// Two logs measured torque at different places.
    #[error("{log} measured torque at another place (`tau_sensor`) than the first log; fit them apart")]
    SensorMismatch {
        /// The log.
        log: String,
    },
    /// Stages that are compared have the same joints.
    #[error("{log} has measured torque of other joints than the first log; compare stages of the same joints")]
    JointsMismatch {
        /// The log.
        log: String,
    },
    /// The time step is part of a model.
    #[error("{what} has a step of {given} s, the model one of {wanted} s; a network knows its own step only")]
    TimeStepMismatch {
        /// The log, or whatever asked.
        what: String,
        /// Its step [s].
        given: f64,
        /// The model's step [s].
        wanted: f64,
    },
    /// A network sees position and velocity errors, and so must know the gains by heart.
    #[error(
        "{log}: the gains of {joint} change (kp {kp}, kd {kd} at row {row}); a network sees only errors, so every row of \
         every log must have the gains that the first has"
    )]
    GainsChange {
        /// The log.
        log: String,
        /// The joint.
        joint: String,
        /// The row of the log.
        row: usize,
        /// Its position gain [N·m/rad].
        kp: f64,
        /// Its velocity gain [N·m·s/rad].
        kd: f64,
    },
    /// Torque was commanded beside the gains.
    #[error("{log} commands `tau_ff_{joint}` at row {row}; a network sees only position and velocity errors")]
    FeedForward {
        /// The log.
        log: String,
        /// The joint.
        joint: String,
        /// The row of the log.
        row: usize,
    },
    /// A robot has one kp and one kd, and networks know several by heart.
    #[error(
        "the ensemble learnt {} with kp {} and kd {}, {} with kp {} and kd {}; a robot is commanded with one kp and one kd \
         for all joints: fit one to logs with equal gains",
        joints[0], gains[0][0], gains[0][1], joints[1], gains[1][0], gains[1][1]
    )]
    GainsDiffer {
        /// Two joints that the ensemble knows.
        joints: [String; 2],
        /// kp [N·m/rad] and kd [N·m·s/rad] of each.
        gains: [[f64; 2]; 2],
    },
    /// What the networks have learnt already.
    #[error(
        "effect `{effect}` on {scope} does not go beside this ensemble: it learnt the torque at `{tap}` and stands for \
         steps 1 to {last} of the chain, `{effect}` ({place}) among them; leave out the effect, or `[actuator]`"
    )]
    StandsFor {
        /// The effect.
        effect: &'static str,
        /// Its scope.
        scope: String,
        /// Where the torque was measured.
        tap: &'static str,
        /// The last step that the ensemble stands for.
        last: u32,
        /// The effect's place in the chain.
        place: &'static str,
    },
    /// A network is told which joint it is, and has never seen this one.
    #[error("the ensemble is told which joint it drives and has learnt none called {joint}; fit one to all twelve")]
    UnknownJoint {
        /// The joint.
        joint: &'static str,
    },
    /// Too few rows to leave blocks out.
    #[error(
        "{rows} complete rows in {blocks} blocks are too few to learn from some, stop by others and judge by the rest"
    )]
    TooShort {
        /// Rows with all that is needed, for any joint.
        rows: usize,
        /// Blocks they are cut into.
        blocks: usize,
    },
    /// A log has no waves as fast as that.
    #[error("smoothing at {given} Hz: the frequency must be above 0 and below half the log's rate, {most} Hz")]
    Smoothing {
        /// What was given [Hz].
        given: f64,
        /// Half the log's rate [Hz].
        most: f64,
    },
    /// Hip, thigh and calf are the Go2's.
    #[error("joint `{joint}` is no hip, thigh or calf of a Go2; give each joint its own input, or pool them")]
    NoKind {
        /// The joint.
        joint: String,
    },
    /// A setting is out of range.
    #[error("`{option}` = {given} is outside 1..={most}")]
    Option {
        /// Its name.
        option: &'static str,
        /// What was given.
        given: usize,
        /// The most there may be.
        most: usize,
    },
    /// Training gave numbers that are none.
    #[error("the loss of member {member} is no number in epoch {epoch}; smaller steps may help (learning rate {rate})")]
    Diverged {
        /// The member.
        member: usize,
        /// The epoch, from one.
        epoch: usize,
        /// The learning rate then.
        rate: f64,
    },
    /// No GPU, or none in this build.
    #[error("cannot train on a GPU: {cause}")]
    NoGpu {
        /// What is missing.
        cause: String,
    },
    /// A saved training of other data or settings.
    #[error("the saved training is of other {what}; go on with the same command, or start anew without it")]
    OtherTraining {
        /// What differs.
        what: &'static str,
    },
    /// The system refused to read or write.
    #[error("cannot {verb} `{path}`: {cause}")]
    File {
        /// `read` or `write`.
        verb: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's answer.
        cause: std::io::Error,
    },
    /// The file is not what it should be.
    #[error("`{path}` {problem}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, as the end of a sentence.
        problem: String,
    },
}
