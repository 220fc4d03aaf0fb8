//! A strict fake of the Go2: speaks its messages, checks commands, simulates motors, battery and services, injects faults.
//!
//! [`FakeRobot`] has no network, thread or clock: its caller steps it every 2 ms, passes the messages that arrive, and
//! publishes those that it returns. It runs on any [`Backend`] with one robot at an actuator rate of 500 Hz.
//!
//! - [`FakeRobot::receive`]: a message on `rt/lowcmd`, refused with a reason ([`Refused`]) as strict firmware would.
//!   The vendor does not document its firmware's limits; those here are choices.
//! - [`FakeRobot::step`]: the messages on `rt/lowstate`. [`FakeRobot::sport_state`]: that on `rt/sportmodestate`.
//! - [`FakeRobot::answer`]: the services `motion_switcher` and `sport`.
//! - [`FakeRobot::inject`]: faults ([`FakeFault`]) and mistakes of wiring and software ([`Mistake`]), one line of text each.
//! - [`FakeRobot::statistics`]: accepted and refused messages, largest gap, largest excess of a position.

mod config;
mod controller;
mod fault;
mod firmware;
mod gear_friction;
mod mistake;
mod power;
mod remote;
mod state_link;
mod wiring;

use std::time::Duration;

use glam::{Quat, Vec3};
use twinstep_model::{
    Backend, Command, InitialState, Joint, Leg, NUM_JOINTS, PerJoint, Stream, frames, standard_normal, stream,
};
use twinstep_unitree::{
    BmsState, HEAD, ImuState, LOW_LEVEL, LowState, MotorState, Remote, RemoteBytes, RpcRequest, RpcResponse,
    SportModeState, foot_index, motor_index,
};

pub use config::{FakeConfig, FakeError};
pub use fault::{FakeFault, UnknownFault};
pub use firmware::{FakeStatistics, Refused};
pub use mistake::{Axis, Mistake, UnknownMistake};
pub use remote::RemoteControl;

use controller::Controller;
use firmware::Firmware;
use gear_friction::GearFriction;
use power::Power;
use state_link::{LinkFaults, StateLink};
use wiring::{Fitted, Readings};

/// Rate of actuators and states [Hz].
const RATE_HZ: f64 = 500.0;
/// Period of a step [ms].
const PERIOD_MS: u64 = 2;
/// Acceleration of gravity [m/s²].
const GRAVITY: f32 = 9.81;
/// Steps in which the robot comes to rest before its first state, held and again as many without gains.
const SETTLING_STEPS: usize = 500;
/// Gains while the robot comes to rest: position [N·m/rad], velocity [N·m·s/rad].
const SETTLING_GAINS: [f32; 2] = [20.0, 2.0];
/// Position of a joint that is out, beyond the end of its range [rad].
const JOINT_OUT: f32 = 0.5;

/// Height from which a robot on its side falls to the ground [m].
const FALL_HEIGHT: f32 = 0.15;
/// Counts of a foot's sensor without load, and per newton.
const FOOT_OFFSET: f32 = 15.0;
const FOOT_COUNTS: f32 = 0.8;

/// The fake robot.
pub struct FakeRobot {
    config: FakeConfig,
    backend: Box<dyn Backend>,
    random: Stream,
    firmware: Firmware,
    controller: Controller,
    power: Power,
    friction: GearFriction,
    link: StateLink,
    mistakes: Vec<Fitted>,
    remote: Option<Remote>,
    joint_out: Option<Joint>,
    foreign_writer: bool,
    powered: bool,
    /// True while the motors do not receive their commands; then the last one stays in force.
    messages_lost: bool,
    lost_messages: u32,
    command: Command,
    now_ms: u64,
    /// Velocity of the base before the last step, in the world frame [m/s].
    last_velocity: Vec3,
    /// Acceleration of the base in the last step, in the world frame [m/s²].
    acceleration: Vec3,
}

impl FakeRobot {
    /// Returns a robot that lies on the ground of `backend`, or hangs if its base is fixed.
    pub fn new(backend: Box<dyn Backend>, config: FakeConfig) -> Result<Self, FakeError> {
        config.check()?;
        if backend.num_robots() != 1 {
            return Err(FakeError::NumRobots(backend.num_robots()));
        }
        if backend.robot().control.actuator_hz != RATE_HZ {
            return Err(FakeError::Rate(backend.robot().control.actuator_hz));
        }
        if backend.ground_truth().is_none() {
            return Err(FakeError::NotSimulated);
        }
        let mut robot = Self {
            random: stream(config.seed, "fake_noise", 0),
            firmware: Firmware::new(backend.robot()),
            controller: Controller::new(config.controller_active),
            power: Power::new(config.charge_percent, config.ambient_c),
            friction: GearFriction::new(config.gear_friction_nm),
            link: StateLink::new(config.seed),
            mistakes: Vec::new(),
            remote: Some(Remote::default()),
            joint_out: None,
            foreign_writer: false,
            powered: true,
            messages_lost: false,
            lost_messages: 0,
            command: Command::hold([0.0; NUM_JOINTS], 0.0, 0.0),
            now_ms: 0,
            last_velocity: Vec3::ZERO,
            acceleration: Vec3::ZERO,
            backend,
            config,
        };
        let lying = InitialState::standing_on(&robot.backend.ground(), robot.backend.robot(), robot.config.start, 0.0);
        robot.backend.reset(&[(0, lying)])?;
        let [kp, kd] = SETTLING_GAINS;
        robot.backend.step(&[Command::hold(robot.config.start, kp, kd)], &[true], SETTLING_STEPS)?;
        for _ in 0..SETTLING_STEPS {
            let limp = robot.limp();
            robot.backend.step(&[limp], &[true], 1)?;
        }
        robot.last_velocity = robot.velocity();
        Ok(robot)
    }

    /// Executes a message on `rt/lowcmd`, as it came from the network.
    pub fn receive(&mut self, payload: &[u8]) -> Result<(), Refused> {
        if !self.powered {
            return Err(self.firmware.refuse_without_power());
        }
        if self.firmware.receive(payload, self.now_ms, self.controller.is_active())? {
            self.powered = false;
        }
        Ok(())
    }

    /// Answers a request to a service. Without power nobody answers: check [`FakeRobot::is_powered`] first.
    pub fn answer(&mut self, service: &str, request: &RpcRequest) -> RpcResponse {
        let was_active = self.controller.is_active();
        let response = self.controller.answer(service, request, self.backend.measured().q[0]);
        if was_active && !self.controller.is_active() {
            // A message from before the release is not executed.
            self.firmware.stop();
        }
        response
    }

    /// Advances by 2 ms and returns the messages to publish now on `rt/lowstate`.
    pub fn step(&mut self) -> Result<Vec<LowState>, FakeError> {
        self.now_ms += PERIOD_MS;
        self.command = self.next_command();
        self.backend.step(&[self.command], &[true], 1)?;
        let velocity = self.velocity();
        self.acceleration = (velocity - self.last_velocity) * RATE_HZ as f32;
        self.last_velocity = velocity;
        if !self.powered {
            return Ok(Vec::new());
        }
        let (tau, dq) = (self.backend.measured().tau[0], self.backend.measured().dq[0]);
        self.power.advance(&tau, &dq, PERIOD_MS as f32 / 1000.0);
        let state = self.state();
        Ok(self.link.pass(state, self.now_ms))
    }

    /// Returns the command that the motors execute in the next 2 ms.
    fn next_command(&mut self) -> Command {
        let of_controller = self.controller.advance(Duration::from_millis(PERIOD_MS));
        if !self.powered {
            return self.limp();
        }
        if self.messages_lost {
            self.lost_messages += 1;
            return self.command;
        }
        let mut command = if self.controller.is_active() { of_controller } else { self.firmware.command() };
        for fitted in &self.mistakes {
            fitted.change_command(&mut command);
        }
        self.friction.add(&mut command, &self.backend.measured().q[0]);
        command
    }

    /// Returns the command of motors without power.
    fn limp(&mut self) -> Command {
        let mut command = Command::hold([0.0; NUM_JOINTS], 0.0, 0.0);
        self.friction.add(&mut command, &self.backend.measured().q[0]);
        command
    }

    /// Returns the message on `rt/sportmodestate`; `None` after the built-in controller was released.
    pub fn sport_state(&mut self) -> Option<SportModeState> {
        let is_published = self.controller.is_active() || self.config.motion_capture;
        if !self.powered || !is_published {
            return None;
        }
        let position = self.backend.ground_truth()?.base_position[0];
        Some(SportModeState {
            sec: (self.now_ms / 1000) as i32,
            nanosec: (self.now_ms % 1000 * 1_000_000) as u32,
            imu_state: self.state().imu_state,
            mode: u8::from(self.controller.is_standing()),
            position,
            body_height: position[2],
            velocity: self.velocity().to_array(),
            yaw_speed: self.backend.measured().gyro[0][2],
            foot_force: self.foot_force(),
            ..SportModeState::default()
        })
    }

    /// Returns what the robot received since it was switched on.
    pub fn statistics(&self) -> &FakeStatistics {
        &self.firmware.statistics
    }

    /// Returns the command that the motors executed in the last step, with the drag of motors without gains.
    pub fn motor_command(&self) -> &Command {
        &self.command
    }

    /// Returns the engine of the robot, for its ground truth.
    pub fn backend(&self) -> &dyn Backend {
        self.backend.as_ref()
    }

    /// Returns true if the robot is switched on.
    pub fn is_powered(&self) -> bool {
        self.powered
    }

    /// Returns true if another process should write to `rt/lowcmd` now. The caller starts and stops it.
    pub fn wants_foreign_writer(&self) -> bool {
        self.foreign_writer
    }

    /// Injects a fault, or ends all.
    pub fn inject(&mut self, fault: FakeFault) -> Result<(), FakeError> {
        let link = &mut self.link.faults;
        match fault {
            FakeFault::Heat(joint, celsius) => self.power.heat(joint, f32::from(celsius)),
            FakeFault::Battery(percent) => self.power.set_percent(percent),
            FakeFault::Voltage(volts) => self.power.forced_voltage = Some(volts),
            FakeFault::Remote(remote) => self.remote = remote.state(),
            FakeFault::Stale(ms) => link.silent_until_ms = self.now_ms + ms,
            FakeFault::Loss(share) => link.loss = share,
            FakeFault::Delay(ms) => link.delay_ms = ms,
            FakeFault::Reorder => link.reorder = true,
            FakeFault::Fall => self.lay(Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2), FALL_HEIGHT)?,
            FakeFault::SetUpright => self.lay(Quat::IDENTITY, 0.0)?,
            FakeFault::PowerCut => {
                self.powered = false;
                self.link.clear();
            }
            FakeFault::MessagesLost => self.messages_lost = true,
            FakeFault::JointOut(joint) => self.joint_out = Some(joint),
            FakeFault::ForeignWriter(on) => self.foreign_writer = on,
            FakeFault::Controller(true) => {
                self.controller.activate();
                self.firmware.stop();
            }
            FakeFault::Controller(false) => self.controller.release(),
            FakeFault::Mistake(mistake) => {
                link.slow |= mistake == Mistake::StatesSlow;
                self.mistakes.push(Fitted::new(mistake, &self.backend.measured().q[0]));
            }
            FakeFault::Clear => {
                *link = LinkFaults::default();
                self.mistakes.clear();
                self.power.forced_voltage = None;
                self.remote = Some(Remote::default());
                self.joint_out = None;
                (self.foreign_writer, self.messages_lost) = (false, false);
            }
        }
        Ok(())
    }

    /// Puts the robot on its left side.
    /// Puts the robot on the ground with this orientation of its base, and with the lowest foot `height` above it [m].
    fn lay(&mut self, orientation: Quat, height: f32) -> Result<(), FakeError> {
        let q = self.backend.measured().q[0];
        let mut lying = InitialState::standing_on(&self.backend.ground(), self.backend.robot(), q, 0.0);
        lying.base_orientation = frames::to_wxyz(orientation);
        lying.base_position[2] += height;
        self.backend.reset(&[(0, lying)])?;
        self.last_velocity = Vec3::ZERO;
        Ok(())
    }

    /// Returns the velocity of the base in the world frame [m/s].
    fn velocity(&self) -> Vec3 {
        self.backend.ground_truth().map_or(Vec3::ZERO, |truth| Vec3::from(truth.base_linear_velocity[0]))
    }

    /// Returns noise with this standard deviation for each entry.
    fn noise<const N: usize>(&mut self, std: f32) -> [f32; N] {
        std::array::from_fn(|_| std * standard_normal(&mut self.random) as f32)
    }

    /// Returns the readings with noise, and with the mistakes.
    fn readings(&mut self) -> Readings {
        let config = self.config.clone();
        let measured = self.backend.measured();
        let (q, dq, tau) = (measured.q[0], measured.dq[0], measured.tau[0]);
        let (orientation, gyro) = (measured.orientation[0], Vec3::from(measured.gyro[0]));
        let world_from_base = frames::world_from_base(orientation);
        let computed = world_from_base.inverse() * (self.acceleration + GRAVITY * Vec3::Z);
        let acc = measured.acc.as_ref().map_or(computed, |acc| Vec3::from(acc[0]));
        let tilt = Quat::from_scaled_axis(Vec3::from(self.noise(config.orientation_noise_rad)));
        let mut readings = Readings {
            q: add(q, self.noise(config.position_noise_rad)),
            dq: add(dq, self.noise(config.velocity_noise_rad_s)),
            tau: add(tau, self.noise(config.torque_noise_nm)),
            quaternion: frames::to_wxyz(world_from_base * tilt),
            gyro: gyro + Vec3::from(self.noise(config.gyro_noise_rad_s)),
            acc: acc + Vec3::from(self.noise(config.acc_noise_m_s2)),
        };
        for fitted in &self.mistakes {
            fitted.change_readings(&mut readings);
        }
        if let Some(joint) = self.joint_out {
            readings.q[joint.index()] = self.backend.robot().upper_limits()[joint.index()] + JOINT_OUT;
        }
        readings
    }

    fn foot_force(&self) -> [i16; 4] {
        let force = self.backend.ground_truth().map_or([0.0; 4], |truth| truth.foot_force[0]);
        let mut counts = [0; 4];
        for leg in Leg::ALL {
            counts[foot_index(leg)] = (FOOT_OFFSET + FOOT_COUNTS * force[leg as usize]).clamp(0.0, 4095.0) as i16;
        }
        counts
    }

    fn state(&mut self) -> LowState {
        let readings = self.readings();
        let temperatures = self.power.temperatures();
        let modes = self.firmware.modes();
        let mut state = LowState {
            head: HEAD,
            level_flag: LOW_LEVEL,
            imu_state: ImuState {
                quaternion: readings.quaternion,
                gyroscope: readings.gyro.to_array(),
                accelerometer: readings.acc.to_array(),
                rpy: roll_pitch_yaw(readings.quaternion),
                temperature: (self.config.ambient_c + 30.0) as u8,
            },
            bms_state: BmsState {
                soc: self.power.percent(),
                current: (-1000.0 * self.power.current()) as i32,
                cycle: 20,
                cell_vol: std::array::from_fn(
                    |cell| if cell < 7 { (self.power.voltage() * 1000.0 / 7.0) as u16 } else { 0 },
                ),
                ..BmsState::default()
            },
            foot_force: self.foot_force(),
            foot_force_est: self.foot_force(),
            tick: if self.has(Mistake::ClockStopped) { 0 } else { self.now_ms as u32 },
            wireless_remote: self.remote.map_or_else(RemoteBytes::default, |remote| remote.encode()),
            power_v: self.power.voltage(),
            power_a: self.power.current(),
            ..LowState::default()
        };
        for joint in Joint::ALL {
            let index = joint.index();
            state.motor_state[motor_index(joint)] = MotorState {
                mode: modes[index],
                q: readings.q[index],
                dq: readings.dq[index],
                tau_est: readings.tau[index],
                q_raw: readings.q[index],
                dq_raw: readings.dq[index],
                temperature: temperatures[index],
                lost: self.lost_messages,
                ..MotorState::default()
            };
        }
        let mut state = state.with_checksum();
        if self.has(Mistake::ChecksumWrong) {
            state.crc ^= 1;
        }
        state
    }

    fn has(&self, mistake: Mistake) -> bool {
        self.mistakes.iter().any(|fitted| fitted.mistake == mistake)
    }
}

fn add(values: PerJoint, noise: PerJoint) -> PerJoint {
    std::array::from_fn(|joint| values[joint] + noise[joint])
}

/// Returns roll, pitch and yaw of an orientation `[w, x, y, z]` [rad].
fn roll_pitch_yaw([w, x, y, z]: [f32; 4]) -> [f32; 3] {
    [
        (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y)),
        (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin(),
        (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z)),
    ]
}
