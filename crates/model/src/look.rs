//! How a quadruped like the Go2 is drawn: a shell, motors and low-poly links with the dimensions of its model.
//!
//! Nothing collides with these parts. Their proportions are those of a Go2, scaled by the distances between the joints.

use std::cell::RefCell;

use glam::{DVec2, DVec3};

use crate::RobotModel;
use crate::scene_shape::{SceneShape, convex, cylinder, sphere};

/// Colours (sRGB, from 0 to 1): painted shell, dark plastic, motor, steel, rubber.
const SHELL: [f32; 3] = [0.82, 0.84, 0.86];
const PLASTIC: [f32; 3] = [0.20, 0.21, 0.24];
const MOTOR: [f32; 3] = [0.31, 0.33, 0.37];
const STEEL: [f32; 3] = [0.58, 0.61, 0.65];
const RUBBER: [f32; 3] = [0.09, 0.09, 0.10];

/// Length of the Go2's thigh [m], for which the numbers below are given.
const GO2_THIGH: f64 = 0.213;

/// Axis along which a part is extruded.
#[derive(Clone, Copy)]
enum Axis {
    X,
    Y,
    Z,
}

impl Axis {
    /// Returns the point at `along` this axis and at `across` the other two, in cyclic order.
    fn point(self, along: f64, across: DVec2) -> DVec3 {
        match self {
            Self::X => DVec3::new(along, across.x, across.y),
            Self::Y => DVec3::new(across.y, along, across.x),
            Self::Z => DVec3::new(across.x, across.y, along),
        }
    }
}

/// Cross-section of a part: a rectangle whose corners are cut at 45°.
#[derive(Clone, Copy)]
struct Section {
    /// Position along the axis [m].
    along: f64,
    /// Position across the axis [m].
    centre: DVec2,
    /// Half of both sides [m].
    half: DVec2,
    /// Length that is cut from each side at a corner [m].
    bevel: f64,
}

fn section(along: f64, centre: [f64; 2], half: [f64; 2], bevel: f64) -> Section {
    Section { along, centre: DVec2::from(centre), half: DVec2::from(half), bevel }
}

impl Section {
    /// Returns the corners, counterclockwise about the axis.
    fn corners(&self) -> [DVec2; 8] {
        let (DVec2 { x, y }, cut) = (self.half, self.bevel);
        [
            (x, cut - y),
            (x, y - cut),
            (x - cut, y),
            (cut - x, y),
            (-x, y - cut),
            (-x, cut - y),
            (cut - x, -y),
            (x - cut, -y),
        ]
        .map(|(u, v)| self.centre + DVec2::new(u, v))
    }
}

/// Returns the convex part through `sections`, which are in the order of their positions and alike in the side of the
/// bevel: so all its faces are plane.
fn loft(body: u32, colour: [f32; 3], axis: Axis, scale: f64, sections: &[Section]) -> SceneShape {
    let corners = |section: &Section| section.corners().map(|across| scale * axis.point(section.along, across));
    let points: Vec<DVec3> = sections.iter().flat_map(corners).collect();
    let mut faces = Vec::new();
    for low in 0..sections.len() as u16 - 1 {
        for corner in 0..8 {
            let [from, to] = [corner, (corner + 1) % 8].map(|corner| 8 * low + corner);
            faces.extend([[from, to, to + 8], [from, to + 8, from + 8]]);
        }
    }
    let top = points.len() as u16 - 8;
    for corner in 1..7 {
        faces.extend([[0, corner + 1, corner], [top, top + corner, top + corner + 1]]);
    }
    convex(body, colour, &points, faces)
}

/// What the parts depend on.
#[derive(PartialEq)]
struct Dimensions {
    /// Of the joints of each leg, as in the model.
    origins: Vec<[DVec3; 3]>,
    foot_centre: DVec3,
    foot_radius: f64,
}

thread_local! {
    /// Parts of the last robot: a measure asks for the scene of every robot in every step.
    static LAST: RefCell<Option<(Dimensions, Vec<SceneShape>)>> = const { RefCell::new(None) };
}

/// Returns the parts of a robot, each on the body of its joint.
pub(crate) fn look(robot: &RobotModel) -> Vec<SceneShape> {
    let RobotModel { legs, shapes, .. } = robot;
    let dimensions = Dimensions {
        origins: legs.iter().map(|leg| leg.origins).collect(),
        foot_centre: shapes.foot_centre,
        foot_radius: shapes.foot_radius,
    };
    LAST.with_borrow_mut(|last| match last {
        Some((known, parts)) if *known == dimensions => parts.clone(),
        _ => {
            let parts = dimensions.parts();
            last.insert((dimensions, parts)).1.clone()
        }
    })
}

impl Dimensions {
    fn parts(&self) -> Vec<SceneShape> {
        trunk(self).into_iter().chain((0..self.origins.len()).flat_map(|leg| self::leg(self, leg))).collect()
    }
}

/// The shell between the hips, the housings of the hip motors before and behind it, the head and its lidar.
fn trunk(robot: &Dimensions) -> Vec<SceneShape> {
    let hip = robot.origins[0][0].abs();
    let scale = hip.x / 0.1934;
    let part = |colour, sections: &[Section]| loft(0, colour, Axis::X, scale, sections);
    let shell = |x: f64, [y, z]: [f64; 2]| section(x, [0.0, 0.006], [y, z], 0.026);
    let housing = |x: f64, [y, z]: [f64; 2]| section(x, [0.0, 0.0], [y, z], 0.03);
    let head = |x: f64, z: f64, half: [f64; 2]| section(x, [0.0, z], half, 0.018);
    vec![
        part(
            SHELL,
            &[
                shell(-0.165, [0.074, 0.042]),
                shell(-0.14, [0.094, 0.058]),
                shell(0.14, [0.094, 0.058]),
                shell(0.165, [0.074, 0.042]),
            ],
        ),
        part(
            PLASTIC,
            &[section(-0.12, [0.0, 0.066], [0.05, 0.006], 0.005), section(0.12, [0.0, 0.066], [0.05, 0.006], 0.005)],
        ),
        part(
            PLASTIC,
            &[section(-0.13, [0.0, -0.052], [0.06, 0.012], 0.01), section(0.13, [0.0, -0.052], [0.06, 0.012], 0.01)],
        ),
        part(PLASTIC, &[housing(0.15, [0.072, 0.044]), housing(0.225, [0.072, 0.044]), housing(0.238, [0.06, 0.036])]),
        part(
            PLASTIC,
            &[housing(-0.238, [0.06, 0.036]), housing(-0.225, [0.072, 0.044]), housing(-0.15, [0.072, 0.044])],
        ),
        part(
            SHELL,
            &[head(0.205, 0.024, [0.066, 0.034]), head(0.27, 0.024, [0.058, 0.034]), head(0.32, 0.014, [0.038, 0.024])],
        ),
        part(PLASTIC, &[head(0.31, 0.010, [0.036, 0.022]), head(0.328, 0.008, [0.028, 0.019])]),
        part(
            PLASTIC,
            &[section(0.25, [0.0, -0.022], [0.034, 0.026], 0.012), section(0.30, [0.0, -0.018], [0.03, 0.022], 0.012)],
        ),
        cylinder(
            0,
            MOTOR,
            scale * 0.042,
            [DVec3::new(0.288, 0.0, -0.06), DVec3::new(0.288, 0.0, -0.03)].map(|end| scale * end),
        ),
        sphere(0, RUBBER, scale * 0.04, scale * DVec3::new(0.288, 0.0, -0.062)),
    ]
}

/// One leg: the motors of abduction, hip and knee, thigh, shank and foot.
fn leg(robot: &Dimensions, leg: usize) -> Vec<SceneShape> {
    let [_, thigh_origin, calf_origin] = robot.origins[leg];
    let scale = calf_origin.length() / GO2_THIGH;
    let side = thigh_origin.y.signum();
    // Outwards from the hip joint [m of a Go2].
    let out = thigh_origin.y.abs() / scale;
    let [hip, thigh, calf] = [1, 2, 3].map(|body| body + 3 * leg as u32);
    let across = |from: f64, to: f64| [from, to].map(|y| scale * DVec3::new(0.0, side * y, 0.0));
    let plate = |z: f64, x: f64, half: [f64; 2]| section(z, [x, side * 0.004], half, 0.009);
    let shank = |z: f64, x: f64, half: [f64; 2]| section(z, [x, 0.0], half, 0.006);
    let arm = |y: f64| section(side * y, [0.0, 0.0], [0.032, 0.034], 0.012);
    // From the hip joint to the thigh, whatever their distance.
    let mut arms = [arm(0.0), arm(out.max(0.01))];
    arms.sort_by(|one, other| one.along.total_cmp(&other.along));
    let foot = robot.foot_centre;
    // Places along the shank, as shares of its length.
    let down = |share: f64| -share * foot.length() / scale;
    vec![
        cylinder(hip, MOTOR, scale * 0.044, [-0.037, 0.037].map(|x| scale * DVec3::new(x, 0.0, 0.0))),
        loft(hip, PLASTIC, Axis::Y, scale, &arms),
        cylinder(hip, MOTOR, scale * 0.049, across(out - 0.052, out - 0.014)),
        cylinder(thigh, MOTOR, scale * 0.048, across(-0.012, 0.042)),
        cylinder(thigh, STEEL, scale * 0.030, across(0.042, 0.046)),
        loft(
            thigh,
            SHELL,
            Axis::Z,
            scale,
            &[
                plate(-GO2_THIGH - 0.014, 0.0, [0.013, 0.013]),
                plate(-GO2_THIGH + 0.01, -0.001, [0.019, 0.015]),
                plate(-0.11, -0.003, [0.034, 0.019]),
                plate(-0.03, -0.006, [0.044, 0.021]),
                plate(0.02, 0.0, [0.036, 0.021]),
            ],
        ),
        cylinder(calf, MOTOR, scale * 0.021, across(-0.020, 0.024)),
        loft(
            calf,
            PLASTIC,
            Axis::Z,
            scale,
            &[
                shank(down(0.56), 0.012, [0.010, 0.009]),
                shank(down(0.09), 0.003, [0.017, 0.013]),
                shank(0.012, -0.002, [0.013, 0.012]),
            ],
        ),
        loft(
            calf,
            PLASTIC,
            Axis::Z,
            scale,
            &[shank(down(0.96), foot.x / scale, [0.009, 0.009]), shank(down(0.54), 0.012, [0.010, 0.009])],
        ),
        sphere(calf, RUBBER, robot.foot_radius, foot),
    ]
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use proptest::prelude::*;

    use super::*;
    use crate::go2;

    /// A robot with legs, hips and shanks of other proportions.
    fn stretched(trunk: f64, out: f64, thigh: f64, shank: f64) -> RobotModel {
        let mut robot = go2();
        for leg in &mut robot.legs {
            leg.origins[0] *= trunk;
            leg.origins[1].y *= out;
            leg.origins[2] *= thigh;
        }
        robot.shapes.foot_centre *= shank;
        robot
    }

    proptest! {
        #[test]
        fn every_part_is_convex_and_its_faces_look_outwards(
            trunk in 0.5..2.0, out in 0.0..2.0, thigh in 0.5..2.0, shank in 0.5..2.0
        ) {
            let robot = stretched(trunk, out, thigh, shank);
            for mesh in look(&robot).iter().filter_map(|part| part.mesh.as_ref()) {
                let points: Vec<Vec3> = mesh.points.iter().copied().map(Vec3::from).collect();
                for face in &mesh.faces {
                    let [a, b, c] = face.map(|point| points[usize::from(point)]);
                    let normal = (b - a).cross(c - a).normalize();
                    prop_assert!(normal.dot(a) > 0.0, "{face:?} looks inwards");
                    for point in &points {
                        prop_assert!(normal.dot(*point - a) < 1e-5, "{point} is outside of {face:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn another_robot_has_its_own_parts() {
        let (small, mut large) = (go2(), go2());
        large.shapes.foot_radius *= 2.0;
        let radius = |robot: &RobotModel| look(robot).last().expect("a foot").size[0];
        for _ in 0..2 {
            assert_eq!(radius(&large), 2.0 * radius(&small));
        }
    }

    #[test]
    fn feet_and_knees_are_where_the_model_has_them() {
        let robot = go2();
        let parts = look(&robot);
        for leg in 0..4_u32 {
            let of_calf: Vec<_> = parts.iter().filter(|part| part.body == 3 + 3 * leg).collect();
            let centre = |part: &SceneShape| Vec3::from_slice(&part.offset[..3]);
            let foot = robot.shapes.foot_centre.as_vec3();
            assert!(of_calf.iter().any(|part| (centre(part) - foot).length() < 1e-6));
            assert!(of_calf.iter().any(|part| centre(part).length() < 0.01), "the knee is at the origin of the calf");
        }
    }
}
