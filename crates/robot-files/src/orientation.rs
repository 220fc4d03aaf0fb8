//! The five ways in which an MJCF element states an orientation.

use glam::{DMat3, DQuat, DVec3};
use roxmltree::Node;

use crate::RobotFileError;
use crate::xml::{attribute_error, parse_numbers, unsupported, vector};

/// Attributes that state an orientation.
pub const ORIENTATIONS: [&str; 5] = ["quat", "axisangle", "xyaxes", "zaxis", "euler"];

/// How a file writes angles.
#[derive(Clone, Copy)]
pub struct Angles<'a> {
    /// Factor to radians.
    pub unit: f64,
    /// Axes of `euler` in their order; upper case for axes that do not turn.
    pub sequence: &'a str,
}

/// Returns the rotation that an attribute of `node` states. `attribute` is the value of an attribute by its name.
pub fn rotation<'a>(
    node: Node,
    attribute: impl Fn(&str) -> Option<&'a str>,
    angles: Angles,
) -> Result<DMat3, RobotFileError> {
    let mut stated = ORIENTATIONS.iter().filter_map(|name| Some((*name, attribute(name)?)));
    let Some((name, text)) = stated.next() else { return Ok(DMat3::IDENTITY) };
    if let Some((other, _)) = stated.next() {
        return Err(unsupported(node, format!("`{name}` and `{other}` state two orientations: remove one")));
    }
    let turned = match name {
        "quat" => parse_numbers(text).and_then(from_quaternion),
        "axisangle" => parse_numbers(text).and_then(|[x, y, z, angle]: [f64; 4]| {
            let axis = DVec3::new(x, y, z).try_normalize()?;
            Some(DMat3::from_axis_angle(axis, angles.unit * angle))
        }),
        "xyaxes" => parse_numbers(text).and_then(from_axes),
        "zaxis" => parse_numbers(text).and_then(|z| Some(from_z(vector(z).try_normalize()?))),
        _ => parse_numbers(text).and_then(|turns| from_euler(turns, angles)),
    };
    let expected = match name {
        "quat" => "four numbers that are not all zero",
        "axisangle" => "three numbers of an axis and an angle",
        "xyaxes" => "six numbers of two axes that are not parallel",
        "zaxis" => "three numbers that are not all zero",
        _ => "three angles, in the order of three letters of `eulerseq`",
    };
    turned.ok_or_else(|| attribute_error(node, name, expected))
}

fn from_quaternion([w, x, y, z]: [f64; 4]) -> Option<DMat3> {
    let quaternion = DQuat::from_xyzw(x, y, z, w);
    (quaternion.length() > 1e-9).then(|| DMat3::from_quat(quaternion.normalize()))
}

/// Gram–Schmidt: the x axis stays, the y axis is made orthogonal to it.
fn from_axes([a, b, c, d, e, f]: [f64; 6]) -> Option<DMat3> {
    let x = DVec3::new(a, b, c).try_normalize()?;
    let y = DVec3::new(d, e, f);
    let y = (y - x.dot(y) * x).try_normalize()?;
    Some(DMat3::from_cols(x, y, x.cross(y)))
}

/// Returns the smallest rotation that turns +z to `z`.
fn from_z(z: DVec3) -> DMat3 {
    let axis = DVec3::Z.cross(z);
    match axis.try_normalize() {
        Some(unit) => DMat3::from_axis_angle(unit, axis.length().atan2(z.z)),
        None if z.z > 0.0 => DMat3::IDENTITY,
        // MuJoCo turns about x.
        None => DMat3::from_axis_angle(DVec3::X, std::f64::consts::PI),
    }
}

fn from_euler(turns: [f64; 3], Angles { unit, sequence }: Angles) -> Option<DMat3> {
    let letters: Vec<char> = sequence.chars().collect();
    if letters.len() != 3 {
        return None;
    }
    let mut whole = DMat3::IDENTITY;
    for (letter, turn) in letters.into_iter().zip(turns) {
        let axis = match letter.to_ascii_lowercase() {
            'x' => DVec3::X,
            'y' => DVec3::Y,
            'z' => DVec3::Z,
            _ => return None,
        };
        let turned = DMat3::from_axis_angle(axis, unit * turn);
        whole = if letter.is_ascii_lowercase() { whole * turned } else { turned * whole };
    }
    Some(whole)
}

/// Returns the rotation of a URDF's `rpy`: about the fixed axes x, y, z.
pub fn from_rpy([roll, pitch, yaw]: [f64; 3]) -> DMat3 {
    DMat3::from_rotation_z(yaw) * DMat3::from_rotation_y(pitch) * DMat3::from_rotation_x(roll)
}
