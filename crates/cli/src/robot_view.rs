//! The robot of `twinstep robot` in the browser.

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use twinstep_model::{Ground, InitialState, PerJoint, Pose, RobotModel, Scene, frames};
use twinstep_robot::{Board, RobotHandle};
use twinstep_viewer::{Frame, Hub, RobotFrame, SceneInfo};

use crate::exit::{Failure, other};
use crate::web_view::ViewArgs;
use twinstep_workflows::web_page::Page;

/// Time between two looks at the robot.
const PERIOD: Duration = Duration::from_millis(10);

/// The robot as its sensors see it, in every state and without clients, too. It is looked at only.
pub struct RobotView {
    hub: Arc<Hub>,
    thread: JoinHandle<()>,
    _page: Option<Page>,
}

impl RobotView {
    /// Shows the robot until [`RobotHandle::end`], also on a page, if there is to be one.
    pub fn start(args: &ViewArgs, robot: &RobotModel, handle: &RobotHandle) -> Result<Self, Failure> {
        let standing = scene(robot, &robot.control.default_pose_f32(), [1.0, 0.0, 0.0, 0.0]);
        let hub = Arc::new(Hub::new(SceneInfo::new("twinstep robot", &standing, robot)));
        let page = args.serve(&hub)?;
        let (robot, handle, shown) = (robot.clone(), handle.clone(), Arc::clone(&hub));
        let thread = std::thread::Builder::new().name("view".to_owned()).spawn(move || {
            while !handle.is_ending() {
                if shown.is_due() {
                    publish(&robot, &handle.board(), &shown);
                }
                std::thread::sleep(PERIOD);
            }
        });
        Ok(Self { hub, thread: thread.map_err(other)?, _page: page })
    }

    /// Returns what is shown.
    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }

    /// Waits for the end of its thread, which comes after [`RobotHandle::end`].
    pub fn join(self) {
        let _ = self.thread.join();
    }
}

fn publish(robot: &RobotModel, board: &Board, hub: &Hub) {
    let Some((arrived, reading)) = &board.reading else { return };
    let largest = reading.tau.iter().fold(0.0_f32, |largest, tau| largest.max(tau.abs()));
    let hottest = reading.temperature.iter().max().copied().unwrap_or_default();
    let curves = [
        ("age of the reading [ms]", 1e3 * board.now.saturating_sub(*arrived).as_secs_f64()),
        ("largest torque [N·m]", f64::from(largest)),
        ("hottest motor [°C]", f64::from(hottest)),
        ("tilt [rad]", f64::from(reading.tilt)),
        ("supply voltage [V]", f64::from(reading.voltage)),
    ];
    let scene = scene(robot, &reading.q, reading.orientation);
    let frame = RobotFrame { torque: Some(reading.tau.to_vec()), ..RobotFrame::of_scene(&scene) };
    hub.publish(&Frame {
        time: board.now.as_secs_f64(),
        robots: vec![frame],
        curves: curves.map(|(name, value)| (name.to_owned(), value)).to_vec(),
        playback: None,
    });
}

/// Returns the robot with its feet on level ground at the origin, because its position is not measured.
fn scene(robot: &RobotModel, q: &PerJoint, orientation: [f32; 4]) -> Scene {
    let position = InitialState::standing_on(&Ground::FLAT, robot, *q, 0.0).base_position;
    let pose = Pose { position: position.into(), rotation: frames::world_from_base(orientation) };
    Scene::new(robot, pose, q, &Ground::FLAT)
}
