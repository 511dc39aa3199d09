"""Trying planners in the sandbox on made-up situations, before they are taken and whenever ``memory verify`` asks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_adv.datatypes import Floats, Planner
from sumo_adv.errors import SandboxError
from sumo_adv.planners.probes import HORIZON, Probe, probes

if TYPE_CHECKING:
    from sumo_adv.planners.sandbox import Call, PlannerSession, Sandbox

FASTEST = 60.0  # m/s: no vehicle on a road gets farther than this from where it is, and
NEAR = 20.0  # m more
OFF_ROAD, DRIFT = 10.0, 0.5  # m from every centreline, and that more for each m it is away: bends may be cut
ACCELERATIONS = (0.0, -6.0)  # m/s2


def trial(sandbox: Sandbox, planner: Planner, applies: Sequence[str], *, type_check: bool = False) -> str | None:
    """None if the planner answers well in every situation of the relations, else one sentence on what it does not.

    It must load, pass the sandbox's checks of each endpoint with its parameters at their defaults, low and high ends,
    stay where a vehicle can get and by the road, answer alike in whatever order it is asked, and its own
    ``trajectory`` must work.
    ``type_check``: have its text type checked too.
    """
    situations = [probe for relation in applies for probe in probes(relation)]
    roads = {probe.name: probe.road for probe in situations}
    named = list(_calls(planner, situations))
    calls = [call for _, call in named]
    try:
        with sandbox.session(planner, roads, type_check=type_check) as session:
            first = _first(session, calls[0])  # one that never ends is found out here, and not in each of its calls
            if first is not None:
                return f"In the situation {named[0][0]!r}: {first}"
            forth = session.endpoints(calls)
        for (name, call), answer in zip(named, forth, strict=True):
            if (wrong := _wrong(call, roads[call[0]], answer)) is not None:
                return f"In the situation {name!r}: {wrong}"
        with sandbox.session(planner, roads) as session:
            back = session.endpoints(calls[::-1])[::-1]
            for (name, _), one, other in zip(named, forth, back, strict=True):
                if not isinstance(other, dict) or one != other:
                    return f"In the situation {name!r}: its answer depends on what it was asked before."
            return _own_trajectory(session, named, forth) if session.has_trajectory else None
    except SandboxError as error:
        return str(error)


def trier(sandbox: Sandbox) -> Callable[[Any, Planner], str | None]:
    """``trial`` for ``exchange.import_bank``: takes the intent's record."""
    return lambda intent, planner: trial(sandbox, planner, intent.applies)


def _first(session: PlannerSession, call: Call) -> SandboxError | None:
    try:
        session.endpoint(*call)
    except SandboxError as error:
        return error
    return None


def _calls(planner: Planner, situations: Sequence[Probe]) -> list[tuple[str, Call]]:
    ends = {
        "defaults": planner.defaults(),
        "low parameters": {p.name: p.low for p in planner.parameters},
        "high parameters": {p.name: p.high for p in planner.parameters},
    }
    return [
        (f"{probe.name}, {words}", (probe.name, probe.bv, probe.ego, values, acceleration, HORIZON))
        for probe in situations
        for words, values in ends.items()
        for acceleration in ACCELERATIONS
    ]


def _wrong(call: Call, road: Mapping[str, Any], answer: dict[str, float] | SandboxError) -> str | None:
    if isinstance(answer, SandboxError):
        return str(answer)
    _, bv, *_ = call
    distance = math.hypot(answer["x"] - bv["x"], answer["y"] - bv["y"])
    if distance > NEAR + FASTEST * answer["time"]:
        return f"it asks for a place {distance:.0f} m away within {answer['time']:.1f} s, which no vehicle reaches."
    aside = _aside(road, answer["x"], answer["y"])
    if aside > OFF_ROAD + DRIFT * distance:
        return f"it asks for a place {aside:.0f} m beside the road."
    return None


def _aside(road: Mapping[str, Any], x: float, y: float) -> float:
    """Metres from a place to the nearest centreline, each going straight on beyond its ends."""
    lines = [road["ego_centreline"], *(way["centreline"] for way in road["ways"])]
    return min(_from_line(np.asarray(line, float), x, y) for line in lines)


def _from_line(line: Floats, x: float, y: float) -> float:
    a, b = line[:-1], line[1:]
    d = b - a
    length = np.hypot(d[:, 0], d[:, 1])
    along = ((x - a[:, 0]) * d[:, 0] + (y - a[:, 1]) * d[:, 1]) / length
    low = np.where(np.arange(len(a)) == 0, -np.inf, 0.0)
    high = np.where(np.arange(len(a)) == len(a) - 1, np.inf, length)
    share = np.clip(along, low, high) / length
    return float(np.hypot(x - a[:, 0] - share * d[:, 0], y - a[:, 1] - share * d[:, 1]).min())


def _own_trajectory(
    session: PlannerSession, named: Sequence[tuple[str, Call]], answers: Sequence[dict[str, float] | SandboxError]
) -> str | None:
    """None, or what is wrong with the planner's own trajectory in a dozen of the situations."""
    for (name, call), endpoint in list(zip(named, answers, strict=True))[:: max(1, len(named) // 12)]:
        assert isinstance(endpoint, dict)  # the others were found out before
        try:
            session.trajectory(call[0], call[1], endpoint, 0.1)
        except SandboxError as error:
            return f"In the situation {name!r}: {error}"
    return None
