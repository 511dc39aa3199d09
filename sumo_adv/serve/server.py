"""The server: encounter after encounter against an ego that a TraCI client drives, each with its outcome.

encounter -> decision (analyzer, bank) -> attempts against the client -> outcome -> memory
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending
from sumo_adv.episode.encounter_detector import COOL_DOWN_S
from sumo_adv.episode.encounter_finder import OUT_OF_REACH
from sumo_adv.episode.encounter_search import INSERTED_EGO
from sumo_adv.episode.loop import Decision, decide, model_ending, pursue
from sumo_adv.episode.prepared_encounter import prepare
from sumo_adv.episode.run import EncounterRecord, Request, Run
from sumo_adv.episode.task import Prefix, Task
from sumo_adv.errors import ModelError, SumoAdvError, UsageError, fault_sentence
from sumo_adv.llm.chat import run_in_thread
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.serve import Mode, OnLoss, Options
from sumo_adv.serve.encounter import AttackScene, EncounterMonitor, LiveAttempts, describe
from sumo_adv.serve.events import Events, ResultWriter, helpers
from sumo_adv.serve.gate import Gate
from sumo_adv.serve.session import ClientGone, EgoLost, EgoPlan, Session
from sumo_adv.simulation.demand import journeys
from sumo_adv.simulation.inputs import EgoRoute, RunInput
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.scan import scan_demand

DEFAULT_TYPE = "DEFAULT_VEHTYPE"
ROUTE_WARM_UP_S = 20.0  # duration of traffic before an ego on random routes departs
AFTER_ATTACK_S = 5.0  # no encounter begins within this time after an attack
MAX_DECISION_AGE_S = 4.0  # maximum age of a decision if the simulation does not wait for it
MAX_FRUITLESS_SIMULATIONS = 3  # give up after this many simulations in a row without an encounter
"""When a simulation ends (its demand, or ``--end``), the next one begins with the next seed."""


@dataclass(frozen=True, slots=True)
class ServerDependencies:
    """Everything that a server needs and does not make itself.

    Attributes:
        run_input: The input.
        options: The options of the server.
        task_for: Returns the task of a simulation, by the number of the simulation; each has another seed.
        road: The road network.
        agents: The agents.
        bank: The memory bank.
        gate: The gate.
        events: Receives what happens.
        writer: Writes the folders of encounters.
        check: Called every step; raises KeyboardInterrupt to stop.
    """

    run_input: RunInput
    options: Options
    task_for: Callable[[int], Task]
    road: RoadMap
    agents: Agents
    bank: MemoryBank
    gate: Gate
    events: Events
    writer: ResultWriter
    check: Callable[[], None]


class EgoServer:
    """Serves encounters until one of these ends it.

    It ends when ``encounters`` are done, the input has no more, the client is gone for good, or the user presses
    Ctrl-C.

    Attributes:
        reason: Why the server ended, in a sentence.
    """

    def __init__(self, parts: ServerDependencies) -> None:
        """Prepare to serve.

        Args:
            parts: What the server needs.
        """
        self._parts = parts
        self._task = parts.task_for(0)
        self._settings = self._task.settings
        self._session: Session | None = None
        self._ended_at: float | None = None  # the end of the last simulation [s]
        self._number = 0  # number of the current encounter, from 1
        self._fruitless = 0
        self.reason = ""

    @property
    def ego(self) -> str:
        """The id of the ego."""
        return self._task.ego if isinstance(self._task.ego, str) else INSERTED_EGO

    @property
    def time(self) -> float | None:
        """The simulated time [s].

        Between two simulations it is the end of the last one; before the first one it is None. Any thread may read it.
        """
        session = self._session
        return self._ended_at if session is None else session.now

    def run(self) -> Ending | None:
        """Serve.

        Returns:
            How the server ended if something failed (``reason`` says what), otherwise None.
        """
        parts = self._parts
        try:
            round_ = 0
            while self._wanted():
                self._simulate(round_)
                round_ += 1
        except ClientGone:
            self.reason = f"No client came to port {parts.gate.port} within {parts.options.patience:g} s."
            return Ending.EGO_LOST
        except EgoLost:
            self.reason = "The ego's client was lost or late, and --on-loss is end."
            return Ending.EGO_LOST
        except KeyboardInterrupt:
            self.reason = "Ctrl-C."
            return Ending.INTERRUPTED
        except ModelError as error:
            self.reason = str(error)
            return model_ending(error)
        except SumoAdvError as error:
            if error.exit_status == 2:
                raise
            self.reason = str(error)
            return Ending.SIMULATION_FAILED
        except Exception as error:  # a bug: earlier results are kept, and the sentence names it
            self.reason = fault_sentence(error)
            return Ending.SIMULATION_FAILED
        finally:
            self._end_session(clean=False)
        return None

    def _wanted(self) -> bool:
        """Return whether another encounter is wanted."""
        most = self._parts.options.encounters
        if self._fruitless >= MAX_FRUITLESS_SIMULATIONS and not self.reason:
            self.reason = f"The last {MAX_FRUITLESS_SIMULATIONS} simulations had no encounter."
        return not self.reason and (most is None or self._number < most)

    # -- a simulation -------------------------------------------------------------------------------------------

    def _simulate(self, round_: int) -> None:
        """Run one simulation from its begin, with all its encounters in continuous mode, otherwise with one."""
        self._task = self._parts.task_for(round_)
        self._settings = self._task.settings
        session, watch = self._start()
        before, quiet, passed = self._number, 0.0, list[str]()
        while self._wanted():
            ranking = watch.until_encounter(self._task.end, trigger=self._task.trigger, quiet=quiet)
            if not ranking and (session.now >= self._task.end - 1e-6 or session.deserted()):
                break
            quiet = COOL_DOWN_S
            scene = describe(session, self._parts.road, self._settings, ranking, passed)
            if isinstance(scene, str):
                self._pass_over(session, scene, passed)
            elif self._encounter(session, watch, scene, passed):
                passed, quiet = [], AFTER_ATTACK_S
                if self._parts.options.mode is Mode.EPISODES:
                    break
                assert self._session is session
            if self._task.trigger is not None:
                break
        self._fruitless = 0 if self._number > before else self._fruitless + 1
        if self._task.trigger is not None and not self.reason and self._number == before:
            self.reason = f"At the trigger given, {self._task.trigger:g} s, there was nothing to attack with."
        self._end_session(clean=True)

    def _start(self) -> tuple[Session, EncounterMonitor]:
        """Start a session, and look for encounters in it."""
        parts, task = self._parts, self._task
        self._session = session = Session(
            task.spec, parts.gate, parts.options, self._ego(task), parts.events, parts.check
        )
        warm_up = task.warm_up if task.ego is not None else 0.0
        return session, EncounterMonitor(session, parts.road, self._settings, tuple(task.only), warm_up)

    def _ego(self, task: Task) -> EgoPlan:
        """Return the vehicle under test: the demand's, a scenario's own, or one on random routes."""
        kind = self._parts.options.ego_type or task.ego_base_type or DEFAULT_TYPE
        if isinstance(task.ego, str):
            return EgoPlan(task.ego, kind, added=not self._in_demand(task, task.ego))
        if self._in_demand(task, INSERTED_EGO):
            raise UsageError(
                f"The demand has a vehicle {INSERTED_EGO!r}, which is the name of the ego that serve inserts: give "
                f"--ego-id {INSERTED_EGO} to have the client drive that vehicle, or another name to the vehicle."
            )
        if isinstance(task.ego, EgoRoute):
            route = task.ego
            return EgoPlan(INSERTED_EGO, kind, lambda: route)
        draw = random.Random(task.spec.seed)
        drawn = journeys(task.spec.network, draw)
        weights = [j.lanes for j in drawn]
        return EgoPlan(
            INSERTED_EGO, kind, lambda: EgoRoute(draw.choices(drawn, weights)[0].edges, 0.0), ROUTE_WARM_UP_S
        )

    def _in_demand(self, task: Task, vehicle: str) -> bool:
        """Return whether the demand has a vehicle."""
        return any(scan_demand(file).has(vehicle) for file in (*task.spec.routes, *task.spec.additional))

    @property
    def ego_is_added(self) -> bool:
        """Whether the client itself must add the ego."""
        return isinstance(self._task.ego, str) and not self._in_demand(self._task, self._task.ego)

    def _end_session(self, *, clean: bool) -> None:
        """End the session, if there is one."""
        if self._session is not None:
            self._ended_at = self._session.now
            session, self._session = self._session, None
            session.close(clean=clean)

    def _pass_over(self, session: Session, why: str, passed: list[str]) -> None:
        """Report an encounter that is passed over."""
        passed.append(f"{session.now:.1f} s ({why})")
        self._parts.events.tell("passed_over", time=session.now, reason=why)

    # -- an encounter -------------------------------------------------------------------------------------------

    def _encounter(self, session: Session, watch: EncounterMonitor, scene: AttackScene, passed: list[str]) -> bool:
        """Decide and attack; return False if the encounter was passed over or dropped."""
        parts, encounter = self._parts, scene.found
        parts.events.tell(
            "encounter", time=encounter.time, number=self._number + 1, ego=encounter.ego,
            ranking=[{"id": i, "relation": r, "risk": k} for i, r, k in encounter.ranking],
        )  # fmt: skip
        lanes = parts.road.strips(*encounter.area)
        kept = [EncounterRecord(encounter, self._settings.goal, lanes=lanes, request=Request.of(parts.run_input))]
        bank_hash = parts.bank.content_hash()
        try:
            decision = self._decided(session, kept, scene)
        except ModelError as error:
            self._number += 1
            record = replace(kept[-1], ending=model_ending(error), reason=str(error))
            parts.writer.keep(self._run(record, self._settings, bank_hash), self._number)
            raise
        given, record = decision.prepared.reaches or self._task.trigger is not None, decision.record
        if decision.library is None or not given:
            self._pass_over(session, record.reason if given else OUT_OF_REACH, passed)
            return False
        search = decision.prepared.search
        best = min(search.pool, key=search.price)
        if stale := self._stale(session, watch, scene, {record.intents[0].bv, *best.bvs}):
            parts.events.tell("dropped", time=session.now, reason=stale)
            return False
        self._number += 1
        self._pursue(session, scene, decision, bank_hash)
        return True

    def _run(self, record: EncounterRecord, settings: Settings, bank_hash: str) -> Run:
        """Return the run of one encounter, as it is written."""
        parts = self._parts
        isolation = parts.agents.sandbox.isolation if record.attacked else ""
        return Run(
            parts.run_input, settings, self._task, (record,), agents=parts.agents, isolation=isolation,
            bank_hash=bank_hash, timing=record.timing,
        )  # fmt: skip

    def _pursue(self, session: Session, scene: AttackScene, decision: Decision, bank_hash: str) -> None:
        """Attack as decided, and have the encounter written."""
        parts, settings = self._parts, self._settings
        episodes = parts.options.mode is Mode.EPISODES
        settings = settings if episodes else settings.model_copy(update={"attempts": 1})
        live = LiveAttempts(
            session, scene, parts.road, settings, parts.agents.sandbox, parts.events,
            (lambda: self._again(scene.found.time)) if episodes else None,
        )  # fmt: skip
        kept, failed = [decision.record], None
        try:
            pursue(decision, live, settings, parts.agents, parts.bank, self._tell_attempt, kept.append)
            if live.lost and kept[-1].ending is not Ending.GOAL_MET:
                failed = (Ending.EGO_LOST, "")
        except KeyboardInterrupt:
            failed = (Ending.INTERRUPTED, "Ctrl-C.")
            raise
        except SumoAdvError as error:
            failed = (Ending.SIMULATION_FAILED, str(error))
            raise
        except (ClientGone, EgoLost):
            failed = (Ending.EGO_LOST, "")
            raise
        finally:
            record, best = kept[-1], kept[-1].best
            index = 0 if best is None else best.index
            before = live.prefixes[index] if index < len(live.prefixes) else ()
            record = replace(record, prefix=Prefix(before, dict(scene.found.sizes)))
            if failed is not None:
                record = replace(record, ending=failed[0], reason=failed[1])
            parts.writer.keep(self._run(record, settings, bank_hash), self._number)
        if live.lost and parts.options.on_loss is OnLoss.END:
            raise EgoLost

    def _again(self, time: float) -> Session | None:
        """Rerun the same simulation up to ``time`` [s]; return None if the ego or its client is not there then."""
        self._end_session(clean=True)
        self._parts.events.tell("again", number=self._number, time=time)
        session, watch = self._start()
        return session if watch.until(time) else None

    def _tell_attempt(self, what: str, value: Any) -> None:
        """Report an attempt."""
        if what != "attempt":
            return
        a: Attempt = value
        v = a.verdict
        self._parts.events.tell(
            "attempt", number=self._number, index=a.index, adversary=a.proposal.bv, intent=a.proposal.label,
            mode=a.proposal.planner.mode, by=a.proposal.by, time=a.trigger_time, ending=a.ending,
            min_ttc=v.min_ttc if v.min_ttc < 1e6 else None, collided=v.collided, critical=v.critical,
            feasible=v.feasible, rear_end=v.rear_end, valid=v.valid, message=a.message, **helpers(a.proposal),
        )  # fmt: skip

    # -- the decision -------------------------------------------------------------------------------------------

    def _decided(self, session: Session, kept: list[EncounterRecord], scene: AttackScene) -> Decision:
        """Predict and decide for an encounter; append later records to ``kept``.

        The simulation waits for the decision or, with ``real_time``, continues meanwhile.

        Raises:
            ModelError: A language model plays a role and failed.
        """
        began, parts, settings = time.perf_counter(), self._parts, self._settings

        def work() -> Decision:
            prepared = prepare(
                scene.found, parts.run_input, settings, self._task, parts.agents.sandbox, parts.bank, parts.agents,
                forecast=True,
            )  # fmt: skip
            helped = settings.adversaries > 1 and self._task.trigger is not None  # supports may make the attack succeed
            if not prepared.reaches and not helped:
                return Decision(kept[-1], prepared, None)
            return decide(kept[-1], prepared, settings, parts.agents, parts.bank, kept.append)

        if session.pace is None:
            decision = work()
        else:
            waited_for = run_in_thread(work)
            while not waited_for.done():
                session.tick()
            decision = waited_for.result()
        self._parts.events.tell(
            "decided", time=session.now, seconds=round(time.perf_counter() - began, 3),
            age=round(session.now - scene.found.time, 2),
            intents=[{"bv": i.bv, "label": i.label, "risk": i.risk} for i in decision.record.intents[:3]],
        )  # fmt: skip
        return decision

    def _stale(self, session: Session, watch: EncounterMonitor, scene: AttackScene, wanted: Collection[str]) -> str:
        """Say why a decision for the ``wanted`` vehicles no longer fits the simulation; empty if it does."""
        age = session.now - scene.found.time
        if age == 0.0:
            return ""
        if not session.ready(0.0):
            return "the ego or its client is gone"
        if age > MAX_DECISION_AGE_S:
            return f"the decision is {age:.1f} s old"
        return next(filter(None, (watch.changed(scene.tracks, bv, scene.relation(bv)) for bv in sorted(wanted))), "")
