"""The front's side of an environment: scenarios open in engines, what attacks in them, and their episodes."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from sumo_adv.app import load, new_engine, new_sandbox, open_agents, open_for_run
from sumo_adv.config import Settings, load_settings
from sumo_adv.datatypes import Proposal, Verdict
from sumo_adv.drivers import Action, Observation
from sumo_adv.drivers.registry import OBJECT_PREFIX, GivenEgo, pack_driver
from sumo_adv.drivers.sumo_driven import sumo_type
from sumo_adv.episode.assessment import AttemptRunner
from sumo_adv.episode.encounter_finder import EncounterFinder
from sumo_adv.episode.engine import EpisodeCalls
from sumo_adv.episode.loop import decide
from sumo_adv.episode.prepared_encounter import prepare
from sumo_adv.episode.refinement import Refiner
from sumo_adv.episode.task import make_task
from sumo_adv.errors import UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.gym.curriculum import Curriculum
from sumo_adv.gym.play import Play
from sumo_adv.planners.answers import Answer, PlannerObservation
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.search.ranking import FixedOrder
from sumo_adv.search.search import AttackSearch
from sumo_adv.simulation.engine import Conversation
from sumo_adv.simulation.inputs import RunInput


class Attacks(Protocol):
    """Chooses the attacks of one encounter, one for each episode."""

    def next(self, draws: np.random.Generator) -> Proposal | None:
        """The next attack; None if there is none at all."""
        ...

    def observe(self, attack: Proposal, verdict: Verdict) -> None:
        """Take note of what an attack came to."""
        ...


Attacker = Literal["expert"] | str | None
"""What attacks the ego: the built-in expert, a language model by its name, or nothing."""

EXPERT_ATTACKER = "expert"
PLANNED_ATTACKS = 25  # attacks in an encounter, unless they keep up with the ego


class AgentEgo:
    """The ego that an agent drives: SUMO's IDM drives it until the encounter, and how the agent drives is unknown."""

    name = "agent"
    forkable = True
    needs_observation = False
    sumo_type: Mapping[str, str] = sumo_type("idm", {})

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, observation: Observation) -> Action:
        """Never called."""
        return None


AGENT = OBJECT_PREFIX + AgentEgo.__name__


def _silent(*_: object) -> None:
    """An environment shows no progress."""


def settings_of(given: Mapping[str, Any], ego: str | None, attacker: Attacker, horizon: float | None) -> Settings:
    """The settings of an environment. Nothing is learnt from its episodes. ``ego``: None, where an agent drives it.

    Raises UsageError.
    """
    for name in ("ego", "llm", "learn"):
        if name in given:
            raise UsageError(f"The setting {name!r} of an environment follows from its other arguments: leave it out.")
    model = None if attacker in (None, EXPERT_ATTACKER) else attacker
    defaults: dict[str, Any] = {"horizon": horizon}
    if ego is None:
        defaults |= {"until": "serious", "attempts": PLANNED_ATTACKS}  # what attacks on an agent are planned for
    if model is not None:
        defaults["tuner"] = "off"  # its attacks, and none of the search
    return load_settings(None, **{**defaults, **given, "ego": ego or AGENT, "llm": model, "learn": "off"})


class TrainingEncounter:
    """The encounter of one scenario, in an engine of its own, and the attacks that were planned in it."""

    def __init__(self, scenario: str | Path, given: Mapping[str, Any], ego: Any, attacker: Attacker) -> None:
        """``ego``: a driver by name, class or object; None: an agent drives. given: settings.

        Raises:
            UsageError: wrong use, or the scenario has no encounter. SimulationError: SUMO failed.
        """
        self.name, self._attacker = Path(scenario).stem, attacker
        run_input = load(Path(scenario), None)
        packed = None if isinstance(ego, str) else pack_driver(AgentEgo if ego is None else ego)
        driver = None if ego is None else ego if packed is None else packed.name
        self.settings = settings_of(given, driver, attacker, run_input.horizon)
        with ExitStack() as opening:
            self._open(run_input, packed, opening)
            self._stack = opening.pop_all()

    def _open(self, run_input: RunInput, packed: GivenEgo | None, stack: ExitStack) -> None:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=scratch_prefix())))
        task = replace(make_task(run_input, self.settings, scratch), ego_given=packed)
        self._sandbox = stack.enter_context(new_sandbox(self.settings))
        self._agents = stack.enter_context(open_agents(self.settings, self._sandbox))
        self.engine = stack.enter_context(new_engine())
        finder = EncounterFinder(run_input, self.settings, task, self.engine, _silent)
        if self._attacker is None or task.trigger is not None:
            finder.seek()
        else:
            with open_for_run(self.settings) as bank:
                finder.find_attackable(self._sandbox, bank)
        if finder.stop is not None:
            raise UsageError(f"The scenario {self.name!r} has no encounter for an environment: {finder.stop.reason}")
        self._run_input, self._task, self._record, self._stopped = run_input, task, finder.records[-1], finder.stopped
        self.found = self._record.found
        self.roads = Roads(self.found.situations)

    def plan(self, *, adapts: bool) -> Attacks:
        """What the attacker does in this encounter, episode after episode. Planning takes a second or two.

        adapts: the attacks that are predicted to collide are the first ones of a ``Curriculum``, which keeps up with
        the ego; else there are no others. Attacks that a language model chose never change.

        Raises:
            ModelError: a language model plans and failed.
        """
        search = self._search(forecast=True)
        if isinstance(search, FixedOrder):
            return AttackPlan(search.propose(self.settings.attempts))
        colliding = [p for p in search.pool if p.prediction is not None and p.prediction.hit]
        best = sorted(colliding, key=search.price)[: self.settings.attempts]
        asked = self._search(forecast=False) if adapts else None
        return Curriculum(asked, self.settings.goal, best) if isinstance(asked, AttackSearch) else AttackPlan(best)

    def _search(self, *, forecast: bool) -> AttackSearch | FixedOrder:
        """The search for attacks; ``forecast``: one that predicts, though how the agent drives is unknown."""
        settings = self.settings
        with open_for_run(settings) as bank:
            prepared = prepare(
                self.found, self._run_input, settings, self._task, self._sandbox, bank, stopped=self._stopped,
                forecast=forecast,
            )  # fmt: skip
            decision = decide(self._record, prepared, settings, self._agents, bank)
        if decision.library is None:
            raise UsageError(f"Nothing attacks in the scenario {self.name!r}: {decision.record.reason}")
        runner = AttemptRunner(self.engine, self._sandbox, self.found, settings.seed)
        refiner = Refiner(runner, self.found, prepared.search, self._agents, decision.library, settings, _silent)
        return refiner.optimizer(decision.record.intents)

    def play(self, play: Play) -> PlayedAttack:
        """Begin an episode; the one before must have ended."""
        return PlayedAttack(self, play, self._sandbox)

    @property
    def alive(self) -> bool:
        """Whether its engine runs."""
        return not self.engine.lost

    def close(self) -> None:
        """End its processes. May be called twice."""
        self._stack.close()


class AttackPlan:
    """Attacks in one encounter that were planned before: the best that are predicted to collide, or those that the
    analyzer chose. Each episode draws one."""

    def __init__(self, attacks: Sequence[Proposal]) -> None:
        self._attacks = attacks

    def next(self, draws: np.random.Generator) -> Proposal | None:
        """The next attack; None if there is none at all."""
        return self._attacks[int(draws.integers(len(self._attacks)))] if self._attacks else None

    def observe(self, attack: Proposal, verdict: Verdict) -> None:
        """Nothing."""


class PlayedAttack:
    """An episode that goes on in an encounter's engine."""

    def __init__(self, encounter: TrainingEncounter, play: Play, sandbox: Any) -> None:
        self.encounter, self.play, self._sandbox = encounter, play, sandbox
        self._stack = ExitStack()
        self._sessions: Sessions | None = None
        self._talk: Conversation = encounter.engine.converse(self._answer, EpisodeCalls.directed_attempt, play)
        self.first = self._talk.said

    def ask(self, message: Any) -> Any:
        """What the episode says to the agents' actions, or its picture."""
        return self._talk.ask(message)

    def _answer(self, observation: PlannerObservation) -> Answer | str:
        """The answer of a planner that we do not ship."""
        proposal, encounter = self.play.proposal, self.encounter
        assert proposal is not None
        if self._sessions is None:
            seed, drivable = encounter.settings.seed, encounter.found.drivable
            sessions = Sessions(self._sandbox, encounter.roads, [proposal], seed, drivable=drivable)
            self._sessions = self._stack.enter_context(sessions)
        return self._sessions.answer(proposal, observation)

    def end(self) -> None:
        """Go back to the trigger. May be called twice."""
        self._stack.close()
        self._talk.end()
