//! Settings of an identification.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::ParameterRequest;

/// Options of an identification.
#[derive(Clone, Debug)]
pub struct IdentifyOptions {
    /// What is estimated, in addition to unknown gains.
    pub requests: Vec<ParameterRequest>,
    /// Rate of the actuators [Hz].
    pub actuator_hz: f64,
    /// Interrupts the identification when it is true.
    pub stop: Arc<AtomicBool>,
}
