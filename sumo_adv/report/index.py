"""Make the index of a batch: one page that sorts and filters all episodes and links to their replays.

OUT/index.html      all episodes
OUT/pages/ID.html   the replay of one episode
OUT/made.json       what each page was made of, so that the next call makes only the missing pages
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
from sumo_adv.files import cell_text, scratch_prefix, sentences
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
MAX_PLAIN_ROWS = 500  # of the table for browsers without JavaScript
HUNT = "hunt.json"  # a hunt's folder has this file
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
)  # text columns that earlier tables may lack
LATER_NUMBER_FIELDS, LATER_FLAG_FIELDS = ("overlap", "warning", "impact_speed"), ("humanlike", "robust")  # likewise
NUMBER_FIELDS = ("seed", "raw_min_ttc", "min_ttc", "attempts", "seconds", "delta_v")
FLAG_FIELDS = ("collided", "valid", "critical")
VARIED = "set_"
SCENARIOS_MARK = "<!-- named scenarios -->"  # the section of named scenarios replaces this mark
INDEX_LEVELS = (Level.CRITICAL, Level.COLLISION, Level.VALID, Level.STRICT, Level.SERIOUS)
INDEX_SCHEMA = 1
INDEX_SCRIPTS = ("common.js", "decode.js", "rows.js", "bars.js", "places.js", "egos.js", "cells.js", "index.js")
INDEX_STYLES = ("common.css", "index.css")
MAX_MAP_LANES = 4000  # the longest lanes are kept
DECIMETRE_M = 0.1
MAP_TOLERANCE_M = 0.5  # maximum error of a simplified line
CODED = {*TEXT_FIELDS, *LATER_TEXT_FIELDS} - {"id", "failure", "cause_sentence"}  # columns with few distinct values
INDEX_PAGE, PAGES_FOLDER, MADE = "index.html", "pages", "made.json"
SAFE_NAME = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]{0,127}")
MAX_MAPS = 40  # networks that the index can show
MAX_PAGES_IN_PROCESS = 12  # up to this number, no processes are started
RUNS_UNPACKED_AT_ONCE = 200  # runs unpacked at a time


@dataclass(frozen=True, slots=True)
class ResultsTable:
    """The results of a batch.

    Attributes:
        rows: One row for each episode, in the batch's order.
        varied: The names of the settings that vary (``set_NAME``).
    """

    rows: Sequence[Mapping[str, Any]]
    varied: Sequence[str] = ()


def table_of(rows: Iterable[Mapping[str, Any]]) -> ResultsTable:
    """Make a table of rows that are in memory. Empty text fields become ''."""
    return ResultsTable([{**row, **{name: row[name] or "" for name in TEXT_FIELDS}} for row in rows])


def read_rows(file: Path) -> ResultsTable:
    """Read the table of a batch.

    Args:
        file: The batch's ``results.csv``.

    Returns:
        The table.

    Raises:
        UsageError: The file is not the table of a batch.
    """
    if (file.parent / HUNT).is_file():
        runs = file.parent / "failures"
        raise UsageError(
            f"{file.parent} is the folder of a hunt: its pages are in report/, and those of its failures are made from "
            f"{runs}. Hunts are not compared: keep their failures, and run 'sumo-adv regress' with each version."
        )
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
        raise UsageError(f"{file} is not the table of a batch ({error}); rerun the batch's command.") from error


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
    """Summarise the episodes of each ego.

    All rates have all episodes of the ego in their denominator, failed ones too. A rate is a list of its value and the
    bounds of its interval.

    Args:
        rows: The episodes.

    Returns:
        For each ego, sorted by name, a dict with these keys. ``reached``: the share of episodes that reached at least
            each of ``INDEX_LEVELS``. ``failed``: the share of failed episodes. ``severity``: the number of collisions
            of each severity among those that reached ``valid``. ``delta_v``: their median delta-v [m/s], None without
            such a collision.
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
    """What is known of an episode's page beyond the episode's row.

    Attributes:
        stamp: The checksum of the episode's outcome.
        place: The ego's centre at the decisive moment [m]; None if unknown.
        network: The name of the network's copy.
    """

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
    every: ResultsTable | None = None,
) -> str:
    """Make the index page.

    Args:
        name: The name of the batch.
        table: The episodes.
        made: The pages that exist, by episode id.
        roads: The maps of networks, by the network's name; see :func:`road_of`.
        coverage: What the campaign has covered; None leaves this section out.
        scenarios: The rows of named scenarios.
        every: All episodes, if the page lists only some; the rates of each ego count them.

    Returns:
        The HTML.
    """
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
        "egos": summarise((every or table).rows),
        "coverage": None if coverage is None else _cells(coverage),
    }  # fmt: skip
    body = plain_table(name, rows, made) + asset("index.html").replace(SCENARIOS_MARK, scenario_section(scenarios))
    return document("Episodes", body, INDEX_STYLES, INDEX_SCRIPTS, data)


def plain_table(name: str, rows: Sequence[Mapping[str, Any]], made: Mapping[str, MadePages]) -> str:
    """Make the part for browsers without JavaScript: episodes by level, and a table of the first ``MAX_PLAIN_ROWS``."""

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
    """Convert the coverage to columns: each cell once, and by ego its encounters, failures and the rate's interval."""
    cells = [row.cell for row in coverage.rows[ALL_EGOS]]
    by_ego = {ego: {row.cell: row for row in rows} for ego, rows in coverage.rows.items()}
    shown = by_ego if len(by_ego) > 2 else {ALL_EGOS: by_ego[ALL_EGOS]}  # a single ego equals all egos together
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
    """Return the distinct values, and the position of each row's value among them."""
    kinds = sorted(set(values))
    places = {v: k for k, v in enumerate(kinds)}
    return {"kinds": kinds, "of": [places[v] for v in values]}


def road_of(file: Path) -> dict[str, Any]:
    """Read a network as a small map.

    Args:
        file: The network.

    Returns:
        The number of points of each line, the origin [m], and the packed coordinates [dm].

    Raises:
        UsageError: The network cannot be read.
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
    """Runs in zip files.

    Attributes:
        outcomes: The text of each run's ``outcome.json``, by id.
        unpack: A function that unpacks the runs with the given ids below a folder; None if there are no packs.
    """

    outcomes: Mapping[str, str] = field(default_factory=dict)
    unpack: Callable[[Sequence[str], Path], Any] | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """What was written.

    Attributes:
        index: The index page.
        episodes: The number of episodes.
        pages: The number of pages that exist now.
        made: The number of pages that this call made.
        damaged: A sentence for each run that could not be shown.
    """

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
    every: ResultsTable | None = None,
    most: int | None = None,
    workers: int = 1,
    again: bool = False,
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> Report:
    """Make the missing pages, the most critical episodes first, and then the index.

    On Ctrl-C, the finished pages are kept and the index is still written.

    Args:
        runs: The folder of the runs, by id.
        out: The folder of the pages.
        name: The name of the batch.
        table: The episodes.
        packs: The runs in zip files.
        coverage: The coverage that the index shows; None leaves it out.
        scenarios: The named scenarios that the index shows.
        every: All episodes, if ``table`` holds only some; the rates of each ego count them.
        most: The maximum number of pages to make; None makes all.
        workers: The number of processes.
        again: Whether existing pages are rebuilt, too.
        tell: Called after each page with the number of pages done and the number to make.

    Returns:
        What was written.

    Raises:
        UsageError: ``out`` cannot be written.
    """
    made, roads = _read(out) if not again else ({}, {})
    stamps = _stamps(runs, table, packs)
    made = {n: m for n, m in made.items() if stamps.get(n) == m.stamp and (out / PAGES_FOLDER / f"{n}.html").is_file()}
    least = {str(r["id"]): (bool(r["failure"]), math.inf if r["min_ttc"] is None else r["min_ttc"]) for r in table.rows}
    missing = sorted((name for name in least if name in stamps and name not in made), key=least.__getitem__)[:most]
    damaged: list[str] = []
    done = 0
    with sentences(out):
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
        write_document(out / INDEX_PAGE, make_index(name, table, made, roads, coverage, scenarios, every))
    return Report(out / INDEX_PAGE, len(table.rows), len(made), done - len(damaged), damaged)


def _stamps(runs: Path, table: ResultsTable, packs: Packs) -> dict[str, int]:
    """Compute a checksum of each run's outcome, by id; skip ids that are not safe file names."""
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
    """Yield each name with its page's place and network, or with an error message; add networks' maps to ``roads``."""
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
    """Write the page of one run.

    Args:
        runs: The folder of the runs.
        target: The folder of the pages.
        name: The run's id.

    Returns:
        The ego's centre at the decisive moment [m] and the network's name, or a sentence about what is wrong with the
            run.
    """
    try:
        page = page_of(runs / name, back=f"../{INDEX_PAGE}")
        write_document(target / f"{name}.html", page.html)
    except SumoAdvError as error:
        return str(error)
    return page.place, page.network


@contextmanager
def _mapper(workers: int) -> Iterator[Callable[..., Iterator[Any]]]:
    """Yield ``map``, run by worker processes if there are any; after an error or Ctrl-C, skip what has not begun."""
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
    """Leave Ctrl-C to the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _read(out: Path) -> tuple[dict[str, MadePages], dict[str, Any]]:
    """Read ``made.json``; return nothing if it is missing, damaged or of another version."""
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
