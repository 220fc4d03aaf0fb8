//! One member: an LSTM encoder with one head for the mean and one for the variance of the torque.

use burn::module::{Module, Param, ParamId};
use burn::optim::GradientsParams;
use burn::tensor::activation::{relu, sigmoid, tanh};
use burn::tensor::{Device, Tensor, TensorData};

use crate::encoder::Encoder;
use crate::sequences::Batch;
use crate::weights::{Shape, Weights};

/// Minimum normalised variance (U2E §IV-B).
pub const VARIANCE_FLOOR: f64 = 1e-6;

/// A network of U2E §IV-B. Its arrays are in the order of [`Shape::layout`].
#[derive(Module, Debug)]
pub struct Network {
    input_weight: Param<Tensor<2>>,
    hidden_weight: Param<Tensor<2>>,
    gate_bias: Param<Tensor<1>>,
    mean: Head,
    variance: Head,
}

/// One hidden layer and one output.
#[derive(Module, Debug)]
struct Head {
    hidden_weight: Param<Tensor<2>>,
    hidden_bias: Param<Tensor<1>>,
    weight: Param<Tensor<2>>,
    bias: Param<Tensor<1>>,
}

impl Network {
    /// Creates a network of the given `shape` with `weights`.
    pub fn new(shape: Shape, weights: &Weights, device: &Device) -> Self {
        let mut arrays = shape.layout().into_iter().enumerate().map(|(index, (name, dimensions))| {
            // Fixed ids, so that the state of a saved optimiser is assigned to the same parameters.
            (ParamId::from(index as u64 + 1), TensorData::new(weights[name].clone(), dimensions))
        });
        let mut next = || arrays.next().expect("the layout lists every array");
        Self {
            input_weight: parameter(next(), device),
            hidden_weight: parameter(next(), device),
            gate_bias: parameter(next(), device),
            mean: Head::new(&mut next, device),
            variance: Head::new(&mut next, device),
        }
    }

    /// Returns the weights.
    pub fn weights(&self, shape: Shape) -> Weights {
        let [mean, variance] = [&self.mean, &self.variance].map(Head::values);
        let encoder = [values(&self.input_weight), values(&self.hidden_weight), values(&self.gate_bias)];
        let arrays = encoder.into_iter().chain(mean).chain(variance);
        shape.layout().into_iter().map(|(name, _)| name).zip(arrays).collect()
    }

    /// Returns the normalised mean and variance of the torque of every row, each `[time · batch]`, from states of zero.
    pub fn outputs(&self, batch: &Batch) -> [Vec<f32>; 2] {
        self.heads(self.states(batch)).map(|tensor| tensor.into_data().try_into_vec().expect("the outputs are f32"))
    }

    /// Returns the Gaussian negative log-likelihood of normalised torque, mean over the rows of the mask [nat].
    ///
    /// U2E, eq. 5, with the constant ½ log 2π that U2E omits.
    pub fn nll(&self, batch: &Batch) -> f32 {
        nll(self.heads(self.states(batch)), batch).into_scalar()
    }

    /// Returns the loss [`Network::nll`] and its gradients. The network must be on an autodiff device.
    pub fn loss_and_gradients(&self, batch: &Batch) -> (f32, GradientsParams) {
        if self.on_cpu() { self.manual_backward(batch) } else { self.autodiff_backward(batch) }
    }

    /// Differentiates the heads with burn, and the encoder with its hand-written backward pass.
    fn manual_backward(&self, batch: &Batch) -> (f32, GradientsParams) {
        let encoder = self.encoder();
        let tape = encoder.forward(batch);
        let states = Tensor::<2>::from_data(tape.states(), &self.hidden_weight.val().device()).require_grad();
        let loss = nll(self.heads(states.clone()), batch);
        let mut gradients = loss.backward();
        let by_states = states.grad_remove(&mut gradients).expect("the loss depends on every state");
        let by_states: Vec<f32> = by_states.into_data().try_into_vec().expect("gradients are f32");
        let found = encoder.backward(batch, &tape, &by_states);
        let mut gradients = GradientsParams::from_grads(gradients, self);
        gradients.register(self.input_weight.id, found.input_weight);
        gradients.register(self.hidden_weight.id, found.hidden_weight);
        let bias = TensorData::new(found.bias.clone(), [found.bias.len()]);
        gradients.register(self.gate_bias.id, Tensor::<1>::from_data(bias, &Device::flex()));
        (loss.into_scalar(), gradients)
    }

    fn autodiff_backward(&self, batch: &Batch) -> (f32, GradientsParams) {
        let loss = nll(self.heads(self.states_by_burn(batch)), batch);
        let gradients = GradientsParams::from_grads(loss.backward(), self);
        (loss.into_scalar(), gradients)
    }

    /// Returns true if the hand-written encoder can be used.
    fn on_cpu(&self) -> bool {
        self.hidden_weight.val().device() == Device::flex()
    }

    fn encoder(&self) -> Encoder {
        Encoder {
            input_weight: self.input_weight.val().inner(),
            hidden_weight: self.hidden_weight.val().inner(),
            bias: values(&self.gate_bias),
        }
    }

    /// Returns the encoder's states, `[time · batch, hidden]`.
    fn states(&self, batch: &Batch) -> Tensor<2> {
        if self.on_cpu() {
            Tensor::from_data(self.encoder().forward(batch).states(), &self.hidden_weight.val().device())
        } else {
            self.states_by_burn(batch)
        }
    }

    /// Returns the encoder's states like [`Network::states`], on any device and with automatic differentiation.
    fn states_by_burn(&self, batch: &Batch) -> Tensor<2> {
        let (device, [units, _]) = (self.hidden_weight.val().device(), self.hidden_weight.val().dims());
        let inputs = Tensor::<2>::from_data(batch.inputs(), &device);
        let zeros = Tensor::<2>::zeros([batch.size, units], &device);
        let (mut state, mut states) = ([zeros.clone(), zeros], Vec::new());
        for time in 0..batch.steps {
            state = self.lstm_step(inputs.clone().narrow(0, time * batch.size, batch.size), state);
            states.push(state[1].clone());
        }
        Tensor::cat(states, 0)
    }

    /// Advances the LSTM by one row in burn's operations and returns cells and states.
    ///
    /// Inputs are `[batch, inputs]`, cells and states `[batch, hidden]`.
    pub fn lstm_step(&self, inputs: Tensor<2>, [cell, state]: [Tensor<2>; 2]) -> [Tensor<2>; 2] {
        let [_, units] = cell.dims();
        let gates = inputs.matmul(self.input_weight.val())
            + state.matmul(self.hidden_weight.val())
            + self.gate_bias.val().unsqueeze();
        let gate = |index: usize| gates.clone().narrow(1, index * units, units);
        let cell = sigmoid(gate(1)) * cell + sigmoid(gate(0)) * tanh(gate(2));
        let state = sigmoid(gate(3)) * tanh(cell.clone());
        [cell, state]
    }

    /// Returns the normalised mean and variance, each `[time · batch, 1]`.
    pub fn heads(&self, states: Tensor<2>) -> [Tensor<2>; 2] {
        [self.mean.forward(states.clone()), softplus(self.variance.forward(states)) + VARIANCE_FLOOR]
    }
}

fn nll([mean, variance]: [Tensor<2>; 2], batch: &Batch) -> Tensor<1> {
    let device = mean.device();
    let column = |data: &[f32]| Tensor::<2>::from_data(TensorData::new(data.to_vec(), [data.len(), 1]), &device);
    let error = column(&batch.torques) - mean;
    let nll = variance.clone().log() * 0.5 + error.powi_scalar(2) / (variance * 2.0);
    (nll * column(&batch.mask)).sum() / batch.counted() + 0.5 * std::f32::consts::TAU.ln()
}

impl Head {
    fn new(next: &mut impl FnMut() -> (ParamId, TensorData), device: &Device) -> Self {
        Self {
            hidden_weight: parameter(next(), device),
            hidden_bias: parameter(next(), device),
            weight: parameter(next(), device),
            bias: parameter(next(), device),
        }
    }

    /// Maps `[rows, hidden]` to `[rows, 1]`.
    fn forward(&self, rows: Tensor<2>) -> Tensor<2> {
        let hidden = relu(rows.matmul(self.hidden_weight.val()) + self.hidden_bias.val().unsqueeze());
        hidden.matmul(self.weight.val()) + self.bias.val().unsqueeze()
    }

    fn values(&self) -> [Vec<f32>; 4] {
        [values(&self.hidden_weight), values(&self.hidden_bias), values(&self.weight), values(&self.bias)]
    }
}

fn parameter<const D: usize>((id, data): (ParamId, TensorData), device: &Device) -> Param<Tensor<D>> {
    let tensor = Tensor::from_data(data, device);
    Param::initialized(id, if device.is_autodiff() { tensor.require_grad() } else { tensor })
}

fn values<const D: usize>(parameter: &Param<Tensor<D>>) -> Vec<f32> {
    parameter.val().into_data().try_into_vec().expect("the parameters are f32")
}

/// Returns log(1 + exp(x)) without overflow. burn's own implementation takes eight passes over the tensor.
fn softplus(x: Tensor<2>) -> Tensor<2> {
    relu(x.clone()) + (-x.abs()).exp().log1p()
}

#[cfg(test)]
mod tests {
    use twinstep_model::stream;

    use super::*;
    use crate::data::tests::log;
    use crate::data::{DataSet, Split};
    use crate::sequences::SequenceDataset;
    use crate::train::Training;
    use crate::training_options::TrainingOptions;

    const SHAPE: Shape = Shape { inputs: 2, hidden: 8 };

    fn network(device: &Device) -> Network {
        Network::new(SHAPE, &SHAPE.random(&mut stream(1, "weights", 0)), device)
    }

    /// Returns two sequences, one of which has burn-in rows.
    fn batch() -> Batch {
        let data = DataSet::new(&[("here".to_owned(), log(2000, |_, _| {}))]).expect("a set");
        let training =
            Training::new(&data, TrainingOptions { hidden: 8, ..TrainingOptions::default() }).expect("options");
        SequenceDataset::sequences(data.runs(Split::Training), &training.description).batch(&[0, 3])
    }

    /// Compares loss and gradients with those of the hand-written encoder.
    ///
    /// The tolerance is 10⁻⁵ times the largest element of an array, or times 1 if that is larger.
    fn check_against_burn(device: &Device) {
        let (by_hand, by_burn, batch) =
            (network(&Device::flex().autodiff()), network(&device.clone().autodiff()), batch());
        let ((expected_loss, expected), (loss, found)) =
            (by_hand.manual_backward(&batch), by_burn.autodiff_backward(&batch));
        assert!((loss - expected_loss).abs() < 1e-5, "{loss} for {expected_loss}");
        for (index, (name, dimensions)) in SHAPE.layout().into_iter().enumerate() {
            let id = ParamId::from(index as u64 + 1);
            let numbers = |all: &GradientsParams| -> Vec<f32> {
                let data = match dimensions.len() {
                    1 => all.get::<1>(id).map(Tensor::into_data),
                    _ => all.get::<2>(id).map(Tensor::into_data),
                };
                data.and_then(|data| data.try_into_vec().ok()).expect("a gradient")
            };
            let (expected, found) = (numbers(&expected), numbers(&found));
            let largest = expected.iter().fold(1.0_f32, |largest, one| largest.max(one.abs()));
            let worst = expected.iter().zip(&found).map(|(one, other)| (one - other).abs()).fold(0.0, f32::max);
            assert!(found.len() == expected.len() && worst < 1e-5 * largest, "{name}: {worst} of {largest}");
        }
    }

    #[test]
    fn loss_and_gradients_of_the_hand_written_encoder_agree_with_burn() {
        check_against_burn(&Device::flex());
    }

    #[cfg(feature = "gpu")]
    #[test]
    fn loss_and_gradients_on_a_gpu_agree_with_the_hand_written_encoder() {
        if let Some(device) = crate::gpu::tests::device() {
            check_against_burn(&device);
        }
    }

    #[test]
    fn gradients_agree_with_finite_differences() {
        let (device, batch) = (Device::flex().autodiff(), batch());
        let weights = network(&device).weights(SHAPE);
        let (_, gradients) = network(&device).loss_and_gradients(&batch);
        let network = network(&device);
        let by_hidden: Vec<f32> = gradients
            .get::<2>(network.hidden_weight.id)
            .and_then(|gradient| gradient.into_data().try_into_vec().ok())
            .expect("a gradient");
        let loss = |index: usize, change: f32| {
            let mut weights = weights.clone();
            weights.get_mut("lstm.hidden_weight").expect("there")[index] += change;
            Network::new(SHAPE, &weights, &Device::flex()).nll(&batch)
        };
        let step = 1e-2;
        for index in (0..by_hidden.len()).step_by(17) {
            let derivative = (loss(index, step) - loss(index, -step)) / (2.0 * step);
            assert!(
                (derivative - by_hidden[index]).abs() < 1e-4 + 0.02 * derivative.abs(),
                "{index}: {derivative} {}",
                by_hidden[index]
            );
        }
    }

    #[test]
    fn variance_is_at_least_its_floor() {
        let mut weights = SHAPE.random(&mut stream(1, "weights", 0));
        weights.insert("variance.bias", vec![-1e4]);
        let [_, variances] = Network::new(SHAPE, &weights, &Device::flex()).outputs(&batch());
        assert!(variances.iter().all(|variance| *variance == VARIANCE_FLOOR as f32));
    }
}
