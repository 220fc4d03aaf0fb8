//! What a server shows to those who look at its robots: a scene and frames, without a lease.

use twinstep_protocol::keys;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

/// Publishes the scene and the frames of a server's robots to those who have subscribed.
///
/// A subscriber that does not read loses frames. It delays neither the robots nor the replies to other requests.
pub struct FramePublisher {
    scene: Publisher<'static>,
    frames: Publisher<'static>,
}

impl FramePublisher {
    pub(crate) fn declare(session: &Session, sid: &str) -> zenoh::Result<Self> {
        let publisher = |key: String| {
            let publisher = session.declare_publisher(key).congestion_control(CongestionControl::Drop);
            publisher.priority(Priority::Background).wait()
        };
        Ok(Self { scene: publisher(keys::scene(sid))?, frames: publisher(keys::frame(sid))? })
    }

    /// Returns true if somebody has subscribed to the scene.
    pub fn is_scene_wanted(&self) -> bool {
        is_matched(&self.scene)
    }

    /// Returns true if somebody has subscribed to the frames.
    pub fn is_frame_wanted(&self) -> bool {
        is_matched(&self.frames)
    }

    /// Sends what stays the same in every frame, as JSON.
    pub fn send_scene(&self, json: &[u8]) {
        send(&self.scene, json);
    }

    /// Sends a frame.
    pub fn send_frame(&self, frame: &[u8]) {
        send(&self.frames, frame);
    }
}

fn is_matched(publisher: &Publisher<'_>) -> bool {
    publisher.matching_status().wait().is_ok_and(|status| status.matching())
}

fn send(publisher: &Publisher<'_>, payload: &[u8]) {
    if let Err(error) = publisher.put(payload).wait() {
        tracing::debug!(%error, "a frame was not sent");
    }
}
