"""The ego's own moves and crests of a draft: their tables in the scenario, and when the ego is where.

The ego is taken to keep its speed, to slow down for its moves as a run has it, and to speed up at ``SPEEDING_UP_M_S2``.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import ValidationError

from sumo_adv.datatypes import Floats
from sumo_adv.ego_way import EgoMove, SightStretch
from sumo_adv.errors import UsageError
from sumo_adv.files import toml_lines
from sumo_adv.parsing import first_fault
from sumo_adv.words.draft import EgoDraft

SLOWING_M_S2, SPEEDING_UP_M_S2 = 2.0, 2.6
STEP_S, LONGEST_S = 0.1, 600.0
STOP_ROOM_M = 0.05  # an ego this near to the place of a stop is there


def way_tables(ego: EgoDraft) -> list[str]:
    """Return the TOML tables of the ego's moves and crests.

    Args:
        ego: The ego of a draft.

    Raises:
        UsageError: A move lacks something, or several are attacked.
    """
    rows: list[tuple[str, dict[str, object]]] = []
    try:
        for move in ego.moves:
            given = move.model_dump(exclude_none=True)
            if move.speed is not None:
                given["speed"] = round(move.speed / 3.6, 2)
            rows.append(("moves", EgoMove.model_validate(given).model_dump(exclude_defaults=True)))
        for crest in ego.crests:
            stretch = SightStretch.model_validate({"from": crest.begin, "to": crest.end, "limit": crest.limit})
            rows.append(("sight", stretch.model_dump(by_alias=True)))
    except ValidationError as error:
        raise UsageError(f"A move or crest of the ego {first_fault(error)}") from error
    if sum(move.attacked for move in ego.moves) > 1:
        raise UsageError("Only one move of the ego can be attacked.")
    return ["\n".join(["", f"[[{name}]]", *toml_lines(row), ""]) for name, row in rows]


def come_after(ego: EgoDraft, *seconds: float) -> list[float]:
    """Return how far the ego has come after some times [m].

    Args:
        ego: The ego of a draft.
        *seconds: Times after the start [s].
    """
    time, come = _motion(ego)
    return [float(each) for each in np.interp(seconds, time, come)]


def time_to(ego: EgoDraft, distance: float) -> float:
    """Return when the ego has come so far [s after the start].

    Args:
        ego: The ego of a draft.
        distance: The distance [m].
    """
    time, come = _motion(ego)
    first = np.concatenate([[True], np.diff(come) > 0.0])  # it stands in the others
    return float(np.interp(distance, come[first], time[first]))


def _motion(ego: EgoDraft) -> tuple[Floats, Floats]:
    """Return times [s] and how far the ego has come then [m], ``(n,)`` each."""
    count = round(LONGEST_S / STEP_S)
    come, speed, pace = np.zeros(count + 1), ego.speed / 3.6, ego.speed / 3.6
    speeds = [(move.at, move.speed / 3.6) for move in ego.moves if move.at is not None and move.speed is not None]
    stops = [(move.at, move.seconds) for move in ego.moves if move.at is not None and move.seconds is not None]
    stood = [0.0] * len(stops)
    for k in range(count):
        pace = next((fast for at, fast in reversed(speeds) if come[k] >= at), pace)
        after = min(speed + SPEEDING_UP_M_S2 * STEP_S, max(pace, speed - SLOWING_M_S2 * STEP_S))
        for j, (at, seconds) in enumerate(stops):
            room = at - come[k]
            if stood[j] < seconds and room < STOP_ROOM_M:
                after, stood[j] = 0.0, stood[j] + STEP_S
            elif stood[j] < seconds:
                after = min(after, math.sqrt(2.0 * SLOWING_M_S2 * room))
        come[k + 1] = come[k] + (speed + after) / 2 * STEP_S
        speed = after
    return np.linspace(0.0, LONGEST_S, count + 1), come
