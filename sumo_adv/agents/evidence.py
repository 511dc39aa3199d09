"""What the predictor and the memory know, as a table that a model is shown with a scene.

A strong model without it was measured to be no better than a random applicable intent (ALGORITHM.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sumo_adv.agents.prompts import tame
from sumo_adv.agents.scene_text import Names
from sumo_adv.datatypes import LibraryEntry, Proposal
from sumo_adv.search.robustness import drawn
from sumo_adv.search.settings import SearchSettings

REACHES = SearchSettings().reaches
HEADING = "EVIDENCE (predictions of the library's planners against a simple model of EGO's driver)"


def evidence_words(
    pool: Sequence[Proposal], names: Names, library: Sequence[LibraryEntry], remembered: Mapping[str, str]
) -> str:
    """A line for each BV and behaviour in the ``pool`` of predicted proposals, the ways of carrying each behaviour
    out, and what the bank remembers (``remembered``: label -> words)."""
    groups: dict[tuple[str, str], list[Proposal]] = {}
    for p in drawn(pool):
        if p.bv in names.aliases:
            groups.setdefault((names.aliases[p.bv], p.label), []).append(p)
    lines = [HEADING, *(_line(alias, label, members) for (alias, label), members in sorted(groups.items()))]
    used = {label for _, label in groups}
    lines.append("Ways of carrying them out:")
    lines += [f"- {tame(e.label)}: {_modes(e)}" for e in library if e.label in used]
    known = [f"- {tame(label)}: {words}" for label, words in remembered.items() if label in used]
    lines += ["The memory of earlier encounters like this one:", *known] if known else []
    return "\n".join(lines) + "\n"


def _line(alias: str, label: str, members: Sequence[Proposal]) -> str:
    made = [(p, p.prediction) for p in members if p.prediction is not None and not p.prediction.failure]
    hits = [prediction for p, prediction in made if prediction.hit and p.nominal_score < REACHES]
    if not made:
        return f"- {alias}, {tame(label)}: its planners failed."
    if not hits:
        least = min((prediction for _, prediction in made), key=lambda r: (r.min_ttc, r.gap))
        spoilt = sum(prediction.hit for _, prediction in made)
        why = (
            f", {spoilt} hit but spoilt (from behind, a third vehicle, off the road or turning too hard)"
            if spoilt
            else ""
        )
        near = f"least TTC {least.min_ttc:.1f} s" if least.min_ttc < 10 else f"nearest {least.gap:.1f} m"
        return f"- {alias}, {tame(label)}: none of {len(members)} candidates collides properly{why}; {near}."
    careful = sum(prediction.careful for prediction in hits)
    manoeuvre = sum(prediction.manoeuvre or prediction.careful for prediction in hits)
    warning = sorted(prediction.warning for prediction in hits)[len(hits) // 2]
    return (
        f"- {alias}, {tame(label)}: {len(hits) / len(members):.0%} of {len(members)} candidates collide;"
        f" {manoeuvre} of these {len(hits)} could be avoided by braking or steering, {careful} by a careful driver"
        f" who only brakes; median warning {warning:.1f} s."
    )


def _modes(entry: LibraryEntry) -> str:
    return "; ".join(f"'{p.mode}' {in_words(p.source)}" for p in entry.planners)


def in_words(source: str) -> str:
    """What a planner's opening comment says it does (the first line is its name)."""
    lines = []
    for line in source.splitlines()[1:]:
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# "))
    return tame(" ".join(lines)) or "without a word on it"
