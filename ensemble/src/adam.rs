//! burn's Adam, whose saved moments are read on the CPU.
//!
//! burn reads them on its default device. With the feature `gpu` that is a GPU, there or not, even where the training is to go
//! on on the CPU. The next step moves them to where the network is.

use burn::grad_clipping::GradientClippingConfig;
use burn::module::ParamGroup;
use burn::optim::{Adam, AdamConfig, DynOptimizer, DynState, ModuleOptimizer, StateSink, StateSource};
use burn::tensor::Device;
use burn::tensor::kind::BridgeTensor;

/// Adam with burn's defaults, for gradients cut to a norm of `gradient_norm` for each array.
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
