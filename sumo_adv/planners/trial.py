"""The trial of a planner: its answers in made-up situations, before it enters a bank and in ``memory verify``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_adv.datatypes import Floats, Planner
from sumo_adv.errors import SandboxError
from sumo_adv.planners.probes import HORIZON, Probe, probes

if TYPE_CHECKING:
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.planners.session import Call, PlannerSession

REACH, REACH_SPEED = 20.0, 60.0  # m, m/s: an endpoint may be this far away, and farther by this speed
OFF_ROAD, DRIFT = 10.0, 0.5  # m from every centreline, and metres more for each metre ahead: bends may be cut
ACCELERATIONS = (0.0, -6.0)  # m/s2


def trial(sandbox: Sandbox, planner: Planner, applies: Sequence[str], *, type_check: bool = False) -> str | None:
    """None if the planner passes in every situation of the relations, else one sentence on its first fault.

    The planner must load. Its endpoints must pass the sandbox's checks with all parameters at their defaults, low and
    high ends, be within reach and near the road, and not depend on the order of the calls. Its own ``trajectory``, if
    it defines one, must pass the sandbox's checks.

    ``type_check``: type check its text too.
    """
    situations = [probe for relation in applies for probe in probes(relation)]
    roads = {probe.name: probe.road for probe in situations}
    named = list(_calls(planner, situations))
    calls = [call for _, call in named]
    try:
        with sandbox.session(planner, roads, type_check=type_check) as session:
            # one call first: a planner that never ends costs its time limit once, and not in each call
            if (failure := _failure(session, calls[0])) is not None:
                return f"In the situation {named[0][0]!r}: {failure}"
            forth = session.endpoints(calls)
        for (name, call), answer in zip(named, forth, strict=True):
            if (fault := _fault(call, roads[call[0]], answer)) is not None:
                return f"In the situation {name!r}: {fault}"
        with sandbox.session(planner, roads) as session:
            back = session.endpoints(calls[::-1])[::-1]
            for (name, _), answer, again in zip(named, forth, back, strict=True):
                if not isinstance(again, dict) or answer != again:
                    return f"In the situation {name!r}: its answer depends on earlier calls."
            return _own_trajectory(session, named, forth) if session.has_trajectory else None
    except SandboxError as error:
        return str(error)


def trier(sandbox: Sandbox) -> Callable[[Any, Planner], str | None]:
    """``trial`` as a function of an intent's record and a planner, for ``exchange.import_bank``."""
    return lambda intent, planner: trial(sandbox, planner, intent.applies)


def _failure(session: PlannerSession, call: Call) -> SandboxError | None:
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


def _fault(call: Call, road: Mapping[str, Any], answer: dict[str, float] | SandboxError) -> str | None:
    if isinstance(answer, SandboxError):
        return str(answer)
    _, bv, *_ = call
    distance = math.hypot(answer["x"] - bv["x"], answer["y"] - bv["y"])
    if distance > REACH + REACH_SPEED * answer["time"]:
        return f"it asks for a place {distance:.0f} m away within {answer['time']:.1f} s, which no vehicle reaches."
    aside = _aside(road, answer["x"], answer["y"])
    if aside > OFF_ROAD + DRIFT * distance:
        return f"it asks for a place {aside:.0f} m beside the road."
    return None


def _aside(road: Mapping[str, Any], x: float, y: float) -> float:
    """Metres from a place to the nearest centreline. Centrelines go straight on beyond their ends."""
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
    """None, or a sentence on a fault of the planner's own trajectory in a dozen of the situations."""
    for (name, call), endpoint in list(zip(named, answers, strict=True))[:: max(1, len(named) // 12)]:
        assert isinstance(endpoint, dict)  # failures were returned before
        try:
            session.trajectory(call[0], call[1], endpoint, 0.1)
        except SandboxError as error:
            return f"In the situation {name!r}: {error}"
    return None
