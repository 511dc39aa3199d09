"""Check whether a motion fits a request: compare it with each part of the request."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.asked import Asked, Event
from sumo_adv.words.motion import DescribedMotion, change_after, end_of_change

BRAKING_WINDOW_S = 0.5  # duration over which braking is averaged
EVENT_ORDER_SLACK_S = 0.4  # an event may be this much earlier than its predecessor


@dataclass(frozen=True, slots=True)
class Part:
    """One part of a request, compared with a motion.

    Attributes:
        name: The key of ``Asked`` that requests the part; for an event, ``events: `` and the event.
        holds: Whether the motion has the part.
        says: What the motion shows of the part, in one sentence.
    """

    name: str
    holds: bool
    says: str


def compare(asked: Asked, motion: DescribedMotion) -> tuple[Part, ...]:
    """Compare a motion with each part of a request.

    Events are looked for in their order. An event that does not happen does not constrain the events after it. An
    event that is requested twice must happen twice.

    Args:
        asked: The request.
        motion: What happened.

    Returns:
        The parts that the request names; empty if it names none.
    """
    parts = []
    if asked.user is not None:
        holds = asked.user is motion.user
        lack = "" if holds else f", not a {asked.user}"
        parts.append(Part("user", holds, f"The adversary is a {motion.user}{lack}."))
    if asked.relation is not None:
        holds = asked.relation == motion.relation
        lack = "" if holds else f", not {asked.relation}"
        parts.append(Part("relation", holds, f"The adversary is {motion.relation}{lack}."))
    parts += _events(asked.events, motion)
    if asked.side is not None:
        holds = asked.side == motion.side
        hit = f"The ego is hit at its {motion.side}" if motion.side else "The ego is not hit"
        lack = "" if holds else f", not at its {asked.side}"
        parts.append(Part("side", holds, f"{hit}{lack}."))
    if asked.hidden:
        what = "Something hides" if motion.hidden else "Nothing hides"
        parts.append(Part("hidden", motion.hidden, f"{what} the adversary from the ego before it comes into the way."))
    if asked.beside is not None:
        holds = asked.beside in motion.beside
        who = "Another vehicle" if holds else "No other vehicle"
        parts.append(Part("beside", holds, f"{who} is beside the ego on its {asked.beside}."))
    if asked.least_length is not None:
        holds = motion.length >= asked.least_length
        lack = "" if holds else f", not {asked.least_length:g} m or more"
        parts.append(Part("least_length", holds, f"The adversary is {motion.length:g} m long{lack}."))
    if asked.most_speed_first is not None:
        first = float(motion.speed[0])
        holds = first <= asked.most_speed_first
        lack = "" if holds else f", not {asked.most_speed_first:g}"
        parts.append(Part("most_speed_first", holds, f"The adversary drives {first:.1f} m/s at first{lack}."))
    if asked.most_braking is not None:
        hardest = _hardest(motion)
        holds = hardest <= asked.most_braking
        lack = "" if holds else f", not with at most {asked.most_braking:g}"
        parts.append(Part("most_braking", holds, f"The adversary brakes with {hardest:.1f} m/s2{lack}."))
    return tuple(parts)


def compare_attackers(
    asked: Asked, attackers: Mapping[str, Asked], motions: Mapping[str, DescribedMotion], collider: str
) -> tuple[Part, ...]:
    """Compare the motions of all attackers with each part of a request.

    Args:
        asked: What is requested of the attack.
        attackers: What is requested of each of several attackers, by id; empty for one adversary.
        motions: What happened, by the attacker's id.
        collider: The id of the attacker whose verdict counts. Its motion is compared with ``asked``.

    Returns:
        The parts; those of one of several attackers begin with its id.
    """
    parts = list(compare(asked, motions[collider]))
    for name, own in attackers.items():
        if name in motions:
            of_it = compare(own, motions[name])
            parts += [Part(f"{name}: {part.name}", part.holds, f"{name}: {part.says}") for part in of_it]
        else:
            parts.append(Part(name, False, f"{name} was gone at once."))
    if asked.within is not None and attackers:
        parts.append(_together(asked.within, attackers, motions))
    return tuple(parts)


def _together(within: float, attackers: Mapping[str, Asked], motions: Mapping[str, DescribedMotion]) -> Part:
    """Compare the times of the last event that is asked of each attacker."""
    last = {
        name: _times_of(own.events, motions[name])[-1] if name in motions else None
        for name, own in attackers.items() if own.events
    }  # fmt: skip
    times = [time for time in last.values() if time is not None]
    if not times or len(times) < len(last):
        return Part("within", False, "Not all attackers do what is asked of them.")
    span = max(times) - min(times)
    lack = "" if span <= within else f", not {within:g} s"
    return Part("within", span <= within, f"What is asked of the attackers happens within {span:.1f} s{lack}.")


def misfits(parts: Iterable[Part]) -> tuple[str, ...]:
    """Return what an attempt lacks of the request, one sentence each; empty if it fits.

    Args:
        parts: The parts of the request.
    """
    return tuple(part.says for part in parts if not part.holds)


def held(parts: Sequence[Mapping[str, Any]]) -> str:
    """Name the parts that hold, in one sentence; empty if none does.

    Args:
        parts: The parts, as in ``outcome.json``.
    """
    names = [str(part["name"]) for part in parts if part["holds"]]
    return f"What holds: {', '.join(names)}." if names else ""


def _events(wanted: Sequence[Event], motion: DescribedMotion) -> Iterator[Part]:
    """Yield the wanted events in their order, each compared with the motion."""
    happened = ", ".join(f"{event} at {time:.1f} s" for time, event in motion.events) or "nothing of note"
    last = ""
    for event, time in zip(wanted, _times_of(wanted, motion), strict=True):
        if time is None:
            yield Part(f"events: {event}", False, f"'{event}' does not happen{last}; what happens: {happened}.")
        else:
            yield Part(f"events: {event}", True, f"'{event}' happens at {time:.1f} s{last}.")
            last = f" after '{event}'"


def _times_of(wanted: Sequence[Event], motion: DescribedMotion) -> list[float | None]:
    """Return when the wanted events happen in their order [s]; None for one that does not."""
    after, times = 0.0, list[float | None]()
    ends: dict[Event, float] = {}  # when the last occurrence of an event ends [s]
    for event in wanted:
        earliest = max(after - EVENT_ORDER_SLACK_S, ends.get(event, -math.inf))
        time = _time_of(event, earliest, motion)
        if time is not None:
            after = max(after, time)
            ends[event] = _end_of(event, time, motion)
        times.append(time)
    return times


def _time_of(event: Event, earliest: float, motion: DescribedMotion) -> float | None:
    """Return when an event first happens at ``earliest`` or later [s]; None if it does not."""
    if event in (Event.BRAKES, Event.SPEEDS_UP):
        return change_after(motion.time, motion.speed, earliest, event)
    return min((time for time, happened in motion.events if happened is event and time >= earliest), default=None)


def _end_of(event: Event, time: float, motion: DescribedMotion) -> float:
    """Return the earliest time of another occurrence of an event that happens at ``time`` [s]."""
    if event in (Event.BRAKES, Event.SPEEDS_UP):
        return end_of_change(motion.time, motion.speed, time, event)
    return math.nextafter(time, math.inf)


def _hardest(motion: DescribedMotion) -> float:
    """Return the hardest braking of the adversary, averaged over ``BRAKING_WINDOW_S`` [m/s2]."""
    late = np.searchsorted(motion.time, motion.time + BRAKING_WINDOW_S - 1e-6)
    k = np.flatnonzero(late < len(motion.time))
    lost = motion.speed[k] - motion.speed[late[k]]
    return float((lost / (motion.time[late[k]] - motion.time[k])).max(initial=0.0))
