"""The evidence of predictions and of the memory bank, as a table in the analyzer's prompt.

Without this table a strong model chose no better than at random among the applicable intents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sumo_adv.agents.prompts import sanitize
from sumo_adv.agents.scene_text import Aliases
from sumo_adv.datatypes import Level, LibraryEntry, Prediction, Proposal
from sumo_adv.search.settings import SearchSettings

REACHES = SearchSettings().reaches
HEADING = "EVIDENCE (predictions of the library's modes, from a few candidates each, against the model of EGO's driver)"


def evidence_words(
    pool: Sequence[Proposal], aliases: Aliases, library: Sequence[LibraryEntry], remembered: Mapping[str, str]
) -> str:
    """A line for each BV and behaviour in the ``pool`` of predicted proposals, and one for each of its modes; then the
    bank's evidence. Empty without such a proposal.

    remembered: label -> the bank's evidence in words.
    """
    groups: dict[tuple[str, str], list[Proposal]] = {}
    for p in pool:
        if p.bv in aliases.by_id:
            groups.setdefault((aliases.by_id[p.bv], p.label), []).append(p)
    if not groups:
        return ""
    begin = min(p.delay for p in pool)
    lines = [HEADING]
    for (alias, label), members in sorted(groups.items()):
        lines.append(f"- {alias}, {sanitize(label)}: {_counts(members)}")
        for mode in sorted({p.planner.mode for p in members}):
            lines.append(f"  mode {sanitize(mode)}: {_mode([p for p in members if p.planner.mode == mode], begin)}")
    shown = {label for _, label in groups}
    memory = [f"- {sanitize(label)}: {words}" for label, words in remembered.items() if label in shown]
    lines += ["The memory of earlier encounters like this one:", *memory] if memory else []
    return "\n".join(lines) + "\n"


def _counts(members: Sequence[Proposal]) -> str:
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
    """How often a mode's candidates collide, and the best of them with its numbers."""
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
    """The predictions of those that collide in a way that counts."""
    return [
        p.prediction for p in members
        if p.prediction is not None and p.prediction.hit and not p.prediction.failure and p.score < REACHES
    ]  # fmt: skip


def _spoilt(made: Sequence[Prediction]) -> str:
    """How many candidates fail by themselves, by cause."""
    causes = {
        "leave the road": sum(r.off_road for r in made), "touch a third vehicle": sum(r.third_party for r in made),
        "move as no car can": sum(r.beyond_limits for r in made),
    }  # fmt: skip
    failures = [f"{count} {cause}" for cause, count in causes.items() if count]
    return f" ({', '.join(failures)})" if failures else ""
