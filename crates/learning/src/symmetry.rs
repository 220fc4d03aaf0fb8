//! Mirroring of observations and actions at the robot's sagittal plane: left and right are exchanged.

use twinstep_model::{EnvSpec, JOINT_NAMES, Joint, JointKind, Leg, SpecField};

/// Mirrored vector: entry `i` is `signs[i] · vector[indices[i]]`.
#[derive(Clone, Debug, PartialEq)]
pub struct Mirror {
    indices: Vec<usize>,
    signs: Vec<f32>,
}

/// A part of an observation or action has no known mirror image.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("`train.symmetry` is not possible: the mirror image of `{field}` is not known")]
pub struct NoMirror {
    /// The part.
    pub field: String,
}

impl Mirror {
    /// Returns the mirror of the observation of a policy, followed by the privileged one of a critic.
    pub fn of_observations(spec: &EnvSpec) -> Result<Self, NoMirror> {
        Self::of_fields(spec, spec.observation.iter().chain(&spec.critic_observation))
    }

    /// Returns the mirror of an action.
    pub fn of_actions(spec: &EnvSpec) -> Result<Self, NoMirror> {
        Self::of_fields(spec, &spec.action)
    }

    fn of_fields<'a>(spec: &EnvSpec, fields: impl IntoIterator<Item = &'a SpecField>) -> Result<Self, NoMirror> {
        let is_quadruped = spec.joint_order == JOINT_NAMES;
        let mut mirror = Self { indices: Vec::new(), signs: Vec::new() };
        for field in fields {
            let start = mirror.indices.len();
            let entries = entries(field, is_quadruped).ok_or_else(|| NoMirror { field: field.name.clone() })?;
            for (index, sign) in entries {
                mirror.indices.push(start + index);
                mirror.signs.push(sign);
            }
        }
        Ok(mirror)
    }

    /// Writes the mirror image of `vector`.
    pub fn apply(&self, vector: &[f32], mirrored: &mut [f32]) {
        for ((mirrored, index), sign) in mirrored.iter_mut().zip(&self.indices).zip(&self.signs) {
            *mirrored = sign * vector[*index];
        }
    }

    /// Replaces mean and variance by those of the vectors and their mirror images together.
    pub fn symmetrise(&self, mean: &mut [f64], variance: &mut [f64]) {
        let moments: Vec<[f64; 2]> = mean.iter().zip(variance.iter()).map(|(mean, var)| [*mean, *var]).collect();
        for entry in 0..mean.len() {
            let [own_mean, own_variance] = moments[entry];
            let [other_mean, other_variance] = moments[self.indices[entry]];
            let other_mean = f64::from(self.signs[entry]) * other_mean;
            mean[entry] = f64::midpoint(own_mean, other_mean);
            let between = (own_mean - other_mean).powi(2) / 4.0;
            variance[entry] = f64::midpoint(own_variance, other_variance) + between;
        }
    }
}

/// Returns source index and sign of each entry of a field. Returns `None` if the field is not known.
///
/// Joints and feet are those of a quadruped with the names of the Go2; which of another robot's face each other is not known.
fn entries(field: &SpecField, is_quadruped: bool) -> Option<Vec<(usize, f32)>> {
    // Vectors change the sign of y, pseudovectors that of x and z.
    let signs = |signs: [f32; 3]| Some(signs.into_iter().enumerate().collect());
    // Earlier frames have the names of the present one and a number.
    let name = match field.name.rsplit_once('_') {
        Some((name, number)) if number.parse::<u32>().is_ok() => name,
        _ => field.name.as_str(),
    };
    match name {
        "base_angular_velocity" | "true_angular_velocity" => signs([-1.0, 1.0, -1.0]),
        "projected_gravity" | "true_linear_velocity" => signs([1.0, -1.0, 1.0]),
        "velocity_command" | "no_velocity_command" | "path_velocity" | "pose_error" | "landing_target" => {
            signs([1.0, -1.0, -1.0])
        }
        "attitude_command" => signs([-1.0, 1.0, 1.0]),
        "base_height" | "phase" => Some(vec![(0, 1.0)]),
        // Stages and errors without a sign.
        "jump_stage" | "landing_error" => Some(vec![(0, 1.0), (1, 1.0)]),
        // Rows along the heading, columns from right to left.
        "ground_depth" => Some(
            (0..field.size).map(|index| (index / COLUMNS * COLUMNS + COLUMNS - 1 - index % COLUMNS, 1.0)).collect(),
        ),
        "foot_force" => is_quadruped.then(|| Leg::ALL.map(|leg| (opposite(leg) as usize, 1.0)).to_vec()),
        "joint_position" | "joint_velocity" | "previous_action" | "joint_position_offset" => {
            let joint = |joint: Joint| {
                let sign = if joint.kind == JointKind::Hip { -1.0 } else { 1.0 };
                (3 * opposite(joint.leg) as usize + joint.kind as usize, sign)
            };
            is_quadruped.then(|| Joint::ALL.map(joint).to_vec())
        }
        _ => None,
    }
}

/// Columns of the grid of `ground_depth`.
const COLUMNS: usize = 5;

fn opposite(leg: Leg) -> Leg {
    match leg {
        Leg::FL => Leg::FR,
        Leg::FR => Leg::FL,
        Leg::RL => Leg::RR,
        Leg::RR => Leg::RL,
    }
}
