"""All pages of a batch, those that are there left as they are, and the index over them.

OUT/index.html      all episodes
OUT/pages/ID.html   the replay of one
OUT/made.json       what each page was made of, so that the next time only new ones are made
"""

from __future__ import annotations

import json
import re
import signal
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from sumo_adv import __version__
from sumo_adv.errors import SumoAdvError
from sumo_adv.parsing import parse_json
from sumo_adv.report.coverage import Coverage
from sumo_adv.report.index.make import Made, make_index, road_of
from sumo_adv.report.index.rows import Table
from sumo_adv.report.page.document import write_document
from sumo_adv.report.page.make import page_of
from sumo_adv.report.page.read import OUTCOME

INDEX, PAGES, MADE = "index.html", "pages", "made.json"
SAFE = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]{0,127}")
MOST_MAPS = 40  # networks on the index's map
FEW = 12  # pages that are made without starting processes
PORTION = 200  # runs unpacked at a time


@dataclass(frozen=True, slots=True)
class Packs:
    """Runs in zip files: their outcomes' texts by id, and a function that unpacks some below a folder."""

    outcomes: Mapping[str, str] = field(default_factory=dict)
    unpack: Callable[[Sequence[str], Path], Any] | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """What was written. ``damaged``: a sentence for each run that could not be shown."""

    index: Path
    episodes: int
    pages: int
    made: int
    damaged: Sequence[str]


def write_report(
    runs: Path,
    out: Path,
    name: str,
    table: Table,
    packs: Packs,
    coverage: Coverage | None = None,
    *,
    most: int | None = None,
    workers: int = 1,
    again: bool = False,
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> Report:
    """Make the pages that are missing, ``most`` of them (None: all), the most critical first, then the index.

    ``runs``: the folder of the runs, by id; ``coverage``: shown in the index; ``again``: make all pages anew. On Ctrl-C
    finished pages are kept. Raises UsageError where ``out`` cannot be written.
    """
    made, roads = _read(out) if not again else ({}, {})
    stamps = _stamps(runs, table, packs)
    made = {n: m for n, m in made.items() if stamps.get(n) == m.stamp and (out / PAGES / f"{n}.html").is_file()}
    order = sorted((r for r in table.rows if str(r["id"]) in stamps), key=_urgency)
    missing = [str(r["id"]) for r in order if str(r["id"]) not in made][:most]
    damaged: list[str] = []
    done = 0
    (out / PAGES).mkdir(parents=True, exist_ok=True)
    try:
        for run, result in _all_pages(missing, runs, packs, out / PAGES, workers, roads):
            done += 1
            if isinstance(result, str):
                damaged.append(result)
            else:
                made[run] = Made(stamps[run], *result)
            tell(done, len(missing))
    finally:
        _write(out, made, roads)
        write_document(out / INDEX, make_index(name, table, made, roads, coverage))
    return Report(out / INDEX, len(table.rows), len(made), done - len(damaged), damaged)


def _urgency(row: Mapping[str, Any]) -> tuple[bool, float]:
    least = row["min_ttc"]
    return bool(row["failure"]), float("inf") if least is None else least


def _stamps(runs: Path, table: Table, packs: Packs) -> dict[str, int]:
    """A checksum of each run's outcome, by id; names that are no plain file names are left out."""
    stamps = {}
    for row in table.rows:
        name = str(row["id"])
        file = runs / name / OUTCOME
        if not SAFE.fullmatch(name):
            continue
        if file.is_file():
            stamps[name] = zlib.crc32(file.read_bytes())
        elif name in packs.outcomes:
            stamps[name] = zlib.crc32(packs.outcomes[name].encode())
    return stamps


def _all_pages(
    names: Sequence[str], runs: Path, packs: Packs, target: Path, workers: int, roads: dict[str, Any]
) -> Iterator[tuple[str, tuple[tuple[float, float] | None, str] | str]]:
    """Each name with its place and network, or its fault; networks' maps are added to ``roads``."""
    plain = [n for n in names if (runs / n / OUTCOME).is_file()]
    others = [n for n in names if n not in set(plain)]
    with _Mapper(workers if len(names) > FEW else 1) as every:
        yield from _some_pages(every, plain, runs, target, roads)
        for start in range(0, len(others), PORTION):
            some = others[start : start + PORTION]
            with tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
                if packs.unpack is not None:
                    packs.unpack(some, Path(scratch))
                yield from _some_pages(every, some, Path(scratch), target, roads)


def _some_pages(
    every: _Mapper, names: Sequence[str], runs: Path, target: Path, roads: dict[str, Any]
) -> Iterator[tuple[str, tuple[tuple[float, float] | None, str] | str]]:
    for name, result in zip(names, every(partial(write_page, runs, target), names), strict=True):
        if not isinstance(result, str) and result[1] not in roads and len(roads) < MOST_MAPS:
            file = runs / name / "inputs" / result[1]
            if result[1] and file.is_file():
                roads[result[1]] = road_of(file)
        yield name, result


def write_page(runs: Path, target: Path, name: str) -> tuple[tuple[float, float] | None, str] | str:
    """Write one run's page; where it happened and on which network, or what is wrong with the run."""
    try:
        page = page_of(runs / name, back=f"../{INDEX}")
        write_document(target / f"{name}.html", page.html)
    except SumoAdvError as error:
        return str(error)
    return page.place, page.network


class _Mapper:
    """Applies a function to many things, here or in processes of its own, in order."""

    def __init__(self, workers: int) -> None:
        self._pool = None
        if workers > 1:
            self._pool = ProcessPoolExecutor(workers, get_context("spawn"), _ignore_interrupts)

    def __enter__(self) -> _Mapper:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=kind is not None)

    def __call__(self, act: Callable[[str], Any], names: Sequence[str]) -> Iterator[Any]:
        return map(act, names) if self._pool is None else self._pool.map(act, names, chunksize=4)


def _ignore_interrupts() -> None:
    """Ctrl-C is for the program that started them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _read(out: Path) -> tuple[dict[str, Made], dict[str, Any]]:
    """What the last time made; nothing where there was none, or another version made it."""
    try:
        kept = parse_json((out / MADE).read_text(encoding="utf-8"))
        if kept["version"] != __version__:
            return {}, {}
        made = {
            n: Made(m["stamp"], tuple(m["place"]) if m["place"] else None, m["network"])
            for n, m in kept["made"].items()
        }
        return made, kept["roads"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}, {}


def _write(out: Path, made: Mapping[str, Made], roads: Mapping[str, Any]) -> None:
    kept = {"version": __version__, "made": {n: asdict(m) for n, m in made.items()}, "roads": dict(roads)}
    write_document(out / MADE, json.dumps(kept) + "\n")
