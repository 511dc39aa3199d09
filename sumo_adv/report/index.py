"""The index of a batch: all episodes in one page that sorts, filters and leads to each one's replay.

OUT/index.html      all episodes
OUT/pages/ID.html   the replay of one
OUT/made.json       what each page was made of, so that the next time only new ones are made
"""

from __future__ import annotations

import csv
import json
import math
import re
import signal
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from html import escape
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from sumo_adv import __version__
from sumo_adv.datatypes import Floats, Level
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import cell_text, scratch_prefix
from sumo_adv.metrics.severity import Severity
from sumo_adv.metrics.statistics import wilson
from sumo_adv.parsing import read_json
from sumo_adv.report.coverage import ALL_EGOS, SPEED_BANDS_M_S, Coverage
from sumo_adv.report.document import asset, document, packed, whole, write_document
from sumo_adv.report.page import page_of
from sumo_adv.report.page_road import network
from sumo_adv.report.read import OUTCOME_FILE
from sumo_adv.report.run_outcome import level_named
from sumo_adv.report.scenario_table import ScenarioRow, scenario_section
from sumo_adv.scenario_names import COLUMNS as SCENARIO

PLAIN_COLUMNS = ("id", "network", "ego", "seed", "intent", "level", "min_ttc", "delta_v", "ending", "failure")
MAX_PLAIN_ROWS = 500  # in the table for browsers without JavaScript
HUNT = "hunt.json"  # in the folder of a hunt
TEXT_FIELDS = (
    "id", "network", "ego", "intent", "ending", "failure", "level", "severity", "relation", "road", "preventable_by",
)  # fmt: skip
LATER_TEXT_FIELDS = (
    "cause",
    "cause_sentence",
    "fault",
    "red_light",
    "right_of_way",
    *SCENARIO,
)  # words that earlier tables may lack
LATER_NUMBER_FIELDS, LATER_FLAG_FIELDS = ("overlap", "warning"), ("humanlike", "robust")  # the same
NUMBER_FIELDS = ("seed", "raw_min_ttc", "min_ttc", "attempts", "seconds", "delta_v")
FLAG_FIELDS = ("collided", "valid", "critical")
VARIED = "set_"
SCENARIOS_MARK = "<!-- named scenarios -->"  # where the page's body has the section of named scenarios
INDEX_LEVELS = (Level.CRITICAL, Level.COLLISION, Level.VALID, Level.STRICT, Level.SERIOUS)
INDEX_SCHEMA = 1
INDEX_SCRIPTS = ("common.js", "decode.js", "rows.js", "bars.js", "places.js", "egos.js", "cells.js", "index.js")
INDEX_STYLES = ("common.css", "index.css")
MAX_MAP_LANES = 4000  # on the map of a network
DECIMETRE_M = 0.1
MAP_TOLERANCE_M = 0.5  # m a line on such a map may be off
CODED = {*TEXT_FIELDS, *LATER_TEXT_FIELDS} - {"id", "failure", "cause_sentence"}  # few values, many rows
INDEX_PAGE, PAGES_FOLDER, MADE = "index.html", "pages", "made.json"
SAFE_NAME = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]{0,127}")
MAX_MAPS = 40  # networks on the index's map
MAX_PAGES_IN_PROCESS = 12  # pages that are made without starting processes
RUNS_UNPACKED_AT_ONCE = 200  # runs unpacked at a time


@dataclass(frozen=True, slots=True)
class ResultsTable:
    """The rows in the batch's order, and the names of the settings that vary (``set_NAME``)."""

    rows: Sequence[Mapping[str, Any]]
    varied: Sequence[str] = ()


def table_of(rows: Iterable[Mapping[str, Any]]) -> ResultsTable:
    """The table of rows that were made here, not read from a file."""
    return ResultsTable([{**row, **{name: row[name] or "" for name in TEXT_FIELDS}} for row in rows])


def read_rows(file: Path) -> ResultsTable:
    """The table of a batch. Raises UsageError: it is no such table."""
    if (file.parent / HUNT).is_file():
        runs = file.parent / "failures"
        raise UsageError(f"{file.parent} is the folder of a hunt: its pages are in report/; give {runs} for others.")
    try:
        with file.open(newline="", encoding="utf-8") as text:
            reader = csv.DictReader(text)
            names = list(reader.fieldnames or [])
            lacking = [n for n in (*TEXT_FIELDS, *NUMBER_FIELDS, *FLAG_FIELDS) if n not in names]
            if lacking:
                raise ValueError(f"it has no column {lacking[0]}")
            varied = tuple(n for n in names if n.startswith(VARIED))
            return ResultsTable([_row(row, varied) for row in reader], varied)
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{file} is not the table of a batch ({error}); say the batch's command again.") from error


def _row(row: Mapping[str, str | None], varied: Sequence[str]) -> dict[str, Any]:
    made: dict[str, Any] = {
        name: cell_text(row.get(name) or "") for name in (*TEXT_FIELDS, *LATER_TEXT_FIELDS, *varied)
    }
    made |= {name: _number(row.get(name)) for name in (*NUMBER_FIELDS, *LATER_NUMBER_FIELDS)}
    truths = (*FLAG_FIELDS, *LATER_FLAG_FIELDS)
    return made | {name: {"true": True, "false": False}.get(row.get(name) or "") for name in truths}


def _number(text: str | None) -> float | None:
    value = float(text) if text else math.nan
    return value if math.isfinite(value) else None


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Each ego's episodes, by name. All rates have all episodes below them, failed ones too: value, low and high.

    reached: the share of episodes that reached at least each of ``INDEX_LEVELS``. failed: the share of failed episodes.
    severity: how many collisions that reached ``valid`` had each one. delta_v: their median [m/s], None without any.
    """
    summaries = []
    for ego in sorted({str(row["ego"]) for row in rows}):
        own = [row for row in rows if row["ego"] == ego]
        levels = [level_named(row["level"]) for row in own]
        hits = [row for row, level in zip(own, levels, strict=True) if level >= Level.VALID]
        counted = Counter(row["severity"] for row in hits)
        speeds = [row["delta_v"] for row in hits if row["delta_v"] is not None]
        counts = [
            sum(bool(row["failure"]) for row in own),
            *(sum(level >= least for level in levels) for least in INDEX_LEVELS),
        ]
        rates = [wilson(count, len(own)) for count in counts]
        failed, *reached = [[round(value, 4) for value in (rate.value, rate.low, rate.high)] for rate in rates]
        summaries.append({
            "ego": ego, "episodes": len(own), "reached": reached, "failed": failed,
            "severity": [counted[name] for name in Severity], "delta_v": median(speeds) if speeds else None,
        })  # fmt: skip
    return summaries


@dataclass(frozen=True, slots=True)
class MadePages:
    """What is known of an episode beyond its row. ``stamp``: of its outcome; ``place``: where it came to its point [m];
    ``network``: the name of the network's copy."""

    stamp: int
    place: tuple[float, float] | None
    network: str


def make_index(
    name: str,
    table: ResultsTable,
    made: Mapping[str, MadePages],
    roads: Mapping[str, Any],
    coverage: Coverage | None = None,
    scenarios: Sequence[ScenarioRow] = (),
) -> str:
    """The index as HTML. ``made``: the episodes that have a page, by id; ``roads``: see :func:`road_of`, by network."""
    rows = table.rows
    pages = [made.get(str(row["id"])) for row in rows]
    maps = [n for n, _ in Counter(m.network for m in pages if m and m.place and m.network in roads).most_common()]
    columns: dict[str, Any] = {
        n: [row[n] for row in rows] for n in (*TEXT_FIELDS, *NUMBER_FIELDS, *FLAG_FIELDS, *table.varied)
    }
    columns |= {n: [row.get(n) or "" for row in rows] for n in LATER_TEXT_FIELDS}
    columns |= {n: [row.get(n) for row in rows] for n in (*LATER_NUMBER_FIELDS, *LATER_FLAG_FIELDS)}
    data = {
        "schema": INDEX_SCHEMA, "name": name, "varied": list(table.varied),
        "columns": {n: _coded(v) if n in CODED else v for n, v in columns.items()},
        "page": [int(m is not None) for m in pages],
        "map": [maps.index(m.network) if m and m.place and m.network in roads else -1 for m in pages],
        "x": [m.place[0] if m and m.place else None for m in pages],
        "y": [m.place[1] if m and m.place else None for m in pages],
        "maps": [{"name": n, **roads[n]} for n in maps],
        "egos": summarise(rows),
        "coverage": None if coverage is None else _cells(coverage),
    }  # fmt: skip
    body = plain_table(name, rows, made) + asset("index.html").replace(SCENARIOS_MARK, scenario_section(scenarios))
    return document("Episodes", body, INDEX_STYLES, INDEX_SCRIPTS, data)


def plain_table(name: str, rows: Sequence[Mapping[str, Any]], made: Mapping[str, MadePages]) -> str:
    """What the index says where JavaScript is off: how many episodes came how far, and a table of the first ones."""

    def cell(row: Mapping[str, Any], column: str) -> str:
        value = row.get(column)
        text = "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)
        words, run = escape(text), str(row["id"])
        if column == "id" and run in made:
            words = f'<a href="{PAGES_FOLDER}/{run}.html">{words}</a>'
        return f"<td>{words}</td>"

    levels = Counter(str(row["level"] or row["ending"]) for row in rows)
    counts = ", ".join(f"{number} {escape(level)}" for level, number in levels.most_common())
    heads = "".join(f'<th scope="col">{column.replace("_", " ")}</th>' for column in PLAIN_COLUMNS)
    lines = "".join(
        f"<tr>{''.join(cell(row, column) for column in PLAIN_COLUMNS)}</tr>" for row in rows[:MAX_PLAIN_ROWS]
    )
    more = f"<p>The first {MAX_PLAIN_ROWS} of them:</p>" if len(rows) > MAX_PLAIN_ROWS else ""
    return (
        f"<noscript><h1>{escape(name)}</h1><p>{len(rows)} episodes: {counts}. Pictures, filters and replays need "
        f"JavaScript.</p>{more}<table><thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table></noscript>\n"
    )


def _cells(coverage: Coverage) -> dict[str, Any]:
    """The cells as columns, each once; by ego and cell the encounters, the failures and the interval of their rate."""
    cells = [row.cell for row in coverage.rows[ALL_EGOS]]
    by_ego = {ego: {row.cell: row for row in rows} for ego, rows in coverage.rows.items()}
    shown = by_ego if len(by_ego) > 2 else {ALL_EGOS: by_ego[ALL_EGOS]}  # one ego alone is all of them
    return {
        "bands": [[low, None if math.isinf(high) else high] for low, high in SPEED_BANDS_M_S],
        "unplaced": coverage.unplaced,
        "intent": _coded([cell.intent for cell in cells]), "relation": _coded([cell.relation for cell in cells]),
        "road": _coded([cell.road for cell in cells]), "band": [cell.band for cell in cells],
        "egos": {
            ego: [
                [row.encounters, row.failures, round(row.rate.low, 4), round(row.rate.high, 4)]
                for row in map(rows.__getitem__, cells)
            ]
            for ego, rows in shown.items()
        },
    }  # fmt: skip


def _coded(values: Sequence[str]) -> dict[str, Any]:
    """Different values once, and each row's place among them."""
    kinds = sorted(set(values))
    places = {v: k for k, v in enumerate(kinds)}
    return {"kinds": kinds, "of": [places[v] for v in values]}


def road_of(file: Path) -> dict[str, Any]:
    """A network for a small map: lines' lengths, the origin [m], and coordinates in decimetres, packed.

    Raises UsageError: the network cannot be read.
    """
    from shapely import linestrings, simplify

    lanes = [lane for lane in network(file).lanes.values() if lane.carriageway and len(lane.shape) > 1]
    lanes = sorted(lanes, key=lambda lane: -lane.length)[:MAX_MAP_LANES]
    lines: list[Floats] = [
        np.asarray(simplify(linestrings(lane.shape), MAP_TOLERANCE_M).coords, float) for lane in lanes
    ]
    origin = np.rint(lines[0][0]) if lines else np.zeros(2)
    columns = [(1, whole(line[:, axis] - origin[axis], DECIMETRE_M)) for axis in (0, 1) for line in lines]
    return {"lines": [len(line) for line in lines], "origin": origin.tolist(), "blob": packed(columns)}


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
    table: ResultsTable,
    packs: Packs,
    coverage: Coverage | None = None,
    scenarios: Sequence[ScenarioRow] = (),
    *,
    most: int | None = None,
    workers: int = 1,
    again: bool = False,
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> Report:
    """Make the pages that are missing, ``most`` of them (None: all), the most critical first, then the index.

    ``runs``: the folder of the runs, by id; ``coverage``, ``scenarios``: shown in the index; ``again``: make all pages
    anew. On Ctrl-C finished pages are kept. Raises UsageError where ``out`` cannot be written.
    """
    made, roads = _read(out) if not again else ({}, {})
    stamps = _stamps(runs, table, packs)
    made = {n: m for n, m in made.items() if stamps.get(n) == m.stamp and (out / PAGES_FOLDER / f"{n}.html").is_file()}
    least = {str(r["id"]): (bool(r["failure"]), math.inf if r["min_ttc"] is None else r["min_ttc"]) for r in table.rows}
    missing = sorted((name for name in least if name in stamps and name not in made), key=least.__getitem__)[:most]
    damaged: list[str] = []
    done = 0
    (out / PAGES_FOLDER).mkdir(parents=True, exist_ok=True)
    try:
        for run, result in _all_pages(missing, runs, packs, out / PAGES_FOLDER, workers, roads):
            done += 1
            if isinstance(result, str):
                damaged.append(result)
            else:
                made[run] = MadePages(stamps[run], *result)
            tell(done, len(missing))
    finally:
        _write(out, made, roads)
        write_document(out / INDEX_PAGE, make_index(name, table, made, roads, coverage, scenarios))
    return Report(out / INDEX_PAGE, len(table.rows), len(made), done - len(damaged), damaged)


def _stamps(runs: Path, table: ResultsTable, packs: Packs) -> dict[str, int]:
    """A checksum of each run's outcome, by id; names that are no plain file names are left out."""
    stamps = {}
    for row in table.rows:
        name = str(row["id"])
        file = runs / name / OUTCOME_FILE
        if not SAFE_NAME.fullmatch(name):
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
    plain = [n for n in names if (runs / n / OUTCOME_FILE).is_file()]
    others = [n for n in names if n not in set(plain)]
    with _mapper(workers if len(names) > MAX_PAGES_IN_PROCESS else 1) as every:
        yield from _some_pages(every, plain, runs, target, roads)
        for start in range(0, len(others), RUNS_UNPACKED_AT_ONCE):
            some = others[start : start + RUNS_UNPACKED_AT_ONCE]
            with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
                if packs.unpack is not None:
                    packs.unpack(some, Path(scratch))
                yield from _some_pages(every, some, Path(scratch), target, roads)


def _some_pages(
    every: Callable[..., Iterator[Any]], names: Sequence[str], runs: Path, target: Path, roads: dict[str, Any]
) -> Iterator[tuple[str, tuple[tuple[float, float] | None, str] | str]]:
    for name, result in zip(names, every(partial(write_page, runs, target), names), strict=True):
        if not isinstance(result, str) and result[1] not in roads and len(roads) < MAX_MAPS:
            file = runs / name / "inputs" / result[1]
            if result[1] and file.is_file():
                roads[result[1]] = road_of(file)
        yield name, result


def write_page(runs: Path, target: Path, name: str) -> tuple[tuple[float, float] | None, str] | str:
    """Write one run's page; where it happened and on which network, or what is wrong with the run."""
    try:
        page = page_of(runs / name, back=f"../{INDEX_PAGE}")
        write_document(target / f"{name}.html", page.html)
    except SumoAdvError as error:
        return str(error)
    return page.place, page.network


@contextmanager
def _mapper(workers: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """``map``, here or in processes of its own; after an error, also Ctrl-C, what has not begun is left out."""
    if workers == 1:
        yield map
        return
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _ignore_interrupts)
    try:
        yield partial(pool.map, chunksize=4)
    except BaseException:
        pool.shutdown(cancel_futures=True)
        raise
    pool.shutdown()


def _ignore_interrupts() -> None:
    """Ctrl-C is for the program that started them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _read(out: Path) -> tuple[dict[str, MadePages], dict[str, Any]]:
    """What the last time made; nothing where there was none, or another version made it."""
    try:
        kept = read_json(out / MADE)
        if kept["version"] != __version__:
            return {}, {}
        made = {
            n: MadePages(m["stamp"], tuple(m["place"]) if m["place"] else None, m["network"])
            for n, m in kept["made"].items()
        }
        return made, kept["roads"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}, {}


def _write(out: Path, made: Mapping[str, MadePages], roads: Mapping[str, Any]) -> None:
    kept = {"version": __version__, "made": {n: asdict(m) for n, m in made.items()}, "roads": dict(roads)}
    write_document(out / MADE, json.dumps(kept) + "\n")
