"""A robot on the vendor's own DDS library, Cyclone DDS 0.10.2, for the interoperation test of the crate ``robot``.

It publishes ``rt/lowstate`` at 200 Hz, which a busy machine can keep up, answers the services ``motion_switcher``
and ``sport``, and its joints follow ``rt/lowcmd``. Its types and its checksum are written from the IDL of the vendor's
SDK, not from the crate ``unitree``.

Usage: ``cyclone_robot.py DOMAIN [reliable]``, for a reliable reader of commands. It prints ``ready`` and, for each line
``statistics`` on stdin, a line of JSON. It ends when stdin closes. Needs Python 3.10: Cyclone DDS 0.10.2 has no wheels
for newer versions.
"""

import contextlib
import json
import os
import select
import struct
import sys
import time
import zlib
from dataclasses import dataclass

os.environ["CYCLONEDDS_URI"] = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, int16, int32, int64, sequence, uint8, uint16, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy as QosPolicy
from cyclonedds.qos import Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

PERIOD_S = 0.005
CROUCH = [0.0, 1.36, -2.65] * 4
MAX_SPEED = 10.0
"""Speed at which a joint follows its command [rad/s]."""


@dataclass
class MotorCmd(IdlStruct, typename="unitree_go::msg::dds_::MotorCmd_"):
    mode: uint8
    q: float32
    dq: float32
    tau: float32
    kp: float32
    kd: float32
    reserve: array[uint32, 3]


@dataclass
class BmsCmd(IdlStruct, typename="unitree_go::msg::dds_::BmsCmd_"):
    off: uint8
    reserve: array[uint8, 3]


@dataclass
class LowCmd(IdlStruct, typename="unitree_go::msg::dds_::LowCmd_"):
    head: array[uint8, 2]
    level_flag: uint8
    frame_reserve: uint8
    sn: array[uint32, 2]
    version: array[uint32, 2]
    bandwidth: uint16
    motor_cmd: array[MotorCmd, 20]
    bms_cmd: BmsCmd
    wireless_remote: array[uint8, 40]
    led: array[uint8, 12]
    fan: array[uint8, 2]
    gpio: uint8
    reserve: uint32
    crc: uint32


@dataclass
class ImuState(IdlStruct, typename="unitree_go::msg::dds_::IMUState_"):
    quaternion: array[float32, 4]
    gyroscope: array[float32, 3]
    accelerometer: array[float32, 3]
    rpy: array[float32, 3]
    temperature: uint8


@dataclass
class MotorState(IdlStruct, typename="unitree_go::msg::dds_::MotorState_"):
    mode: uint8
    q: float32
    dq: float32
    ddq: float32
    tau_est: float32
    q_raw: float32
    dq_raw: float32
    ddq_raw: float32
    temperature: uint8
    lost: uint32
    reserve: array[uint32, 2]


@dataclass
class BmsState(IdlStruct, typename="unitree_go::msg::dds_::BmsState_"):
    version_high: uint8
    version_low: uint8
    status: uint8
    soc: uint8
    current: int32
    cycle: uint16
    bq_ntc: array[uint8, 2]
    mcu_ntc: array[uint8, 2]
    cell_vol: array[uint16, 15]


@dataclass
class LowState(IdlStruct, typename="unitree_go::msg::dds_::LowState_"):
    head: array[uint8, 2]
    level_flag: uint8
    frame_reserve: uint8
    sn: array[uint32, 2]
    version: array[uint32, 2]
    bandwidth: uint16
    imu_state: ImuState
    motor_state: array[MotorState, 20]
    bms_state: BmsState
    foot_force: array[int16, 4]
    foot_force_est: array[int16, 4]
    tick: uint32
    wireless_remote: array[uint8, 40]
    bit_flag: uint8
    adc_reel: float32
    temperature_ntc1: uint8
    temperature_ntc2: uint8
    power_v: float32
    power_a: float32
    fan_frequency: array[uint16, 4]
    reserve: uint32
    crc: uint32


@dataclass
class Identity(IdlStruct, typename="unitree_api::msg::dds_::RequestIdentity_"):
    id: int64
    api_id: int64


@dataclass
class Lease(IdlStruct, typename="unitree_api::msg::dds_::RequestLease_"):
    id: int64


@dataclass
class Policy(IdlStruct, typename="unitree_api::msg::dds_::RequestPolicy_"):
    priority: int32
    noreply: bool


@dataclass
class RequestHeader(IdlStruct, typename="unitree_api::msg::dds_::RequestHeader_"):
    identity: Identity
    lease: Lease
    policy: Policy


@dataclass
class Request(IdlStruct, typename="unitree_api::msg::dds_::Request_"):
    header: RequestHeader
    parameter: str
    binary: sequence[uint8]


@dataclass
class Status(IdlStruct, typename="unitree_api::msg::dds_::ResponseStatus_"):
    code: int32


@dataclass
class ResponseHeader(IdlStruct, typename="unitree_api::msg::dds_::ResponseHeader_"):
    identity: Identity
    status: Status


@dataclass
class Response(IdlStruct, typename="unitree_api::msg::dds_::Response_"):
    header: ResponseHeader
    data: str
    binary: sequence[uint8]


REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc32_mpeg2(image: bytes) -> int:
    """Return the CRC-32/MPEG-2 of little-endian words, by way of the reflected CRC-32 of zlib."""
    words = struct.unpack(f"<{len(image) // 4}I", image)
    reflected = zlib.crc32(struct.pack(f">{len(words)}I", *words).translate(REVERSED)) ^ 0xFFFFFFFF
    return int(f"{reflected:032b}"[::-1], 2)


def command_image(command: LowCmd) -> bytes:
    """Return the C structure of a command, without its checksum."""
    parts = [
        struct.pack("<2BBB2I2IH2x", *command.head, command.level_flag, command.frame_reserve, *command.sn,
                    *command.version, command.bandwidth)
    ]  # fmt: skip
    parts += [
        struct.pack("<B3x5f3I", motor.mode, motor.q, motor.dq, motor.tau, motor.kp, motor.kd, *motor.reserve)
        for motor in command.motor_cmd
    ]
    bms = command.bms_cmd
    parts.append(struct.pack("<4B40B12B2BB1xI", bms.off, *bms.reserve, *command.wireless_remote, *command.led,
                             *command.fan, command.gpio, command.reserve))  # fmt: skip
    return b"".join(parts)


def state_image(state: LowState) -> bytes:
    """Return the C structure of a state, without its checksum."""
    imu, bms = state.imu_state, state.bms_state
    parts = [
        struct.pack("<2BBB2I2IH2x", *state.head, state.level_flag, state.frame_reserve, *state.sn, *state.version,
                    state.bandwidth),
        struct.pack("<13fB3x", *imu.quaternion, *imu.gyroscope, *imu.accelerometer, *imu.rpy, imu.temperature),
    ]  # fmt: skip
    parts += [
        struct.pack("<B3x7fB3xI2I", motor.mode, motor.q, motor.dq, motor.ddq, motor.tau_est, motor.q_raw, motor.dq_raw,
                    motor.ddq_raw, motor.temperature, motor.lost, *motor.reserve)
        for motor in state.motor_state
    ]  # fmt: skip
    parts += [
        struct.pack("<4BiH2B2B15H", bms.version_high, bms.version_low, bms.status, bms.soc, bms.current, bms.cycle,
                    *bms.bq_ntc, *bms.mcu_ntc, *bms.cell_vol),
        struct.pack("<4h4hI40BB3xfBB2xff4HI", *state.foot_force, *state.foot_force_est, state.tick,
                    *state.wireless_remote, state.bit_flag, state.adc_reel, state.temperature_ntc1,
                    state.temperature_ntc2, state.power_v, state.power_a, *state.fan_frequency, state.reserve),
    ]  # fmt: skip
    return b"".join(parts)


def resting_state() -> LowState:
    """Return the state of a robot that lies on its belly."""
    imu = ImuState([1.0, 0.0, 0.0, 0.0], [0.0] * 3, [0.0, 0.0, 9.81], [0.0] * 3, 30)
    motors = [MotorState(1, q, 0.0, 0.0, 0.0, q, 0.0, 0.0, 30, 0, [0, 0]) for q in CROUCH + [0.0] * 8]
    bms = BmsState(1, 0, 8, 80, 0, 1, [30, 30], [30, 30], [3600] * 15)
    remote = [0x55, 0x51] + [0] * 38
    return LowState([0xFE, 0xEF], 0xFF, 0, [0, 0], [0, 0], 0, imu, motors, bms, [20] * 4, [0] * 4, 0, remote, 0, 0.0,
                    30, 30, 29.0, 1.0, [0] * 4, 0, 0)  # fmt: skip


class SerialisedState:
    """The bytes of a state. Serialising one in Python takes longer than a busy machine has for 200 a second.

    Only the numbers that change are written again. A state with known numbers shows where they are.
    """

    def __init__(self) -> None:
        known = resting_state()
        known.tick = 123456789
        for joint, motor in enumerate(known.motor_state):
            motor.q, motor.dq = 1000.0 + joint, 2000.0 + joint
        known.crc = 987654321
        image = known.serialize()
        self.tick = image.index(struct.pack("<I", known.tick))
        self.crc = image.index(struct.pack("<I", known.crc))
        self.motors = [image.index(struct.pack("<2f", motor.q, motor.dq)) for motor in known.motor_state]
        self.image = bytearray(resting_state().serialize())

    def update(self, state: LowState) -> bytes:
        """Return the bytes of ``state``, which differs from the resting one in tick, motion and checksum."""
        struct.pack_into("<I", self.image, self.tick, state.tick)
        struct.pack_into("<I", self.image, self.crc, state.crc)
        for place, motor in zip(self.motors, state.motor_state, strict=True):
            struct.pack_into("<2f", self.image, place, motor.q, motor.dq)
        return bytes(self.image)


class Robot:
    """The robot with its topics."""

    def __init__(self, domain: int, *, reliable: bool) -> None:
        participant = DomainParticipant(domain)
        topic = Topic(participant, "rt/lowstate", LowState)
        self.states = DataWriter(participant, topic)
        kind = QosPolicy.Reliability.Reliable(duration(seconds=1)) if reliable else QosPolicy.Reliability.BestEffort
        self.commands = DataReader(participant, Topic(participant, "rt/lowcmd", LowCmd), qos=Qos(kind))
        self.services = [
            (
                DataReader(participant, Topic(participant, f"rt/api/{service}/request", Request)),
                DataWriter(participant, Topic(participant, f"rt/api/{service}/response", Response)),
            )
            for service in ("motion_switcher", "sport")
        ]
        self.controller = "mcf"
        self.state = resting_state()
        serialised = SerialisedState()
        self.state.serialize = lambda **_: serialised.update(self.state)
        self.started = self.stepped = time.monotonic()
        self.elapsed = PERIOD_S
        """Time since the step before [s]."""
        self.last: LowCmd | None = None
        self.statistics = {"received": 0, "wrong_checksum": 0, "not_low_level": 0, "before_release": 0}

    def step(self) -> None:
        now = time.monotonic()
        self.elapsed, self.stepped = now - self.stepped, now
        self.state.tick = int(1000.0 * (now - self.started))
        self.take_commands()
        self.answer_requests()
        if self.last is not None:
            self.follow(self.last)
        self.state.crc = crc32_mpeg2(state_image(self.state))
        self.states.write(self.state)

    def take_commands(self) -> None:
        for command in self.commands.take(16):
            if not isinstance(command, LowCmd):
                continue
            self.statistics["received"] += 1
            self.statistics["wrong_checksum"] += command.crc != crc32_mpeg2(command_image(command))
            self.statistics["not_low_level"] += bytes(command.head) != b"\xfe\xef" or command.level_flag != 0xFF
            self.statistics["before_release"] += self.controller != ""
            self.last = command

    def answer_requests(self) -> None:
        for reader, writer in self.services:
            for request in reader.take(4):
                if not isinstance(request, Request):
                    continue
                identity = request.header.identity
                data = ""
                if identity.api_id == 1001:
                    data = json.dumps({"form": "0", "name": self.controller})
                elif identity.api_id == 1003:
                    self.controller = ""
                writer.write(Response(ResponseHeader(identity, Status(0)), data, []))

    def follow(self, command: LowCmd) -> None:
        """Move each joint to its commanded position, with a limited speed and without dynamics."""
        for motor, wanted in zip(self.state.motor_state, command.motor_cmd, strict=True):
            error = wanted.q - motor.q if wanted.mode == 1 and wanted.kp > 0.0 else 0.0
            motor.dq = max(-MAX_SPEED, min(MAX_SPEED, error / max(self.elapsed, PERIOD_S)))
            motor.q += self.elapsed * motor.dq

    def report(self) -> str:
        command = self.last
        gains = [] if command is None else [[motor.kp, motor.kd] for motor in command.motor_cmd[:12]]
        q = [motor.q for motor in self.state.motor_state[:12]]
        return json.dumps({**self.statistics, "q": q, "last_gains": gains})


def main() -> None:
    # As the robot's own computer: other processes do not delay it, where that is allowed.
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    robot = Robot(int(sys.argv[1]), reliable="reliable" in sys.argv[2:])
    print("ready", flush=True)
    due = time.monotonic()
    while True:
        if select.select([sys.stdin], [], [], 0.0)[0]:
            line = sys.stdin.readline()
            if not line:
                return
            print(robot.report(), flush=True)
        robot.step()
        due = max(due + PERIOD_S, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
