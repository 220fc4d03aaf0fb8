"""Gymnasium spaces from the spec of a server."""

from typing import cast

import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

from .codec import Spec, SpecField


def observation_space(spec: Spec) -> Space[NDArray[np.float32]]:
    """Return the space of one observation, ``(obs_len,)`` float32."""
    return _box(spec.observation)


def action_space(spec: Spec) -> Space[NDArray[np.float32]]:
    """Return the space of one action, ``(action_len,)`` float32."""
    return _box(spec.action)


def _box(parts: tuple[SpecField, ...]) -> Space[NDArray[np.float32]]:
    low = np.concatenate([np.full(part.size, part.low, np.float32) for part in parts])
    high = np.concatenate([np.full(part.size, part.high, np.float32) for part in parts])
    # Gymnasium's type of a Box does not contain its dtype.
    return cast(Space[NDArray[np.float32]], Box(low, high, dtype=np.float32))
