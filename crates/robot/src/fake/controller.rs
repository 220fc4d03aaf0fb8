//! The built-in controller and the services that start, stop and command it.

use std::time::Duration;

use twinstep_model::{Command, Joint, PerJoint};
use twinstep_unitree::{RpcRequest, RpcResponse};

use crate::trajectory::Trajectory;

/// Response code: the service has no such procedure.
const NOT_IMPLEMENTED: i32 = 3203;
/// Response code: a parameter is missing or wrong.
const WRONG_PARAMETER: i32 = 3204;
/// Names of the built-in controllers.
const NAMES: [&str; 4] = ["normal", "ai", "advanced", "mcf"];
/// Poses of every leg: hip, thigh, calf [rad].
const STANDING: [f32; 3] = [0.0, 0.67, -1.3];
const CROUCHED: [f32; 3] = [0.0, 1.36, -2.65];
/// Gains of the controller: position [N·m/rad], velocity [N·m·s/rad], velocity in damping.
const GAINS: [f32; 3] = [60.0, 5.0, 3.0];

/// The built-in controller.
#[derive(Clone, Debug)]
pub(super) struct Controller {
    /// Name of the active controller; `None` if it is released.
    name: Option<String>,
    /// Motion to a pose; `None` for damping.
    motion: Option<Trajectory>,
}

impl Controller {
    pub fn new(active: bool) -> Self {
        Self { name: active.then(|| "mcf".to_owned()), motion: None }
    }

    /// Returns true if the controller commands the motors.
    pub fn is_active(&self) -> bool {
        self.name.is_some()
    }

    /// Starts the controller, as the remote control does.
    pub fn activate(&mut self) {
        *self = Self::new(true);
    }

    /// Releases the controller.
    pub fn release(&mut self) {
        *self = Self::new(false);
    }

    /// Returns true if the controller holds or changes a pose.
    pub fn is_standing(&self) -> bool {
        self.motion.is_some()
    }

    /// Advances by `dt` and returns the controller's command.
    pub fn advance(&mut self, dt: Duration) -> Command {
        match &mut self.motion {
            Some(motion) => {
                motion.advance(dt);
                Command::hold(motion.pose(), GAINS[0], GAINS[1])
            }
            None => Command::hold([0.0; 12], 0.0, GAINS[2]),
        }
    }

    /// Answers a request to a service. `q` are the measured joint positions [rad].
    pub fn answer(&mut self, service: &str, request: &RpcRequest, q: PerJoint) -> RpcResponse {
        let (code, data) = match self.execute(service, request, q) {
            Ok(data) => (0, data),
            Err(code) => (code, String::new()),
        };
        RpcResponse { id: request.id, api_id: request.api_id, code, data, binary: Vec::new() }
    }

    fn execute(&mut self, service: &str, request: &RpcRequest, q: PerJoint) -> Result<String, i32> {
        match (service, request.api_id) {
            ("motion_switcher", 1001) => {
                let name = self.name.as_deref().unwrap_or_default();
                return Ok(serde_json::json!({ "form": "0", "name": name }).to_string());
            }
            ("motion_switcher", 1002) => {
                let parameter: serde_json::Value =
                    serde_json::from_str(&request.parameter).map_err(|_| WRONG_PARAMETER)?;
                let name = parameter["name"].as_str().filter(|name| NAMES.contains(name)).ok_or(WRONG_PARAMETER)?;
                *self = Self { name: Some(name.to_owned()), motion: None };
            }
            ("motion_switcher", 1003) => self.release(),
            // A released controller does not move the robot.
            ("sport", 1001 | 1004 | 1005) if self.name.is_none() => {}
            ("sport", 1001) => self.motion = None,
            ("sport", 1004) => {
                self.motion = Some(motion(q, &[(CROUCHED, 1), (STANDING, 1)]));
            }
            ("sport", 1005) => self.motion = Some(motion(q, &[(CROUCHED, 2)])),
            _ => return Err(NOT_IMPLEMENTED),
        }
        Ok("{}".to_owned())
    }
}

/// Returns a motion through poses of every leg, each with the time to reach it [s].
fn motion(start: PerJoint, poses: &[([f32; 3], u64)]) -> Trajectory {
    let pose = |([hip, thigh, calf], seconds): &([f32; 3], u64)| {
        (Joint::map_kinds(*hip, *thigh, *calf), Duration::from_secs(*seconds))
    };
    Trajectory::new(start, poses.iter().map(pose).collect())
}
