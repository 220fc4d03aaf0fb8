//! `twinstep view ENDPOINT`: the robots of another process.

use std::sync::Arc;
use std::time::{Duration, Instant};

use twinstep_client::{ConnectOptions, RobotWatch};
use twinstep_viewer::SceneInfo;

use twinstep_workflows::Observer;

use crate::exit::{CommandResult, Failure, other};
use crate::web_view::PageArgs;

/// Beginnings of Zenoh endpoints.
const PROTOCOLS: [&str; 4] = ["tcp/", "tls/", "quic/", "udp/"];
/// Time between two looks for pages.
const TICK: Duration = Duration::from_millis(50);
/// Time between two looks for the server.
const CHECK_PERIOD: Duration = Duration::from_secs(2);

/// Returns true if the target of `twinstep view` is an endpoint.
pub fn is_endpoint(target: &str) -> bool {
    PROTOCOLS.iter().any(|protocol| target.starts_with(protocol))
}

/// Shows the robots until a signal or the end of their server. The server draws only while a page is open.
pub fn run(options: &ConnectOptions, page: &PageArgs, observer: &Observer) -> CommandResult {
    let watch = RobotWatch::open(options).map_err(other)?;
    let scene: SceneInfo = serde_json::from_slice(&watch.scene().map_err(other)?)
        .map_err(|error| text(&format!("the scene of `{}` is not valid: {error}", watch.robot())))?;
    let title = format!("{} at {}", scene.title, options.endpoint);
    let page =
        page.open(SceneInfo { title, is_interactive: false, is_learning: false, velocity_bounds: None, ..scene })?;
    let (mut frames, mut checked) = (None, Instant::now());
    while !observer.check()? {
        if page.hub().pages() == 0 {
            frames = None;
        } else if frames.is_none() {
            let hub = Arc::clone(page.hub());
            let show = move |frame: &[u8]| {
                if !hub.forward(frame) {
                    tracing::debug!(bytes = frame.len(), "a frame with wrong lengths");
                }
            };
            frames = Some(watch.frames(show).map_err(other)?);
        }
        if checked.elapsed() >= CHECK_PERIOD {
            if !watch.server_is_visible() {
                return Err(text(&format!("the server of `{}` at {} has ended", watch.robot(), options.endpoint)));
            }
            checked = Instant::now();
        }
        std::thread::sleep(TICK);
    }
    Ok(())
}

fn text(message: &str) -> Failure {
    Failure::Other(miette::miette!("{message}"))
}
