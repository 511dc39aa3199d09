"""An encounter that is worth attacking: found by the engine, with the predictions that say so and its intents."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.agents.teams import Teamwork
from sumo_adv.config import Settings
from sumo_adv.datatypes import Ending, Intent, LibraryEntry
from sumo_adv.drivers.timing import DriverTime
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine
from sumo_adv.episode.memory_access import (
    known_casts,
    read_library,
    recall,
    remembered,
    retrieve,
    selected,
    signature,
)
from sumo_adv.episode.run import EncounterRecord, Request, Run, Stop, best_record, seconds_by_part
from sumo_adv.episode.task import FoundEncounter, NoEncounter, Task
from sumo_adv.errors import SumoAdvError
from sumo_adv.memory.bank import MemoryBank, compositions
from sumo_adv.memory.records import SceneSignature
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.intents import FREE, Selection, composed
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.sampling import templates_of
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.words.request import needs_model

MAX_PASSED_OVER = 6  # encounters that are passed over because no candidate is predicted to collide
OUT_OF_REACH = "no intent reaches the ego, by prediction"
Tell = Callable[[str, Any], None]
"""Called with what happens, for progress: ("encounter", FoundEncounter), ("intents", ...), ("attempt", Attempt)."""
Keep = Callable[[EncounterRecord], None]
"""Called with the record of an encounter whenever it has grown, so that nothing is lost if something breaks."""


def forget(record: EncounterRecord) -> None:
    """Keep nothing: for callers that need the record only if nothing breaks."""


@dataclass(frozen=True, slots=True)
class PlannedEncounter:
    """An encounter with the predictions of the first candidates.

    Attributes:
        found: The encounter.
        predictor: Predicts candidates.
        library: The bank's intents, with those for pedestrians and cyclists near.
        scene: What the bank compares this encounter by.
        search: The search for attacks.
        known: The intent recalled from a similar scene; None if there is none.
        selection: The intents that may be tried.
        teamwork: What an analyzer may compose; None if one adversary is all that is allowed.
        network: The name of the run's input.
        bandit: How the planners of each intent were ordered, for the manifest.
        timing: How long each part took [s].
    """

    found: FoundEncounter
    predictor: Predictor
    library: Sequence[LibraryEntry]
    scene: SceneSignature
    search: AttackSearch
    known: Intent | None
    selection: Selection
    teamwork: Teamwork | None
    network: str
    bandit: Sequence[Mapping[str, object]] = ()
    timing: Mapping[str, float] = field(default_factory=dict)

    @property
    def reaches(self) -> bool:
        """Whether some candidate is predicted to collide, or an intent is recalled."""
        return self.known is not None or self.search.reaches


class EncounterFinder:
    """Finds the encounters of a run one after another, and keeps their records while the run goes on.

    Attributes:
        records: The records so far; the last one is that of the encounter at hand.
        stop: Why there is no further encounter; None while there may be one.
        forked: Whether attempts are forks of the simulation; known once the first encounter was looked for.
        stopped: How many calls of each planner ran into a limit in predictions, by the planner's hash.
        timing: How long the start took [s].
    """

    def __init__(self, run_input: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, tell: Tell) -> None:
        """Find encounters of a task; nothing is simulated yet."""
        self._run_input, self._settings, self._task = run_input, settings, task
        self._engine, self._tell, self._began = engine, tell, time.perf_counter()
        self.records: list[EncounterRecord] = []
        self.stop: Stop | None = None
        self.forked = False
        self.stopped: Mapping[str, int] = {}
        self.timing: dict[str, float] = {}

    def seek(self) -> EncounterRecord | None:
        """Start the simulation, if it has not started, and go on to the next encounter.

        Returns:
            The record of the encounter; None if there is none (``stop`` says why).
        """
        began = time.perf_counter()
        if not self.records:
            self._engine.call(EpisodeCalls.open, self._task)
            self.forked = self._engine.call(EpisodeCalls.forks)
            self.timing["start"] = time.perf_counter() - began
            began = time.perf_counter()
        found = self._engine.call(EpisodeCalls.seek, self.records[-1].left if self.records else "")
        seconds = time.perf_counter() - began
        if isinstance(found, NoEncounter):
            self.stop = Stop(found.ending, found.reason)
            self.timing["seek"] = seconds
            return None
        record = EncounterRecord(
            found, self._settings.goal, self._engine.call(EpisodeCalls.prefix),
            self._engine.call(EpisodeCalls.lanes, *found.area),
            Request(self._run_input.asked, self._run_input.words), timing={"seek": seconds},
        )  # fmt: skip
        self.records.append(record)
        self._tell("encounter", found)
        return record

    def driver_time(self) -> DriverTime | None:
        """Return how long the driver's answers took so far; None if that is not known."""
        engine = self._engine
        if "start" not in self.timing or engine.lost or engine.asked or engine.talks:
            return None
        try:
            return engine.call(EpisodeCalls.driver_time)
        except SumoAdvError:
            return None

    def find_attackable(
        self, sandbox: Sandbox, bank: MemoryBank, agents: Agents | None = None, *, any_candidate: bool = False
    ) -> PlannedEncounter | None:
        """Go on to the first encounter in which some candidate is predicted to collide.

        Args:
            sandbox: Where planners run.
            bank: The memory bank.
            agents: Who plays along; None if nobody does.
            any_candidate: True if an encounter with any candidate is enough, because attempts will be varied until one
                collides.

        Returns:
            The encounter, whose record is the last one; None if there is none (``stop`` says why).

        Raises:
            UsageError: The settings name an intent that the bank does not know.
        """
        selected(self._settings, bank, self._run_input.intents)  # refuses misspelt names before anything is simulated
        while (record := self.seek()) is not None:
            planned = with_predictions(
                record.found, self._run_input, self._settings, self._task, sandbox, bank, agents, stopped=self.stopped
            )
            self.stopped = planned.predictor.stopped
            reaches = planned.reaches or (any_candidate and bool(planned.search))
            given = self._task.trigger is not None
            if reaches or record.found.last or given or len(self.records) > MAX_PASSED_OVER:
                return planned
            self.leave(OUT_OF_REACH)
        return None

    def keep(self, record: EncounterRecord) -> None:
        """Replace the record of the encounter at hand by a later one."""
        self.records[-1] = record

    def leave(self, why: str) -> None:
        """Leave the encounter at hand, so that ``seek`` goes on to the next one. Only the best record so far keeps its
        recorded states, which are large."""
        record = replace(self.records[-1], left=why)
        if not record.attacked:
            record = replace(record, ending=Ending.NO_ENCOUNTER, reason=record.reason or why)
        self.records[-1] = record
        best = best_record(self.records)
        self.records = [r if r is best else r.without_states() for r in self.records]

    def break_off(self, stop: Stop) -> None:
        """Note what broke the run off, also in the record of the encounter at hand."""
        self.stop = stop
        if self.records and not self.records[-1].left:
            self.keep(replace(self.records[-1], ending=stop.ending, reason=stop.reason))

    def run(self, agents: Agents | None = None, *, isolation: str = "", bank_hash: str = "") -> Run:
        """Return the run with the records so far, SUMO's warnings, and the time since the finder was made.

        Args:
            agents: Who analyzed, generated and modified; None if no part was played.
            isolation: How planners were kept apart from this machine; empty if none ran.
            bank_hash: Hash of the bank's content before the run.
        """
        spent = seconds_by_part(self.timing, *(record.timing for record in self.records))
        return Run(
            self._run_input, self._settings, self._task, tuple(self.records), self.stop, self.forked, agents, isolation,
            bank_hash, self._task.own_names(self._engine.log.warnings()),
            {**spent, "total": time.perf_counter() - self._began}, self.driver_time(),
        )  # fmt: skip


def with_predictions(
    found: FoundEncounter, run_input: RunInput, settings: Settings, task: Task, sandbox: Sandbox, bank: MemoryBank,
    agents: Agents | None = None, *, stopped: Mapping[str, int] | None = None, forecast: bool = False,
) -> PlannedEncounter:  # fmt: skip
    """Return an encounter with the bank's library and the predictions of the first candidates.

    A driver that is not known is asked, not predicted, unless ``forecast``: for those that cannot ask it by attempts.
    With ``recall = scene`` the search starts with a candidate that succeeded in a similar scene. ``stopped``: how many
    calls of each planner ran into a limit in earlier encounters, by hash.
    """
    share = settings.per_planner if agents is not None and agents.by_model("modifier") else settings.attempts
    evidence = agents is not None and agents.by_model("analyzer") and settings.evidence == "on"
    weights = SearchSettings(proposals=settings.proposals, share=share)
    selection = selected(settings, bank, run_input.intents)
    predictor = Predictor(sandbox, settings, found.drivable, found.situations, weights.score, stopped)
    scene = signature(found.first, found.first.target_list()[0].state.id, task.ego_driver)
    library, bandit = read_library(bank, scene, settings.seed, found.situations)
    predicts = forecast or found.first.baseline.model.known or evidence
    log = task.playback
    if settings.tuner == "builtin" and (not predicts or (log is not None and log.tracks is not None)):
        library = [*library, FREE]
    timing, recalled = dict[str, float](), None
    if settings.recall == "scene":
        began = time.perf_counter()
        recalled = recall(found, library, bank, selection, settings.limits.limits(), task.ego_driver)
        timing["recall"] = time.perf_counter() - began
    intent, first = (None, None) if recalled is None else recalled
    known = tuple(compositions(bank)) if settings.adversaries > 1 else ()
    search = AttackSearch(
        predictor, found.situations, library, weights, seed=settings.seed, goal=settings.goal, selection=selection,
        recalled=first, adversaries=settings.adversaries, colliders=task.colliders, compositions=known,
        predicts=predicts,
    )  # fmt: skip
    teamwork = Teamwork(settings.adversaries, task.colliders, known) if settings.adversaries > 1 else None
    return PlannedEncounter(
        found, predictor, library, scene, search, intent, selection, teamwork, run_input.name, bandit, timing
    )


def analyze(
    record: EncounterRecord, planned: PlannedEncounter, settings: Settings, agents: Agents, bank: MemoryBank,
    keep: Keep,
) -> tuple[EncounterRecord, Sequence[LibraryEntry]]:  # fmt: skip
    """Return the record with the intents of an encounter, and the library with retrieved or generated planners for new
    intents. Raises ModelError: a language model plays a part and failed."""
    began = time.perf_counter()
    situations, library = planned.found.situations, planned.library
    try:
        intents = agents.analyze(
            planned.search, situations, library, selection=planned.selection,
            remembered=remembered(bank, library, planned.scene), teamwork=planned.teamwork,
        )  # fmt: skip
        record = _with_request(replace(record, intents=intents), settings, agents)
        if agents.by_model("analyzer") and settings.tuner == "builtin" and settings.ask is None:
            chosen = {(i.bv, i.label) for i in intents}
            others = (i for i in planned.search.ranking(library) if (i.bv, i.label) not in chosen)
            record = replace(record, intents=[*intents, *others])
        retrieved = retrieve(record.intents, agents, situations, library, bank)
        record = replace(record, intents=retrieved.intents).took("retrieval", retrieved.seconds)
    finally:
        record = record.took("analyzer", time.perf_counter() - began)
        keep(record)
    entries, labels = retrieved.library, {i.label for i in record.intents}
    record = replace(record, casts=known_casts(agents.casts, bank))
    if entries != library or any(composed(e) and e.label in labels for e in entries):
        planned.search.extend([e for e in entries if not composed(e) or e.label in labels])
    if settings.ask is not None:
        planned.search.confine({(i.bv, i.label) for i in record.intents})
    if record.casts and settings.tuner == "builtin":
        planned.search.add_casts(record.casts, agents.player("analyzer"))
    return record, entries


def _with_request(record: EncounterRecord, settings: Settings, agents: Agents) -> EncounterRecord:
    """Keep what a model made of the words of ``ask``, or why they cannot be played here. Raises UsageError."""
    if settings.ask is None:
        return record
    if agents.asked is None:  # no model, or one that failed and was replaced
        raise needs_model("An attack asked for in words", settings.ask)
    record = replace(record, request=Request(agents.asked, settings.ask, agents.why_not))
    if not agents.why_not:
        return record
    note = f"The encounter at {record.found.time:.1f} s cannot play the request: {agents.why_not}"
    return replace(record, notes=[*record.notes, note])


# -- what the next run would see of the bank ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BankView:
    """What an encounter depends on. templates: keys of what the search draws from, in order where nothing but the order
    is tried. evidence: number of pieces, 0 where no model is shown them and no scene is recalled."""

    templates: tuple[tuple[float, str, str, str], ...]
    evidence: int

    @classmethod
    def of(cls, planned: PlannedEncounter, settings: Settings, agents: Agents, bank: MemoryBank) -> BankView:
        """Return the view of the bank as it is now, in an encounter."""
        library, _ = read_library(bank, planned.scene, settings.seed, planned.found.situations)
        plain = [e for e in library if not composed(e)]  # the expert composes the others anyway
        templates = [t.key for t in templates_of(planned.found.situations, plain)]
        shown = agents.by_model("analyzer") and settings.evidence == "on"
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
