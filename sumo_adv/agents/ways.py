"""How an intent is carried out: the modes that a model may choose from, its choices, and what they mean."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import takewhile
from typing import Literal

from pydantic import BaseModel, Field

from sumo_adv.agents.scene_text import Aliases
from sumo_adv.datatypes import Level, LibraryEntry, ModeChoice, Planner, Prediction, Proposal
from sumo_adv.llm.prompts import sanitize
from sumo_adv.planners.text import uses_acceleration
from sumo_adv.search.settings import SearchSettings
from sumo_adv.situation import Situation

MAX_WAYS_PER_INTENT = 3
NAME_LINE = re.compile(r'.*, mode "[^"]+"')  # the first line of shipped planners: # Aggressive Cut-in, mode "side"

# The two classes below are sent to the model as a JSON schema, with their names and docstrings.


class Moment(BaseModel):
    """A condition for the start: the first moment at which the quantity is at most this."""

    quantity: Literal["distance", "ego_arrival"]
    at_most: float


class HowTo(BaseModel):
    """One way to carry an intent out."""

    mode: str = Field(min_length=1, max_length=40)
    parameters: dict[str, float] = Field(default_factory=dict)
    begin: float | Moment = 0.0


def modes_words(entry: LibraryEntry) -> list[str]:
    """List the modes of an intent with their parameters, one line each; only the first version of a mode.

    Args:
        entry: The intent.
    """
    lines = []
    for planner in first_of_each_mode(entry):
        mark = " (uses acceleration)" if uses_acceleration(planner.text) else ""
        lines.append(f"  mode {sanitize(planner.mode)}{mark}: {opening_comment(planner.text)}")
        lines += [
            f"    {sanitize(p.name)}: {p.default:g} ({p.low:g} to {p.high:g}{' ' + p.unit if p.unit else ''})"
            f"{', ' + sanitize(p.meaning) if p.meaning else ''}"
            for p in planner.parameters
        ]
    return lines


def first_of_each_mode(entry: LibraryEntry) -> list[Planner]:
    """Return the planners that the names of the modes refer to: the first one of each mode.

    Args:
        entry: The intent.
    """
    first: dict[str, Planner] = {}
    for planner in entry.planners:
        first.setdefault(planner.mode, planner)
    return list(first.values())


def opening_comment(text: str) -> str:
    """Return the comment that opens a planner's text, without a first line that only names the planner.

    Args:
        text: The text of the planner.
    """
    lines = [line.lstrip("# ") for line in takewhile(lambda line: line.startswith("#"), text.splitlines())]
    if lines and NAME_LINE.fullmatch(lines[0]):
        del lines[0]
    return sanitize(" ".join(lines)) or "without a word on it"


def way_fault(how: HowTo, entry: LibraryEntry) -> str | None:
    """Return the fault of a chosen way as a sentence for the model.

    Args:
        how: The way.
        entry: Its intent.

    Returns:
        The fault; None for a usable way.
    """
    planners = {p.mode: p for p in first_of_each_mode(entry)}
    if how.mode not in planners:
        return f"'{entry.label}' has no mode '{sanitize(how.mode)}'; it has {', '.join(planners)}."
    parameters = {p.name: p for p in planners[how.mode].parameters}
    for name, value in how.parameters.items():
        if name not in parameters:
            return f"Mode '{how.mode}' has no parameter '{sanitize(name)}'; it has {', '.join(parameters) or 'none'}."
        p = parameters[name]
        if not p.low <= value <= p.high:
            return f"{name} = {value:g} of mode '{how.mode}' is not within {p.low:g} and {p.high:g}."
    return None


def way_of(how: HowTo, situations: Mapping[float, Situation], bv: str) -> ModeChoice:
    """Return a chosen way, with its start as one of the delays that have a situation.

    Args:
        how: The way.
        situations: The situations by delay after the trigger [s].
        bv: The id of the vehicle.
    """
    return ModeChoice(how.mode, dict(how.parameters), begin_of(how.begin, situations, bv))


def begin_of(begin: float | Moment, situations: Mapping[float, Situation], bv: str) -> float:
    """Return the delay for a start.

    Args:
        begin: The start after the earliest situation [s], or a condition.
        situations: The situations by delay after the trigger [s].
        bv: The id of the vehicle.

    Returns:
        The nearest delay [s]. For a condition, the first delay at which it holds without an attack, or the last delay
        if it never holds.
    """
    delays = sorted(d for d, s in situations.items() if bv in s.targets) or sorted(situations)
    if not isinstance(begin, Moment):
        earliest = min(situations)
        return min(delays, key=lambda d: (abs(d - earliest - begin), d))
    for delay in delays:
        quantity = _quantity(begin.quantity, situations[delay], bv)
        if quantity is not None and quantity <= begin.at_most:
            return delay
    return delays[-1]


def _quantity(name: str, situation: Situation, bv: str) -> float | None:
    """Return the distance of the centres [m], or the time until the ego reaches the BV's conflict [s]; None if it has
    none.
    """
    if bv not in situation.targets:
        return None
    target, ego = situation.targets[bv], situation.ego
    if name == "distance":
        return math.hypot(target.state.x - ego.x, target.state.y - ego.y)
    reached = [situation.baseline.s >= way.conflict.ego_s for way in target.ways if way.conflict is not None]
    arrivals = [float(steps.argmax()) * situation.dt for steps in reached if steps.any()]
    return min(arrivals, default=None)


def starts_words(situations: Mapping[float, Situation]) -> str:
    """List the moments at which an attack may begin.

    Args:
        situations: The situations by delay after the trigger [s].
    """
    earliest = min(situations)
    return ", ".join(f"{d - earliest:g}" for d in sorted(situations))


def library_words(library: Sequence[LibraryEntry], shown: frozenset[str] | set[str]) -> str:
    """List the modes of the intents with these labels.

    Args:
        library: The known intents.
        shown: The labels of the intents to list.
    """
    lines = []
    for entry in library:
        if entry.label in shown and entry.planners:
            lines += [f"{sanitize(entry.label)}", *modes_words(entry)]
    return "\n".join(lines)


# -- the evidence of predictions ------------------------------------------------------------------------------------

REACHES = SearchSettings().reaches
EVIDENCE_HEADING = (
    "EVIDENCE (predictions of the library's modes, from a few candidates each, against the model of EGO's driver)"
)


def evidence_words(
    pool: Sequence[Proposal], aliases: Aliases, library: Sequence[LibraryEntry], remembered: Mapping[str, str]
) -> str:
    """Describe the predictions for each BV and behaviour, and for each mode; then the bank's evidence.

    Args:
        pool: The predicted candidates.
        aliases: The aliases of the vehicles.
        library: The known intents.
        remembered: What the bank knows of each intent, in words, by label.

    Returns:
        The evidence; empty if no candidate's vehicle has an alias.
    """
    names = {vehicle: alias for alias, vehicle in aliases.bvs.items()}
    groups: dict[tuple[str, str], list[Proposal]] = {}
    for p in pool:
        if p.bv in names:
            groups.setdefault((names[p.bv], p.label), []).append(p)
    if not groups:
        return ""
    begin = min(p.delay for p in pool)
    lines = [EVIDENCE_HEADING]
    for (alias, label), members in sorted(groups.items()):
        lines.append(f"- {alias}, {sanitize(label)}: {_counts(members)}")
        for mode in sorted({p.planner.mode for p in members}):
            lines.append(f"  mode {sanitize(mode)}: {_mode([p for p in members if p.planner.mode == mode], begin)}")
    shown = {label for _, label in groups}
    memory = [f"- {sanitize(label)}: {words}" for label, words in remembered.items() if label in shown]
    lines += ["The memory of earlier encounters like this one:", *memory] if memory else []
    return "\n".join(lines) + "\n"


def _counts(members: Sequence[Proposal]) -> str:
    """Say how many candidates collide, and how many of these collisions are avoidable."""
    made = [p.prediction for p in members if p.prediction is not None and not p.prediction.failure]
    if not made:
        return "its planners failed."
    hits = _hits(members)
    if not hits:
        least = min(made, key=lambda r: (r.min_ttc, r.gap))
        near = f"least TTC {least.min_ttc:.1f} s" if least.min_ttc < 10 else f"nearest {least.gap:.1f} m"
        return f"none of {len(members)} candidates collides in a way that counts{_spoilt(made)}; {near}."
    careful = sum(prediction.careful for prediction in hits)
    manoeuvre = sum(prediction.manoeuvre or prediction.careful for prediction in hits)
    warning = sorted(prediction.warning for prediction in hits)[len(hits) // 2]
    return (
        f"{len(hits)} of {len(members)} candidates collide; {manoeuvre} of these could be avoided by braking or "
        f"steering, {careful} by a careful driver that only brakes; median warning {warning:.1f} s{_spoilt(made)}."
    )


def _mode(members: Sequence[Proposal], now: float) -> str:
    """Say how often a mode's candidates collide, and describe the best of them."""
    best = min(members, key=lambda p: p.score)
    seen = best.prediction
    if seen is None or seen.failure:
        return "its planner failed."
    numbers = ", ".join(f"{name} {value:.4g}" for name, value in best.parameters.items()) or "no parameters"
    if best.score < REACHES:
        came_to = f"level {seen.level}, warning {seen.warning:.1f} s, delta-v {seen.delta_v:.1f} m/s"
    else:
        came_to = f"nearest {seen.gap:.1f} m" if seen.level < Level.COLLISION else "a contact that does not count"
    return (
        f"{len(_hits(members))} of {len(members)} collide; the best one ({came_to}) begins {best.delay - now:g} s from "
        f"now with {numbers}."
    )


def _hits(members: Sequence[Proposal]) -> list[Prediction]:
    """Return the predictions of the candidates that collide in a way that counts."""
    return [
        p.prediction for p in members
        if p.prediction is not None and p.prediction.hit and not p.prediction.failure and p.score < REACHES
    ]  # fmt: skip


def _spoilt(made: Sequence[Prediction]) -> str:
    """Say how many candidates fail by themselves, by cause."""
    causes = {
        "leave the road": sum(r.off_road for r in made), "touch a third vehicle": sum(r.third_party for r in made),
        "move as no car can": sum(r.beyond_limits for r in made),
    }  # fmt: skip
    failures = [f"{count} {cause}" for cause, count in causes.items() if count]
    return f" ({', '.join(failures)})" if failures else ""
