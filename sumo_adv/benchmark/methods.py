"""The program's own rows, in words: ``expert``, ``llm-f``, ``llm-a:MODEL``, each with changed settings behind a plus.

    raw                        the unattacked run
    expert                     the whole library, updated as the suite goes on; the expert plays all parts (LLM-A)
    llm-f                      a bank of Close Car-following and Emergency Braking, nothing learnt (the paper's LLM-F)
    llm-a:MODEL, llm-f:MODEL   the same with a language model in all parts
    expert+tuner=off           any setting of ``run`` changed; several: ``expert+learn=off+replan=12``
    expert+shift=-1.5          the trigger by these seconds later (negative: earlier)

Whatever else is an opponent (``rows/``).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sumo_adv.config import Settings, load_settings
from sumo_adv.errors import UsageError

RAW = "raw"
FIXED_LIBRARY = ("Close Car-following", "Emergency Braking")
OWN = ("expert", "llm-a", "llm-f")
GIVEN_ELSEWHERE = (
    "ego", "ego_id", "ego_parameters", "seed", "until", "attempts", "memory", "trigger", "ttc", "critical_ttc",
    "min_delta_v", "limits", "duration",
    "step_length", "density", "background", "begin", "end", "search", "history", "shortlist", "adversary",
)  # fmt: skip
"""Settings that no row changes: who is attacked, where, with what budget, and how it is judged."""

ABLATIONS: Mapping[str, str] = {
    "expert": "everything",
    "expert+learn=off": "no memory: nothing of one encounter is known in the next",
    "expert+tuner=off+learn=off": "no tuner: the authors' numbers alone",
    "expert+replan=60+learn=off": "no replanning: one endpoint an attempt",
    "expert+forecast=constant+learn=off": "the ego predicted by constant velocity",
    "expert+shift=-1.5+learn=off": "the trigger 1.5 s early",
    "expert+shift=1.5+learn=off": "the trigger 1.5 s late",
}
"""Row -> what is left out; each compared with ``REFERENCE``."""
REFERENCE = "expert+learn=off"
SAMPLES = (1, 3, 5)
GROWING = ("", "+learn=off", "+recall=scene")  # learning, its reference, and recall by scene


def sampled(model: str) -> dict[str, str]:
    """Row -> what: a model as it is and asked several times, which differ in that alone."""
    return {f"llm-a:{model}+samples={k}+learn=off": f"{model}, the analyzer asked {k} times" for k in SAMPLES}


@dataclass(frozen=True, slots=True)
class Method:
    """A row that is the program itself. ``settings``: what differs from the table's; ``shift`` [s]: of the trigger."""

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    fixed: bool = False  # a bank of two intents
    learns: bool = False
    shift: float = 0.0

    @property
    def key(self) -> str:
        """What methods must have in common to share one simulation."""
        return json.dumps([dict(self.settings), self.shift], sort_keys=True)


def method_of(row: str) -> Method | None:
    """The method of that name; None if it is not the program's own.

    Raises:
        UsageError: a setting that there is not, or that a table gives for all rows.
    """
    base, *changes = row.split("+")
    kind, _, model = base.partition(":")
    if kind not in (*OWN, RAW) or (model and kind not in ("llm-a", "llm-f")):
        return None
    if kind == RAW:
        if changes:
            raise UsageError(f"The row '{row}' has no settings to change; say just '{kind}'.")
        return Method(row)
    if kind == "llm-a" and not model:
        raise UsageError("The row llm-a needs a model: llm-a:NAME; without one it is the row 'expert'.")
    settings: dict[str, Any] = {"llm": model} if model else {}
    shift = 0.0
    for change in changes:
        name, equals, value = change.partition("=")
        if not equals or (name != "shift" and name not in Settings.model_fields):
            raise UsageError(f"The row '{row}' changes '{name}', which is no setting; say it as expert+NAME=VALUE.")
        if name in GIVEN_ELSEWHERE:
            raise UsageError(f"The row '{row}' changes '{name}', which is the same for all rows of a table.")
        if name == "llm":
            raise UsageError(f"The row '{row}' changes 'llm'; a row with a model is called llm-a:NAME or llm-f:NAME.")
        if name == "shift":
            shift = _number(row, value)
        else:
            settings[name] = value
    load_settings(None, **settings)  # raises for bad values
    learns = settings.pop("learn", "off" if kind == "llm-f" else "on") == "on"
    if learns and kind == "llm-f":
        raise UsageError(f"The row '{row}' learns, but llm-f is the row with a bank that stays; say llm-a or expert.")
    return Method(row, settings, kind == "llm-f", learns, shift)


def growing_banks(rows: Sequence[str]) -> list[str]:
    """A sentence for each row that changes its bank as a table goes on."""
    return [
        f"The bank of the row {row} grows from encounter to encounter, so its figures depend on their order; with "
        "learn=off it stays as it is."
        for row in rows
        if (method := method_of(row)) is not None and method.learns
    ]


def _number(row: str, value: str) -> float:
    try:
        seconds = float(value)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise UsageError(f"The row '{row}' has shift={value}, which is no number of seconds.")
    return seconds
