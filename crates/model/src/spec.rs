//! Specification of an environment, and the hash of what agent and robot must agree on.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Named part of an observation or action vector.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpecField {
    /// Name of the quantity, such as `joint_velocity`.
    pub name: String,
    /// Number of entries.
    pub size: usize,
    /// Unit, such as `rad/s`; empty if dimensionless.
    pub unit: String,
    /// Lowest value; observations are clipped to it.
    pub low: f32,
    /// Highest value; observations are clipped to it.
    pub high: f32,
    /// Description in one line.
    pub description: String,
}

/// A quantity on which two specs do not agree.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SpecDifference {
    /// Name of the quantity, such as `kp`.
    pub quantity: String,
    /// Value in each spec, as in [`EnvSpec::hash_input`].
    pub values: [String; 2],
}

/// Specification of an environment: layouts, periods, gains and limits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnvSpec {
    /// Name of the task, such as `walk`.
    pub task: String,
    /// Name of the nominal robot, such as `go2`.
    pub robot: String,
    /// Parts of the observation of group `policy`, in order.
    pub observation: Vec<SpecField>,
    /// Parts of the privileged observation of group `critic`, in order; empty if there is none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub critic_observation: Vec<SpecField>,
    /// Parts of the action, in order.
    pub action: Vec<SpecField>,
    /// Joint names in the order of every per-joint array.
    pub joint_order: Vec<String>,
    /// Policy period [s].
    pub policy_dt: f64,
    /// Actuator period [s].
    pub actuator_dt: f64,
    /// Position gain [N·m/rad].
    pub kp: f64,
    /// Velocity gain [N·m·s/rad].
    pub kd: f64,
    /// Position gain [N·m/rad] and velocity gain [N·m·s/rad] of each joint, if they differ. `kp` and `kd` are then those of the first joint.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub joint_gains: Vec<[f64; 2]>,
    /// Joint offset of an action of 1 [rad].
    pub action_scale: f64,
    /// Joint positions to which actions are relative [rad].
    pub default_pose: Vec<f64>,
    /// Names of the reward terms, in the order of every per-term array.
    pub reward_terms: Vec<String>,
    /// Policy steps after which an episode is truncated.
    pub max_episode_steps: u32,
}

impl EnvSpec {
    /// Returns position gain [N·m/rad] and velocity gain [N·m·s/rad] of a joint.
    pub fn gains(&self, joint: usize) -> [f64; 2] {
        self.joint_gains.get(joint).copied().unwrap_or([self.kp, self.kd])
    }

    /// Returns the length of one observation of group `policy`.
    pub fn obs_len(&self) -> usize {
        self.observation.iter().map(|field| field.size).sum()
    }

    /// Returns the length of one observation of group `critic`; 0 if there is none.
    pub fn critic_obs_len(&self) -> usize {
        self.critic_observation.iter().map(|field| field.size).sum()
    }

    /// Returns the length of one action.
    pub fn action_len(&self) -> usize {
        self.action.iter().map(|field| field.size).sum()
    }

    /// Returns the name of entry `index` of the observation, such as `joint_position[FL_hip]`.
    pub fn observation_entry(&self, index: usize) -> String {
        entry_name(&self.observation, &self.joint_order, index)
    }

    /// Returns the name of entry `index` of the action, such as `joint_position_offset[FL_hip]`.
    pub fn action_entry(&self, index: usize) -> String {
        entry_name(&self.action, &self.joint_order, index)
    }

    /// Returns the part of the observation with this name and the index of its first entry.
    pub fn observation_field(&self, name: &str) -> Option<(usize, &SpecField)> {
        find_field(&self.observation, name)
    }

    /// Returns the part of the observation of group `critic` with this name and the index of its first entry.
    pub fn critic_field(&self, name: &str) -> Option<(usize, &SpecField)> {
        find_field(&self.critic_observation, name)
    }

    /// Returns each quantity of [`EnvSpec::hash_input`] that differs from that of `other`, one per line of the text.
    pub fn differences(&self, other: &EnvSpec) -> Vec<SpecDifference> {
        let (ours, theirs) = (self.hash_input(), other.hash_input());
        // Only specs whose joints have different gains have a line for them.
        let quantity = |line: &'_ str| line.split(' ').next().unwrap_or_default().to_owned();
        let mut quantities: Vec<String> = ours.lines().chain(theirs.lines()).map(quantity).collect();
        let mut seen = std::collections::BTreeSet::new();
        quantities.retain(|quantity| seen.insert(quantity.clone()));
        let value = |text: &str, quantity: &str, spec: &Self| {
            let line = text.lines().find(|line| line.split(' ').next() == Some(quantity));
            let equal = || format!("{}:{} for every joint", spec.kp, spec.kd);
            line.map_or_else(equal, |line| line.split_once(' ').unwrap_or_default().1.to_owned())
        };
        let all = quantities.into_iter().map(|quantity| {
            let values = [value(&ours, &quantity, self), value(&theirs, &quantity, other)];
            SpecDifference { quantity, values }
        });
        all.filter(|SpecDifference { values: [one, other], .. }| one != other).collect()
    }

    /// Returns the hash of all that an agent and a robot must agree on, as 32 hexadecimal digits.
    ///
    /// It covers the robot's name, the layouts of observation and action, joint order, policy period, gains, action scale and default pose: [`EnvSpec::hash_input`].
    pub fn hash(&self) -> String {
        let digest: [u8; 32] = Sha256::digest(self.hash_input()).into();
        let half: [u8; 16] = std::array::from_fn(|index| digest[index]);
        format!("{:032x}", u128::from_be_bytes(half))
    }

    /// Returns the text that [`EnvSpec::hash`] hashes, one line per quantity.
    pub fn hash_input(&self) -> String {
        let layout = |fields: &[SpecField]| {
            fields.iter().map(|field| format!("{}:{}", field.name, field.size)).collect::<Vec<_>>().join(" ")
        };
        let pose = self.default_pose.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        let gains = self.joint_gains.iter().map(|[kp, kd]| format!("{kp}:{kd}")).collect::<Vec<_>>().join(" ");
        let gains = if gains.is_empty() { gains } else { format!("joint_gains {gains}\n") };
        format!(
            "robot {}\nobservation {}\naction {}\njoint_order {}\npolicy_dt {}\nkp {}\nkd {}\naction_scale {}\n\
             default_pose {pose}\n{gains}",
            self.robot,
            layout(&self.observation),
            layout(&self.action),
            self.joint_order.join(" "),
            self.policy_dt,
            self.kp,
            self.kd,
            self.action_scale,
        )
    }
}

fn find_field<'a>(fields: &'a [SpecField], name: &str) -> Option<(usize, &'a SpecField)> {
    let index = fields.iter().position(|field| field.name == name)?;
    Some((fields[..index].iter().map(|field| field.size).sum(), &fields[index]))
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
