//! Recording of robots as MCAP with Foxglove's schemas.

mod messages;
mod protobuf;

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use mcap::McapError;
use mcap::records::MessageHeader;
use serde_json::{Map, Value};

use crate::frame::{Frame, RobotFrame, SceneInfo};

/// Definitions of the messages: file descriptor sets of Protocol Buffers (`schema/`).
const SCENE_UPDATE: &[u8] = include_bytes!("schema/SceneUpdate.bin");
const FRAME_TRANSFORMS: &[u8] = include_bytes!("schema/FrameTransforms.bin");
/// Any JSON object: the names depend on what is shown.
const OBJECT: &[u8] = br#"{"type":"object"}"#;

/// Writes `frames` of `scene` as MCAP, compressed with Zstandard.
///
/// | topic | message |
/// |---|---|
/// | `/tf` | `foxglove.FrameTransforms`: pose of each body `robot_0/trunk` … in `world`; `ghost_0/…` is the simulation of a log |
/// | `/scene` | `foxglove.SceneUpdate`, once: the shapes of the bodies and the ground |
/// | `/robot_0` … | JSON: torque [N·m], contact force [N], commanded and actual velocity [m/s, rad/s] |
/// | `/curves` | JSON: the curves beside the scene |
pub fn write_mcap(target: impl Write + Seek, scene: &SceneInfo, frames: &[Frame]) -> Result<(), McapError> {
    let mut writer = mcap::WriteOptions::new().profile("").library("twinstep").create(target)?;
    let none = BTreeMap::new();
    let mut channel = |topic: &str, name: &str, encoding: &str, schema: &[u8]| {
        let data = if encoding == "json" { "jsonschema" } else { encoding };
        let schema = writer.add_schema(name, data, schema)?;
        writer.add_channel(schema, topic, encoding, &none)
    };
    let transforms = channel("/tf", "foxglove.FrameTransforms", "protobuf", FRAME_TRANSFORMS)?;
    let shapes = channel("/scene", "foxglove.SceneUpdate", "protobuf", SCENE_UPDATE)?;
    let curves = channel("/curves", "twinstep.Curves", "json", OBJECT)?;
    let count = frames.first().map_or(0, |frame| frame.robots.len());
    let robots = (0..count)
        .map(|robot| channel(&format!("/robot_{robot}"), "twinstep.Robot", "json", OBJECT))
        .collect::<Result<Vec<_>, _>>()?;
    let mut sequence = 0;
    let mut write = |channel_id: u16, seconds: f64, data: &[u8]| {
        let time = (seconds.max(0.0) * 1e9).round() as u64;
        sequence += 1;
        writer.write_to_known_channel(&MessageHeader { channel_id, sequence, log_time: time, publish_time: time }, data)
    };
    for (index, frame) in frames.iter().enumerate() {
        if index == 0 {
            write(shapes, frame.time, &messages::scene(scene, frame))?;
        }
        write(transforms, frame.time, &messages::transforms(scene, frame))?;
        for (channel, robot) in robots.iter().zip(&frame.robots) {
            write(*channel, frame.time, Value::Object(quantities(scene, robot)).to_string().as_bytes())?;
        }
        let values: Map<String, Value> =
            frame.curves.iter().map(|(name, value)| (name.clone(), (*value).into())).collect();
        write(curves, frame.time, Value::Object(values).to_string().as_bytes())?;
    }
    writer.finish().map(drop)
}

/// Returns the known quantities of a robot.
fn quantities(scene: &SceneInfo, robot: &RobotFrame) -> Map<String, Value> {
    let contacts: Vec<&str> = scene.contacts.iter().map(|contact| contact.name.as_str()).collect();
    let joints: Vec<&str> = scene.joints.iter().map(String::as_str).collect();
    let object = |names: &[&str], values: &[f32]| {
        let known = names.iter().zip(values).filter(|(_, value)| value.is_finite());
        Value::Object(known.map(|(name, value)| ((*name).to_owned(), f64::from(*value).into())).collect())
    };
    let curves: Vec<&str> = scene.robot_curves.iter().map(String::as_str).collect();
    let axes = ["forward", "left", "yaw_rate"];
    let known = [
        ("torque", robot.torque.as_ref().map(|values| object(&joints, values))),
        ("contact_force", robot.contact_force.as_ref().map(|values| object(&contacts, values))),
        ("velocity_command", robot.command.map(|values| object(&axes, &values))),
        ("velocity", robot.velocity.map(|values| object(&axes, &values))),
        ("curves", (!robot.curves.is_empty()).then(|| object(&curves, &robot.curves))),
    ];
    known.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))).collect()
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use twinstep_model::{Ground, JOINT_NAMES, Pose, Scene, go2};

    use super::*;

    #[test]
    fn recording_has_a_message_per_topic_and_frame_and_the_scene_once() {
        let robot = go2();
        let standing = Scene::new(&robot, Pose::IDENTITY, &robot.control.default_pose_f32(), &Ground::FLAT);
        let scene = SceneInfo::new("walk", &standing, &robot);
        let walker = RobotFrame { torque: Some(vec![1.5; 12]), ..RobotFrame::of_scene(&standing) };
        let frame = |time| Frame {
            time,
            robots: vec![walker.clone(); 2],
            curves: vec![("falls".to_owned(), 0.0)],
            playback: None,
        };
        let mut file = Cursor::new(Vec::new());
        write_mcap(&mut file, &scene, &[frame(0.0), frame(0.5)]).expect("written");
        let bytes = file.into_inner();
        let messages: Vec<_> =
            mcap::MessageStream::new(&bytes).expect("MCAP").map(|one| one.expect("a message")).collect();
        let topics: Vec<_> = messages.iter().map(|message| message.channel.topic.as_str()).collect();
        let of_frame = ["/tf", "/robot_0", "/robot_1", "/curves"];
        assert_eq!(topics, [&["/scene"][..], &of_frame, &of_frame].concat());
        assert_eq!(messages.last().expect("one").log_time, 500_000_000);
        let text: Value = serde_json::from_slice(&messages[2].data).expect("JSON");
        assert_eq!(
            text,
            serde_json::json!({ "torque": JOINT_NAMES.map(|name| (name, 1.5)).into_iter().collect::<BTreeMap<_, _>>() })
        );
        let schema = messages[0].channel.schema.as_ref().expect("a schema");
        assert_eq!((schema.name.as_str(), schema.encoding.as_str()), ("foxglove.SceneUpdate", "protobuf"));
    }
}
