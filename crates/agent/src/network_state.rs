//! Which inputs of a network are observations, and which are the state that it keeps from step to step.

use crate::error::AgentError;
use crate::mapping::Mapping;
use crate::onnx::{OnnxNetwork, Port};

/// Index of an input that is an observation, and its name in the mapping; `None` is the one of `[[observation]]`.
pub type Observed = (usize, Option<String>);

/// The state of a recurrent network; 0 after a reset.
#[derive(Clone, Debug, Default)]
pub struct NetworkState(Vec<Kept>);

/// One array of the state.
#[derive(Clone, Debug)]
struct Kept {
    /// Indices of the input and of the output that follows it.
    input: usize,
    output: usize,
    values: Vec<f32>,
}

impl NetworkState {
    /// Returns the inputs that are observations, and the state. Fails if an input is neither.
    pub fn of(network: &OnnxNetwork, mapping: &Mapping) -> Result<(Vec<Observed>, Self), AgentError> {
        let (inputs, outputs) = (network.inputs(), network.outputs());
        let unknown = |name: &str, what: &'static str, ports: &[Port]| AgentError::UnknownPort {
            name: name.to_owned(),
            what,
            available: described(ports),
        };
        let position = |ports: &[Port], name: &str| ports.iter().position(|port| port.name == name);
        let mut observed = Vec::new();
        for name in mapping.input.keys() {
            let index = position(inputs, name).ok_or_else(|| unknown(name, "inputs", inputs))?;
            observed.push((index, Some(name.clone())));
        }
        let mut kept = Vec::new();
        for pair in &mapping.state {
            let input = position(inputs, &pair.input).ok_or_else(|| unknown(&pair.input, "inputs", inputs))?;
            let output = position(outputs, &pair.output).ok_or_else(|| unknown(&pair.output, "outputs", outputs))?;
            kept.push((input, output));
        }
        let is_free = |index: &usize| {
            !observed.iter().any(|(taken, _)| taken == index) && !kept.iter().any(|(taken, _)| taken == index)
        };
        let free: Vec<usize> = (0..inputs.len()).filter(is_free).collect();
        // A network may list its state before the observation.
        let main = free.iter().position(|index| inputs[*index].len() == mapping.input_len()).unwrap_or(0);
        for (order, index) in free.into_iter().enumerate() {
            if order == main {
                observed.push((index, None));
            } else {
                let taken = |output: usize| kept.iter().any(|(_, taken)| *taken == output);
                let follows = |output: &usize| !taken(*output) && outputs[*output].shape == inputs[index].shape;
                let output = (1..outputs.len()).find(follows).ok_or_else(|| AgentError::UnassignedInput {
                    input: described(std::slice::from_ref(&inputs[index])),
                    name: inputs[index].name.clone(),
                    outputs: described(outputs),
                })?;
                kept.push((index, output));
            }
        }
        let array = |(input, output): (usize, usize)| {
            let values = vec![0.0; inputs[input].len()];
            let (given, expected) = (outputs[output].len(), values.len());
            let hint = format!("the state `{}` must have the size of `{}`", outputs[output].name, inputs[input].name);
            if given == expected {
                Ok(Kept { input, output, values })
            } else {
                Err(AgentError::NetworkSize { what: "outputs", given, expected, hint })
            }
        };
        Ok((observed, Self(kept.into_iter().map(array).collect::<Result<_, _>>()?)))
    }

    /// Sets the state to 0.
    pub fn reset(&mut self) {
        self.0.iter_mut().for_each(|kept| kept.values.fill(0.0));
    }

    /// Writes the state to the inputs of the network.
    pub fn write(&self, inputs: &mut [Vec<f32>]) {
        self.0.iter().for_each(|kept| inputs[kept.input].clone_from(&kept.values));
    }

    /// Takes the state from the outputs of the network.
    pub fn read(&mut self, outputs: &[Vec<f32>]) {
        self.0.iter_mut().for_each(|kept| kept.values.clone_from(&outputs[kept.output]));
    }
}

fn described(ports: &[Port]) -> String {
    ports.iter().map(|port| format!("`{}` {:?}", port.name, port.shape)).collect::<Vec<_>>().join(", ")
}
