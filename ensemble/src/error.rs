//! Errors of logs, options and files.

use std::path::PathBuf;

use twinstep_logs::replay::ReplayError;

/// Reasons why an ensemble cannot be trained, loaded or used.
#[derive(Debug, thiserror::Error)]
pub enum EnsembleError {
    /// The log has no measured torque.
    #[error(
        "{log} has no measured torque; columns `tau_measured_<joint>`, and `tau_sensor` in meta.json, are required"
    )]
    NoTorque {
        /// The log.
        log: String,
    },
    /// Two logs have different locations of the torque sensor.
    #[error("{log} has a different `tau_sensor` than the first log; train one ensemble per sensor location")]
    SensorMismatch {
        /// The log.
        log: String,
    },
    /// The logs of two stages have torque of different joints.
    #[error("{log} has measured torque of different joints than the first log; stages must have the same joints")]
    JointsMismatch {
        /// The log.
        log: String,
    },
    /// The time step differs from that of the model.
    #[error("{what} has a time step of {given} s, the model one of {expected} s; a network is valid for one time step")]
    TimeStepMismatch {
        /// Log or simulation with the other time step.
        what: String,
        /// Its time step [s].
        given: f64,
        /// Time step of the model [s].
        expected: f64,
    },
    /// The networks have a shorter time step than the actuators that they stand for.
    #[error(
        "the ensemble computes a torque at {network_hz:.0} Hz, {what} at {hz:.0} Hz; it must not be slower: use a log or a \
         robot at {network_hz:.0} Hz or more, or train an ensemble with `twinstep fit --rate-hz {hz:.0}`"
    )]
    TooFast {
        /// The actuator.
        what: String,
        /// Rate of the networks [Hz].
        network_hz: f64,
        /// Rate of the actuator [Hz].
        hz: f64,
    },
    /// `[actuator] mode` does not match what the networks predict.
    #[error("`actuator.mode`: the ensemble predicts {target}; use mode = \"{allowed}\"")]
    WrongMode {
        /// What the networks predict.
        target: &'static str,
        /// The mode for it.
        allowed: &'static str,
    },
    /// The gains change. A network is valid for one value of the gains, because they are not an input.
    #[error(
        "{log}: the gains of {joint} change (kp {kp}, kd {kd} at row {row}); gains are not an input of this \
         network, so every row of every log must have the same; `twinstep fit --input torque` learns for all gains"
    )]
    GainsChange {
        /// The log.
        log: String,
        /// The joint.
        joint: String,
        /// The row of the log.
        row: usize,
        /// Position gain in that row [N·m/rad].
        kp: f64,
        /// Velocity gain in that row [N·m·s/rad].
        kd: f64,
    },
    /// The gains of the log are unknown.
    #[error("{log}: {cause}")]
    UnknownGain {
        /// The log.
        log: String,
        /// Joint and gain.
        cause: ReplayError,
    },
    /// The log contains feed-forward torque.
    #[error(
        "{log} has `tau_ff_{joint}` at row {row}; it must be 0, because it is not an input of this network; \
             `twinstep fit --input torque` learns with it"
    )]
    FeedForward {
        /// The log.
        log: String,
        /// The joint.
        joint: String,
        /// The row of the log.
        row: usize,
    },
    /// The ensemble is trained with different gains per joint, but a robot has one kp and one kd.
    #[error(
        "the ensemble is trained for {} with kp {} and kd {}, for {} with kp {} and kd {}; a robot has one kp and one \
         kd for all joints: train an ensemble on logs with equal gains",
        joints[0], gains[0][0], gains[0][1], joints[1], gains[1][0], gains[1][1]
    )]
    GainsDiffer {
        /// Two joints of the ensemble.
        joints: [String; 2],
        /// kp [N·m/rad] and kd [N·m·s/rad] of each.
        gains: [[f64; 2]; 2],
    },
    /// An effect belongs to a stage that the ensemble replaces.
    #[error(
        "effect `{effect}` on {scope} is part of this ensemble, which is trained on the torque at `{tap}`: it replaces \
         stages 1 to {last} of the chain, including `{effect}` ({place}); remove the effect or `[actuator]`"
    )]
    StandsFor {
        /// The effect.
        effect: &'static str,
        /// Scope of the effect.
        scope: String,
        /// Location of the torque sensor.
        tap: &'static str,
        /// Last stage that the ensemble replaces.
        last: u32,
        /// Stage of the effect.
        place: &'static str,
    },
    /// The joint is an input of the networks, and there were no training data of this joint.
    #[error("the joint is an input of the ensemble, which is not trained for {joint}; train one on all twelve joints")]
    UnknownJoint {
        /// The joint.
        joint: &'static str,
    },
    /// Too few rows for a split into training, validation and test data.
    #[error(
        "{rows} complete rows in {blocks} blocks are too few for training, validation and test data; use longer logs"
    )]
    TooShort {
        /// Number of rows with all channels, for any joint.
        rows: usize,
        /// Number of blocks.
        blocks: usize,
    },
    /// The smoothing frequency is out of range.
    #[error("smoothing at {given} Hz: the frequency must be above 0 and below half the rate of the log, {most} Hz")]
    Smoothing {
        /// The frequency [Hz].
        given: f64,
        /// Half the rate of the log [Hz].
        most: f64,
    },
    /// The joint has no type (hip, thigh or calf of the Go2).
    #[error("joint `{joint}` is not a hip, thigh or calf of a Go2; use the joint input `identity` or `pooled`")]
    NoKind {
        /// The joint.
        joint: String,
    },
    /// An option is out of range.
    #[error("`{option}` = {given} is not allowed: 1 to {most}")]
    Option {
        /// Name of the option.
        option: &'static str,
        /// Its value.
        given: usize,
        /// Maximum value.
        most: usize,
    },
    /// The loss became NaN or infinite.
    #[error("the loss of member {member} is not finite in epoch {epoch} (learning rate {rate}); try another seed")]
    Diverged {
        /// The member.
        member: usize,
        /// The epoch, counted from 1.
        epoch: usize,
        /// Learning rate of the epoch.
        rate: f64,
    },
    /// There is no GPU, or the program was built without GPU support.
    #[error("cannot train on a GPU: {cause}")]
    NoGpu {
        /// What is missing.
        cause: String,
    },
    /// The checkpoint belongs to a training with different data or settings.
    #[error("the checkpoint has different {what}; resume with the same command, or start without the checkpoint")]
    OtherTraining {
        /// What differs.
        what: &'static str,
    },
    /// The earlier ensemble of a warm start has other networks or joints.
    #[error(
        "the earlier ensemble has another {what} ({earlier}) than the training ({given}); a warm start needs the same"
    )]
    OtherEnsemble {
        /// What differs.
        what: &'static str,
        /// Value of the earlier ensemble.
        earlier: String,
        /// Value of the training.
        given: String,
    },
    /// The file cannot be read or written.
    #[error("cannot {verb} `{path}`: {cause}")]
    File {
        /// `read` or `write`.
        verb: &'static str,
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        cause: std::io::Error,
    },
    /// The content of the file is invalid.
    #[error("`{path}` {problem}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong; continues a sentence that begins with the path.
        problem: String,
    },
}
