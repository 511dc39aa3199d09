"""From rows, places and networks to the text of the index."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.metrics.statistics import Estimate
from sumo_adv.report.coverage import ALL, BANDS, Coverage, Row
from sumo_adv.report.index.rows import LATER, NUMBERS, TRUTHS, WORDS, Table
from sumo_adv.report.index.summary import EgoSummary, summarise
from sumo_adv.report.page.document import asset, document
from sumo_adv.report.page.encode import packed, whole
from sumo_adv.report.page.road import network

SCHEMA = 1
SCRIPTS = ("common.js", "decode.js", "rows.js", "bars.js", "places.js", "egos.js", "cells.js", "index.js")
STYLES = ("common.css", "index.css")
MOST_LANES = 4000  # on the map of a network
DECIMETRE = 0.1
THINNED = 0.5  # m a line on such a map may be off
CODED = (
    "network",
    "ego",
    "intent",
    "ending",
    "level",
    "severity",
    "relation",
    "road",
    "preventable_by",
    "cause",
)  # few values, many rows


@dataclass(frozen=True, slots=True)
class Made:
    """What is known of an episode beyond its row. ``stamp``: of its outcome; ``place``: where it came to its point [m];
    ``network``: the name of the network's copy."""

    stamp: int
    place: tuple[float, float] | None
    network: str


def make_index(
    name: str, table: Table, made: Mapping[str, Made], roads: Mapping[str, Any], coverage: Coverage | None = None
) -> str:
    """The index as HTML. ``made``: the episodes that have a page, by id; ``roads``: see :func:`road_of`, by network."""
    rows = table.rows
    pages = [made.get(str(row["id"])) for row in rows]
    maps = [n for n, _ in Counter(m.network for m in pages if m and m.place and m.network in roads).most_common()]
    columns: dict[str, Any] = {n: [row[n] for row in rows] for n in (*WORDS, *NUMBERS, *TRUTHS, *table.varied)}
    columns |= {n: [row.get(n) or "" for row in rows] for n in LATER}
    data = {
        "schema": SCHEMA, "name": name, "varied": list(table.varied),
        "columns": {n: _coded(v) if n in CODED else v for n, v in columns.items()},
        "page": [int(m is not None) for m in pages],
        "map": [maps.index(m.network) if m and m.place and m.network in roads else -1 for m in pages],
        "x": [m.place[0] if m and m.place else None for m in pages],
        "y": [m.place[1] if m and m.place else None for m in pages],
        "maps": [{"name": n, **roads[n]} for n in maps],
        "egos": [_ego(summary) for summary in summarise(rows)],
        "coverage": None if coverage is None else _cells(coverage),
    }  # fmt: skip
    return document("Episodes", asset("index.html"), STYLES, SCRIPTS, data)


def _ego(summary: EgoSummary) -> dict[str, Any]:
    return {
        "ego": summary.ego, "episodes": summary.episodes, "reached": [_rate(rate) for rate in summary.reached],
        "failed": _rate(summary.failed), "severity": list(summary.severity.values()), "delta_v": summary.delta_v,
    }  # fmt: skip


def _rate(rate: Estimate) -> list[float]:
    """Value, low and high of a rate of at least one episode."""
    return [round(value, 4) for value in (rate.value, rate.low, rate.high)]


def _cells(coverage: Coverage) -> dict[str, Any]:
    """The cells as columns, each once; by ego and cell the encounters, the failures and the interval of their rate."""
    cells = [row.cell for row in coverage.rows[ALL]]
    by_ego = {ego: {row.cell: row for row in rows} for ego, rows in coverage.rows.items()}
    shown = by_ego if len(by_ego) > 2 else {ALL: by_ego[ALL]}  # one ego alone is all of them
    return {
        "bands": [[low, None if math.isinf(high) else high] for low, high in BANDS], "unplaced": coverage.unplaced,
        "intent": _coded([cell.intent for cell in cells]), "relation": _coded([cell.relation for cell in cells]),
        "road": _coded([cell.road for cell in cells]), "band": [cell.band for cell in cells],
        "egos": {ego: [_counts(rows[cell]) for cell in cells] for ego, rows in shown.items()},
    }  # fmt: skip


def _counts(row: Row) -> list[float]:
    rate = row.rate
    return [row.encounters, row.failures, round(rate.low, 4), round(rate.high, 4)]


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

    lanes = [lane for lane in network(file).lanes.values() if lane.passenger and len(lane.shape) > 1]
    lanes = sorted(lanes, key=lambda lane: -lane.length)[:MOST_LANES]
    lines: list[Floats] = [np.asarray(simplify(linestrings(lane.shape), THINNED).coords, float) for lane in lanes]
    origin = np.rint(lines[0][0]) if lines else np.zeros(2)
    columns = [(1, whole(line[:, axis] - origin[axis], DECIMETRE)) for axis in (0, 1) for line in lines]
    return {"lines": [len(line) for line in lines], "origin": origin.tolist(), "blob": packed(columns)}
