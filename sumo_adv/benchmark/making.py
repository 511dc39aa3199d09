"""Make a suite: draw encounters of each kind with a seed until enough of them are calm, and list them.

The same seed gives the same files byte for byte, with the same SUMO. Another seed gives as many encounters of each
kind, on the same networks, in the same lanes and with traffic of the same density, but with other values. A trial
drives as ``run`` does (``EpisodeWorker.open``, ``EpisodeWorker.seek``), so ``run`` finds the same encounters. Each
trial is a fork of a process that has run nothing.
"""

from __future__ import annotations

import math
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

from sumo_adv.benchmark.drafts import STRAIGHT_KINDS, EncounterDraft, draw_junction, draw_straight, write_draft
from sumo_adv.benchmark.nouns import CRITICAL_TTC_S
from sumo_adv.benchmark.suites import NAME_PATTERN, SUITE_FILE, hash_of_file
from sumo_adv.config import load_settings
from sumo_adv.episode.encounter_detector import MAX_LATER_ARRIVAL_S, MAX_START_ACCELERATION_M_S2
from sumo_adv.episode.task import FoundEncounter, NoEncounter, Task, make_task
from sumo_adv.episode.worker import EpisodeWorker
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.forks import can_fork, in_forks
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.programs import load_libsumo
from sumo_adv.situation import Target

EGOS = ("idm", "krauss", "eidm", "careful")
"""The drivers with which an encounter must be calm. A replayed ego repeats what ``idm`` drives."""

EGO_STAYS_AFTER_TRIGGER_S = 15.0  # an attack begun 3 s late lasts 12 s
BV_STAYS_AFTER_TRIGGER_S = 8.0
RELATION_OF_KIND = {
    "leader": "leader", "neighbour_ahead": "neighbour", "neighbour_behind": "neighbour", "oncoming": "oncoming",
    "follower": "follower",
}  # fmt: skip
CONFLICT_RELATIONS = ("crossing", "merging", "oncoming")


@dataclass(frozen=True, slots=True)
class Trial:
    """An encounter with one driver.

    Attributes:
        task: The task.
        bv: The intended adversary.
        kind: The kind of encounter, which says where the intended adversary is.
        first: Whether the intended adversary must be the most dangerous vehicle.
    """

    task: Task
    bv: str
    kind: str
    first: bool


def scenario_trial(scenario: Path, ego: str, bv: str, kind: str) -> Trial:
    """Make the trial of a scenario.

    Args:
        scenario: The scenario file.
        ego: The ego's driver.
        bv: The intended adversary.
        kind: The kind of encounter.

    Returns:
        The trial, with SUMO's seed 0.
    """
    run_input = load_input(scenario)
    settings = load_settings(None, ego=ego, seed=0, critical_ttc=CRITICAL_TTC_S, horizon=run_input.horizon)
    task = make_task(run_input, settings, Path(tempfile.gettempdir()))
    return Trial(task, bv, kind, kind in RELATION_OF_KIND and ego == EGOS[0])


def tried(candidate: Trial) -> str:
    """Drive a trial.

    Args:
        candidate: The trial.

    Returns:
        What is wrong with the encounter, in words without values; '' if it is good.
    """
    worker = EpisodeWorker([])
    worker.open(candidate.task)
    try:
        outcome = worker.seek()
    except UsageError:  # SUMO found no room for the ego in the given time
        return "the ego is not inserted"
    if isinstance(outcome, NoEncounter):
        words = re.sub(r"^At the trigger given, [\d.]+ s, ", "", outcome.reason)
        return re.sub(r":.*", "", words).rstrip(".")
    return _fault(candidate, outcome)


def _fault(candidate: Trial, encounter: FoundEncounter) -> str:
    """Return the reason to reject an encounter; '' if there is none."""
    present = {
        name: sum(name in snapshot.raw for snapshot in encounter.baseline) for name in (encounter.ego, candidate.bv)
    }
    dt = candidate.task.settings.step_length
    if present[encounter.ego] * dt < EGO_STAYS_AFTER_TRIGGER_S:
        return "the ego stays too short"
    if present[candidate.bv] * dt < BV_STAYS_AFTER_TRIGGER_S:
        return "the vehicle meant stays too short"
    relations = {name: relation for name, relation, _ in encounter.ranking}
    target = encounter.first.targets.get(candidate.bv)
    if candidate.bv not in relations or target is None:
        return "the vehicle meant is no candidate"
    if candidate.first and encounter.ranking[0][0] != candidate.bv:
        return "another vehicle is more dangerous than the one meant"
    if candidate.kind not in RELATION_OF_KIND:
        ok = relations[candidate.bv] in CONFLICT_RELATIONS and in_time(target, encounter.first.ego.speed)
        return "" if ok else "the vehicle meant cannot be at the conflict in time"
    ahead = encounter.first.frame.to_local(target.state.x, target.state.y, target.state.heading)[0] > 0
    sided = {"neighbour_ahead": ahead, "neighbour_behind": not ahead}.get(candidate.kind, True)
    as_meant = relations[candidate.bv] == RELATION_OF_KIND[candidate.kind] and sided
    return "" if as_meant else "the vehicle meant stands otherwise by then"


def in_time(target: Target, ego_speed: float) -> bool:
    """Check whether a vehicle can reach a conflict in time.

    Args:
        target: The vehicle.
        ego_speed: The ego's speed [m/s].

    Returns:
        Whether the vehicle, if it accelerates at once, reaches one of its conflicts at most ``MAX_LATER_ARRIVAL_S``
            (0.2 s) after the ego.
    """
    for way in target.ways:
        if way.conflict is None or way.conflict.bv_s < 1.0 or way.conflict.ego_s < 1.0:
            continue
        v = max(target.state.speed, 0.1)
        earliest = (
            -v + math.sqrt(v * v + 2 * MAX_START_ACCELERATION_M_S2 * way.conflict.bv_s)
        ) / MAX_START_ACCELERATION_M_S2
        if earliest <= way.conflict.ego_s / max(ego_speed, 1.0) + MAX_LATER_ARRIVAL_S:
            return True
    return False


class TrialWorker:
    """Forks the trials, in the engine's process."""

    def __init__(self, slots: Sequence[Connection]) -> None:
        import shapely.geometry  # noqa: F401 - what every trial needs is there before the first fork

        load_libsumo()

    def trials(self, trials: Sequence[Trial]) -> list[str]:
        """Drive trials, each in a fork.

        Args:
            trials: The trials.

        Returns:
            What is wrong with each encounter, as ``tried`` returns it.
        """
        return in_forks([partial(tried, candidate) for candidate in trials])


# -- the suite


SUITE_VERSION = "1"
SHIPPED_SUITE, SHIPPED_SUITE_SEED = "suite81", 1
ENCOUNTERS_PER_KIND: Mapping[str, int] = {
    "leader": 11, "neighbour_ahead": 13, "neighbour_behind": 8, "oncoming": 11, "follower": 7,
    "crossing_priority": 9, "crossing_allway": 5, "crossing_signals": 7, "crossing_t": 6, "crossing_roundabout": 2,
    "crossing_merge": 2,
}  # fmt: skip
"""The number of encounters of each kind: 50 on straight roads, 31 at junctions."""

MAX_TRIES_PER_ENCOUNTER = 60  # candidates for one place
ReportCandidate = Callable[[str, str], None]  # the case, and why the candidate is rejected ('' if it is taken)


@dataclass(frozen=True, slots=True)
class MadeSuite:
    """The making of a suite.

    Attributes:
        file: The list.
        drawn: The number of candidates that were drawn.
        rejected: The number of rejected candidates by reason.
        seconds: The time that it took [s].
    """

    file: Path
    drawn: int
    rejected: Mapping[str, int]
    seconds: float


@dataclass(frozen=True, slots=True)
class EncounterPlace:
    """One place in the list.

    Attributes:
        name: The name of the case.
        kind: The kind of encounter.
        group: The group.
        number: The number within its kind, from 0.
    """

    name: str
    kind: str
    group: str
    number: int


def make_suite(
    seed: int,
    folder: Path,
    *,
    name: str = "",
    shares: Mapping[str, int] = ENCOUNTERS_PER_KIND,
    report: ReportCandidate | None = None,
) -> MadeSuite:
    """Make the suite of a seed. Nothing is left if it fails.

    Args:
        seed: The seed.
        folder: The folder, which must not exist or be empty.
        name: The suite's name; '' means ``suite81`` for the shipped seed and ``suite81-<seed>`` for others.
        shares: The number of encounters of each kind.
        report: Called with each candidate's case, and why the candidate was rejected ('' if it was taken).

    Returns:
        How the suite was made.

    Raises:
        UsageError: The folder is not empty, the name is not allowed, or this system cannot fork.
        SumoAdvError: ``MAX_TRIES_PER_ENCOUNTER`` candidates held no calm encounter for a place.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty: give a new folder for the suite.")
    if not can_fork():
        raise UsageError(
            "A suite can be made only where processes can be forked (Linux): make it there and copy the folder."
        )
    name = name or (SHIPPED_SUITE if seed == SHIPPED_SUITE_SEED else f"{SHIPPED_SUITE}-{seed}")
    if not re.fullmatch(NAME_PATTERN, name):
        raise UsageError(
            f"'{name}' is not a valid name for a suite: use letters, digits, dots, dashes and underscores."
        )
    began = time.perf_counter()
    folder.parent.mkdir(parents=True, exist_ok=True)
    faults = Counter[str]()  # by fault; '' counts good candidates
    with (
        tempfile.TemporaryDirectory(prefix=".making-", dir=folder.parent) as scratch,
        Engine(TrialWorker, slots=1) as engine,
    ):
        work = Path(scratch) / "suite"
        work.mkdir()
        places = places_of(shares)
        for place in places:
            _fill(place, seed, work, engine, faults, report)
        drawn = faults.total()
        del faults[""]
        _write_list(work, name, seed, places, drawn, faults)
        if folder.exists():
            folder.rmdir()
        work.replace(folder)
    return MadeSuite(folder / SUITE_FILE, drawn, dict(faults), time.perf_counter() - began)


def places_of(shares: Mapping[str, int]) -> list[EncounterPlace]:
    """Return the places of the list, kind after kind, named by their group and numbered."""
    places: list[EncounterPlace] = []
    numbers = Counter[str]()
    for kind, many in shares.items():
        group = "straight" if kind in STRAIGHT_KINDS else "intersection"
        for number in range(many):
            numbers[group] += 1
            places.append(EncounterPlace(f"{group}-{numbers[group]:02d}", kind, group, number))
    return places


def candidate(place: EncounterPlace, seed: int, attempt: int) -> EncounterDraft:
    """Draw a candidate for a place; the same arguments give the same candidate."""
    draw = Random(f"{seed}/{place.name}/{attempt}")
    return (draw_straight if place.kind in STRAIGHT_KINDS else draw_junction)(place.kind, place.number, draw)


def _fill(
    place: EncounterPlace,
    seed: int,
    work: Path,
    engine: Engine[TrialWorker],
    faults: Counter[str],
    report: ReportCandidate | None,
) -> None:
    """Draw candidates for one place until one is good, and count their faults."""
    for attempt in range(MAX_TRIES_PER_ENCOUNTER):
        draft = candidate(place, seed, attempt)
        network = work / "networks" / f"{draft.network}.net.xml"
        network.parent.mkdir(exist_ok=True)
        if not network.exists():
            shutil.copyfile(data_folder("networks") / network.name, network)
        fault = _refused(draft, write_draft(draft, place.name, work), engine)
        faults[fault] += 1
        if report is not None:
            report(place.name, fault)
        if not fault:
            return
    raise SumoAdvError(
        f"No calm encounter was found for {place.name} in {MAX_TRIES_PER_ENCOUNTER} candidates; try another seed."
    )


def _refused(draft: EncounterDraft, scenario: Path, engine: Engine[TrialWorker]) -> str:
    """Return why a candidate is rejected, '' if it is good; try the first driver alone, and then all others."""
    for egos in (EGOS[:1], EGOS[1:]):
        trials = [scenario_trial(scenario, ego, draft.bv_id(), draft.kind) for ego in egos]
        for fault in engine.call(TrialWorker.trials, trials):
            if fault:
                return fault
    return ""


def _write_list(
    work: Path, name: str, seed: int, places: list[EncounterPlace], drawn: int, rejected: Mapping[str, int]
) -> None:
    """Write the list of the suite: its cases, how many candidates were drawn, and the hash of every file."""
    lines = [
        f"# {len(places)} encounters, made by `sumo-adv bench make --seed {seed}`; frozen: the hashes are checked.",
        "schema = 1", f'name = "{name}"', f'version = "{SUITE_VERSION}"', f"seed = {seed}", "", "[making]",
        f"drawn = {drawn}", "", "[making.rejected]",
        *(f'"{why}" = {many}' for why, many in sorted(rejected.items())),
    ]  # fmt: skip
    for place in places:
        lines += [
            "", "[[cases]]", f'name = "{place.name}"', f'kind = "{place.kind}"', f'group = "{place.group}"',
            f'file = "{place.name}.toml"',
        ]  # fmt: skip
    lines += ["", "[files]  # SHA-256"]
    for path in sorted(p for p in work.rglob("*") if p.is_file()):
        lines.append(f'"{path.relative_to(work).as_posix()}" = "{hash_of_file(path)}"')
    (work / SUITE_FILE).write_text("\n".join([*lines, ""]), encoding="utf-8", newline="\n")
