//! The collision shapes of a quadruped, reduced to those that the engines have.

use glam::DVec3;
use twinstep_model::{Leg, RobotTree, Shapes, TreeShape, TreeShapeKind};

use crate::RobotFileError;

/// Lowest share of the distance of the legs' mounts that a box of the trunk has along x and y.
const PLAUSIBLE_SHARE: f64 = 0.4;
/// Distance from the origin at which a shape is off its centre [m].
const OFF_CENTRE: f64 = 0.01;

/// Returns the collision shapes; `found` has the index of each joint. They are a box of the trunk, and a box, a capsule and a sphere of the front left leg.
pub fn shapes(
    tree: &RobotTree,
    found: &[usize],
    feet: Option<&[String; 4]>,
    notes: &mut Vec<String>,
) -> Result<Shapes, RobotFileError> {
    let of = |body: usize| tree.shapes.iter().filter(move |shape| shape.body == body);
    let (thigh, calf) = (1 + found[1], 1 + found[2]);
    let mounts = Leg::ALL.map(|leg| tree.joints[found[3 * leg as usize]].parent_from_child.translation);
    let trunk_half_size = trunk_box(of(0), mounts, notes);
    let (foot_centre, foot_radius) = foot(of(calf), feet, &tree.bodies[calf].name)?;
    let (calf_ends, calf_radius) = match capsule(of(calf)) {
        Some(([one, other], radius)) if one.z < other.z => ([other, one], radius),
        Some((ends, radius)) => (ends, radius),
        None => {
            notes.push("the calves have no long shape: thin capsules over their upper part collide".to_owned());
            ([DVec3::ZERO, 0.6 * foot_centre], 0.5 * foot_radius)
        }
    };
    let knee = tree.joints[found[2]].parent_from_child.translation;
    let thigh_radius = capsule(of(thigh)).map_or(calf_radius, |(_, radius)| radius);
    let (hip_centre, hip_radius) =
        hip(of(1 + found[0]), tree.joints[found[1]].parent_from_child.translation, thigh_radius);
    Ok(Shapes {
        trunk_half_size,
        hip_centre,
        hip_radius,
        thigh_half_size: DVec3::new(thigh_radius, thigh_radius, 0.5 * knee.z.abs()),
        thigh_centre: 0.5 * knee,
        calf_radius,
        calf_ends,
        foot_radius,
        foot_centre,
    })
}

/// Returns the half sizes of the largest box, or of the bounds of a mesh, that can be the trunk: it reaches towards the mounts of the legs. Without one, that of a box
/// between the mounts.
fn trunk_box<'a>(shapes: impl Iterator<Item = &'a TreeShape>, mounts: [DVec3; 4], notes: &mut Vec<String>) -> DVec3 {
    let reach = mounts.iter().fold(DVec3::ZERO, |reach, mount| reach.max(mount.abs()));
    let volume = |half: &DVec3| half.x * half.y * half.z;
    let boxes = shapes.filter_map(|shape| {
        let (half, centre) = match shape.kind {
            TreeShapeKind::Box(half) => (half, DVec3::ZERO),
            TreeShapeKind::Mesh(Some([low, high])) => (0.5 * (high - low), 0.5 * (high + low)),
            _ => return None,
        };
        let pose = shape.body_from_shape;
        // The box along the axes of the trunk that contains this one.
        let columns = pose.matrix3.to_cols_array_2d().map(|column| DVec3::from_array(column).abs());
        let half = half.x * columns[0] + half.y * columns[1] + half.z * columns[2];
        Some((half, pose.transform_point3(centre)))
    });
    let plausible = boxes.filter(|(half, _)| half.x > PLAUSIBLE_SHARE * reach.x && half.y > PLAUSIBLE_SHARE * reach.y);
    let Some((half, centre)) = plausible.max_by(|one, other| volume(&one.0).total_cmp(&volume(&other.0))) else {
        let half = DVec3::new(reach.x, reach.y, reach.y);
        let size = 2.0 * half;
        notes.push(format!(
            "the trunk has no box or readable mesh of plausible size: it collides as a box between the mounts of the legs, \
             {:.3} x {:.3} x {:.3} m",
            size.x, size.y, size.z
        ));
        return half;
    };
    if centre.length() > OFF_CENTRE {
        notes.push(format!(
            "the box of the trunk is {:.3} m off its origin; it collides as if it were not",
            centre.length()
        ));
    }
    half
}

/// Returns centre and radius of the sphere of the front left hip: those of its thickest round shape, without one a sphere as thick as the
/// thigh at its joint.
fn hip<'a>(shapes: impl Iterator<Item = &'a TreeShape>, thigh_joint: DVec3, thigh_radius: f64) -> (DVec3, f64) {
    let round = shapes.filter_map(|shape| match shape.kind {
        TreeShapeKind::Sphere(radius)
        | TreeShapeKind::Capsule { radius, .. }
        | TreeShapeKind::Cylinder { radius, .. } => Some((shape.body_from_shape.translation, radius)),
        _ => None,
    });
    round.max_by(|one, other| one.1.total_cmp(&other.1)).unwrap_or((thigh_joint, thigh_radius))
}

/// Returns centre and radius of the front left foot.
fn foot<'a>(
    shapes: impl Iterator<Item = &'a TreeShape>,
    feet: Option<&[String; 4]>,
    calf: &str,
) -> Result<(DVec3, f64), RobotFileError> {
    let named = feet.map(|feet| &feet[0]);
    let spheres = shapes.filter(|shape| named.is_none_or(|name| *name == shape.name));
    let spheres = spheres.filter_map(|shape| match shape.kind {
        TreeShapeKind::Sphere(radius) => Some((shape.body_from_shape.translation, radius)),
        _ => None,
    });
    spheres.min_by(|one, other| one.0.z.total_cmp(&other.0.z)).ok_or_else(|| {
        let problem = named.map_or("it has no foot: a collision sphere, in it or fixed to it".to_owned(), |name| {
            format!("the foot `{name}` of `[joints] feet` is not a collision sphere in it or fixed to it")
        });
        RobotFileError::Link { link: calf.to_owned(), problem }
    })
}

/// Returns ends and radius of the longest shape that is not a sphere.
fn capsule<'a>(shapes: impl Iterator<Item = &'a TreeShape>) -> Option<([DVec3; 2], f64)> {
    let capsules = shapes.filter_map(|shape| {
        let (axis, half_length, radius) = match shape.kind {
            TreeShapeKind::Sphere(_) | TreeShapeKind::Mesh(_) => return None,
            TreeShapeKind::Capsule { radius, half_length } | TreeShapeKind::Cylinder { radius, half_length } => {
                (DVec3::Z, half_length, radius)
            }
            TreeShapeKind::Box(half) | TreeShapeKind::Ellipsoid(half) => {
                let longest = half.max_element();
                let axis = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().find(|axis| half.dot(*axis) == longest);
                (axis.unwrap_or(DVec3::Z), longest, half.min_element())
            }
        };
        let ends = [-half_length, half_length].map(|along| shape.body_from_shape.transform_point3(along * axis));
        Some((ends, radius))
    });
    let length = |ends: &[DVec3; 2]| (ends[1] - ends[0]).length();
    capsules.max_by(|one, other| length(&one.0).total_cmp(&length(&other.0)))
}
