//! Evaluation of one model on one log.

use twinstep_identify::{Evaluation, InverseDynamicsResidual, JointSeries};

/// Evaluation of a model on a log.
pub struct ModelEvaluation {
    /// Errors by joint.
    pub evaluation: Evaluation,
    /// Simulated minus measured position [rad], by joint and row.
    pub position: JointSeries,
    /// Modelled torques of the measured motion.
    pub balance: InverseDynamicsResidual,
}
