//! One row at a time in burn's own operations: what the kernel is measured beside.

use burn::tensor::{Device, Tensor, TensorData};
use twinstep_model::NUM_JOINTS;

use crate::ensemble::Ensemble;
use crate::network::Network;

/// As [`crate::Inference`], by burn: for measurements side by side. Its outputs are normalised.
pub struct BurnInference {
    members: Vec<(Network, [Tensor<2>; 2])>,
    one_hot: Vec<Option<usize>>,
    inputs: usize,
    scales: crate::Normalisers,
}

impl BurnInference {
    /// `num_robots` robots whose past is unseen.
    pub fn new(ensemble: &Ensemble, num_robots: usize) -> Self {
        let (model, device) = (&ensemble.description, Device::flex());
        let shape = model.shape();
        let member = |weights| {
            let nothing = || Tensor::zeros([num_robots * NUM_JOINTS, shape.hidden], &device);
            (Network::new(shape, weights, &device), [nothing(), nothing()])
        };
        Self {
            members: ensemble.members.iter().map(member).collect(),
            one_hot: (0..NUM_JOINTS).map(|joint| model.one_hot_index(joint)).collect(),
            inputs: shape.inputs,
            scales: model.scales,
        }
    }

    /// The next row of every robot, as [`crate::Inference::hear`]; mean and variance of each member, `[robots · 12]`.
    pub fn hear(&mut self, errors: &[[[f64; 2]; NUM_JOINTS]]) -> Vec<[Vec<f32>; 2]> {
        let rows = errors.len() * NUM_JOINTS;
        let mut inputs = vec![0.0; rows * self.inputs];
        let [position, velocity] = self.scales.errors;
        for (row, [q, dq]) in errors.iter().flatten().enumerate() {
            let input = &mut inputs[row * self.inputs..(row + 1) * self.inputs];
            (input[0], input[1]) = (position.normalise(*q), velocity.normalise(*dq));
            if let Some(one) = self.one_hot[row % NUM_JOINTS] {
                input[2 + one] = 1.0;
            }
        }
        let inputs = Tensor::<2>::from_data(TensorData::new(inputs, [rows, self.inputs]), &Device::flex());
        let answer = |(network, memory): &mut (Network, [Tensor<2>; 2])| {
            *memory = network.lstm_step(inputs.clone(), memory.clone());
            network.heads(memory[1].clone()).map(|tensor| tensor.into_data().try_into_vec().expect("outputs are f32"))
        };
        self.members.iter_mut().map(answer).collect()
    }
}
