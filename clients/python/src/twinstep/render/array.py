"""The type of the arrays of rendering."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
"""32-bit floats, because rendering is limited by memory bandwidth."""
