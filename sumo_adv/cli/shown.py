"""What all progress on a terminal has in common: something of rich's that lives as long as the work."""

from __future__ import annotations

from types import TracebackType
from typing import Any, Self


class Shown:
    """A context in which ``_display`` is shown, where there is one: what rich starts and stops."""

    _display: Any = None

    def __enter__(self) -> Self:
        if self._display is not None:
            self._display.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._display is not None:
            self._display.stop()
