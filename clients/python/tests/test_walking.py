"""Velocity errors and falls of a policy."""

import numpy as np
import pytest
from numpy.typing import NDArray

import twinstep
from twinstep.walking import evaluate_walking


def stand(obs: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.zeros((len(obs), 12), np.float32)


def fold(obs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Stretch the left legs and bend the right ones."""
    return np.tile(np.array([1, -1, 1, 1, 1, -1] * 2, np.float32), (len(obs), 1))


def test_robots_that_stand_have_the_error_of_their_commands() -> None:
    errors = evaluate_walking(stand, 64, seconds=4)
    assert errors.up == 1
    # Uniform commands: sqrt(1/3 + 1/12) = 0.65 m/s and sqrt(1/3) = 0.58 rad/s, 5 % of which are 0.
    assert errors.velocity_rms == pytest.approx(0.63, abs=0.06)
    assert errors.yaw_rate_rms == pytest.approx(0.56, abs=0.06)
    assert str(errors).endswith("still up 100.0 %")


def test_fallen_robots_are_counted() -> None:
    assert evaluate_walking(fold, 16, seconds=2).up < 0.5


def test_task_without_velocities_is_rejected_by_name() -> None:
    with pytest.raises(twinstep.SpecMismatchError, match="`true_linear_velocity`"):
        evaluate_walking(stand, 2, task="counter")
