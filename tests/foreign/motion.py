"""Commanded motions of about a minute: a hanging robot, then a robot that stands, sways, trots and hops."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drive import Array

RATE = 200.0  # rows per second
FIXED, FLOATING = "fixed", "floating"
LINK = 0.213  # [m], length of a thigh and of a calf
HIP_OFFSET = 0.0955  # [m], from the hip's axis to the leg's plane
STAND_FOOT_RADIUS = 0.022  # [m]
HANG_POSE = np.array([0.0, 0.9, -1.7] * 4)
LOW = np.array([-0.7, -0.3, -2.5] * 4)  # [rad], with a margin to the joint limits
HIGH = np.array([0.7, 2.2, -1.0] * 4)
SIDES = np.array([1.0, -1.0, 1.0, -1.0])  # y of FL, FR, RL, RR


@dataclass(frozen=True)
class Phase:
    """Commands of one segment: positions [rad] of shape (rows, 12), kp [N·m/rad], kd [N·m·s/rad]."""

    name: str
    base: str
    kp: float
    kd: float
    commands: Array


@dataclass(frozen=True)
class Motion:
    """Phases of one log, hanging ones first, and the height of the base over the feet [m]."""

    phases: tuple[Phase, ...]
    height: float


def draw_motion(rng: np.random.Generator, gain_scale: float) -> Motion:
    """Draw a motion; `gain_scale` below 1 lowers all position gains for robots that oscillate."""
    low = gain_scale * rng.uniform(18.0, 30.0), rng.uniform(0.5, 0.9)
    high = gain_scale * rng.uniform(38.0, 65.0), rng.uniform(0.9, 1.4)
    stand = max(gain_scale, 0.7) * rng.uniform(45.0, 70.0), rng.uniform(1.0, 1.8)
    slow_gains, fast_gains = (low, high) if rng.random() < 0.5 else (high, low)
    fixed = [
        ("hang_slow", slow_gains, _slow(rng, rng.uniform(9.0, 12.0))),
        ("hang_sines_a", fast_gains, _sines(rng, rng.uniform(7.0, 9.0))),
        ("hang_sines_b", slow_gains, _sines(rng, rng.uniform(7.0, 9.0))),
        ("hang_steps", high, _steps(rng, rng.uniform(7.0, 9.0), high[0])),
    ]
    height = rng.uniform(0.27, 0.31)
    floating = [
        ("sway", stand, _sway(rng, rng.uniform(9.0, 11.0), height)),
        ("trot", stand, _trot(rng, rng.uniform(7.0, 9.0), height)),
        ("hop", stand, _hop(rng, rng.uniform(4.0, 6.0), height)),
    ]
    return Motion((*_joined(fixed, FIXED), *_joined(floating, FLOATING)), height)


def _joined(parts: list[tuple[str, tuple[float, float], Array]], base: str) -> list[Phase]:
    """Return phases whose commands begin where the previous phase stops, blended over 0.6 s."""
    phases = []
    last = parts[0][2][0]
    for name, (kp, kd), raw in parts:
        rows = int(0.6 * RATE)
        share = 0.5 - 0.5 * np.cos(np.pi * np.minimum(np.arange(len(raw)) / rows, 1.0))[:, None]
        commands = (1.0 - share) * last + share * raw
        phases.append(Phase(name, base, kp, kd, commands))
        last = commands[-1]
    return phases


def _times(duration: float) -> Array:
    """Return the times of the rows of a phase [s]."""
    return np.arange(int(duration * RATE)) / RATE


def _slow(rng: np.random.Generator, duration: float) -> Array:
    """Return triangle waves at speeds of 0.03 to 0.3 rad/s about drawn poses [rad]."""
    t = _times(duration)[:, None]
    amplitude = rng.uniform(0.08, 0.3, 12)
    speed = np.exp(rng.uniform(np.log(0.03), np.log(0.3), 12))
    phase = rng.uniform(0.0, 1.0, 12)
    cycle = (t * speed / (4.0 * amplitude) + phase) % 1.0
    wave = 4.0 * np.abs(cycle - 0.5) - 1.0
    return np.clip(HANG_POSE + rng.uniform(-0.2, 0.2, 12) + amplitude * wave, LOW, HIGH)


def _sines(rng: np.random.Generator, duration: float) -> Array:
    """Return sums of five sines of 0.3 to 7 Hz whose speeds are similar [rad]."""
    t = _times(duration)[:, None, None]
    frequency = np.exp(rng.uniform(np.log(0.3), np.log(7.0), (12, 5)))
    speed = rng.uniform(0.4, 2.2, (12, 5)) * rng.uniform(0.6, 1.0)
    amplitude = np.minimum(speed / (2.0 * np.pi * frequency), 0.2)
    phase = rng.uniform(0.0, 2.0 * np.pi, (12, 5))
    wave = np.sum(amplitude * np.sin(2.0 * np.pi * frequency * t + phase), axis=2)
    return np.clip(HANG_POSE + rng.uniform(-0.1, 0.1, 12) + wave, LOW, HIGH)


def _steps(rng: np.random.Generator, duration: float, kp: float) -> Array:
    """Return steps to drawn poses, each held 0.4 to 0.9 s; their torque stays below a drawn 16 to 45 N·m."""
    rows = int(duration * RATE)
    commands = np.empty((rows, 12))
    pose, row = HANG_POSE.copy(), 0
    largest = min(rng.uniform(16.0, 45.0) / kp, 0.9)
    while row < rows:
        hold = int(rng.uniform(0.4, 0.9) * RATE)
        commands[row : row + hold] = pose
        moved = rng.random(12) < 0.5
        step = rng.uniform(0.3, 1.0, 12) * largest * rng.choice([-1.0, 1.0], 12)
        wanted = np.where(moved, pose + step, pose)
        pose = np.clip(
            np.where(np.abs(wanted - HANG_POSE) > 0.55, pose - moved * step, wanted),
            LOW,
            HIGH,
        )
        row += hold
    return commands


def _stand_feet(height: float) -> Array:
    """Return the feet in the frames of their hips, of shape (4, 3) [m]."""
    feet = np.zeros((4, 3))
    feet[:, 1] = SIDES * HIP_OFFSET
    feet[:, 2] = -height
    return feet


def inverse_kinematics(feet: Array) -> Array:
    """Return joint angles (rows, 12) [rad] of feet (rows, 4, 3) in the frames of their hips [m]."""
    x, y, z = feet[..., 0], feet[..., 1], feet[..., 2]
    side = SIDES * HIP_OFFSET
    drop = np.sqrt(np.maximum(y**2 + z**2 - side**2, 1e-4))
    hip = np.arctan2(y, -z) - np.arctan2(side, drop)
    reach = np.clip(x**2 + drop**2, 0.02, (1.98 * LINK) ** 2)
    calf = -np.arccos(np.clip(reach / (2.0 * LINK**2) - 1.0, -1.0, 1.0))
    thigh = np.arctan2(-x, drop) - 0.5 * calf
    return np.stack([hip, thigh, calf], axis=-1).reshape(len(feet), 12)


def _envelope(t: Array, rise: float) -> Array:
    """Return a factor that rises from 0 to 1 and falls back, each over `rise` [s]."""
    end = t[-1]
    return np.sin(0.5 * np.pi * np.clip(np.minimum(t, end - t) / rise, 0.0, 1.0)) ** 2


def _sway(rng: np.random.Generator, duration: float, height: float) -> Array:
    """Return a stand that shifts and turns its base slowly, and presses its feet outwards [rad]."""
    t = _times(duration)
    feet = np.repeat(_stand_feet(height)[None], len(t), axis=0)
    window = _envelope(t, 1.0)
    mounts = np.array([[0.1934, 0.0465], [0.1934, -0.0465], [-0.1934, 0.0465], [-0.1934, -0.0465]])

    def wave(size: float) -> Array:
        frequency = rng.uniform(0.2, 0.8, 2)
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        return window * size * rng.uniform(0.5, 1.0) * np.sin(2.0 * np.pi * np.outer(t, frequency) + phase).sum(1) / 2.0

    feet[:, :, 0] -= wave(0.04)[:, None]
    feet[:, :, 1] -= wave(0.03)[:, None]
    feet[:, :, 2] -= wave(0.03)[:, None]
    roll, pitch, yaw = wave(0.1), wave(0.1), wave(0.15)
    for leg, (forward, left) in enumerate(mounts):
        left = left + SIDES[leg] * HIP_OFFSET
        feet[:, leg, 2] -= roll * left - pitch * forward
        feet[:, leg, 0] += yaw * left
        feet[:, leg, 1] -= yaw * forward
    feet[:, :, 1] += (window * rng.uniform(0.0, 0.03) * np.sin(2.0 * np.pi * 0.3 * t))[:, None] * SIDES
    return inverse_kinematics(feet)


def _trot(rng: np.random.Generator, duration: float, height: float) -> Array:
    """Return a trot in place of 1.6 to 2.4 Hz, diagonal pairs of feet in turn [rad]."""
    t = _times(duration)
    window = _envelope(t, 0.8)
    cycle = rng.uniform(1.6, 2.4) * t
    lift = rng.uniform(0.04, 0.065)
    feet = np.repeat(_stand_feet(height)[None], len(t), axis=0)
    for leg, offset in enumerate((0.0, 0.5, 0.5, 0.0)):
        phase = (cycle + offset) % 1.0
        swing = np.clip((phase - 0.55) / 0.45, 0.0, 1.0)
        feet[:, leg, 2] += window * lift * np.sin(np.pi * swing) ** 2
        feet[:, leg, 0] += 0.01 * window * rng.uniform(-1.0, 1.0)
    return inverse_kinematics(feet)


def _hop(rng: np.random.Generator, duration: float, height: float) -> Array:
    """Return vertical oscillations of the base of 2 to 2.8 Hz with short flights [rad]."""
    t = _times(duration)
    frequency = rng.uniform(2.0, 2.8)
    acceleration = rng.uniform(4.0, 8.5)
    amplitude = min(acceleration / (2.0 * np.pi * frequency) ** 2, 0.06)
    feet = np.repeat(_stand_feet(height)[None], len(t), axis=0)
    depth = amplitude * (1.0 - np.cos(2.0 * np.pi * frequency * t))
    feet[:, :, 2] += (_envelope(t, 0.6) * depth)[:, None]
    return inverse_kinematics(feet)
