"""A window that shows pictures one after the other, by matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.errors import UsageError
from sumo_adv.gym.core import Core

RENDER_MODES = ("rgb_array", "human")
DRAW_PAUSE_S = 0.001  # for the window to draw itself


class PictureWindow:
    """Opens with the first picture. Without a display matplotlib draws into nothing."""

    def __init__(self) -> None:
        self._figure: Any = None
        self._image: Any = None

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture ``(height, width, 3)``."""
        import matplotlib.pyplot as plt

        if self._figure is None:
            self._figure = plt.figure("sumo_adv", figsize=(5, 5))
            axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
            axes.set_axis_off()
            self._image = axes.imshow(picture)
        self._image.set_data(picture)
        self._figure.canvas.draw_idle()
        self._figure.canvas.start_event_loop(DRAW_PAUSE_S)

    def close(self) -> None:
        if self._figure is not None:
            import matplotlib.pyplot as plt

            plt.close(self._figure)
            self._figure = self._image = None


class Viewer:
    """What all environments do with pictures, and at their end."""

    def __init__(self, core: Core, render_mode: str | None) -> None:
        """Raises UsageError."""
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UsageError(f"There is no render_mode {render_mode!r}; choose {' or '.join(RENDER_MODES)}.")
        self._core, self.render_mode, self._window = core, render_mode, PictureWindow()

    def render(self) -> Any:
        """The scene from above as an array; with ``human`` it is in the window already."""
        return self._core.picture() if self.render_mode == "rgb_array" else None

    def _show(self) -> None:
        if self.render_mode == "human":
            self._window.show(self._core.picture())

    def close(self) -> None:
        """End the simulation's processes."""
        self._window.close()
        self._core.close()
