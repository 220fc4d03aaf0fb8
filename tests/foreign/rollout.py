"""Simulation of all phases of a log, with the supply and the heat of the motors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from drive import PHYSICS_DT, ROW_STEPS, Array, Command
from motion import FIXED, STAND_FOOT_RADIUS, Motion
from plant import Robot, Simulation, small_turn

SETTLE_ROWS = 240  # rows before the recording in which the robot comes to rest
IDLE_POWER = 20.0  # [W], of the computers
GAP_BETWEEN_PARTS = 5.0  # [s] between the hanging and the standing part of a log


class FallError(Exception):
    """The robot fell or oscillated: the motion must be drawn again."""


@dataclass
class Supply:
    """Battery voltage [V] and motor temperatures [°C], advanced once per row."""

    nuisance: dict[str, Any]
    temperature: Array
    time: float = 0.0
    power: float = IDLE_POWER

    @property
    def idle_voltage(self) -> float:
        """Voltage of the full battery of a robot at rest [V], the highest of its log."""
        return self.nuisance["voltage"] - self.nuisance["resistance"] * IDLE_POWER / self.nuisance["voltage"]

    def advance(self, torque: Array, speed: Array) -> float:
        """Advance by 5 ms with torques [N·m] and speeds [rad/s]; return the voltage [V]."""
        n, dt = self.nuisance, ROW_STEPS * PHYSICS_DT
        losses = 0.3 * torque**2
        used = IDLE_POWER + float(np.sum(np.maximum(torque * speed, 0.0) + losses))
        self.power += (used - self.power) * dt / 0.05
        self.time += dt
        ambient = n["temperature"].min()
        self.temperature += dt * (n["warming"] * losses - (self.temperature - ambient) / n["cooling_time"])
        open_circuit = n["voltage"] - n["discharge"] * self.time / 60.0
        return open_circuit - n["resistance"] * self.power / open_circuit


def simulate(robot: Robot, motion: Motion, xml: str, seed: int) -> dict[str, Array]:
    """Simulate all phases of a motion; return arrays with one row each 5 ms. Raises `FallError`."""
    rng = np.random.default_rng(seed)
    supply = Supply(robot.nuisance, robot.nuisance["temperature"].copy())
    rows: list[dict[str, Array]] = []
    clock = 0.0
    for part, fixed in enumerate((True, False)):
        phases = [(i, p) for i, p in enumerate(motion.phases) if (p.base == FIXED) == fixed]
        if not phases:
            continue
        first = phases[0][1]
        simulation = Simulation(robot, xml, fixed=fixed, start_time=clock, temperature=supply.temperature)
        simulation.place(first.commands[0], motion.height + STAND_FOOT_RADIUS + 0.004)
        settle = Command(first.commands[0], first.kp, first.kd)
        for _ in range(SETTLE_ROWS):
            simulation.row(settle, np.zeros(12), np.zeros(12))
        simulation.drive.time = clock
        count = sum(len(p.commands) for _, p in phases)
        shift_at = count // 2 if "moving_payload" in robot.plant and not fixed else -1
        done = 0
        for index, phase in phases:
            for target in phase.commands:
                if done == shift_at:
                    simulation.shift_payload()
                noise = rng.standard_normal((2, 12))
                command = Command(target, phase.kp, phase.kd)
                row = simulation.row(command, robot.noise["q"] * noise[0], robot.noise["dq"] * noise[1])
                voltage = supply.advance(row["tau"], row["dq"])
                simulation.drive.voltage_ratio = voltage / supply.idle_voltage
                simulation.drive.temperature = supply.temperature
                row |= {
                    "command": target,
                    "gains": np.array([phase.kp, phase.kd]),
                    "voltage": np.array(voltage),
                }
                row |= {
                    "temperature": supply.temperature.copy(),
                    "t": np.array(clock),
                    "segment": np.array(index),
                }
                row["episode"] = np.array(part)
                rows.append(_with_base(row, robot) if fixed else row)
                clock += ROW_STEPS * PHYSICS_DT
                done += 1
            _check(rows[-len(phase.commands) :], fixed)
        clock += GAP_BETWEEN_PARTS
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _with_base(row: dict[str, Array], robot: Robot) -> dict[str, Array]:
    """Add the resting base of a hanging robot to a row."""
    base = {"pos": np.array([0.0, 0.0, 1.0]), "vel": np.zeros(3), "gyro": np.zeros(3)}
    return row | base | {"quat": small_turn(robot.nuisance["tilt"])}


def _check(rows: list[dict[str, Array]], fixed: bool) -> None:
    """Raise `FallError` if a phase has a fall, an oscillation or a number that is not finite."""
    speed = np.array([row["dq"] for row in rows])
    if not np.all(np.isfinite(speed)) or np.sqrt(np.mean(speed**2, axis=0)).max() > (5.0 if fixed else 7.0):
        raise FallError("oscillation")
    if not fixed:
        upright = np.array([1.0 - 2.0 * (r["quat"][1] ** 2 + r["quat"][2] ** 2) for r in rows])
        height = np.array([r["pos"][2] for r in rows])
        if upright.min() < 0.85 or height.min() < 0.13:
            raise FallError("fall")
