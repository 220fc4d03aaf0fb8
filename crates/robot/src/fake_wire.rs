//! A fake robot on the DDS topics of the real one, in real time.

use std::time::{Duration, Instant};

use twinstep_unitree::{LowCmd, RpcRequest, decode, encode};

use crate::dds::{
    Dds, DdsError, LOW_CMD, LOW_STATE, MOTION_SWITCHER_REQUEST, MOTION_SWITCHER_RESPONSE, Reader, SPORT_MODE_STATE,
    SPORT_REQUEST, SPORT_RESPONSE, Writer,
};
use crate::fake::{FakeError, FakeRobot};

/// Period of the robot's states.
const PERIOD: Duration = Duration::from_millis(2);
/// States that may wait to be sent: after a pause of this process several are written at once.
const STATES: i32 = 16;
/// Longest delay that is made up for. After a longer one, the robot's time stands still meanwhile.
const MAX_DELAY: Duration = Duration::from_millis(20);

/// A fake robot with its topics.
pub struct FakeWire {
    robot: FakeRobot,
    dds: Dds,
    states: Writer,
    sport_states: Writer,
    commands: Reader,
    services: [Service; 2],
    /// Exists while the fault `foreign writer` is on.
    foreign_writer: Option<Writer>,
    due: Instant,
}

struct Service {
    name: &'static str,
    requests: Reader,
    responses: Writer,
}

impl FakeWire {
    /// Puts a robot on the topics of a domain. The calling thread has to be the one that calls [`FakeWire::step`].
    pub fn new(robot: FakeRobot, dds: Dds) -> Result<Self, DdsError> {
        let thread = std::thread::current();
        let service = |name, request, response| {
            Ok(Service { name, requests: dds.reader(request, thread.clone())?, responses: dds.writer(response, 1)? })
        };
        Ok(Self {
            states: dds.writer(LOW_STATE, STATES)?,
            sport_states: dds.writer(SPORT_MODE_STATE, STATES)?,
            commands: dds.reader(LOW_CMD, thread.clone())?,
            services: [
                service("motion_switcher", MOTION_SWITCHER_REQUEST, MOTION_SWITCHER_RESPONSE)?,
                service("sport", SPORT_REQUEST, SPORT_RESPONSE)?,
            ],
            foreign_writer: None,
            due: Instant::now(),
            robot,
            dds,
        })
    }

    /// Returns the robot.
    pub fn robot(&mut self) -> &mut FakeRobot {
        &mut self.robot
    }

    /// Waits for the next period, takes in what arrives meanwhile, advances the robot and publishes its states.
    pub fn step(&mut self) -> Result<(), FakeError> {
        loop {
            self.take_in();
            let left = self.due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            std::thread::park_timeout(left);
        }
        let now = Instant::now();
        self.due += PERIOD;
        if now.saturating_duration_since(self.due) > MAX_DELAY {
            self.due = now;
        }
        for state in self.robot.step()? {
            self.states.write(encode(&state));
        }
        if let Some(state) = self.robot.sport_state() {
            self.sport_states.write(encode(&state));
        }
        self.write_as_stranger();
        Ok(())
    }

    fn take_in(&mut self) {
        while let Some(payload) = self.commands.take() {
            if let Err(refused) = self.robot.receive(&payload) {
                tracing::warn!(%refused, "command refused");
            }
        }
        for Service { name, requests, responses } in &self.services {
            while let Some(payload) = requests.take() {
                if let Ok(request) = decode::<RpcRequest>(&payload) {
                    responses.write(encode(&self.robot.answer(name, &request)));
                }
            }
        }
    }

    /// Commands nothing, like a forgotten program, while the fault is on.
    fn write_as_stranger(&mut self) {
        if !self.robot.wants_foreign_writer() {
            self.foreign_writer = None;
            return;
        }
        if self.foreign_writer.is_none() {
            match self.dds.writer(LOW_CMD, 1) {
                Ok(writer) => self.foreign_writer = Some(writer),
                Err(error) => tracing::error!(%error, "no foreign writer"),
            }
        }
        if let Some(writer) = &self.foreign_writer {
            writer.write(encode(&LowCmd::stopped().with_checksum()));
        }
    }
}
