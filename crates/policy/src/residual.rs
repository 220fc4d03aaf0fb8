//! A residual on the actions of a frozen base policy (U2E, eq. 12): its environments, and both as one policy.

use twinstep_model::{
    AgentCommands, EnvError, EnvSpec, GaitCommand, RealTimeReport, ResetRequest, RobotSample, Scene, StepBatch, VecEnv,
    VelocityCommand,
};

use crate::mlp::Mlp;
use crate::policy::{Policy, PolicyRunner};

/// The base policy is for other robots or observations than the environments.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "the base policy was trained with spec {base}, the environment has {env}; they must agree on observation, action, \
     gains, action scale and default pose"
)]
pub struct OtherBase {
    /// Hash of the base policy's spec.
    pub base: String,
    /// Hash of the environment's spec.
    pub env: String,
}

/// Environments whose action is a residual: `base(obs) + max_residual · clip(residual, −1, 1)` is executed.
pub struct ResidualEnv {
    env: Box<dyn VecEnv>,
    base: PolicyRunner,
    spec: EnvSpec,
    max_residual: f32,
    /// Action of the base policy in each environment.
    base_actions: Vec<f32>,
    /// Commands that were set since the last step.
    next_commands: AgentCommands,
}

impl ResidualEnv {
    /// Creates the environments of the task `task` from those of the base policy.
    pub fn new(env: Box<dyn VecEnv>, task: &str, base: &Policy, max_residual: f32) -> Result<Self, OtherBase> {
        if env.spec().hash() != base.spec.hash() {
            return Err(OtherBase { base: base.spec.hash(), env: env.spec().hash() });
        }
        let mut spec = EnvSpec { task: task.to_owned(), ..env.spec().clone() };
        for field in &mut spec.action {
            "residual".clone_into(&mut field.name);
            field.description =
                format!("added to the action of the base policy, in units of {max_residual} · action_scale");
        }
        let base_actions = vec![0.0; env.num_envs() * spec.action_len()];
        let base = PolicyRunner::new(base);
        Ok(Self { base, env, spec, max_residual, base_actions, next_commands: AgentCommands::default() })
    }
}

impl VecEnv for ResidualEnv {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn num_envs(&self) -> usize {
        self.env.num_envs()
    }

    fn mean_level(&self) -> Option<f64> {
        self.env.mean_level()
    }

    fn autoreset(&self) -> twinstep_model::AutoresetMode {
        self.env.autoreset()
    }

    fn reset(&mut self, request: &ResetRequest) -> Result<&[f32], EnvError> {
        self.env.reset(request)
    }

    fn obs(&self) -> &[f32] {
        self.env.obs()
    }

    fn critic_obs(&self) -> &[f32] {
        self.env.critic_obs()
    }

    fn set_velocity_commands(&mut self, commands: &[VelocityCommand]) -> Result<(), EnvError> {
        self.spec.check_velocity_commands(commands, self.num_envs())?;
        self.next_commands.velocity = Some(commands.to_vec());
        Ok(())
    }

    fn set_gait_commands(&mut self, commands: &[GaitCommand]) -> Result<(), EnvError> {
        self.spec.check_gait_commands(commands, self.num_envs())?;
        self.next_commands.gait = Some(commands.to_vec());
        Ok(())
    }

    fn set_action_tick(&mut self, tick: u64) {
        self.env.set_action_tick(tick);
    }

    fn real_time(&self) -> Option<&RealTimeReport> {
        self.env.real_time()
    }

    fn step(&mut self, actions: &[f32]) -> Result<&StepBatch, EnvError> {
        let commands = std::mem::take(&mut self.next_commands);
        let expected = self.base_actions.len();
        if actions.len() != expected {
            return Err(EnvError::WrongLength { field: "actions", given: actions.len(), expected });
        }
        if let Some(index) = actions.iter().position(|value| !value.is_finite()) {
            let (env, entry) = (index / self.spec.action_len(), index % self.spec.action_len());
            let entry = self.spec.action_entry(entry);
            return Err(EnvError::ActionNotFinite { env, entry, value: actions[index] });
        }
        if let Some(commands) = commands.velocity {
            self.env.set_velocity_commands(&commands)?;
        }
        if let Some(commands) = commands.gait {
            self.env.set_gait_commands(&commands)?;
        }
        self.base.run(self.env.obs(), &mut self.base_actions);
        for (action, residual) in self.base_actions.iter_mut().zip(actions) {
            *action += self.max_residual * residual.clamp(-1.0, 1.0);
        }
        self.env.step(&self.base_actions)
    }

    fn push(&mut self, env: usize, velocity: [f32; 3]) -> Result<(), EnvError> {
        self.env.push(env, velocity)
    }

    fn scene(&self, env: usize) -> Result<Scene, EnvError> {
        self.env.scene(env)
    }

    fn samples(&mut self, env: usize) -> Result<Vec<RobotSample>, EnvError> {
        self.env.samples(env)
    }
}

/// Returns base policy and residual as one policy of the base policy's task.
///
/// Its network has both side by side. A last hidden layer of pairs of rectified linear units passes the base action on
/// and clips the residual: `x = relu(x) − relu(−x)`, `clip(x, −1, 1) = relu(x + 1) − relu(x − 1) − 1`. The residual then
/// reads observations that are clipped as those of the base policy: ten standard deviations from their mean.
pub fn with_residual(base: &Policy, residual: &Policy, max_residual: f32) -> Policy {
    let outputs = base.actor.outputs();
    let mut networks = [Layers::new(&base.actor), Layers::new(&residual.actor)];
    networks[1].read_inputs_of(base, residual);
    let depth = networks.iter().map(|network| network.0.len()).max().unwrap_or_default();
    for network in &mut networks {
        network.deepen(depth);
    }
    let [base_layers, residual_layers] = networks;
    let mut layers: Vec<Layer> = Vec::new();
    for (index, (one, other)) in base_layers.0.iter().zip(&residual_layers.0).enumerate() {
        layers.push(one.beside(other, index == 0));
    }
    let last = layers.pop().expect("a network has a layer");
    layers.push(last.with_units(outputs));
    layers.push(sum_of_units(outputs, max_residual));
    let log_std = residual.log_std.iter().map(|log_std| log_std + max_residual.ln()).collect();
    Policy { actor: network(&layers), log_std, ..base.clone() }
}

/// A linear layer: weight, row-major, inputs × outputs, and bias.
#[derive(Clone)]
struct Layer {
    inputs: usize,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

struct Layers(Vec<Layer>);

impl Layers {
    fn new(network: &Mlp) -> Self {
        let layer = |(index, inputs): (usize, &usize)| {
            let (weight, bias) = network.layer(index);
            Layer { inputs: *inputs, weight, bias }
        };
        Self(network.sizes()[..network.sizes().len() - 1].iter().enumerate().map(layer).collect())
    }

    /// Changes the first layer, so that its input is normalised as that of `base` instead of that of `own`.
    fn read_inputs_of(&mut self, base: &Policy, own: &Policy) {
        let ((base_mean, base_std), (mean, std)) = (base.normaliser.mean_and_std(), own.normaliser.mean_and_std());
        let Layer { inputs, weight, bias } = &mut self.0[0];
        for input in 0..*inputs {
            let (factor, offset) = (base_std[input] / std[input], (base_mean[input] - mean[input]) / std[input]);
            for (weight, bias) in weight[input * bias.len()..].iter_mut().zip(bias.iter_mut()) {
                *bias += offset * *weight;
                *weight *= factor;
            }
        }
    }

    /// Inserts layers that pass the hidden units on, until there are `depth` layers.
    fn deepen(&mut self, depth: usize) {
        if self.0.len() == 1 && depth > 1 {
            self.split_inputs();
        }
        while self.0.len() < depth {
            let units = self.0[self.0.len() - 1].inputs;
            let mut identity = Layer { inputs: units, weight: vec![0.0; units * units], bias: vec![0.0; units] };
            (0..units).for_each(|unit| identity.weight[unit * units + unit] = 1.0);
            // Hidden units are not negative, so that a rectified linear unit does not change them.
            self.0.insert(self.0.len() - 1, identity);
        }
    }

    /// Inserts a layer of the units `x` and `−x` of each input before the only layer.
    fn split_inputs(&mut self) {
        let Layer { inputs, weight, bias } = &self.0[0];
        let (inputs, units) = (*inputs, 2 * *inputs);
        let negative = weight.iter().map(|weight| -weight);
        let output =
            Layer { inputs: units, weight: weight.iter().copied().chain(negative).collect(), bias: bias.clone() };
        let mut split = Layer { inputs, weight: vec![0.0; inputs * units], bias: vec![0.0; units] };
        for input in 0..inputs {
            split.weight[input * units + input] = 1.0;
            split.weight[input * units + inputs + input] = -1.0;
        }
        self.0 = vec![split, output];
    }
}

impl Layer {
    /// Returns both layers with their outputs side by side; they have the same inputs, or each its own.
    fn beside(&self, other: &Self, has_same_inputs: bool) -> Self {
        let (own, others) = (self.bias.len(), other.bias.len());
        let first = if has_same_inputs { 0 } else { self.inputs };
        let inputs = if has_same_inputs { self.inputs } else { self.inputs + other.inputs };
        let mut weight = vec![0.0; inputs * (own + others)];
        for input in 0..self.inputs {
            weight[input * (own + others)..][..own].copy_from_slice(&self.weight[input * own..][..own]);
        }
        for input in 0..other.inputs {
            weight[(first + input) * (own + others) + own..][..others]
                .copy_from_slice(&other.weight[input * others..][..others]);
        }
        Self { inputs, weight, bias: [&self.bias[..], &other.bias].concat() }
    }

    /// Returns the layer of the units `x` and `−x` of the first `outputs` outputs, `x + 1` and `x − 1` of the others.
    fn with_units(&self, outputs: usize) -> Self {
        let row = |values: &[f32], offset: f32| {
            let (base, residual) = values.split_at(outputs);
            let negative = base.iter().map(|value| -value);
            let [above, below] = [offset, -offset].map(|offset| residual.iter().map(move |value| value + offset));
            base.iter().copied().chain(negative).chain(above).chain(below).collect::<Vec<_>>()
        };
        Self {
            inputs: self.inputs,
            weight: self.weight.chunks_exact(2 * outputs).flat_map(|values| row(values, 0.0)).collect(),
            bias: row(&self.bias, 1.0),
        }
    }
}

/// Returns the output layer above the units of [`Layer::with_units`].
fn sum_of_units(outputs: usize, max_residual: f32) -> Layer {
    let mut weight = vec![0.0; 4 * outputs * outputs];
    for (block, factor) in [1.0, -1.0, max_residual, -max_residual].into_iter().enumerate() {
        (0..outputs).for_each(|output| weight[(block * outputs + output) * outputs + output] = factor);
    }
    Layer { inputs: 4 * outputs, weight, bias: vec![-max_residual; outputs] }
}

fn network(layers: &[Layer]) -> Mlp {
    let sizes: Vec<usize> = [layers[0].inputs].into_iter().chain(layers.iter().map(|layer| layer.bias.len())).collect();
    let mut network = Mlp::zeros(&sizes);
    for (index, layer) in layers.iter().enumerate() {
        network.set_layer(index, &layer.weight, &layer.bias);
    }
    network
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::RngExt;
    use twinstep_model::{EnvSpec, SpecField, stream};

    use super::*;
    use crate::normaliser::Normaliser;

    const OBS_LEN: usize = 7;
    const ACTION_LEN: usize = 3;

    fn spec() -> EnvSpec {
        let field = |name: &str, size| SpecField {
            name: name.to_owned(),
            size,
            unit: String::new(),
            low: -1.0,
            high: 1.0,
            description: String::new(),
        };
        EnvSpec {
            task: "walk".to_owned(),
            robot: "go2".to_owned(),
            observation: vec![field("obs", OBS_LEN)],
            critic_observation: Vec::new(),
            action: vec![field("action", ACTION_LEN)],
            joint_order: Vec::new(),
            policy_dt: 0.02,
            actuator_dt: 0.005,
            kp: 30.0,
            kd: 0.75,
            joint_gains: Vec::new(),
            action_scale: 0.5,
            default_pose: Vec::new(),
            reward_terms: Vec::new(),
            max_episode_steps: 10,
        }
    }

    fn policy(seed: u64, hidden: &[usize], gain: f32) -> Policy {
        let mut random = stream(seed, "policy", 0);
        let mut numbers =
            |low: f32, high: f32| (0..OBS_LEN).map(|_| random.random_range(low..high)).collect::<Vec<_>>();
        let normaliser = Normaliser::from_mean_and_std(&numbers(-1.0, 1.0), &numbers(0.5, 2.0));
        let sizes = [&[OBS_LEN], hidden, &[ACTION_LEN]].concat();
        Policy { spec: spec(), normaliser, actor: Mlp::orthogonal(&sizes, gain, &mut random), log_std: vec![0.0; 3] }
    }

    fn action(policy: &Policy, obs: &[f32]) -> Vec<f32> {
        let mut action = vec![0.0; ACTION_LEN];
        PolicyRunner::new(policy).run(obs, &mut action);
        action
    }

    proptest! {
        #[test]
        fn one_policy_has_the_actions_of_both(
            seed: u64,
            obs in prop::collection::vec(-3.0f32..3.0, OBS_LEN),
            depth in 0usize..3,
            residual_depth in 0usize..3,
        ) {
            // Residuals of some units, so that many are clipped.
            let (base, residual) = (policy(seed, &[8; 3][..depth], 1.0), policy(!seed, &[5; 3][..residual_depth], 2.0));
            let both = action(&with_residual(&base, &residual, 0.3), &obs);
            for (both, (base, residual)) in both.iter().zip(action(&base, &obs).iter().zip(action(&residual, &obs))) {
                let expected = base + 0.3 * residual.clamp(-1.0, 1.0);
                prop_assert!((both - expected).abs() < 1e-5 * (1.0 + base.abs()), "{both} {expected}");
            }
        }
    }
}
