"""The three agents of a run: analyzer, generator and modifier, each played by a language model or the built-in expert.

A run asks its models at most ``questions`` times, or ``questions_familiar`` times if no intent is new. ``bought`` holds
the result of each question.

If a model fails, the run ends with its ModelError. With the setting ``fallback = builtin``, the expert takes over that
role for the rest of the run instead, and ``failed`` holds the reason.
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
from sumo_adv.agents.request import ReadRequest
from sumo_adv.agents.teams import Teamwork
from sumo_adv.agents.ways import evidence_words
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
"""Maps each role to what plays it without a model. No built-in agent modifies planners."""
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Bought:
    """The result of a question to a model.

    Attributes:
        agent: The role that asked.
        what: The answer in a few words.
        planner: The hash of the planner that was written; None if there is none.
    """

    agent: str
    what: str
    planner: str | None = None


class Agents:
    """Analyzer, generator and modifier of one run.

    Attributes:
        settings: The settings of the run.
        sandbox: Where planners are tried.
        models: The models by role. ``BUILT_IN_AGENTS`` says what plays the other roles.
        ledger: Counts what the models spend.
        calls: The number of calls of each role.
        failed: Why the expert took over a role, by role.
        bought: The results of the questions so far.
        casts: The compositions that the analysis proposes.
        read: What the model makes of an attack that was requested in words; None if none was.
    """

    def __init__(
        self, settings: Settings, sandbox: Sandbox, models: Mapping[str, ChatModel] | None = None,
        ledger: Ledger | None = None, prompts: Prompts | None = None,
    ) -> None:  # fmt: skip
        """Assign the roles.

        Args:
            settings: The settings of the run.
            sandbox: Where planners are tried.
            models: The models by role; None lets the built-in agents play all roles.
            ledger: Counts what the models spend; None starts a new one.
            prompts: The prompts; required if there are models.
        """
        self.settings, self.sandbox = settings, sandbox
        self.models, self.ledger = dict(models or {}), ledger or Ledger()
        self._prompts, self._limits = prompts, settings.limits.limits()
        self._distribution: Distribution | None = None
        self.calls = dict.fromkeys(AGENT_ROLES, 0)
        self.failed: dict[str, str] = {}  # by role
        self.bought: list[Bought] = []
        self.casts: tuple[Cast, ...] = ()
        self.read: ReadRequest | None = None
        self._novel = False  # whether the analysis contains a new intent

    def player(self, role: str) -> str:
        """Return the name of the model that plays a role now, otherwise that of ``BUILT_IN_AGENTS``.

        Args:
            role: The role.
        """
        return self.models[role].name if self.by_model(role) else BUILT_IN_AGENTS[role]

    def by_model(self, role: str) -> bool:
        """Return whether a model plays a role now.

        Args:
            role: The role.
        """
        return role in self.models and role not in self.failed

    @property
    def may_ask(self) -> bool:
        """Whether the encounter has questions left."""
        settings = self.settings
        most = settings.questions if self._novel else min(settings.questions, settings.questions_familiar)
        return len(self.bought) < most

    @property
    def prompts(self) -> Prompts:
        """The prompts, which a run with models must have."""
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
        """Choose intents, most dangerous first.

        Args:
            search: The search, which has predicted its candidates. They are the model's evidence, and their ranking is
                the expert's answer.
            situations: The situations by delay after the trigger [s].
            library: The known intents.
            selection: The intents that may be chosen. Unless it is open, a model invents none.
            remembered: What the bank knows of each intent, in words, by label.
            teamwork: What a model may compose (``casts``); None if only one adversary is allowed.

        Raises:
            ModelError: The model failed, and the expert may not take over.
        """

        self.read = None

        def by_model() -> list[Intent]:
            evidence = partial(evidence_words, search.pool, library=library, remembered=remembered)
            analyzer = ModelAnalyzer(
                self._metered("analyzer"), self.prompts, self._limits, samples=self.settings.samples,
                allowed=() if selection.is_open else [e.label for e in selection.of(library)],
                evidence=evidence if self.settings.evidence == "on" else None, teamwork=teamwork,
                request=self.settings.ask or "",
            )  # fmt: skip
            intents = analyzer.analyze(situations, library)
            self.read = analyzer.read
            self._distribution, self.casts = analyzer.distribution, analyzer.casts
            scripts = 0 if analyzer.read is None else len(analyzer.read.scripts)
            novel, ways = sum(i.source == "generated" for i in intents) - scripts, sum(len(i.ways) for i in intents)
            self._novel = novel > 0
            summary = f"{len(intents)} intents, {novel} of them novel, {ways} ways"
            summary += f", scripts: {scripts}" if scripts else ""
            teams = f", compositions: {len(self.casts)}" if self.casts else ""
            self.bought.append(Bought("analyzer", f"{summary}{teams}"))
            return intents

        return self._played("analyzer", by_model, lambda: search.ranking(library))

    def confirm(
        self, intent: Intent, nearest: Sequence[LibraryEntry], situations: Mapping[float, Situation]
    ) -> Intent | None:
        """Check whether a model's new intent is a known one.

        Args:
            intent: The new intent.
            nearest: The known intents that it may be.
            situations: The situations by delay after the trigger [s].

        Returns:
            The intent by the label among ``nearest`` that means the same behaviour. It is None for a novel intent, and
            if no questions are left.

        Raises:
            ModelError: The model failed, and the expert may not take over.
        """

        def by_model() -> Intent | None:
            analyzer = ModelAnalyzer(self._metered("analyzer"), self.prompts, self._limits)
            same = analyzer.confirm(intent, nearest, situations)
            self.bought.append(Bought("analyzer", f"'{intent.label}' is {'novel' if same is None else same.label}"))
            return same

        return self._played("analyzer", by_model, lambda: None) if self.may_ask else None

    def generate(self, intent: Intent, situation: Situation, examples: Sequence[LibraryEntry]) -> tuple[Planner, ...]:
        """Get planners for an intent that the bank lacks.

        If the expert composed the intent in addition to a model's intents, the expert writes the planners.

        Args:
            intent: The intent.
            situation: The situation in which it is tried.
            examples: Known intents with planners, nearest first.

        Returns:
            The planners; none if no questions are left.

        Raises:
            ModelError: The model failed, and the expert may not take over.
        """
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
        """Ask a model for a change after attempts with a planner.

        Args:
            planner: The planner.
            reports: The attempts with the planner.
            scene: What the modifier is told in addition.

        Returns:
            The change. It is None if no questions are left, or if no model plays the modifier, since the search itself
            tries other parameters.

        Raises:
            ModelError: The model failed, and ``fallback`` is not ``builtin``.
        """
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
        """Return a function that runs a planner in the sandbox."""
        return lambda planner: trial(self.sandbox, planner, applies, type_check=True)

    def _metered(self, role: str) -> MeteredModel:
        """Return the model of a role with its ledger."""
        return MeteredModel(self.models[role], self.ledger)

    def _played(self, role: str, by_model: Callable[[], T], by_expert: Callable[[], T]) -> T:
        """Call the player of a role, and count the call; a failed model is replaced if the settings allow it."""
        self.calls[role] += 1
        if self.by_model(role):
            try:
                return by_model()
            except ModelError as error:
                if self.settings.fallback != "builtin":
                    raise
                self.failed[role] = str(error)
        return by_expert()
