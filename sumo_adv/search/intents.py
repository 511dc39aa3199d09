"""Intents that the program adds to the library of a bank, and the intents that a search may try.

The built-in expert composes intents for relations that the library does not cover. Free motions are offered in
recordings, where the vehicles' positions often match no intent of the library. A free motion leads to a place near the
ego's future position, at a time and a speed of the vehicle's own, whatever its lane. An attempt of a free motion is
named afterwards by the collision that it caused (``labelled_by_motion``). It becomes part of the memory bank only if a
success adds it to an intent.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from sumo_adv.datatypes import Intent, LibraryEntry, Proposal, Verdict
from sumo_adv.errors import UsageError, nearest
from sumo_adv.memory.records import RELATIONS, canonical
from sumo_adv.planners.text import make_planner
from sumo_adv.situation import Situation, Target

# -- composed by the expert -----------------------------------------------------------------------------------------

EXPERT = "expert"

NEW_INTENTS: Mapping[str, tuple[str, str, str]] = {
    "merging": (
        "Ramp Merge Rush",
        "From a slip road or a feeder road that joins, the vehicle ignores the yield sign and arrives where both "
        "carriageways unite together with the ego.",
        "any",
    ),
    "crossing_right": (
        "Intersection Rush-through Turn Right",
        "The vehicle turns right through the junction without giving way, at a moment that meets the ego.",
        "right",
    ),
}

COMPOSED = frozenset(label for label, _, _ in NEW_INTENTS.values())
"""Labels of the intents that the expert composes itself."""


def composed(entry: LibraryEntry) -> bool:
    """Return whether all planners of the intent are the expert's own.

    Args:
        entry: The intent of a library.
    """
    return entry.label in COMPOSED and all(p.origin == EXPERT for p in entry.planners)


def compose(situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
    """Compose intents of ``NEW_INTENTS`` for relations that no other intent of the library covers.

    Args:
        situations: The situations by delay after the trigger [s]; the earliest one counts.
        library: The intents that may be tried.

    Returns:
        The intents, one for each vehicle and relation. Their source is ``memory`` if the bank has learnt them by now,
        otherwise ``generated``.
    """
    labels = {entry.label for entry in library}
    covered = {word for entry in library if not composed(entry) for word in entry.applies}
    intents = []
    for target in situations[min(situations)].target_list():
        for word, (label, description, _) in NEW_INTENTS.items():
            if word in target.applies() and word not in covered:
                reason = "no intent of the library can reach the ego from where this vehicle is"
                source = "memory" if label in labels else "generated"
                intents.append(Intent(target.state.id, label, description, "medium", 0.0, reason, source))
    return intents


def applies_of(label: str) -> tuple[str, ...]:
    """Return the relations that a composed intent applies to.

    Args:
        label: The label of the intent.
    """
    return tuple(word for word, (name, _, _) in NEW_INTENTS.items() if name == label)


# -- free motions ---------------------------------------------------------------------------------------------------

_FREE_MOTION_TEXT = """\
# Free Motion, mode "free"
# Leaves its way and meets the ego at a place beside or ahead of it, at a time and with a speed of its own.
PARAMETERS = {
    "meet": (4.0, 1.5, 7.5, "s", "how long after its start it meets the ego"),
    "ahead": (2.0, -4.0, 7.0, "m", "how far ahead of the ego's centre its own is then"),
    "left": (0.0, -2.5, 2.5, "m", "how far to the left of it"),
    "pace": (0.5, 0.0, 1.2, "", "its speed then, as a share of the ego's and its own mean speed"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    time = max(parameters["meet"] - bv["time"], 0.8)
    for _ in range(3):  # later where it cannot be there in time
        pose = at(ego["path"], time)
        x, y = offset(pose, parameters["ahead"], parameters["left"])
        dx = x - bv["x"]
        dy = y - bv["y"]
        time = max(time, 1.2 * math.sqrt(dx * dx + dy * dy) / max(road["fastest"], 1.0))
    heading = bv["heading"]
    if dx * dx + dy * dy > 25.0:
        heading = math.atan2(dy, dx)
    if bv["ahead"] * bv["ahead"] + bv["left"] * bv["left"] < 900.0 and abs(wrap(pose[2] - heading)) < 0.5:
        heading = pose[2]
    mean = 0.5 * (pose[3] + road["start"]["speed"])
    speed = clip(parameters["pace"] * mean, 0.0, road["fastest"])
    return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}
"""

FREE_MOTION = "Free Motion"
FREE = LibraryEntry(
    FREE_MOTION,
    "The vehicle leaves its way and goes to where the ego will be, at a time and a speed of its own.",
    tuple(word for word in RELATIONS if not word.startswith(("cyclist", "pedestrian"))),
    (make_planner(FREE_MOTION, "free", _FREE_MOTION_TEXT, EXPERT),),
    "generated",
)

_LABEL_BY_CONTACT = {
    ("leader", "front"): "Emergency Braking",
    ("neighbour", "front"): "Aggressive Cut-in",
    ("neighbour", "left"): "Straight Lane Shift",
    ("neighbour", "right"): "Straight Lane Shift",
    ("neighbour", "rear"): "Close Car-following",
    ("follower", "rear"): "Close Car-following",
}  # by relation and by the side of the ego that is hit
_WORDS = {
    "oncoming": "Opposite Direction Intrusion",
    "crossing_straight": "Intersection Rush-through Go-straight",
    "crossing_left": "Intersection Rush-through Turn Left",
    **{word: label for word, (label, _, _) in NEW_INTENTS.items()},
}


def labelled_by_motion(p: Proposal, target: Target, verdict: Verdict) -> Proposal:
    """Label a free motion that collided with the intent that it carried out.

    The relation and the side of the ego that was hit decide. For other relations the label is that of the way of the
    vehicle that meets the ego's path soonest.

    Args:
        p: The candidate that was attempted.
        target: Its vehicle.
        verdict: The verdict on the attempt.

    Returns:
        The candidate with the new label. It is unchanged if it is no free motion, did not collide, or if no intent
        fits.
    """
    if p.label != FREE_MOTION or not verdict.collided:
        return p
    label = _LABEL_BY_CONTACT.get((target.relation, verdict.contact_side or ""))
    if label is None:
        label = next((_WORDS[word] for word in _by_conflict(target) if word in _WORDS), None)
    return p if label is None else replace(p, label=label, planner=replace(p.planner, label=label))


def entry_of(p: Proposal, library: Sequence[LibraryEntry]) -> LibraryEntry:
    """Return the intent of the library that a candidate was drawn from.

    A free motion that collided has the label of another intent, which the library may lack.

    Args:
        p: The candidate.
        library: The intents that candidates are drawn from.

    Returns:
        The intent that has the planner; otherwise the intent with the candidate's label, and finally the free motion.

    Raises:
        StopIteration: The library has none of these.
    """
    drawn_from = (e for e in library if p.planner.hash in {planner.hash for planner in e.planners})
    changed = (e for e in library if e.label == p.label)  # the candidate's planner is a version that the library lacks
    return next(chain(drawn_from, changed, (e for e in library if e.label == FREE_MOTION)))


def _by_conflict(target: Target) -> list[str]:
    """Return the vehicle's relations; if some ways meet the ego's path, only those of the way that does so soonest."""
    meeting = [w for w in target.ways if w.conflict is not None]
    if target.relation == "oncoming" or not meeting:
        return list(target.applies())
    soonest = min(meeting, key=lambda w: w.conflict.bv_s if w.conflict is not None else 0.0)
    return list(replace(target, ways=(soonest,)).applies())


# -- selection ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Selection:
    """The labels of intents that may be tried.

    Attributes:
        only: No other labels may be tried; None allows all.
        exclude: These labels may not be tried.
    """

    only: frozenset[str] | None = None
    exclude: frozenset[str] = frozenset()

    def allows(self, label: str) -> bool:
        """Return whether an intent may be tried.

        Args:
            label: The label of the intent.
        """
        return label not in self.exclude and (self.only is None or label in self.only)

    def names(self, label: str) -> bool:
        """Return whether ``only`` names an intent that may be tried.

        Args:
            label: The label of the intent.
        """
        return self.only is not None and label in self.only and label not in self.exclude

    @property
    def is_open(self) -> bool:
        """Whether nothing is restricted, so that a language model may invent intents."""
        return self.only is None and not self.exclude

    def of(self, library: Sequence[LibraryEntry]) -> tuple[LibraryEntry, ...]:
        """Return the entries of a library that may be tried.

        Args:
            library: The entries to choose from.
        """
        return tuple(e for e in library if self.allows(e.label))


def select(
    known: Iterable[str], intents: Sequence[str] = (), exclude: Sequence[str] = (), scenario: Sequence[str] = ()
) -> Selection:
    """Combine the settings ``intents`` and ``exclude`` with the intents of a scenario.

    The setting ``intents`` takes precedence over the scenario's list. Case and punctuation are ignored. An unknown
    intent of the scenario is no error, so that a bank with fewer intents can run any scenario.

    Args:
        known: Labels of the memory bank. Composed intents and free motions are always known.
        intents: The setting ``intents``; empty allows all.
        exclude: The setting ``exclude``.
        scenario: The intents of the scenario; empty allows all.

    Returns:
        The labels that may be tried.

    Raises:
        UsageError: A setting names an unknown intent, or no intent is left.
    """
    labels = {canonical(label): label for label in (FREE_MOTION, *COMPOSED, *known)}
    chosen, without = (frozenset(_label(name, labels) for name in names) for names in (intents, exclude))
    only = chosen or frozenset(labels.get(canonical(name), name) for name in scenario) or None
    if not (frozenset(labels.values()) if only is None else only) - without:
        place = "the scenario's own list" if scenario and not chosen else "intents"
        raise UsageError(f"No intent is left to try: {place} and exclude together leave none.")
    return Selection(only, without)


def _label(name: str, labels: Mapping[str, str]) -> str:
    """Return the label that a name means; raise UsageError with the known labels if there is none."""
    label = labels.get(canonical(name))
    if label is None:
        names = ", ".join(sorted(labels.values()))
        raise UsageError(f"There is no intent '{name}'{nearest(name, labels.values())}; known intents are {names}.")
    return label
