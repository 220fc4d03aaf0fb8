"""A window that shows images."""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Window:
    """A pygame window with a maximum frame rate of ``fps``."""

    def __init__(self, width: int, height: int, fps: int) -> None:
        try:
            # Imported by name, because it is an optional dependency.
            self._pygame: Any = importlib.import_module("pygame")
        except ImportError as error:
            message = 'render mode "human" needs pygame\n  pip install "twinstep[render]"'
            raise ImportError(message) from error
        self._pygame.display.init()
        self._pygame.display.set_caption("twinstep")
        self._surface: Any = self._pygame.display.set_mode((width, height))
        self._period_s = 1.0 / fps
        self._next_s = time.monotonic()

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show ``image``, (height, width, 3), at the next frame time."""
        time.sleep(max(0.0, self._next_s - time.monotonic()))
        self._next_s = max(self._next_s, time.monotonic() - self._period_s) + self._period_s
        # A window that does not read its events is reported as unresponsive.
        self._pygame.event.pump()
        self._pygame.surfarray.blit_array(self._surface, image.swapaxes(0, 1))
        self._pygame.display.flip()

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()
