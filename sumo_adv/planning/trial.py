"""Trying planners in the sandbox on made-up situations, before they are taken and whenever ``memory verify`` asks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from sumo_adv.datatypes import Planner
from sumo_adv.errors import SandboxError
from sumo_adv.planning.probes import HORIZON, Probe, probes

if TYPE_CHECKING:
    from sumo_adv.planning.sandbox import Call, PlannerSession, Sandbox

FASTEST = 60.0  # m/s: no vehicle on a road gets farther than this from where it is, and
NEAR = 20.0  # m more
ACCELERATIONS = (0.0, -6.0)  # m/s2


def trial(sandbox: Sandbox, planner: Planner, applies: Sequence[str], *, type_check: bool = False) -> str | None:
    """None if the planner answers well in every situation of the relations, else one sentence on what it does not.

    It must load, pass the sandbox's checks of each endpoint with its parameters at their defaults, low and high ends,
    stay where a vehicle can get, answer alike in whatever order it is asked, and its own ``trajectory`` must work.
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
            if (wrong := _wrong(call, answer)) is not None:
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


def _wrong(call: Call, answer: dict[str, float] | SandboxError) -> str | None:
    if isinstance(answer, SandboxError):
        return str(answer)
    _, bv, *_ = call
    distance = math.hypot(answer["x"] - bv["x"], answer["y"] - bv["y"])
    if distance > NEAR + FASTEST * answer["time"]:
        return f"it asks for a place {distance:.0f} m away within {answer['time']:.1f} s, which no vehicle reaches."
    return None


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
