"""Who plays analyzer, generator and modifier: a language model or the built-in expert, each part by itself.

A model that fails ends the run (ModelError), unless the expert may step in; then it plays that part to the end, and
``failed`` says why.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from sumo_adv.agents.expert_generator import ExpertGenerator
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Intent, LibraryEntry, Planner
from sumo_adv.errors import ModelError
from sumo_adv.llm.ledger import Ledger
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.source import HELPERS_TEXT, make_planner
from sumo_adv.planners.trial import trial
from sumo_adv.search.composed_intents import NAME
from sumo_adv.search.search import AttackSearch
from sumo_adv.situation import Situation

if TYPE_CHECKING:
    from sumo_adv.agents.analyzer import ModelAnalyzer
    from sumo_adv.agents.prompts import Prompts
    from sumo_adv.llm.asking import Line
    from sumo_adv.llm.chat import ChatModel

ROLES = ("analyzer", "generator", "modifier")
T = TypeVar("T")


class Agents:
    """The three parts of one run.

    models: by role, those played by a model; ledger: what these spend; prompts: needed where there is a model.
    """

    def __init__(
        self,
        settings: Settings,
        sandbox: Sandbox,
        models: Mapping[str, ChatModel] | None = None,
        ledger: Ledger | None = None,
        prompts: Prompts | None = None,
    ) -> None:
        self.settings, self.sandbox = settings, sandbox
        self.models, self.ledger = dict(models or {}), ledger or Ledger()
        self._prompts = prompts
        self.calls = dict.fromkeys(ROLES, 0)
        self.failed: dict[str, str] = {}  # role -> why the expert stepped in
        self.analysis: dict[str, Any] = {}  # what the model's samples came to
        self.undecided = False

    def player(self, role: str) -> str:
        """Who plays a part now: a model's name or ``expert``."""
        return self.models[role].name if self.by_model(role) else NAME

    def by_model(self, role: str) -> bool:
        """Whether a model plays it."""
        return role in self.models and role not in self.failed

    @property
    def prompts(self) -> Prompts:
        """The prompts. There are some wherever there is a model."""
        assert self._prompts is not None
        return self._prompts

    # -- analyzer -----------------------------------------------------------------------------------------------

    def analyze(
        self,
        search: AttackSearch,
        situations: Mapping[float, Situation],
        library: Sequence[LibraryEntry],
        *,
        allowed: Sequence[str],
        remembered: Mapping[str, str],
    ) -> list[Intent]:
        """Intents, most dangerous first. The ``search`` has predicted before: its pool is a model's evidence, its
        ranking the expert's answer. ``remembered``: label -> what the bank knows, in words. Raises ModelError."""

        def ask() -> list[Intent]:
            analyzer = self._analyzer(search, library, allowed, remembered)
            intents = analyzer.analyze(situations, library)
            self._keep(analyzer)
            return intents

        return self._played("analyzer", ask, lambda: search.ranking(library))

    def confirm(self, intent: Intent, nearest: Sequence[LibraryEntry]) -> str | None:
        """In the uncertain band of retrieval: the label that a new intent is the same as, or None for novel; the
        expert takes the nearest. Raises ModelError."""
        from sumo_adv.agents.analyzer import ModelAnalyzer

        def ask() -> str | None:
            analyzer = ModelAnalyzer(self._line("analyzer"), self.prompts, self.settings.limits.limits())
            return analyzer.confirm(intent.label, intent.description, nearest)

        return self._played("analyzer", ask, lambda: nearest[0].label)

    def _analyzer(
        self, search: AttackSearch, library: Sequence[LibraryEntry], allowed: Sequence[str],
        remembered: Mapping[str, str],
    ) -> ModelAnalyzer:  # fmt: skip
        from sumo_adv.agents.analyzer import ModelAnalyzer
        from sumo_adv.agents.evidence import evidence_words

        evidence = partial(evidence_words, search.pool, library=library, remembered=remembered)
        return ModelAnalyzer(
            self._line("analyzer"), self.prompts, self.settings.limits.limits(), samples=self.settings.samples,
            allowed=allowed, evidence=evidence if self.settings.evidence == "on" else None,
        )  # fmt: skip

    def _keep(self, analyzer: ModelAnalyzer) -> None:
        found = analyzer.distribution
        if found is None:
            return
        self.undecided = found.undecided and found.samples > 1
        self.analysis = {
            "samples": found.samples, "entropy": found.entropy, "side_by_side": self.undecided,
            "first": [{"bv": bv, "label": label, "share": round(s, 4)} for (bv, label), s in found.first.items()],
            "expected_risk": [
                {"bv": bv, "label": label, "risk": r} for (bv, label), r in found.expected_risk.items()
            ],
        }  # fmt: skip

    # -- generator and modifier ---------------------------------------------------------------------------------

    def generate(self, intent: Intent, situation: Situation, examples: Sequence[LibraryEntry]) -> tuple[Planner, ...]:
        """Planners for an intent that the bank does not know; ``examples``: nearest first. Raises ModelError."""
        from sumo_adv.agents.generator import ModelGenerator

        applies = situation.targets[intent.bv].applies()

        def ask() -> tuple[Planner, ...]:
            settings = self.settings
            return ModelGenerator(
                self._line("generator"), self.prompts, settings.limits.limits(), HELPERS_TEXT, make_planner,
                self._trial(applies), tries=settings.generations, instruction=settings.instruction,
            ).generate(intent, situation, examples)  # fmt: skip

        return self._played(
            "generator", ask, lambda: ExpertGenerator(make_planner).generate(intent, situation, examples)
        )

    def modify(self, planner: Planner, attempts: Sequence[Attempt], entry: LibraryEntry) -> Planner | None:
        """A model's changed planner of an entry; None if it changes nothing or the expert plays this part, since the
        search changes parameters itself. Raises ModelError."""
        if not self.by_model("modifier"):
            return None
        from sumo_adv.agents.modifier import ModelModifier

        def ask() -> Planner | None:
            return ModelModifier(
                self._line("modifier"), self.prompts, self.settings.limits.limits(), HELPERS_TEXT, make_planner,
                self._trial(entry.applies), ttc=self.settings.ttc,
            ).modify(planner, attempts, entry.description)  # fmt: skip

        return self._played("modifier", ask, lambda: None)

    def _trial(self, applies: Sequence[str]) -> Callable[[Planner], str | None]:
        return lambda planner: trial(self.sandbox, planner, applies, type_check=True)

    def _line(self, role: str) -> Line:
        from sumo_adv.llm.asking import Line

        return Line(self.models[role], self.ledger)

    def _played(self, role: str, by_model: Callable[[], T], by_expert: Callable[[], T]) -> T:
        self.calls[role] += 1
        if self.by_model(role):
            try:
                return by_model()
            except ModelError as error:
                if self.settings.fallback != "builtin":
                    raise
                self.failed[role] = str(error)
        return by_expert()
