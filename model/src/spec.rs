//! What an environment looks like from outside, and the hash of what agent and robot must agree on.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// One named part of an observation or action vector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpecField {
    /// The quantity, such as `joint_velocity`.
    pub name: String,
    /// Number of entries.
    pub size: usize,
    /// Unit, such as `rad/s`; empty for pure numbers.
    pub unit: String,
    /// Lowest value; observations are clipped to it.
    pub low: f32,
    /// Highest value; observations are clipped to it.
    pub high: f32,
    /// One line for a reader.
    pub description: String,
}

/// Everything that a client must know of an environment before it uses it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnvSpec {
    /// The task, such as `walk`.
    pub task: String,
    /// The nominal robot, such as `go2`.
    pub robot: String,
    /// Parts of the observation, in order.
    pub observation: Vec<SpecField>,
    /// Parts of the action, in order.
    pub action: Vec<SpecField>,
    /// Joint names in the order of every per-joint array.
    pub joint_order: Vec<String>,
    /// One period of the policy [s].
    pub policy_dt: f64,
    /// One period of the drive [s].
    pub actuator_dt: f64,
    /// Position gain [N·m/rad].
    pub kp: f64,
    /// Velocity gain [N·m·s/rad].
    pub kd: f64,
    /// Joint offset of a full action [rad].
    pub action_scale: f64,
    /// The pose that actions are offsets from [rad].
    pub default_pose: Vec<f64>,
    /// Names of the reward terms, in the order of every per-term array.
    pub reward_terms: Vec<String>,
    /// Policy steps after which an episode is truncated.
    pub max_episode_steps: u32,
}

impl EnvSpec {
    /// Length of one observation.
    pub fn obs_len(&self) -> usize {
        self.observation.iter().map(|field| field.size).sum()
    }

    /// Length of one action.
    pub fn action_len(&self) -> usize {
        self.action.iter().map(|field| field.size).sum()
    }

    /// Name of the observation's entry `index`, such as `joint_position[FL_hip]` or `gravity[2]`.
    pub fn observation_entry(&self, index: usize) -> String {
        entry_name(&self.observation, &self.joint_order, index)
    }

    /// Name of the action's entry `index`, such as `joint_position_offset[FL_hip]`.
    pub fn action_entry(&self, index: usize) -> String {
        entry_name(&self.action, &self.joint_order, index)
    }

    /// Hash of everything that must agree between an agent and a robot: layouts, joint order, periods, gains,
    /// action scale and default pose. 32 hexadecimal digits; the text that is hashed is [`EnvSpec::agreement`].
    pub fn hash(&self) -> String {
        let digest: [u8; 32] = Sha256::digest(self.hash_input()).into();
        let half: [u8; 16] = std::array::from_fn(|index| digest[index]);
        format!("{:032x}", u128::from_be_bytes(half))
    }

    /// The text that [`EnvSpec::hash`] hashes: one line for each thing that must agree.
    pub fn hash_input(&self) -> String {
        let layout = |fields: &[SpecField]| {
            fields.iter().map(|field| format!("{}:{}", field.name, field.size)).collect::<Vec<_>>().join(" ")
        };
        let pose = self.default_pose.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        format!(
            "observation {}\naction {}\njoint_order {}\npolicy_dt {}\ndrive_dt {}\nkp {}\nkd {}\naction_scale {}\n\
             default_pose {pose}\n",
            layout(&self.observation),
            layout(&self.action),
            self.joint_order.join(" "),
            self.policy_dt,
            self.actuator_dt,
            self.kp,
            self.kd,
            self.action_scale,
        )
    }
}

fn entry_name(fields: &[SpecField], joint_order: &[String], index: usize) -> String {
    let mut start = 0;
    for field in fields {
        if index < start + field.size {
            let within = index - start;
            let label = if field.size == joint_order.len() { joint_order[within].clone() } else { within.to_string() };
            return format!("{}[{label}]", field.name);
        }
        start += field.size;
    }
    format!("entry {index}")
}
