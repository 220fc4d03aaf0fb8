//! Input of a policy.

/// What a policy may observe in a step.
#[derive(Clone, Copy, Debug)]
pub struct PolicyInput<'a> {
    /// Observation of group `policy`.
    pub obs: &'a [f32],
    /// Observation of group `critic`; empty if the endpoint has none.
    pub critic_obs: &'a [f32],
}
