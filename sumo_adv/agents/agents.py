"""The three agents of a run: analyzer, generator and modifier, each played by a language model or the built-in expert.

A run asks its models at most ``questions`` times, and ``questions_familiar`` times where no intent is new. ``bought``
has the result of each question.

If a model fails, the run ends with its ModelError. With the setting ``fallback = builtin`` the expert takes over that
role for the rest of the run instead, and ``failed`` has the reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from sumo_adv.agents.analyzer import Distribution, ModelAnalyzer
from sumo_adv.agents.feedback import AttemptReport
from sumo_adv.agents.generator import ModelGenerator, Trial, expert_planners
from sumo_adv.agents.modifier import Change, ModelModifier, RepairScene
from sumo_adv.agents.teams import Teamwork
from sumo_adv.agents.ways import evidence_words
from sumo_adv.asked import Asked
from sumo_adv.config import Settings
from sumo_adv.datatypes import Intent, LibraryEntry, Planner
from sumo_adv.errors import ModelError
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.llm.chat import ChatModel, Ledger
from sumo_adv.llm.prompts import Prompts
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.trial import trial
from sumo_adv.search.intents import COMPOSED, EXPERT, Selection
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.supports import Cast
from sumo_adv.situation import Situation

AGENT_ROLES = ("analyzer", "generator", "modifier")
BUILT_IN_AGENTS = {"analyzer": EXPERT, "generator": EXPERT, "modifier": "none"}
"""Role -> what plays it without a model: nothing built in modifies planners."""
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Bought:
    """The result of a question to a model: the agent, the answer in a few words, and the planner that was written."""

    agent: str
    what: str
    planner: str | None = None


class Agents:
    """Analyzer, generator and modifier of one run. models: by role, the models that play one; ``BUILT_IN_AGENTS`` says
    what plays the other roles. ledger: counts what the models spend. prompts: required if there are models."""

    def __init__(
        self, settings: Settings, sandbox: Sandbox, models: Mapping[str, ChatModel] | None = None,
        ledger: Ledger | None = None, prompts: Prompts | None = None,
    ) -> None:  # fmt: skip
        self.settings, self.sandbox = settings, sandbox
        self.models, self.ledger = dict(models or {}), ledger or Ledger()
        self._prompts, self._limits = prompts, settings.limits.limits()
        self._distribution: Distribution | None = None
        self.calls = dict.fromkeys(AGENT_ROLES, 0)
        self.failed: dict[str, str] = {}  # role -> why the expert took over
        self.bought: list[Bought] = []
        self.casts: tuple[Cast, ...] = ()  # compositions that the analysis proposes
        self.asked: Asked | None = None  # what must be true of an attack that was asked for in words
        self.why_not = ""  # why that cannot be played in the encounter, empty if it can
        self._novel = False  # whether the analysis has a new intent

    def player(self, role: str) -> str:
        """The name of the model that plays a role now, else that of ``BUILT_IN_AGENTS``."""
        return self.models[role].name if self.by_model(role) else BUILT_IN_AGENTS[role]

    def by_model(self, role: str) -> bool:
        """Whether a model plays a role now."""
        return role in self.models and role not in self.failed

    @property
    def may_ask(self) -> bool:
        """Whether the encounter has questions left."""
        settings = self.settings
        most = settings.questions if self._novel else min(settings.questions, settings.questions_familiar)
        return len(self.bought) < most

    @property
    def prompts(self) -> Prompts:
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
        self, search: AttackSearch, situations: Mapping[float, Situation], library: Sequence[LibraryEntry], *,
        selection: Selection, remembered: Mapping[str, str], teamwork: Teamwork | None = None,
    ) -> list[Intent]:  # fmt: skip
        """Intents, most dangerous first. Raises ModelError.

        search: has predicted its candidates; they are the model's evidence, and their ranking is the expert's answer.
        selection: the intents that may be chosen; unless it is open, a model invents none.
        remembered: label -> what the bank knows of that intent, in words.
        teamwork: what a model may compose (``casts``), None if one adversary is all that is allowed.
        """

        def by_model() -> list[Intent]:
            evidence = partial(evidence_words, search.pool, library=library, remembered=remembered)
            analyzer = ModelAnalyzer(
                self._metered("analyzer"), self.prompts, self._limits, samples=self.settings.samples,
                allowed=() if selection.is_open else [e.label for e in selection.of(library)],
                evidence=evidence if self.settings.evidence == "on" else None, teamwork=teamwork,
                request=self.settings.ask or "",
            )  # fmt: skip
            intents = analyzer.analyze(situations, library)
            self.asked, self.why_not = analyzer.asked, analyzer.why_not
            self._distribution, self.casts = analyzer.distribution, analyzer.casts
            novel, ways = sum(i.source == "generated" for i in intents), sum(len(i.ways) for i in intents)
            self._novel = novel > 0
            summary = f"{len(intents)} intents, {novel} of them novel, {ways} ways"
            teams = f", compositions: {len(self.casts)}" if self.casts else ""
            self.bought.append(Bought("analyzer", f"{summary}{teams}"))
            return intents

        return self._played("analyzer", by_model, lambda: search.ranking(library))

    def confirm(
        self, intent: Intent, nearest: Sequence[LibraryEntry], situations: Mapping[float, Situation]
    ) -> Intent | None:
        """A model's new intent by the label among ``nearest`` that means the same behaviour, None for a novel one.
        Without questions left the intent is as novel as its analyzer said. Raises ModelError."""

        def by_model() -> Intent | None:
            analyzer = ModelAnalyzer(self._metered("analyzer"), self.prompts, self._limits)
            same = analyzer.confirm(intent, nearest, situations)
            self.bought.append(Bought("analyzer", f"'{intent.label}' is {'novel' if same is None else same.label}"))
            return same

        return self._played("analyzer", by_model, lambda: None) if self.may_ask else None

    def generate(self, intent: Intent, situation: Situation, examples: Sequence[LibraryEntry]) -> tuple[Planner, ...]:
        """Planners for an intent that the bank lacks, none without questions left. ``examples``: nearest first. Those
        of an intent that the expert composed beside a model's are the expert's. Raises ModelError."""
        if self.by_model("analyzer") and intent.label in COMPOSED:
            return expert_planners(intent, examples)
        if self.by_model("generator") and not self.may_ask:
            return ()

        def by_model() -> tuple[Planner, ...]:
            settings, applies = self.settings, situation.targets[intent.bv].applies()
            generator = ModelGenerator(
                self._metered("generator"), self.prompts, self._limits, self._trial(applies),
                tries=settings.generations, instruction=settings.instruction,
            )  # fmt: skip
            planners = generator.generate(intent, situation, examples)
            self.bought.append(Bought("generator", f"a planner for '{intent.label}'", planners[0].hash))
            return planners

        return self._played("generator", by_model, lambda: expert_planners(intent, examples))

    def modify(self, planner: Planner, reports: Sequence[AttemptReport], scene: RepairScene) -> Change | None:
        """A model's change after the attempts with a planner, None if it changes nothing. Raises ModelError. None also
        if the expert plays the modifier, since the search itself tries other parameters, and without questions left."""
        if not self.by_model("modifier") or not self.may_ask:
            return None

        def by_model() -> Change | None:
            modifier = ModelModifier(
                self._metered("modifier"), self.prompts, self._limits, self._trial(scene.entry.applies), self.settings
            )
            change = modifier.modify(planner, reports, scene)
            self.bought.append(Bought("modifier", change.words, change.planner.hash if change.planner else None))
            return change

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
