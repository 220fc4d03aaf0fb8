//! Policies: networks, observation normaliser, action distribution, and the policy file.
//!
//! - [`Mlp`]: parameters of a multilayer perceptron; [`Network`]: its forward and backward pass for a batch of rows, on
//!   SIMD registers ([`mod@matrix`]).
//! - [`Normaliser`]: mean and standard deviation of observations; [`gaussian`]: noise of actions.
//! - [`Policy`]: normaliser, actor and the spec of the environment; [`PolicyRunner`] evaluates it. [`Policy::read`] and
//!   [`Policy::write`]: the policy file; [`Policy::write_onnx`]: the same for other runtimes.
//! - [`BehaviourPolicy`]: a policy that explores; [`Collector`]: robots that can be run with it, in process or remote.
//! - [`ResidualEnv`]: environments whose action is added to that of a frozen base policy; [`with_residual`]: base policy
//!   and residual as one policy.
//! - [`array_file`]: named arrays in a safetensors file.
//!
//! Equal weights and observations give equal bits on every instruction set and in every batch.

#![allow(clippy::inline_always, reason = "a function that is not inlined is compiled for the baseline instruction set")]
#![allow(clippy::needless_range_loop, reason = "closures may not be inlined")]

pub mod array_file;
mod behaviour;
mod collector;
pub mod gaussian;
mod matrix;
mod mlp;
mod network;
mod normaliser;
mod onnx;
mod policy;
mod policy_file;
mod residual;

pub use behaviour::{ActionSampler, BehaviourPolicy, noise_seed};
pub use collector::{Collector, StepCollector};
pub use mlp::{LayerLayout, Mlp};
pub use network::{Activations, Network};
pub use normaliser::Normaliser;
pub use policy::{Policy, PolicyRunner};
pub use policy_file::{CurvePoint, PolicyHeader, PolicyOrigin, mlp_arrays, take_mlp};
pub use residual::{OtherBase, ResidualEnv, with_residual};
