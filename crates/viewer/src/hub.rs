//! Between a program and the pages that look at it.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use serde::Deserialize;
use tokio::sync::watch;

use crate::frame::{Frame, SceneInfo};

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
}

impl Hub {
    /// Returns a hub without a frame.
    pub fn new(scene: SceneInfo) -> Self {
        let latest = watch::Sender::new(Bytes::new());
        Self { scene, latest, published: Mutex::default(), shown: AtomicU64::new(0), requests: Mutex::default() }
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

    /// Returns the number of pages that receive frames.
    pub fn pages(&self) -> usize {
        self.latest.receiver_count()
    }

    /// Returns true if a page is open and the last frame is old enough. Cheap enough for every step.
    pub fn is_due(&self) -> bool {
        let published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
        self.pages() > 0 && published.is_none_or(|at| at.elapsed() >= PERIOD)
    }

    /// Shows a frame. Never waits for a page.
    pub fn publish(&self, frame: &Frame) {
        *self.published.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
        self.latest.send_replace(frame.to_bytes());
    }

    /// Returns the requests of the pages since the last call.
    pub fn take_requests(&self) -> Vec<PageRequest> {
        self.requests.lock().unwrap_or_else(PoisonError::into_inner).drain(..).collect()
    }

    /// Adds the request of a page. Returns false if too many wait, or if the scene has no such control.
    pub(crate) fn request(&self, request: PageRequest) -> bool {
        let mut requests = self.requests.lock().unwrap_or_else(PoisonError::into_inner);
        let is_allowed = match request {
            PageRequest::Velocity(_) => self.scene.velocity_bounds.is_some(),
            _ => self.scene.is_interactive,
        };
        let is_taken = is_allowed && requests.len() < CAPACITY;
        if is_taken {
            requests.push_back(request);
        }
        is_taken
    }

    pub(crate) fn subscribe(&self) -> watch::Receiver<Bytes> {
        self.latest.subscribe()
    }
}
