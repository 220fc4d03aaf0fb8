//! Memory for the equations and constraints of one step.

use twinstep_dynamics::StepEquations;
use twinstep_simd::SimdFloat;

use super::contact::Constraints;

/// Memory for the equations of one step. It is large, so batches and steps share it.
pub struct Workspace<T: SimdFloat, E: StepEquations<T>> {
    /// Factored equations of motion.
    pub equations: E,
    /// Constraints of the step.
    pub constraints: Constraints<T, E::Branch>,
}

/// What the workspaces of a batch have in common.
pub struct WorkspaceShape<T: SimdFloat, E: StepEquations<T>> {
    /// Parameters of a batch, for their sizes.
    pub parameters: E::Parameters,
    /// Body of each contact.
    pub bodies: Vec<usize>,
    /// Number of joints.
    pub num_joints: usize,
}

impl<T: SimdFloat, E: StepEquations<T>> WorkspaceShape<T, E> {
    /// Creates a workspace without equations.
    pub fn workspace(&self) -> Workspace<T, E> {
        let equations = E::empty(&self.parameters);
        let constraints = Constraints::empty(&equations, &self.bodies, self.num_joints);
        Workspace { equations, constraints }
    }
}
