//! Plays a motion that is known from beginning to end.

use std::time::{Duration, Instant};

use twinstep_viewer::{Frame, Hub, PageRequest, Playback, RobotFrame};

use crate::failure::Failure;
use crate::observer::Observer;

/// Time between two looks at the requests.
const TICK: Duration = Duration::from_millis(10);
/// Frames per second of a file.
const FRAME_RATE: f64 = 30.0;
/// Slowest and fastest speed.
const SPEEDS: [f64; 2] = [0.05, 4.0];

/// Values of curves by their names.
pub type Curves = Vec<(String, f64)>;

/// A motion, and where its playback is.
pub struct Player {
    /// Time of each row [s].
    times: Vec<f64>,
    /// Returns the robot at a row, and the curves beside it.
    robot: Box<dyn Fn(usize) -> (RobotFrame, Curves)>,
    /// Time since the first row [s].
    time: f64,
    is_paused: bool,
    speed: f64,
}

impl Player {
    /// Returns a player at the first of these times [s], of which there is at least one.
    pub fn new(times: Vec<f64>, robot: impl Fn(usize) -> (RobotFrame, Curves) + 'static) -> Self {
        Self { times, robot: Box::new(robot), time: 0.0, is_paused: false, speed: 1.0 }
    }

    fn duration(&self) -> f64 {
        self.times[self.times.len() - 1] - self.times[0]
    }

    /// Plays until a signal, as the pages of `hub` ask.
    pub fn run(&mut self, hub: &Hub, observer: &Observer) -> Result<(), Failure> {
        let mut last = Instant::now();
        while !observer.check()? {
            for request in hub.take_requests() {
                self.obey(request);
            }
            let elapsed = last.elapsed().as_secs_f64();
            last = Instant::now();
            if !self.is_paused && hub.pages() > 0 {
                self.time = (self.time + self.speed * elapsed).min(self.duration());
                // The last row stays until somebody goes back.
                self.is_paused = self.time >= self.duration();
            }
            if hub.is_due() {
                hub.publish(&self.frame());
            }
            std::thread::sleep(TICK);
        }
        Ok(())
    }

    /// Returns the frames of the first seconds.
    pub fn motion(mut self, seconds: f64) -> Vec<Frame> {
        let count = (seconds.min(self.duration()) * FRAME_RATE).floor() as usize;
        let frame = |index| {
            self.time = index as f64 / FRAME_RATE;
            self.frame()
        };
        (0..=count).map(frame).collect()
    }

    fn obey(&mut self, request: PageRequest) {
        match request {
            PageRequest::Pause(is_paused) => {
                if !is_paused && self.time >= self.duration() {
                    self.time = 0.0;
                }
                self.is_paused = is_paused;
            }
            PageRequest::Speed(speed) if speed.is_finite() => self.speed = speed.clamp(SPEEDS[0], SPEEDS[1]),
            PageRequest::Seek(time) if time.is_finite() => self.time = time.clamp(0.0, self.duration()),
            _ => {}
        }
    }

    fn frame(&self) -> Frame {
        let row = self.times.partition_point(|time| *time <= self.times[0] + self.time).saturating_sub(1);
        let (robot, curves) = (self.robot)(row);
        let playback = Playback { duration: Some(self.duration()), is_paused: self.is_paused, speed: self.speed };
        Frame { time: self.time, robots: vec![robot], curves, playback: Some(playback) }
    }
}
