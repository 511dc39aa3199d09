"""What the next run of the same command would see of the memory bank: to say when learning has changed it."""

from __future__ import annotations

from dataclasses import dataclass

from sumo_adv.episode.episode import Episode
from sumo_adv.episode.memory_access import read_library
from sumo_adv.episode.planned_encounter import PlannedEncounter
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.search.composed_intents import composed
from sumo_adv.search.templates import templates_of

Template = tuple[float, str, str, str]
"""Delay [s], vehicle, intent, hash of the planner."""


@dataclass(frozen=True, slots=True)
class BankView:
    """What an encounter depends on.

    templates: what the search draws from, in order where nothing but the order is tried. evidence:
    number of pieces, 0 where no model is shown them and no scene is recalled.
    """

    templates: tuple[Template, ...]
    evidence: int

    @classmethod
    def of(cls, episode: Episode, bank: MemoryBank, planned: PlannedEncounter) -> BankView:
        """The view of the bank as it is now, in the encounter of an episode."""
        settings, agents = episode.settings, episode.agents
        library, _ = read_library(bank, planned.scene, settings.seed, planned.found.situations)
        plain = [e for e in library if not composed(e)]  # the expert composes the others anyway
        all_templates = templates_of(planned.found.situations, plain)
        templates = [(t.delay, t.target.state.id, t.entry.label, t.planner.hash) for t in all_templates]
        shown = agents is not None and agents.by_model("analyzer") and settings.evidence == "on"
        counts = shown or settings.recall == "scene"
        return cls(
            tuple(templates if settings.tuner == "off" else sorted(templates)),
            len(bank.evidence()) if counts else 0,
        )  # fmt: skip

    def difference(self, after: BankView) -> str:
        """What a later view has that this one has not, in a sentence; empty if the next run is the same."""
        new = sorted({label for *_, label, _ in set(after.templates) - set(self.templates)})
        learnt = [f"planners of {', '.join(new)}"] if new else []
        learnt += ["another order of planners"] if not new and after.templates != self.templates else []
        learnt += ["the outcome of this scene"] if after.evidence != self.evidence else []
        if not learnt:
            return ""
        return (
            f"The memory bank has learnt {' and '.join(learnt)}: the same command may run differently next time "
            "(--learn off keeps the bank as it is)."
        )
