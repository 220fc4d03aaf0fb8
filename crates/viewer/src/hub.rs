//! Between a program and the pages that look at it.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use serde::Deserialize;
use tokio::sync::watch;

use crate::frame::{Frame, LearningPoint, SceneInfo};

/// Time between two frames.
const PERIOD: Duration = Duration::from_micros(33_333);
/// Number of requests that wait for the program; further ones are dropped.
const CAPACITY: usize = 64;

/// What a page asks for.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum PageRequest {
    /// Stand still, or go on.
    Pause(bool),
    /// Play at this speed, 1 for real time.
    Speed(f64),
    /// Go to this time [s].
    Seek(f64),
    /// Walk with this velocity: forward [m/s], left [m/s], yaw rate [rad/s].
    Velocity([f32; 3]),
    /// Push a robot: its number, and the change of its velocity in the world frame [m/s].
    Push {
        /// Number of the robot.
        robot: usize,
        /// Change of velocity [m/s].
        velocity: [f32; 3],
    },
    /// Begin a new episode.
    Reset,
}

/// Newest frame, and the requests of the pages.
pub struct Hub {
    scene: SceneInfo,
    latest: watch::Sender<Bytes>,
    published: Mutex<Option<Instant>>,
    /// Number of the environments that are shown.
    shown: AtomicU64,
    requests: Mutex<VecDeque<PageRequest>>,
    /// Newest velocity that a page asked for, with the time when it came.
    velocity: Mutex<Option<(Instant, [f32; 3])>>,
    /// The learning curve since the beginning of the training.
    learning: Mutex<Vec<LearningPoint>>,
}

impl Hub {
    /// Returns a hub without a frame.
    pub fn new(scene: SceneInfo) -> Self {
        let latest = watch::Sender::new(Bytes::new());
        Self {
            scene,
            latest,
            published: Mutex::default(),
            shown: AtomicU64::new(0),
            requests: Mutex::default(),
            velocity: Mutex::default(),
            learning: Mutex::default(),
        }
    }

    /// Returns a number for environments that are shown from now on, in place of earlier ones.
    pub(crate) fn take_over(&self) -> u64 {
        self.shown.fetch_add(1, Ordering::AcqRel) + 1
    }

    /// Returns true if the environments with this number are shown.
    pub(crate) fn shows(&self, number: u64) -> bool {
        self.shown.load(Ordering::Acquire) == number
    }

    /// Returns what stays the same.
    pub fn scene(&self) -> &SceneInfo {
        &self.scene
    }

    /// Returns the number of readers of frames, which are pages and other programs.
    pub fn pages(&self) -> usize {
        self.latest.receiver_count()
    }

    /// Returns true if a page is open and the last frame is old enough. Cheap enough for every step.
    pub fn is_due(&self) -> bool {
        self.pages() > 0 && {
            let published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
            published.is_none_or(|at| at.elapsed() >= PERIOD)
        }
    }

    /// Shows a frame. Never waits for a page.
    pub fn publish(&self, frame: &Frame) {
        *self.published.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
        self.latest.send_replace(frame.to_bytes());
    }

    /// Shows a frame of another program. Returns false if its lengths are wrong.
    pub fn forward(&self, frame: &[u8]) -> bool {
        let word =
            |at: usize| frame.get(at..at + 4).map(|bytes| u32::from_le_bytes(bytes.try_into().unwrap_or_default()));
        let (all, header) = (word(0).map(|all| all as usize), word(4).map(|header| header as usize));
        let is_valid = all.is_some_and(|all| all + 8 == frame.len()) && header <= all;
        if is_valid {
            self.latest.send_replace(Bytes::copy_from_slice(frame));
        }
        is_valid
    }

    /// Adds points to the learning curve.
    pub fn add_learning(&self, points: impl IntoIterator<Item = LearningPoint>) {
        self.learning.lock().unwrap_or_else(PoisonError::into_inner).extend(points);
    }

    /// Returns the points of the learning curve from this index on.
    pub(crate) fn learning_from(&self, index: usize) -> Vec<LearningPoint> {
        let points = self.learning.lock().unwrap_or_else(PoisonError::into_inner);
        points.get(index..).unwrap_or_default().to_vec()
    }

    /// Returns the newest velocity that a page asked for since the last call, with the time when it came.
    pub fn take_velocity(&self) -> Option<(Instant, [f32; 3])> {
        self.velocity.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Returns the other requests of the pages since the last call.
    pub fn take_requests(&self) -> Vec<PageRequest> {
        self.requests.lock().unwrap_or_else(PoisonError::into_inner).drain(..).collect()
    }

    /// Adds the request of a page. Returns false if too many wait, or if the scene has no such control.
    ///
    /// A velocity replaces the one before it, so that the last one is never refused.
    pub(crate) fn request(&self, request: PageRequest) -> bool {
        if let PageRequest::Velocity(velocity) = request {
            let is_taken = self.scene.velocity_bounds.is_some() && velocity.iter().all(|part| part.is_finite());
            if is_taken {
                *self.velocity.lock().unwrap_or_else(PoisonError::into_inner) = Some((Instant::now(), velocity));
            }
            return is_taken;
        }
        let mut requests = self.requests.lock().unwrap_or_else(PoisonError::into_inner);
        let is_taken = self.scene.is_interactive && requests.len() < CAPACITY;
        if is_taken {
            requests.push_back(request);
        }
        is_taken
    }

    /// Returns a reader of frames, which sees the newest one.
    pub fn subscribe(&self) -> watch::Receiver<Bytes> {
        self.latest.subscribe()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use twinstep_model::{Ground, Pose, Scene, go2};

    #[test]
    fn newest_velocity_is_kept_however_many_came_before() {
        let robot = go2();
        let pose = robot.control.default_pose_f32();
        let scene = Scene::new(&robot, Pose::IDENTITY, &pose, &Ground::FLAT);
        let info = SceneInfo::new("run", &scene, &robot);
        let hub = Hub::new(SceneInfo { velocity_bounds: Some([[-1.0, 1.0]; 3]), ..info });
        for _ in 0..2 * CAPACITY {
            assert!(hub.request(PageRequest::Velocity([1.0, 0.0, 0.0])));
        }
        assert!(hub.request(PageRequest::Velocity([0.0; 3])));
        assert!(!hub.request(PageRequest::Velocity([f32::NAN; 3])) && !hub.request(PageRequest::Reset));
        assert_eq!(hub.take_velocity().map(|(_, velocity)| velocity), Some([0.0; 3]));
        assert!(hub.take_velocity().is_none() && hub.take_requests().is_empty());
    }

    #[test]
    fn frame_of_another_program_is_shown_if_its_lengths_are_right() {
        let robot = go2();
        let scene = Scene::new(&robot, Pose::IDENTITY, &robot.control.default_pose_f32(), &Ground::FLAT);
        let hub = Hub::new(SceneInfo::new("view", &scene, &robot));
        let mut reader = hub.subscribe();
        let frame = Frame { time: 2.0, ..Frame::default() }.to_bytes();
        assert!(hub.forward(&frame));
        assert_eq!(*reader.borrow_and_update(), frame);
        for bad in [&frame[..frame.len() - 1], &frame[..3], &[], &[0, 0, 0, 0, 1, 0, 0, 0]] {
            assert!(!hub.forward(bad), "{bad:?}");
        }
        assert!(!reader.has_changed().expect("the hub is there"));
    }
}
