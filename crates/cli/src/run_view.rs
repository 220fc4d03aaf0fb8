//! The robot of `twinstep run` in the browser, with sliders for its velocity.

use std::cell::Cell;

use twinstep_agent::Status;
use twinstep_model::{ResetRequest, VecEnv, go2};
use twinstep_viewer::{Frame, PageRequest, RobotFrame, SceneInfo};

use crate::exit::{Failure, other};
use crate::velocity_input;
use crate::web_view::{Page, ViewArgs};

/// Page of the robot.
pub struct RunView {
    page: Page,
    /// Velocity of the sliders; `None` before they are moved.
    velocity: Cell<Option<[f32; 3]>>,
}

impl RunView {
    /// Serves the page of `env`, which is reset, if there is to be one. It has sliders if `steers`.
    pub fn open(args: &ViewArgs, env: &mut dyn VecEnv, steers: bool) -> Result<Option<Self>, Failure> {
        if !args.is_wanted() {
            return Ok(None);
        }
        env.reset(&ResetRequest::default()).map_err(other)?;
        let scene = env.scene(0).map_err(|error| {
            Failure::Input(miette::miette!("`--view` has nothing to show: the endpoint gives no scene: {error}"))
        })?;
        let title = format!("twinstep run on {}", env.spec().robot);
        let has_command = env.spec().observation_field("velocity_command").is_some();
        let velocity_bounds = (steers && has_command).then(velocity_input::limits);
        let info = SceneInfo { velocity_bounds, ..SceneInfo::new(title, &scene, go2().torque_limits()) };
        let page = args.serve(info)?;
        Ok(page.map(|page| Self { page, velocity: Cell::new(None) }))
    }

    /// Returns the velocity command of the sliders; `None` before they are moved.
    pub fn velocity(&self) -> Option<[f32; 3]> {
        self.velocity.get()
    }

    /// Shows the robot before a step, and takes the requests of the page.
    pub fn show(&self, status: &Status, env: &dyn VecEnv) {
        let hub = self.page.hub();
        for request in hub.take_requests() {
            if let PageRequest::Velocity(velocity) = request
                && velocity.iter().all(|part| part.is_finite())
            {
                let limits = velocity_input::limits();
                let clamped = std::array::from_fn(|axis| velocity[axis].clamp(limits[axis][0], limits[axis][1]));
                self.velocity.set(Some(clamped));
            }
        }
        // A robot that cannot be seen for a moment walks on.
        if hub.is_due()
            && let Ok(scene) = env.scene(0)
        {
            let (command, velocity) = (status.command, status.velocity);
            let robot = RobotFrame { command, velocity, ..RobotFrame::of_scene(&scene) };
            hub.publish(&Frame { time: status.seconds, robots: vec![robot], curves: curves(status), playback: None });
        }
    }
}

fn curves(status: &Status) -> Vec<(String, f64)> {
    let mut curves = Vec::new();
    if let (Some(command), Some(velocity)) = (status.command, status.velocity) {
        curves.push(("forward [m/s]", f64::from(velocity[0])));
        curves.push(("error, forward [m/s]", f64::from(command[0] - velocity[0])));
    }
    curves.push(("falls", status.falls as f64));
    curves.push(("step time [ms]", 1e3 * status.step_time));
    curves.push(("lateness [ms]", 1e3 * status.lateness));
    curves.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}
