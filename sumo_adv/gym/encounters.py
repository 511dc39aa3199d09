"""The front's side of an environment: scenarios that are open in engines, their attackers, and their episodes."""

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
from sumo_adv.simulation.inputs import RunInput, own_simulation


class Attacks(Protocol):
    """Chooses the attacks of one encounter, one for each episode."""

    def next(self, draws: np.random.Generator) -> Proposal | None:
        """Return the next attack; None if there is none at all."""
        ...

    def observe(self, attack: Proposal, verdict: Verdict) -> None:
        """Learn from the verdict on an attack."""
        ...


Attacker = Literal["expert"] | str | None
"""What attacks the ego: the built-in expert, a language model by its name, or nothing."""

EXPERT_ATTACKER = "expert"
PLANNED_ATTACKS = 25  # maximum number of attacks in an encounter, unless they keep up with the ego


class AgentEgo:
    """The ego that an agent drives. SUMO's IDM drives it until the encounter. Predictions treat the agent as an unknown
    driver.
    """

    name = "agent"
    forkable = True
    needs_observation = False
    sumo_type: Mapping[str, str] = sumo_type("idm", {})

    def reset(self, seed: int) -> None:
        """Do nothing."""

    def act(self, observation: Observation) -> Action:
        """Return None; this is never called."""
        return None


AGENT = OBJECT_PREFIX + AgentEgo.__name__


def _silent(*_: object) -> None:
    """Ignore progress; an environment shows none."""


def settings_of(given: Mapping[str, Any], ego: str | None, attacker: Attacker, run_input: RunInput) -> Settings:
    """Return the settings of an environment. Nothing is learnt from its episodes.

    Args:
        given: The user's settings.
        ego: The driver of the ego; None if an agent drives.
        attacker: What attacks the ego.
        run_input: The scenario. The environments have one adversary, and an agent sees without errors of sensors.

    Raises:
        UsageError: A setting is wrong, or follows from other arguments.
    """
    for name in ("ego", "llm", "learn"):
        if name in given:
            raise UsageError(f"The setting {name!r} of an environment follows from its other arguments: leave it out.")
    model = None if attacker in (None, EXPERT_ATTACKER) else attacker
    defaults = {**own_simulation(run_input), **run_input.settings(("until",))}
    defaults.pop("adversaries", None)
    if ego is None:
        defaults.pop("ego_sensing", None)
        defaults |= {"until": "serious", "attempts": PLANNED_ATTACKS}  # what attacks on an agent are planned for
    if model is not None:
        defaults["tuner"] = "off"  # only the model's attacks, none of the search
    return load_settings(None, **{**defaults, **given, "ego": ego or AGENT, "llm": model, "learn": "off"})


class TrainingEncounter:
    """The encounter of one scenario, in its own engine, and the attacks that were planned in it.

    Attributes:
        name: The name of the scenario.
        settings: The settings of its episodes.
        engine: Simulates the episodes.
        found: The encounter.
        roads: The roads, for planners.
    """

    def __init__(self, scenario: str | Path, given: Mapping[str, Any], ego: Any, attacker: Attacker) -> None:
        """Open the scenario and drive to its encounter.

        Args:
            scenario: The path or name of the scenario.
            given: The user's settings.
            ego: A driver by name, class or object; None if an agent drives.
            attacker: What attacks the ego.

        Raises:
            UsageError: An argument is wrong, or the scenario has no encounter.
            SimulationError: SUMO failed.
        """
        self.name, self._attacker = Path(scenario).stem, attacker
        run_input = load(Path(scenario), None)
        packed = None if isinstance(ego, str) else pack_driver(AgentEgo if ego is None else ego)
        driver = None if ego is None else ego if packed is None else packed.name
        self.settings = settings_of(given, driver, attacker, run_input)
        with ExitStack() as opening:
            self._open(run_input, packed, opening)
            self._stack = opening.pop_all()

    def _open(self, run_input: RunInput, packed: GivenEgo | None, stack: ExitStack) -> None:
        """Start the engine, the sandbox and the agents, and find the encounter."""
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
        """Plan the attacks in this encounter, for episode after episode. Planning takes a second or two.

        Args:
            adapts: Whether a ``Curriculum`` keeps up with the ego, starting with the attacks that are predicted to
                collide. If not, only these attacks are used. Attacks that a language model chose never change.

        Raises:
            ModelError: A language model plans and failed.
        """
        search = self._search(forecast=True)
        if isinstance(search, FixedOrder):
            return AttackPlan(search.propose(self.settings.attempts))
        colliding = [p for p in search.pool if p.prediction is not None and p.prediction.hit]
        best = sorted(colliding, key=search.price)[: self.settings.attempts]
        asked = self._search(forecast=False) if adapts else None
        return Curriculum(asked, self.settings.goal, best) if isinstance(asked, AttackSearch) else AttackPlan(best)

    def _search(self, *, forecast: bool) -> AttackSearch | FixedOrder:
        """Return the search for attacks; ``forecast`` makes one that predicts although the driver is unknown."""
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
        """Begin an episode; the previous one must have ended.

        Args:
            play: The episode.
        """
        return PlayedAttack(self, play, self._sandbox)

    @property
    def alive(self) -> bool:
        """Whether the engine runs."""
        return not self.engine.lost

    def close(self) -> None:
        """End the encounter's processes. A second call does nothing."""
        self._stack.close()


class AttackPlan:
    """Attacks in one encounter that were planned beforehand; each episode draws one.

    They are the best ones that are predicted to collide, or those that the analyzer chose.
    """

    def __init__(self, attacks: Sequence[Proposal]) -> None:
        """Keep the attacks.

        Args:
            attacks: The planned attacks.
        """
        self._attacks = attacks

    def next(self, draws: np.random.Generator) -> Proposal | None:
        """Draw an attack; None if there is none at all."""
        return self._attacks[int(draws.integers(len(self._attacks)))] if self._attacks else None

    def observe(self, attack: Proposal, verdict: Verdict) -> None:
        """Do nothing."""


class PlayedAttack:
    """An episode in progress in an encounter's engine.

    Attributes:
        encounter: The encounter.
        play: The episode.
        first: The first moment.
    """

    def __init__(self, encounter: TrainingEncounter, play: Play, sandbox: Any) -> None:
        """Begin the episode.

        Args:
            encounter: The encounter.
            play: The episode.
            sandbox: Runs planners.
        """
        self.encounter, self.play, self._sandbox = encounter, play, sandbox
        self._stack = ExitStack()
        self._sessions: Sessions | None = None
        self._talk: Conversation = encounter.engine.converse(self._answer, EpisodeCalls.directed_attempt, play)
        self.first = self._talk.said

    def ask(self, message: Any) -> Any:
        """Return the moment after the agents' actions, or the picture.

        Args:
            message: The actions, or ``DRAW_REQUEST``.
        """
        return self._talk.ask(message)

    def _answer(self, observation: PlannerObservation) -> Answer | str:
        """Return the answer of a planner that is not shipped."""
        proposal, encounter = self.play.proposal, self.encounter
        assert proposal is not None
        if self._sessions is None:
            seed, drivable = encounter.settings.seed, encounter.found.drivable
            sessions = Sessions(self._sandbox, encounter.roads, [proposal], seed, drivable=drivable)
            self._sessions = self._stack.enter_context(sessions)
        return self._sessions.answer(proposal, observation)

    def end(self) -> None:
        """Return to the trigger. A second call does nothing."""
        self._stack.close()
        self._talk.end()
