//! Sends the frames of a hub to those who look at the robots of a server from elsewhere: `twinstep view ENDPOINT`.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use twinstep_env_server::FramePublisher;
use twinstep_viewer::Hub;

use crate::exit::{Failure, other};

/// Time between two looks for subscribers, and between two scenes.
const CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Time between two looks for a new frame.
const FRAME_PERIOD: Duration = Duration::from_millis(10);

/// A thread that sends scene and frames. Without subscribers it makes the hub draw nothing.
pub struct FrameFeed {
    running: Sender<()>,
    thread: JoinHandle<()>,
}

impl FrameFeed {
    /// Starts the thread.
    pub fn start(publisher: FramePublisher, hub: Arc<Hub>) -> Result<Self, Failure> {
        let (running, stopped) = channel();
        let thread = std::thread::Builder::new().name("frames".to_owned());
        let thread = thread.spawn(move || send(&publisher, &hub, &stopped)).map_err(other)?;
        Ok(Self { running, thread })
    }

    /// Ends the thread.
    pub fn stop(self) {
        drop(self.running);
        let _ = self.thread.join();
    }
}

fn send(publisher: &FramePublisher, hub: &Hub, stopped: &Receiver<()>) {
    // Numbers and names are always JSON.
    let scene = serde_json::to_vec(hub.scene()).unwrap_or_default();
    let (mut frames, mut checked) = (None, Instant::now());
    loop {
        let period = if frames.is_some() { FRAME_PERIOD } else { CHECK_PERIOD };
        if stopped.recv_timeout(period) != Err(RecvTimeoutError::Timeout) {
            return;
        }
        if checked.elapsed() >= CHECK_PERIOD {
            checked = Instant::now();
            if publisher.is_scene_wanted() {
                publisher.send_scene(&scene);
            }
            frames = publisher.is_frame_wanted().then(|| frames.unwrap_or_else(|| hub.subscribe()));
        }
        if let Some(frames) = &mut frames
            && frames.has_changed().unwrap_or(false)
        {
            let frame = frames.borrow_and_update().clone();
            publisher.send_frame(&frame);
        }
    }
}
