"""A window that shows one picture after the other, by matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.errors import UsageError
from sumo_adv.gym.core import Core

RENDER_MODES = ("rgb_array", "human")
DRAW_PAUSE_S = 0.001  # lets the window draw itself


class PictureWindow:
    """A window that opens with the first picture. Without a display, matplotlib draws into nothing."""

    def __init__(self) -> None:
        """Start without a window."""
        self._figure: Any = None
        self._image: Any = None

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture.

        Args:
            picture: The picture, ``(height, width, 3)``.
        """
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
        """Close the window, if it is open."""
        if self._figure is not None:
            import matplotlib.pyplot as plt

            plt.close(self._figure)
            self._figure = self._image = None


class Viewer:
    """Pictures and closing, for all environments."""

    def __init__(self, core: Core, render_mode: str | None) -> None:
        """Check the render mode.

        Args:
            core: The episodes.
            render_mode: One of ``RENDER_MODES``, or None.

        Raises:
            UsageError: There is no such mode.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise UsageError(f"There is no render_mode {render_mode!r}; choose {' or '.join(RENDER_MODES)}.")
        self._core, self.render_mode, self._window = core, render_mode, PictureWindow()

    def render(self) -> Any:
        """Return the scene from above as an array; None unless the mode is ``rgb_array``."""
        return self._core.picture() if self.render_mode == "rgb_array" else None

    def _show(self) -> None:
        """Show the scene in the window, in the mode ``human``."""
        if self.render_mode == "human":
            self._window.show(self._core.picture())

    def close(self) -> None:
        """Close the window, and end the simulation's processes."""
        self._window.close()
        self._core.close()
