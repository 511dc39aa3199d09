"""The evidence of predictions and of the memory bank, as a table in the analyzer's prompt.

Without this table a strong model chose no better than at random among the applicable intents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sumo_adv.agents.prompts import sanitize
from sumo_adv.agents.scene_text import Aliases
from sumo_adv.datatypes import LibraryEntry, Proposal
from sumo_adv.search.robustness import drawn
from sumo_adv.search.settings import SearchSettings

REACHES = SearchSettings().reaches
HEADING = "EVIDENCE (predictions of the library's planners against a simple model of EGO's driver)"


def evidence_words(
    pool: Sequence[Proposal], aliases: Aliases, library: Sequence[LibraryEntry], remembered: Mapping[str, str]
) -> str:
    """One line per BV and behaviour in the ``pool`` of predicted proposals, then the planners and the bank's evidence.

    remembered: label -> the bank's evidence in words.
    """
    groups: dict[tuple[str, str], list[Proposal]] = {}
    for p in drawn(pool):
        if p.bv in aliases.by_id:
            groups.setdefault((aliases.by_id[p.bv], p.label), []).append(p)
    lines = [HEADING, *(_prediction(alias, label, members) for (alias, label), members in sorted(groups.items()))]
    shown = {label for _, label in groups}
    lines.append("Ways of carrying them out:")
    lines += [f"- {sanitize(e.label)}: {_planners(e)}" for e in library if e.label in shown]
    memory = [f"- {sanitize(label)}: {words}" for label, words in remembered.items() if label in shown]
    lines += ["The memory of earlier encounters like this one:", *memory] if memory else []
    return "\n".join(lines) + "\n"


def _prediction(alias: str, label: str, members: Sequence[Proposal]) -> str:
    predicted = [(p, p.prediction) for p in members if p.prediction is not None and not p.prediction.failure]
    hits = [prediction for p, prediction in predicted if prediction.hit and p.nominal_score < REACHES]
    if not predicted:
        return f"- {alias}, {sanitize(label)}: its planners failed."
    if not hits:
        least = min((prediction for _, prediction in predicted), key=lambda r: (r.min_ttc, r.gap))
        invalid = sum(prediction.hit for _, prediction in predicted)
        why = (
            f", {invalid} hit but spoilt (from behind, a third vehicle, off the road or turning too hard)"
            if invalid
            else ""
        )
        near = f"least TTC {least.min_ttc:.1f} s" if least.min_ttc < 10 else f"nearest {least.gap:.1f} m"
        return f"- {alias}, {sanitize(label)}: none of {len(members)} candidates collides properly{why}; {near}."
    careful = sum(prediction.careful for prediction in hits)
    manoeuvre = sum(prediction.manoeuvre or prediction.careful for prediction in hits)
    warning = sorted(prediction.warning for prediction in hits)[len(hits) // 2]
    return (
        f"- {alias}, {sanitize(label)}: {len(hits)} of {len(members)} candidates collide;"
        f" {manoeuvre} of these {len(hits)} could be avoided by braking or steering, {careful} by a careful driver"
        f" who only brakes; median warning {warning:.1f} s."
    )


def _planners(entry: LibraryEntry) -> str:
    return "; ".join(f"'{p.mode}' {opening_comment(p.source)}" for p in entry.planners)


def opening_comment(source: str) -> str:
    """The comment that opens a planner's text, without its first line, which is the planner's name."""
    lines = []
    for line in source.splitlines()[1:]:
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# "))
    return sanitize(" ".join(lines)) or "without a word on it"
