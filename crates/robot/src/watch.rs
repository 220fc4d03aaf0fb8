//! Watches what else commands the robot: other writers of `rt/lowcmd`, and the built-in controller. Finds the readers of the
//! commands.
//!
//! Runs on its own thread, because a service may take long to answer.

use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use twinstep_unitree::{RpcRequest, RpcResponse, decode, encode};

use crate::dds::{
    Dds, DdsError, LOW_CMD, MOTION_SWITCHER_REQUEST, MOTION_SWITCHER_RESPONSE, Reader, SPORT_REQUEST, SPORT_RESPONSE,
    Topic, Writer,
};
use crate::robot_handle::RobotHandle;

/// Period at which the other writers are counted.
const PERIOD: Duration = Duration::from_millis(20);
/// Period at which the active controller is asked for.
const CHECK_PERIOD: Duration = Duration::from_millis(500);
/// Time after which a service counts as silent. The vendor's own timeout is 1 s.
const TIMEOUT: Duration = Duration::from_secs(1);

/// Motion switcher: returns the name of the active controller, empty for none.
const CHECK_MODE: i64 = 1001;
/// Motion switcher: releases the active controller.
const RELEASE_MODE: i64 = 1003;
/// Built-in controller: lies down.
const STAND_DOWN: i64 = 1005;

/// Starts to watch, until [`RobotHandle::end`].
pub fn start(dds: &Dds, handle: RobotHandle) -> Result<JoinHandle<()>, DdsError> {
    let dds = dds.clone();
    let (ready, is_ready) = std::sync::mpsc::channel();
    let thread = std::thread::Builder::new().name("watch".to_owned()).spawn(move || match Watch::new(dds, handle) {
        Ok(mut watch) => {
            let _ = ready.send(Ok(()));
            watch.run();
        }
        Err(error) => drop(ready.send(Err(error))),
    });
    let thread = thread.map_err(|error| DdsError::Join { domain: 0, reason: error.to_string() })?;
    is_ready.recv().unwrap_or(Ok(()))?;
    Ok(thread)
}

struct Watch {
    dds: Dds,
    handle: RobotHandle,
    motion_switcher: Service,
    sport: Service,
    next_check: Instant,
}

impl Watch {
    fn new(dds: Dds, handle: RobotHandle) -> Result<Self, DdsError> {
        let motion_switcher = Service::new(&dds, MOTION_SWITCHER_REQUEST, MOTION_SWITCHER_RESPONSE)?;
        let sport = Service::new(&dds, SPORT_REQUEST, SPORT_RESPONSE)?;
        Ok(Self { dds, handle, motion_switcher, sport, next_check: Instant::now() })
    }

    fn run(&mut self) {
        while !self.handle.is_ending() {
            look(&self.dds, &self.handle);
            if self.handle.take_release_request() {
                self.release();
            }
            if Instant::now() >= self.next_check {
                self.check_mode();
                self.next_check = Instant::now() + CHECK_PERIOD;
            }
            std::thread::sleep(PERIOD);
        }
    }

    /// Asks for the active controller. A service that does not answer changes nothing: a robot that is armed would fall.
    fn check_mode(&mut self) {
        let Some(response) = self.motion_switcher.call(CHECK_MODE, "{}", &self.dds, &self.handle) else { return };
        match active_controller(&response) {
            Some(name) => self.handle.set_controller_released(name.is_empty()),
            None => {
                tracing::warn!(code = response.code, data = response.data, "the motion switcher's answer is unknown");
            }
        }
    }

    /// Lets the robot lie down and releases its built-in controller.
    fn release(&mut self) {
        self.sport.call(STAND_DOWN, "{}", &self.dds, &self.handle);
        if self.motion_switcher.call(RELEASE_MODE, "{}", &self.dds, &self.handle).is_none() {
            tracing::warn!("the motion switcher does not answer: the built-in controller is not released");
        }
        self.next_check = Instant::now();
    }
}

/// Looks for those who write and those who read the commands to the motors.
fn look(dds: &Dds, handle: &RobotHandle) {
    handle.set_foreign_writers(dds.foreign_writers(LOW_CMD));
    handle.set_readers(dds.readers(LOW_CMD, handle.robot()));
}

/// Returns the name of the active controller in the answer to [`CHECK_MODE`].
fn active_controller(response: &RpcResponse) -> Option<String> {
    if response.code != 0 {
        return None;
    }
    let data: serde_json::Value = serde_json::from_str(&response.data).ok()?;
    data.get("name")?.as_str().map(str::to_owned)
}

/// A service of the robot.
struct Service {
    requests: Writer,
    responses: Reader,
    next_id: i64,
}

impl Service {
    fn new(dds: &Dds, request: Topic, response: Topic) -> Result<Self, DdsError> {
        let responses = dds.reader(response, std::thread::current())?;
        Ok(Self { requests: dds.writer(request, 1)?, responses, next_id: 1 })
    }

    /// Returns the response, or `None` if there is none in time. Keeps counting the other writers meanwhile.
    fn call(&mut self, api_id: i64, parameter: &str, dds: &Dds, handle: &RobotHandle) -> Option<RpcResponse> {
        let id = self.next_id;
        self.next_id += 1;
        let request = RpcRequest { id, api_id, parameter: parameter.to_owned(), ..RpcRequest::default() };
        self.requests.write(encode(&request));
        let end = Instant::now() + TIMEOUT;
        while Instant::now() < end && !handle.is_ending() {
            while let Some(payload) = self.responses.take() {
                if let Ok(response) = decode::<RpcResponse>(&payload)
                    && response.id == id
                {
                    return Some(response);
                }
            }
            look(dds, handle);
            std::thread::park_timeout(PERIOD);
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn name_of_the_active_controller_is_read() {
        let answer = |code, data: &str| {
            active_controller(&RpcResponse { code, data: data.to_owned(), ..RpcResponse::default() })
        };
        assert_eq!(answer(0, r#"{"form":"0","name":"normal"}"#).as_deref(), Some("normal"));
        assert_eq!(answer(0, r#"{"form":"0","name":""}"#).as_deref(), Some(""));
        assert_eq!(answer(3104, r#"{"name":""}"#), None);
        assert_eq!(answer(0, "no JSON"), None);
    }
}
