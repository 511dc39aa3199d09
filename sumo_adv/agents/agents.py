"""The three agents of a run: analyzer, generator and modifier, each played by a language model or the built-in expert.

If a model fails, the run ends with its ModelError. With the setting ``fallback = builtin`` the expert takes over that
role for the rest of the run instead, and ``failed`` has the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

from sumo_adv.agents.analyzer import Distribution, ExpertAnalyzer, ModelAnalyzer
from sumo_adv.agents.evidence import evidence_words
from sumo_adv.agents.generator import ExpertGenerator, ModelGenerator, Trial
from sumo_adv.agents.modifier import ModelModifier
from sumo_adv.agents.prompts import Prompts
from sumo_adv.agents.protocols import Analyzer, Generator, Modifier
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Intent, LibraryEntry, Planner
from sumo_adv.errors import ModelError
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.llm.chat import ChatModel
from sumo_adv.llm.ledger import Ledger
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.trial import trial
from sumo_adv.search.composed_intents import NAME
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.selection import Selection
from sumo_adv.situation import Situation

ROLES = ("analyzer", "generator", "modifier")
BUILT_IN = {"analyzer": NAME, "generator": NAME, "modifier": "none"}
"""Role -> what plays it without a model: nothing built in modifies planners."""
T = TypeVar("T")


class Agents:
    """Analyzer, generator and modifier of one run.

    models: by role, the models that play one; ``BUILT_IN`` says what plays the other roles.
    ledger: counts what the models spend.
    prompts: required if there are models.
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
        self._prompts, self._limits = prompts, settings.limits.limits()
        self._distribution: Distribution | None = None
        self.calls = dict.fromkeys(ROLES, 0)
        self.failed: dict[str, str] = {}  # role -> why the expert took over

    def player(self, role: str) -> str:
        """The name of the model that plays a role now, else that of ``BUILT_IN``."""
        return self.models[role].name if self.by_model(role) else BUILT_IN[role]

    def by_model(self, role: str) -> bool:
        """Whether a model plays a role now."""
        return role in self.models and role not in self.failed

    @property
    def prompts(self) -> Prompts:
        """The prompts of the models."""
        assert self._prompts is not None, "Agents with models need prompts"
        return self._prompts

    @property
    def undecided(self) -> bool:
        """Whether the model's samples disagree, so that the first intents must be tried side by side."""
        return self._distribution is not None and self._distribution.undecided

    @property
    def analysis(self) -> dict[str, Any]:
        """The distribution of the model's samples for ``outcome.json``; empty if no model analyzed."""
        return {} if self._distribution is None else self._distribution.as_dict()

    def analyze(
        self,
        search: AttackSearch,
        situations: Mapping[float, Situation],
        library: Sequence[LibraryEntry],
        *,
        selection: Selection,
        remembered: Mapping[str, str],
    ) -> list[Intent]:
        """Intents, most dangerous first. Raises ModelError.

        search: has predicted its candidates; they are the model's evidence, and their ranking is the expert's answer.
        selection: the intents that may be chosen; unless it is open, a model invents none.
        remembered: label -> what the bank knows of that intent, in words.
        """

        def ask(analyzer: Analyzer) -> list[Intent]:
            return analyzer.analyze(situations, library)

        def by_model() -> list[Intent]:
            evidence = partial(evidence_words, search.pool, library=library, remembered=remembered)
            analyzer = ModelAnalyzer(
                self._metered("analyzer"), self.prompts, self._limits, samples=self.settings.samples,
                allowed=() if selection.is_open else [e.label for e in selection.of(library)],
                evidence=evidence if self.settings.evidence == "on" else None,
            )  # fmt: skip
            intents = ask(analyzer)
            self._distribution = analyzer.distribution
            return intents

        return self._played("analyzer", by_model, lambda: ask(ExpertAnalyzer(search)))

    def confirm(self, intent: Intent, nearest: Sequence[LibraryEntry]) -> str | None:
        """The label among ``nearest`` that means the same behaviour as a new intent, None for a novel one.

        Call this if the distance of a retrieval is near epsilon. The expert takes the nearest. Raises ModelError.
        """

        def by_model() -> str | None:
            analyzer = ModelAnalyzer(self._metered("analyzer"), self.prompts, self._limits)
            return analyzer.confirm(intent.label, intent.description, nearest)

        return self._played("analyzer", by_model, lambda: nearest[0].label)

    def generate(self, intent: Intent, situation: Situation, examples: Sequence[LibraryEntry]) -> tuple[Planner, ...]:
        """Planners for an intent that the bank lacks. ``examples``: nearest first. Raises ModelError."""

        applies = situation.targets[intent.bv].applies()

        def ask(generator: Generator) -> tuple[Planner, ...]:
            return generator.generate(intent, situation, examples)

        def by_model() -> tuple[Planner, ...]:
            settings = self.settings
            return ask(
                ModelGenerator(
                    self._metered("generator"), self.prompts, self._limits, self._trial(applies),
                    tries=settings.generations, instruction=settings.instruction,
                )
            )  # fmt: skip

        return self._played("generator", by_model, lambda: ask(ExpertGenerator()))

    def modify(self, planner: Planner, attempts: Sequence[Attempt], entry: LibraryEntry) -> Planner | None:
        """A model's changed planner of an entry, None if it changes nothing. Raises ModelError.

        None also if the expert plays the modifier: the search itself tries other parameters.
        """
        if not self.by_model("modifier"):
            return None

        def by_model() -> Planner | None:
            modifier: Modifier = ModelModifier(
                self._metered("modifier"),
                self.prompts,
                self._limits,
                self._trial(entry.applies),
                ttc=self.settings.critical_ttc,
            )
            return modifier.modify(planner, attempts, entry.description)

        return self._played("modifier", by_model, lambda: None)

    def _trial(self, applies: Sequence[str]) -> Trial:
        return lambda planner: trial(self.sandbox, planner, applies, type_check=True)

    def _metered(self, role: str) -> MeteredModel:
        return MeteredModel(self.models[role], self.ledger)

    def _played(self, role: str, by_model: Callable[[], T], by_expert: Callable[[], T]) -> T:
        """The result of the role's player. Counts the call; a failed model is replaced if the settings allow it."""
        self.calls[role] += 1
        if self.by_model(role):
            try:
                return by_model()
            except ModelError as error:
                if self.settings.fallback != "builtin":
                    raise
                self.failed[role] = str(error)
        return by_expert()
