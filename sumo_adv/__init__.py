"""Online, retrieval-augmented generation of safety-critical scenarios inside SUMO.

From Python: ``result = sumo_adv.run("priority_crossing")``, ``sumo_adv.load("runs/priority_crossing-0")`` (``api.py``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sumo_adv.api import Result, judge, load, run

__version__ = "0.1.0"
__all__ = ["Result", "__version__", "judge", "load", "run"]


def __getattr__(name: str) -> Any:
    """The names of ``api.py``, imported when they are first asked for."""
    if name not in ("Result", "judge", "load", "run"):
        raise AttributeError(f"module 'sumo_adv' has no attribute '{name}'")
    from sumo_adv import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted(__all__)
