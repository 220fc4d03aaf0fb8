//! The robot of `twinstep run` in the browser, with sliders for its velocity.

use std::cell::Cell;
use std::sync::Arc;
use std::time::{Duration, Instant};

use twinstep_agent::Status;
use twinstep_model::{EnvSpec, VecEnv, go2};
use twinstep_viewer::{Frame, Hub, RobotFrame, SceneInfo};

use crate::exit::Failure;
use crate::velocity_input;
use crate::web_view::ViewArgs;
use twinstep_workflows::web_page::Page;

/// Time without a request of the page after which the robot is to stand. The page sends its velocity every 0.5 s.
const PAGE_IS_GONE: Duration = Duration::from_secs(2);

/// Page of the robot.
pub struct RunView {
    page: Page,
    /// Lowest and highest velocity of the sliders.
    bounds: Option<[[f32; 2]; 3]>,
    /// Velocity of the sliders, with the time when it came; `None` before they are moved.
    velocity: Cell<Option<(Instant, [f32; 3])>>,
}

impl RunView {
    /// Serves the page of `env`, which was reset, if there is to be one. It has sliders if `steers`.
    pub fn open(args: &ViewArgs, env: &dyn VecEnv, steers: bool) -> Result<Option<Self>, Failure> {
        if !args.is_wanted() {
            return Ok(None);
        }
        let scene = env.scene(0).map_err(|error| {
            Failure::Input(miette::miette!("`--view` has nothing to show: the endpoint gives no scene: {error}"))
        })?;
        let title = format!("twinstep run on {}", env.spec().robot);
        let bounds = if steers { slider_bounds(env.spec()) } else { None };
        let info = SceneInfo { velocity_bounds: bounds, ..SceneInfo::new(title, &scene, &go2()) };
        let page = args.serve(&Arc::new(Hub::new(info)))?;
        Ok(page.map(|page| Self { page, bounds, velocity: Cell::new(None) }))
    }

    /// Returns the velocity command of the sliders; `None` before they are moved. It is zero once the page is gone.
    pub fn velocity(&self) -> Option<[f32; 3]> {
        let (since, velocity) = self.velocity.get()?;
        let wanted = if since.elapsed() < PAGE_IS_GONE { velocity } else { [0.0; 3] };
        let bounds = self.bounds?;
        Some(std::array::from_fn(|axis| wanted[axis].clamp(bounds[axis][0], bounds[axis][1])))
    }

    /// Shows the robot before a step, and takes the requests of the page.
    pub fn show(&self, status: &Status, env: &dyn VecEnv) {
        let hub = self.page.hub();
        if let Some(asked) = hub.take_velocity() {
            self.velocity.set(Some(asked));
        }
        if hub.is_due()
            && let Ok(scene) = env.scene(0)
        {
            let (command, velocity) = (status.command, status.velocity);
            let robot = RobotFrame { command, velocity, ..RobotFrame::of_scene(&scene) };
            hub.publish(&Frame { time: status.seconds, robots: vec![robot], curves: curves(status), playback: None });
        }
    }
}

/// Returns the velocities that the keyboard has, within those of the endpoint; `None` if it has no velocity command.
fn slider_bounds(spec: &EnvSpec) -> Option<[[f32; 2]; 3]> {
    let (_, field) = spec.observation_field("velocity_command").filter(|(_, field)| field.size == 3)?;
    let bounds = velocity_input::limits().map(|[low, high]| [low.max(field.low), high.min(field.high)]);
    bounds.iter().all(|[low, high]| low <= high).then_some(bounds)
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
