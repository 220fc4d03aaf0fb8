//! Shapes of MJCF files: where they collide, and what they weigh.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use roxmltree::Node;
use twinstep_model::{RigidBody, TreeShapeKind};

use super::compiler::Settings;
use super::element::Element;
use crate::RobotFileError;
use crate::inertia::{self, DENSITY, MIN_LENGTH};
use crate::orientation::ORIENTATIONS;
use crate::xml::unsupported;

const RESOLVED: [&str; 16] = [
    "name",
    "class",
    "type",
    "size",
    "pos",
    "fromto",
    "mass",
    "density",
    "contype",
    "conaffinity",
    "group",
    "mesh",
    "shellinertia",
    "fluidshape",
    "hfield",
    "fluidcoef",
];
/// Looks, and how contacts are made soft, which the engines do in their own way.
const WITHOUT_EFFECT: [&str; 11] =
    ["rgba", "material", "user", "condim", "friction", "priority", "solmix", "solref", "solimp", "margin", "gap"];

/// A shape of a body.
pub struct Geom {
    /// Name of the shape.
    pub name: Option<String>,
    /// Kind and size.
    pub kind: TreeShapeKind,
    /// Pose in the frame of the body, or of the `<frame>` around it.
    pub pose: DAffine3,
    /// True if it collides with anything.
    pub collides: bool,
    /// Group.
    group: f64,
    /// Mass, and density [kg, kg/m³].
    mass: Option<f64>,
    density: f64,
}

/// Reads a shape. Returns `None` for a plane.
pub fn read(element: &Element, settings: &Settings) -> Result<Option<Geom>, RobotFileError> {
    element.check(&[&RESOLVED, &ORIENTATIONS, &WITHOUT_EFFECT])?;
    element.check_value("shellinertia", &["false"])?;
    element.check_value("fluidshape", &["none"])?;
    let flag = |name: &str| element.attribute(name).is_none_or(|value| value != "0");
    let size = element.up_to::<3>("size", "up to three numbers")?.unwrap_or_default();
    let span = span(element)?;
    let half_length = |index: usize| span.map_or(size[index], |(_, half)| half);
    let (kind, sizes) = match element.attribute("type").unwrap_or("sphere") {
        "plane" => return Ok(None),
        "mesh" => (TreeShapeKind::Mesh(None), 0),
        // The size follows from the mesh.
        "box" | "sphere" | "capsule" | "cylinder" | "ellipsoid" if element.attribute("mesh").is_some() => {
            (TreeShapeKind::Mesh(None), 0)
        }
        "sphere" => (TreeShapeKind::Sphere(size[0]), 1),
        "capsule" => (TreeShapeKind::Capsule { radius: size[0], half_length: half_length(1) }, 1),
        "cylinder" => (TreeShapeKind::Cylinder { radius: size[0], half_length: half_length(1) }, 1),
        "box" => (TreeShapeKind::Box(DVec3::new(size[0], size[1], half_length(2))), 2),
        "ellipsoid" => (TreeShapeKind::Ellipsoid(DVec3::new(size[0], size[1], half_length(2))), 2),
        _ => return Err(element.error("type", "plane, sphere, capsule, cylinder, box, ellipsoid or mesh")),
    };
    let is_small = |length: f64| length < MIN_LENGTH;
    if size[..sizes].iter().any(|size| is_small(*size)) || sizes > 0 && is_small(kind.shortest_length()) {
        return Err(element.error("size", "as many sizes above 0 as the type has"));
    }
    let pose = match span {
        Some((pose, _)) => pose,
        None => element.pose(settings)?,
    };
    Ok(Some(Geom {
        name: element.node.attribute("name").map(str::to_owned),
        kind,
        pose,
        collides: flag("contype") || flag("conaffinity"),
        group: element.number("group", 0.0)?,
        mass: element.numbers::<1>("mass", "a number")?.map(|[mass]| mass),
        density: element.number("density", DENSITY)?,
    }))
}

/// Returns pose and half of the length that `fromto` states.
fn span(element: &Element) -> Result<Option<(DAffine3, f64)>, RobotFileError> {
    let Some([ax, ay, az, bx, by, bz]) = element.numbers("fromto", "six numbers")? else { return Ok(None) };
    if ORIENTATIONS.iter().any(|name| element.attribute(name).is_some()) {
        return Err(unsupported(element.node, "`fromto` and an orientation: remove one"));
    }
    let (from, to) = (DVec3::new(ax, ay, az), DVec3::new(bx, by, bz));
    let along = (from - to).try_normalize().ok_or_else(|| element.error("fromto", "two points that differ"))?;
    let rotation = DMat3::from_quat(DQuat::from_rotation_arc(DVec3::Z, along));
    Ok(Some((DAffine3 { matrix3: rotation, translation: 0.5 * (from + to) }, 0.5 * (to - from).length())))
}

impl Geom {
    /// Returns true if the group of the shape has mass.
    pub fn is_weighed(&self, settings: &Settings) -> bool {
        let [low, high] = settings.mass_groups;
        (low..=high).contains(&self.group)
    }

    /// Returns the shape as a body in the frame of its pose. `None` if its group has no mass.
    pub fn body(&self, node: Node, settings: &Settings) -> Result<Option<RigidBody>, RobotFileError> {
        if self.mass.unwrap_or(self.density) == 0.0 || !self.is_weighed(settings) {
            return Ok(None);
        }
        let Some(volume) = inertia::volume(self.kind) else {
            let problem =
                "a mesh whose mass is needed, because its body has no <inertial>, is not supported: state <inertial>";
            return Err(unsupported(node, problem));
        };
        let mass = self.mass.unwrap_or(self.density * volume);
        if mass < 0.0 {
            return Err(unsupported(node, format!("the mass of a geom is {mass}; 0 or more expected")));
        }
        Ok(inertia::solid(self.kind, mass).map(|body| inertia::transformed(self.pose, body)))
    }
}
