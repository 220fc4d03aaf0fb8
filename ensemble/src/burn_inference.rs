//! Row-by-row inference in burn's operations, the baseline of the kernel.

use burn::tensor::{Device, Tensor, TensorData};
use twinstep_model::NUM_JOINTS;

use crate::ensemble::Ensemble;
use crate::network::Network;

/// Row-by-row inference in burn's operations, the baseline of [`crate::Inference`]. Its outputs are normalised.
pub struct BurnInference {
    members: Vec<(Network, [Tensor<2>; 2])>,
    one_hot: Vec<Option<usize>>,
    inputs: usize,
    scales: crate::Normalisers,
}

impl BurnInference {
    /// Creates the inference for `num_robots` robots, with network states of zero.
    pub fn new(ensemble: &Ensemble, num_robots: usize) -> Self {
        let (model, device) = (&ensemble.description, Device::flex());
        let shape = model.shape();
        let member = |weights| {
            let zeros = || Tensor::zeros([num_robots * NUM_JOINTS, shape.hidden], &device);
            (Network::new(shape, weights, &device), [zeros(), zeros()])
        };
        Self {
            members: ensemble.members.iter().map(member).collect(),
            one_hot: (0..NUM_JOINTS).map(|joint| model.one_hot_index(joint)).collect(),
            inputs: shape.inputs,
            scales: model.scales,
        }
    }

    /// Advances every robot by one row, as [`crate::Inference::step`].
    ///
    /// Returns the mean and the variance of each member, `[robots · 12]`.
    pub fn hear(&mut self, errors: &[[[f64; 2]; NUM_JOINTS]]) -> Vec<[Vec<f32>; 2]> {
        let rows = errors.len() * NUM_JOINTS;
        let mut inputs = vec![0.0; rows * self.inputs];
        let [position, velocity] = self.scales.inputs;
        for (row, [q, dq]) in errors.iter().flatten().enumerate() {
            let input = &mut inputs[row * self.inputs..(row + 1) * self.inputs];
            (input[0], input[1]) = (position.normalise(*q), velocity.normalise(*dq));
            if let Some(one) = self.one_hot[row % NUM_JOINTS] {
                input[2 + one] = 1.0;
            }
        }
        let inputs = Tensor::<2>::from_data(TensorData::new(inputs, [rows, self.inputs]), &Device::flex());
        let step = |(network, state): &mut (Network, [Tensor<2>; 2])| {
            *state = network.lstm_step(inputs.clone(), state.clone());
            network.heads(state[1].clone()).map(|tensor| tensor.into_data().try_into_vec().expect("outputs are f32"))
        };
        self.members.iter_mut().map(step).collect()
    }
}
