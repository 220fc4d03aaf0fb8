//! burn's Adam optimiser, which loads its saved moments on the CPU.
//!
//! burn loads them on its default device. With the feature `gpu` this is a GPU, even if there is none or the training
//! resumes on the CPU. The next step moves the moments to the device of the network.

use burn::grad_clipping::GradientClippingConfig;
use burn::module::ParamGroup;
use burn::optim::{Adam, AdamConfig, DynOptimizer, DynState, ModuleOptimizer, StateSink, StateSource};
use burn::tensor::Device;
use burn::tensor::kind::BridgeTensor;

/// Returns Adam with burn's defaults and gradients clipped to the norm `gradient_norm` per array.
pub fn adam(gradient_norm: f32) -> ModuleOptimizer {
    let config = AdamConfig::new();
    let clipping = GradientClippingConfig::Norm(gradient_norm).init();
    config.init().with_group(ParamGroup::all(), ReadOnCpu(config.build()), Some(clipping))
}

struct ReadOnCpu(Adam);

impl DynOptimizer for ReadOnCpu {
    fn step_dyn(
        &self,
        rank: usize,
        rate: f64,
        tensor: BridgeTensor,
        gradient: BridgeTensor,
        state: Option<DynState>,
    ) -> (BridgeTensor, Option<DynState>) {
        self.0.step_dyn(rank, rate, tensor, gradient, state)
    }

    fn to_device_dyn(&self, state: DynState, device: &Device) -> DynState {
        self.0.to_device_dyn(state, device)
    }

    fn state_flatten(&self, prefix: &str, state: &DynState, out: &mut StateSink) {
        self.0.state_flatten(prefix, state, out);
    }

    fn state_unflatten(
        &self,
        rank: usize,
        prefix: &str,
        source: &mut StateSource,
        _default: &Device,
    ) -> Option<DynState> {
        self.0.state_unflatten(rank, prefix, source, &Device::flex())
    }
}
