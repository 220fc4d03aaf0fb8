//! A film strip as SVG: one robot from its left side at several times. The camera follows its base.

use std::fmt::Write;

use glam::{Quat, Vec2, Vec3};
use twinstep_model::{Pose, Scene, SceneShape, ShapeKind};

/// Width and height of a frame [px].
const FRAME: [f32; 2] = [230.0, 180.0];
/// Scale [px/m].
const SCALE: f32 = 260.0;
/// Frames in a row.
const COLUMNS: usize = 5;

/// Returns the film strip. Each frame has its time [s].
pub fn film_strip(frames: &[(f64, Scene)]) -> String {
    let rows = frames.len().div_ceil(COLUMNS).max(1);
    let (width, height) = (FRAME[0] * COLUMNS.min(frames.len().max(1)) as f32, FRAME[1] * rows as f32);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"13\">\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n"
    );
    for (index, (time, scene)) in frames.iter().enumerate() {
        let corner = [FRAME[0] * (index % COLUMNS) as f32, FRAME[1] * (index / COLUMNS) as f32];
        let _ = write!(svg, "<g transform=\"translate({:.0} {:.0})\">", corner[0], corner[1]);
        frame(&mut svg, *time, scene);
        svg += "</g>\n";
    }
    svg + "</svg>\n"
}

fn frame(svg: &mut String, time: f64, scene: &Scene) {
    let base = pose(&scene.pose[0]);
    let heading = base.rotation * Vec3::X;
    let forward = Vec3::new(heading.x, heading.y, 0.0).normalize_or(Vec3::X);
    let ground = scene.ground.height(base.position.x, base.position.y);
    let view = View { centre: base.position, forward, ground };
    let floor = view.project(Vec3::new(base.position.x, base.position.y, ground)).y;
    let _ = write!(
        svg,
        "<path d=\"M4 {floor:.1}H{:.1}\" stroke=\"#a8a8a8\" stroke-width=\"2\"/>\
         <text x=\"8\" y=\"18\" fill=\"#262626\">{time:.2} s</text>",
        FRAME[0] - 4.0
    );
    if let Some([x, y, yaw]) = scene.command {
        let _ = write!(
            svg,
            "<text x=\"8\" y=\"{:.0}\" fill=\"#737373\">{x:.1}, {y:.1} m/s, {yaw:.1} rad/s</text>",
            FRAME[1] - 6.0
        );
    }
    // The viewer is on the left: far shapes first.
    let left = Vec3::Z.cross(forward);
    let mut shapes: Vec<&SceneShape> = scene.shapes.iter().collect();
    let depth = |shape: &SceneShape| world_from_shape(scene, shape).position.dot(left);
    shapes.sort_by(|one, other| depth(one).total_cmp(&depth(other)));
    for shape in shapes {
        let is_far = depth(shape) < base.position.dot(left) - 0.05;
        draw(svg, &view, &world_from_shape(scene, shape), shape, &colour(shape, is_far));
    }
}

/// Returns the colour of a shape; legs on the far side are paler.
fn colour(shape: &SceneShape, is_far: bool) -> String {
    let own = shape.colour.unwrap_or(if shape.body == 0 { [0.25; 3] } else { [1.0, 0.42, 0.07] });
    let [red, green, blue] =
        own.map(|part| (255.0 * if is_far { 0.5 + 0.5 * part } else { part }).round().clamp(0.0, 255.0) as u8);
    format!("#{red:02x}{green:02x}{blue:02x}")
}

/// A camera at the side of the robot.
struct View {
    centre: Vec3,
    forward: Vec3,
    ground: f32,
}

impl View {
    /// Returns the position of a point in the frame [px].
    fn project(&self, point: Vec3) -> Vec2 {
        let along = (point - self.centre).dot(self.forward);
        Vec2::new(0.5 * FRAME[0] + SCALE * along, FRAME[1] - 34.0 - SCALE * (point.z - self.ground))
    }
}

fn draw(svg: &mut String, view: &View, pose: &Pose, shape: &SceneShape, colour: &str) {
    let [x, y, _] = shape.size;
    match shape.kind {
        ShapeKind::Sphere => {
            let centre = view.project(pose.position);
            let _ = write!(
                svg,
                "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{:.1}\" fill=\"{colour}\"/>",
                centre.x,
                centre.y,
                SCALE * x
            );
        }
        ShapeKind::Capsule => {
            let [from, to] = [-y, y].map(|along| view.project(pose.transform(Vec3::new(0.0, 0.0, along))));
            let _ = write!(
                svg,
                "<path d=\"M{:.1} {:.1}L{:.1} {:.1}\" stroke=\"{colour}\" stroke-width=\"{:.1}\" \
                 stroke-linecap=\"round\"/>",
                from.x,
                from.y,
                to.x,
                to.y,
                2.0 * SCALE * x
            );
        }
        ShapeKind::Box | ShapeKind::Cylinder | ShapeKind::Convex => {
            let hull =
                convex_hull(corners(shape).into_iter().map(|corner| view.project(pose.transform(corner))).collect());
            let points: Vec<String> = hull.iter().map(|point| format!("{:.1},{:.1}", point.x, point.y)).collect();
            let _ = write!(
                svg,
                "<polygon points=\"{}\" fill=\"{colour}\" stroke=\"#20242b\" stroke-width=\"0.5\"/>",
                points.join(" ")
            );
        }
    }
}

/// Returns points in the frame of the shape whose convex hull is the shape [m].
fn corners(shape: &SceneShape) -> Vec<Vec3> {
    let [x, y, z] = shape.size;
    let signs = [-1.0_f32, 1.0];
    match (&shape.mesh, shape.kind) {
        (Some(mesh), _) => mesh.points.iter().copied().map(Vec3::from).collect(),
        (None, ShapeKind::Cylinder) => {
            let rim = (0..24).map(|side| Vec2::from_angle(side as f32 * std::f32::consts::TAU / 24.0) * x);
            rim.flat_map(|point| signs.map(|end| point.extend(end * y))).collect()
        }
        _ => signs
            .iter()
            .flat_map(|i| signs.iter().flat_map(move |j| signs.map(|k| Vec3::new(i * x, j * y, k * z))))
            .collect(),
    }
}

fn pose(values: &[f32; 7]) -> Pose {
    let [x, y, z, w, i, j, k] = *values;
    Pose { position: Vec3::new(x, y, z), rotation: Quat::from_xyzw(i, j, k, w) }
}

fn world_from_shape(scene: &Scene, shape: &SceneShape) -> Pose {
    let (body, offset) = (pose(&scene.pose[shape.body as usize]), pose(&shape.offset));
    Pose { position: body.transform(offset.position), rotation: body.rotation * offset.rotation }
}

/// Returns the corners of the convex hull (Andrew's monotone chain).
fn convex_hull(mut points: Vec<Vec2>) -> Vec<Vec2> {
    points.sort_by(|one, other| one.x.total_cmp(&other.x).then(one.y.total_cmp(&other.y)));
    let half = |points: &mut dyn Iterator<Item = Vec2>| {
        let mut chain: Vec<Vec2> = Vec::new();
        for point in points {
            while chain.len() > 1 {
                let [.., before, last] = chain[..] else { unreachable!("two points") };
                if (last - before).perp_dot(point - before) > 0.0 {
                    break;
                }
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut points.iter().copied());
    hull.extend(half(&mut points.iter().rev().copied()));
    hull
}

#[cfg(test)]
mod tests {
    use twinstep_model::{Ground, go2};

    use super::*;

    #[test]
    fn every_frame_has_its_time_and_every_shape() {
        let robot = go2();
        let base = Pose { position: Vec3::new(5.0, 2.0, 0.3), rotation: Quat::from_rotation_z(1.0) };
        let scene = Scene::new(&robot, base, &robot.control.default_pose_f32(), &Ground::FLAT);
        let shapes = scene.shapes.len();
        let svg = film_strip(&[(0.0, scene.clone()), (0.5, scene)]);
        assert!(svg.contains(">0.00 s<") && svg.contains(">0.50 s<"));
        let drawn = svg.matches("<circle").count() + svg.matches("<polygon").count() + svg.matches("round").count();
        assert_eq!(drawn, 2 * shapes);
        assert!(!svg.contains("NaN"));
    }

    #[test]
    fn hull_of_a_square_with_a_point_inside_has_four_corners() {
        let corners = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (1.0, 1.0)];
        let hull = convex_hull(corners.map(|(x, y)| Vec2::new(x, y)).to_vec());
        assert_eq!(hull.len(), 4);
        assert!(!hull.contains(&Vec2::ONE));
    }
}
