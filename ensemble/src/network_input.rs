//! What a network receives and what it predicts.

use serde::{Deserialize, Serialize};

/// The two numbers of each row in the input of a network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkInput {
    /// ξ = [q_cmd − q, dq_cmd − dq] in \[rad] and \[rad/s], as in U2E (eq. 1). The networks learn the gains of the data.
    #[default]
    Errors,
    /// Torque that was asked for, kp (q_cmd − q) + kd (dq_cmd − dq) + tau_ff \[N·m], and joint velocity \[rad/s]. The
    /// networks are valid for all gains and for feed-forward torque.
    Torque,
}

/// The torque that a network predicts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkTarget {
    /// The measured torque.
    #[default]
    Torque,
    /// The torque that a model of the robot lacks: measured minus modelled.
    Residual,
}
