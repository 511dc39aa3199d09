"""Makes a suite: a number of encounters of each kind, drawn with a seed until they are calm, and the list of them.

The same seed gives the same files byte for byte (same SUMO); another seed gives as many of each kind, on the same
networks, in the same lanes and as dense traffic, with other figures.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from sumo_adv.benchmark.making.drafts import Draft, write_draft
from sumo_adv.benchmark.making.junctions import draw_junction
from sumo_adv.benchmark.making.straight import KINDS as STRAIGHT
from sumo_adv.benchmark.making.straight import draw_straight
from sumo_adv.benchmark.making.trials import EGOS, body, trial
from sumo_adv.benchmark.suites import NAME, SUITE_FILE, hash_of_file
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.simulation.engine import Engine, can_fork
from sumo_adv.simulation.inputs import data_folder

VERSION = "1"
SHIPPED, SHIPPED_SEED = "suite81", 1
SHARES: Mapping[str, int] = {
    "leader": 11, "neighbour_ahead": 13, "neighbour_behind": 8, "oncoming": 11, "follower": 7,
    "crossing_priority": 9, "crossing_allway": 5, "crossing_signals": 7, "crossing_t": 6, "crossing_roundabout": 2,
    "crossing_merge": 2,
}  # fmt: skip
"""How many encounters of each kind: 50 on straight roads, 31 at junctions."""

MOST_TRIES = 60  # candidates for one place in the list
Report = Callable[[str, str], None]  # name of the case, why a candidate is refused (empty: it is taken)


@dataclass(frozen=True, slots=True)
class Made:
    """What a suite took to make: candidates drawn, why others than those taken were rejected, seconds."""

    file: Path
    drawn: int
    rejected: Mapping[str, int]
    seconds: float


@dataclass(frozen=True, slots=True)
class Place:
    """One place in the list: its case's name, kind, group and number among its kind."""

    name: str
    kind: str
    group: str
    number: int


@dataclass(slots=True)
class _Count:
    drawn: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


def make_suite(
    seed: int, folder: Path, *, name: str = "", shares: Mapping[str, int] = SHARES, report: Report | None = None
) -> Made:
    """Makes the suite of a seed in ``folder``, which must not exist or be empty; nothing is left if it fails.

    name: of the suite, else ``suite81`` and for other seeds than the shipped one's ``suite81-<seed>``.

    Raises:
        UsageError: the folder is taken, the name is of no use, or this system cannot fork.
        SumoAdvError: an encounter could not be found in ``MOST_TRIES`` candidates.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} is there already and not empty: give a new folder for the suite.")
    if not can_fork():
        raise UsageError("Suites are made where processes can be forked (Linux): make it there and copy the folder.")
    name = name or (SHIPPED if seed == SHIPPED_SEED else f"{SHIPPED}-{seed}")
    if not re.fullmatch(NAME, name):
        raise UsageError(f"'{name}' is no name for a suite: use letters, digits, dots, dashes and underscores.")
    began = time.perf_counter()
    folder.parent.mkdir(parents=True, exist_ok=True)
    count = _Count()
    with tempfile.TemporaryDirectory(prefix=".making-", dir=folder.parent) as scratch, Engine(body, slots=1) as engine:
        work = Path(scratch) / "suite"
        work.mkdir()
        places = places_of(shares)
        for place in places:
            _fill(place, seed, work, engine, count, report)
        _write_list(work, name, seed, places, count)
        if folder.exists():
            folder.rmdir()
        work.replace(folder)
    return Made(folder / SUITE_FILE, count.drawn, dict(count.rejected), time.perf_counter() - began)


def places_of(shares: Mapping[str, int]) -> list[Place]:
    """The list's places, kind after kind, named by their group."""
    places: list[Place] = []
    numbers = Counter[str]()
    for kind, many in shares.items():
        group = "straight" if kind in STRAIGHT else "intersection"
        for number in range(many):
            numbers[group] += 1
            places.append(Place(f"{group}-{numbers[group]:02d}", kind, group, number))
    return places


def candidate(place: Place, seed: int, attempt: int) -> Draft:
    """The candidate number ``attempt`` for a place."""
    draw = Random(f"{seed}/{place.name}/{attempt}")
    return (draw_straight if place.kind in STRAIGHT else draw_junction)(place.kind, place.number, draw)


def _fill(place: Place, seed: int, work: Path, engine: Engine, count: _Count, report: Report | None) -> None:
    """Candidates for one place until one is good."""
    for attempt in range(MOST_TRIES):
        draft = candidate(place, seed, attempt)
        count.drawn += 1
        _provide_network(draft.network, work)
        fault = _fault(draft, write_draft(draft, place.name, work), engine)
        if report is not None:
            report(place.name, fault)
        if not fault:
            return
        count.rejected[fault] += 1
    raise SumoAdvError(f"No calm encounter was found for {place.name} in {MOST_TRIES} candidates; try another seed.")


def _provide_network(network: str, work: Path) -> None:
    target = work / "networks" / f"{network}.net.xml"
    target.parent.mkdir(exist_ok=True)
    if not target.exists():
        shutil.copyfile(data_folder("networks") / target.name, target)


def _fault(draft: Draft, scenario: Path, engine: Engine) -> str:
    """Why a candidate is refused, and by which driver; the first driver alone, then all others."""
    for egos in (EGOS[:1], EGOS[1:]):
        trials = [trial(scenario, ego, draft.bv_id(), draft.kind) for ego in egos]
        for fault in engine.request("trials", trials):
            if fault:
                return str(fault)
    return ""


def _write_list(work: Path, name: str, seed: int, places: list[Place], count: _Count) -> None:
    """The suite's own file: its cases, what was drawn for them, and the hash of every file."""
    lines = [
        f"# {len(places)} encounters, made by `sumo-adv bench make --seed {seed}`; frozen: the hashes are checked.",
        "schema = 1", f'name = "{name}"', f'version = "{VERSION}"', f"seed = {seed}", "", "[making]",
        f"drawn = {count.drawn}", "", "[making.rejected]",
        *(f'"{why}" = {many}' for why, many in sorted(count.rejected.items())),
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
