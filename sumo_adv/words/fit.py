"""Whether an attempt is what was asked for, by rules: the adversary, what it does in which order, and the side hit."""

from __future__ import annotations

from sumo_adv.asked import Asked, Event
from sumo_adv.words.motion import Motion, change_after

SLACK = 0.4  # s by which an event may be earlier than its predecessor


def misfits(asked: Asked, motion: Motion) -> tuple[str, ...]:
    """What an attempt lacks of the request, a sentence each; empty if it fits."""
    lacks = []
    if asked.user is not None and asked.user is not motion.user:
        lacks.append(f"The adversary is a {motion.user}, not a {asked.user}.")
    if asked.relation is not None and asked.relation != motion.relation:
        lacks.append(f"The adversary is {motion.relation}, not {asked.relation}.")
    if (missing := _missing(asked.events, motion)) is not None:
        after = "" if missing == 0 else f" after '{asked.events[missing - 1]}'"
        happened = ", ".join(f"{event} at {time:.1f} s" for time, event in motion.events) or "nothing of note"
        lacks.append(f"'{asked.events[missing]}' does not happen{after}; what happens: {happened}.")
    if asked.side is not None and asked.side != motion.side:
        hit = f"The ego is hit at its {motion.side}" if motion.side else "The ego is not hit"
        lacks.append(f"{hit}, not at its {asked.side}.")
    if asked.hidden and not motion.hidden:
        lacks.append("Nothing hides the adversary from the ego at first.")
    if asked.beside is not None and asked.beside not in motion.beside:
        lacks.append(f"No other vehicle is beside the ego on its {asked.beside}.")
    if asked.least_length is not None and motion.length < asked.least_length:
        lacks.append(f"The adversary is {motion.length:g} m long, not {asked.least_length:g} m or more.")
    first = float(motion.speed[0])
    if asked.most_speed_first is not None and first > asked.most_speed_first:
        lacks.append(f"The adversary drives {first:.1f} m/s at first, not {asked.most_speed_first:g}.")
    return tuple(lacks)


def _missing(wanted: tuple[Event, ...], motion: Motion) -> int | None:
    """The place of the first wanted event that does not come in its order; None if all do."""
    after = 0.0
    for place, event in enumerate(wanted):
        if event in (Event.BRAKES, Event.SPEEDS_UP):
            time = change_after(motion.time, motion.speed, after - SLACK, event)
        else:
            times = (time for time, happened in motion.events if happened is event and time >= after - SLACK)
            time = min(times, default=None)
        if time is None:
            return place
        after = max(after, time)
    return None
