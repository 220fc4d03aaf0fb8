//! Scene and poses as Foxglove's messages.

use twinstep_model::{SceneShape, ShapeKind};

use super::protobuf::Message;
use crate::frame::{Frame, Heights, SceneInfo};

/// Frame of the world.
const WORLD: &str = "world";
/// Colours (red, green, blue, opacity) of robot, simulation of a log, and ground.
const ROBOT: [f64; 4] = [0.78, 0.79, 0.82, 1.0];
const GHOST: [f64; 4] = [0.25, 0.5, 1.0, 0.5];
const GROUND: [f64; 4] = [0.35, 0.38, 0.4, 1.0];
/// Half side and thickness of level ground [m].
const GROUND_SIZE: [f64; 2] = [50.0, 0.01];

/// Returns the bytes of a `foxglove.FrameTransforms` with the pose of every body.
pub fn transforms(scene: &SceneInfo, frame: &Frame) -> Vec<u8> {
    let mut all = Message::default();
    for (index, robot) in frame.robots.iter().enumerate() {
        for (prefix, poses) in [("robot", &robot.poses), ("ghost", &robot.ghost)] {
            // Rows of a log that are not simulated have no ghost.
            let known = scene.bodies.iter().zip(poses).filter(|(_, pose)| pose.iter().all(|part| part.is_finite()));
            for (body, pose) in known {
                let transform = Message::default()
                    .message(1, timestamp(frame.time))
                    .text(2, WORLD)
                    .text(3, &format!("{prefix}_{index}/{body}"));
                all = all.message(1, with_pose(transform, [4, 5], pose));
            }
        }
    }
    all.into_bytes()
}

/// Returns the bytes of a `foxglove.SceneUpdate` with the shapes of every body and the ground.
pub fn scene(scene: &SceneInfo, frame: &Frame) -> Vec<u8> {
    let mut all = Message::default();
    for index in 0..frame.robots.len() {
        for (body, name) in scene.bodies.iter().enumerate() {
            let shapes: Vec<_> = scene.shapes.iter().filter(|shape| shape.body as usize == body).collect();
            for (prefix, colour) in [("robot", ROBOT), ("ghost", GHOST)] {
                if prefix == "robot" || scene.has_ghost {
                    let id = format!("{prefix}_{index}/{name}");
                    let entity = entity(frame.time, &id, &id);
                    all = all.message(2, shapes.iter().fold(entity, |entity, shape| add(entity, shape, colour)));
                }
            }
        }
    }
    let ground = entity(frame.time, WORLD, "ground");
    let ground = match &scene.heights {
        None => cuboid(
            ground,
            &[0.0, 0.0, -0.5 * GROUND_SIZE[1] as f32, 1.0, 0.0, 0.0, 0.0],
            [2.0 * GROUND_SIZE[0], 2.0 * GROUND_SIZE[0], GROUND_SIZE[1]],
            GROUND,
        ),
        Some(heights) => ground.message(12, height_field(heights)),
    };
    all.message(2, ground).into_bytes()
}

/// Returns a `foxglove.SceneEntity` that moves with a frame and lasts for the whole recording.
fn entity(time: f64, frame_id: &str, id: &str) -> Message {
    Message::default().message(1, timestamp(time)).text(2, frame_id).text(3, id).integer(5, 1)
}

/// Adds a shape to an entity, in its own colour if it has one. A capsule is a cylinder with a sphere at each end.
fn add(entity: Message, shape: &SceneShape, colour: [f64; 4]) -> Message {
    let [a, b, c] = shape.size.map(f64::from);
    let colour = match (shape.colour, colour == GHOST) {
        (Some([red, green, blue]), false) => [red, green, blue, 1.0].map(f64::from),
        _ => colour,
    };
    match shape.kind {
        ShapeKind::Box => cuboid(entity, &shape.offset, [2.0 * a, 2.0 * b, 2.0 * c], colour),
        ShapeKind::Sphere => sphere(entity, &shape.offset, a, colour),
        ShapeKind::Cylinder => cylinder(entity, &shape.offset, [a, b], colour),
        ShapeKind::Capsule => {
            let ends = [1.0, -1.0].map(|side| end_of_capsule(&shape.offset, side * shape.size[1]));
            let entity = cylinder(entity, &shape.offset, [a, b], colour);
            ends.iter().fold(entity, |entity, end| sphere(entity, end, a, colour))
        }
        ShapeKind::Convex => match &shape.mesh {
            Some(mesh) => {
                let points = mesh.points.iter().map(|point| point.map(f64::from));
                let indices: Vec<u32> = mesh.faces.iter().flatten().copied().map(u32::from).collect();
                entity.message(12, triangles(&shape.offset, points, &indices, colour))
            }
            None => entity,
        },
    }
}

/// Adds a cylinder of this radius and half length.
fn cylinder(entity: Message, pose: &[f32; 7], [radius, half_length]: [f64; 2], colour: [f64; 4]) -> Message {
    let cylinder = primitive(pose, [2.0 * radius, 2.0 * radius, 2.0 * half_length]);
    entity.message(10, cylinder.with_number(3, 1.0).with_number(4, 1.0).message(5, numbers(colour)))
}

/// Returns the pose `offset`, moved along its z axis by `distance` [m].
fn end_of_capsule(offset: &[f32; 7], distance: f32) -> [f32; 7] {
    let [x, y, z, qw, qx, qy, qz] = *offset;
    // Third column of the rotation matrix.
    let axis = [2.0 * (qx * qz + qw * qy), 2.0 * (qy * qz - qw * qx), 1.0 - 2.0 * (qx * qx + qy * qy)];
    [x + distance * axis[0], y + distance * axis[1], z + distance * axis[2], qw, qx, qy, qz]
}

fn cuboid(entity: Message, pose: &[f32; 7], size: [f64; 3], colour: [f64; 4]) -> Message {
    entity.message(8, primitive(pose, size).message(3, numbers(colour)))
}

fn sphere(entity: Message, pose: &[f32; 7], radius: f64, colour: [f64; 4]) -> Message {
    entity.message(9, primitive(pose, [2.0 * radius; 3]).message(3, numbers(colour)))
}

/// Returns pose and size of a primitive.
fn primitive(pose: &[f32; 7], size: [f64; 3]) -> Message {
    Message::default().message(1, with_pose(Message::default(), [1, 2], pose)).message(2, numbers(size))
}

/// Returns a `foxglove.TriangleListPrimitive` of the ground.
fn height_field(field: &Heights) -> Message {
    let [rows, columns] = field.shape;
    let point = |index: usize| {
        let along = |index: usize, axis: usize| f64::from(field.origin[axis] + index as f32 * field.cell_size);
        [along(index / columns, 0), along(index % columns, 1), f64::from(field.heights[index])]
    };
    let mut indices = Vec::new();
    for row in 0..rows.saturating_sub(1) {
        for column in 0..columns.saturating_sub(1) {
            let corner = |down: usize, right: usize| ((row + down) * columns + column + right) as u32;
            indices.extend([corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 0), corner(1, 1), corner(0, 1)]);
        }
    }
    triangles(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (0..rows * columns).map(point), &indices, GROUND)
}

/// Returns a `foxglove.TriangleListPrimitive`.
fn triangles(pose: &[f32; 7], points: impl Iterator<Item = [f64; 3]>, indices: &[u32], colour: [f64; 4]) -> Message {
    let list = Message::default().message(1, with_pose(Message::default(), [1, 2], pose));
    let list = points.fold(list, |list, point| list.message(2, numbers(point)));
    list.message(3, numbers(colour)).fixed32s(5, indices)
}

/// Adds position and orientation to a message, in these fields.
fn with_pose(message: Message, fields: [u32; 2], pose: &[f32; 7]) -> Message {
    let [x, y, z, qw, qx, qy, qz] = pose.map(f64::from);
    message.message(fields[0], numbers([x, y, z])).message(fields[1], numbers([qx, qy, qz, qw]))
}

/// Returns a vector, quaternion or colour.
fn numbers<const N: usize>(values: [f64; N]) -> Message {
    Message::default().numbers(values)
}

/// Returns a `google.protobuf.Timestamp` [s].
fn timestamp(seconds: f64) -> Message {
    let nanoseconds = (seconds.max(0.0) * 1e9).round() as u64;
    Message::default().integer(1, nanoseconds / 1_000_000_000).integer(2, nanoseconds % 1_000_000_000)
}
