"""Count what a campaign has covered: encounters and failures by intent, relation, road class and speed of the ego.

A cell is one combination of the four. An encounter counts in a cell if one of its attempts had the cell's intent and
came from a vehicle of the cell's relation. It counts once, whatever the number of such attempts. It is a failure of the
ego if one of these attempts reached the level ``valid``, which is a collision that a reference driver avoids.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from sumo_adv.config_odd import Odd
from sumo_adv.datatypes import Level, RoadClass
from sumo_adv.errors import UsageError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import IntentRecord
from sumo_adv.metrics.statistics import Estimate, wilson
from sumo_adv.outcome_schema import check_schema
from sumo_adv.parsing import parse_json, read_json
from sumo_adv.report.document import write_document
from sumo_adv.report.read import OUTCOME_FILE
from sumo_adv.report.run_outcome import level_named
from sumo_adv.report.staging import PLAN_FILE
from sumo_adv.report.tables import csv_text, plain_row

SPEED_BANDS_M_S = ((0.0, 8.0), (8.0, 14.0), (14.0, 22.0), (22.0, math.inf))  # bounds of about 30, 50 and 80 km/h
COVERAGE_COLUMNS = (
    "ego", "intent", "relation", "road", "speed_from", "speed_to", "encounters", "failures", "rate", "low", "high",
)  # fmt: skip
RELATIONS_OF_KIND = {"pedestrian": ("crossing",), "cyclist": ("crossing", "oncoming")}  # in an encounter
ALL_EGOS = "all"  # the key of all egos together
IMPOSSIBLE = "oncoming", str(RoadClass.MOTORWAY)
BANK_FILE, COVERAGE_FILE = "bank.sqlite", "coverage.csv"


@dataclass(frozen=True, slots=True, order=True)
class CoverageCell:
    """One combination of intent, relation, road class and speed.

    Attributes:
        intent: The label of the intent.
        relation: The relation of the adversary to the ego.
        road: The road class.
        band: The speed band of the ego, an index into ``SPEED_BANDS_M_S``.
    """

    intent: str
    relation: str
    road: str
    band: int


@dataclass(frozen=True, slots=True)
class CoverageRow:
    """A cell with its counts.

    Attributes:
        cell: The cell.
        encounters: Encounters that count in the cell.
        failures: Those of these encounters in which the ego failed.
    """

    cell: CoverageCell
    encounters: int
    failures: int

    @property
    def rate(self) -> Estimate:
        """The share of encounters in which the ego failed, with its Wilson interval [-]."""
        return wilson(self.failures, self.encounters)


@dataclass(frozen=True, slots=True)
class Coverage:
    """The cells of a campaign, by ego.

    Attributes:
        rows: The rows of each ego; ``ALL_EGOS`` is the first key. Cells without an encounter come first, then the cells
            with the fewest encounters.
        unplaced: Episodes that count in no cell, because they made no attempt or because the run does not record the
            road class and the ego's speed.
    """

    rows: Mapping[str, Sequence[CoverageRow]]
    unplaced: int

    def covered(self, ego: str = ALL_EGOS) -> tuple[int, int]:
        """Count the cells that have an encounter.

        Args:
            ego: The ego; all egos together by default.

        Returns:
            The number of cells with an encounter, and the number of all cells.
        """
        return sum(row.encounters > 0 for row in self.rows[ego]), len(self.rows[ego])


def band_of(speed: float) -> int:
    """Return the index of the band that contains a speed [m/s]; a band contains its lower bound, not its upper one."""
    return next(k for k, (_, high) in enumerate(SPEED_BANDS_M_S) if speed < high)


def cells_of(document: Mapping[str, Any]) -> dict[CoverageCell, bool]:
    """Find the cells in which an episode counts.

    Args:
        document: The content of the episode's ``outcome.json``.

    Returns:
        For each cell, whether the ego failed in it. Empty if the road class or the ego's speed is not recorded.
    """
    encounter = document["encounter"] or {}
    road, speed = encounter.get("road"), encounter.get("ego_speed")
    if road is None or speed is None:
        return {}
    relations = {each["id"]: each["relation"] for each in encounter["ranking"]}
    cells: dict[CoverageCell, bool] = {}
    for attempt in document["attempts"]:
        relation = relations.get(attempt["adversaries"][0])
        if relation is not None:
            cell = CoverageCell(attempt["intent"], relation, road, band_of(speed))
            cells[cell] = cells.get(cell, False) or level_named(attempt.get("level")) >= Level.VALID
    return cells


def pairs_of(library: Iterable[IntentRecord]) -> set[tuple[str, str]]:
    """Return the pairs of an intent's label and a relation that it applies to, for the active intents of a library.

    The relations are those of encounters: a pedestrian is ``crossing``, and a cyclist ``crossing`` or ``oncoming``.
    """
    active = [record for record in library if record.status == "active"]
    words = {(record.label, word.split("_")[0]) for record in active for word in record.applies}
    return {(label, relation) for label, word in words for relation in RELATIONS_OF_KIND.get(word, (word,))}


def make_coverage(
    documents: Iterable[Mapping[str, Any]], library: Iterable[IntentRecord], odds: Sequence[Odd] = ()
) -> Coverage:
    """Compute the coverage of episodes.

    A cell that was met is always included. Cells with an oncoming adversary on a motorway do not exist, so they are
    left out unless they were met.

    Args:
        documents: The episodes, each as the content of its ``outcome.json``.
        library: The bank's intents. The cells are made of the relations that they apply to.
        odds: The campaign's operational design domains (ODDs). Cells outside all of them are left out unless they were
            met.

    Returns:
        The coverage of all egos together and of each ego.
    """
    counts: dict[str, dict[CoverageCell, list[int]]] = {ALL_EGOS: {}}
    unplaced = 0
    for document in documents:
        cells = cells_of(document)
        unplaced += not cells
        for ego in (ALL_EGOS, str(document["ego"]["controller"])):
            tally = counts.setdefault(ego, {})
            for cell, failed in cells.items():
                count = tally.setdefault(cell, [0, 0])
                count[0] += 1
                count[1] += failed
    pairs = pairs_of(library) | {(cell.intent, cell.relation) for cell in counts[ALL_EGOS]}
    roads, bands = tuple(str(road) for road in RoadClass), range(len(SPEED_BANDS_M_S))
    every = {CoverageCell(*pair, road, band) for pair, road, band in product(pairs, roads, bands)}
    exist = {cell for cell in every if (cell.relation, cell.road) != IMPOSSIBLE}
    possible = {cell for cell in exist if not odds or any(_within(cell, odd) for odd in odds)}
    return Coverage({ego: _rows(possible | counts[ALL_EGOS].keys(), tally) for ego, tally in counts.items()}, unplaced)


def _within(cell: CoverageCell, odd: Odd) -> bool:
    """Return whether a cell lies in an ODD, at least with a part of its speed band."""
    low, high = SPEED_BANDS_M_S[cell.band]
    slowest, fastest = odd.speed or (0.0, math.inf)
    on_road = not odd.roads or cell.road in odd.roads
    return on_road and odd.has_relation(cell.relation) and low <= fastest and slowest < high


def _rows(cells: Iterable[CoverageCell], tally: Mapping[CoverageCell, Sequence[int]]) -> list[CoverageRow]:
    """Make a row for each cell, in the order of ``Coverage.rows``."""
    rows = [CoverageRow(cell, *tally.get(cell, (0, 0))) for cell in cells]
    return sorted(rows, key=lambda row: (row.encounters, -row.failures, row.cell))


def coverage_csv(coverage: Coverage) -> str:
    """Format all rows as CSV: the ego, the cell, the counts, and the failure rate with its interval.

    The upper speed of the last band is empty. The rate of a cell without an encounter is empty.
    """
    lines: list[tuple[Any, ...]] = []
    for ego, rows in coverage.rows.items():
        for row in rows:
            (low, high), rate, cell = SPEED_BANDS_M_S[row.cell.band], row.rate, row.cell
            shown = (f"{rate.value:.4f}" if row.encounters else "", f"{rate.low:.4f}", f"{rate.high:.4f}")
            speeds = (f"{low:g}", "" if math.isinf(high) else f"{high:g}")
            lines.append((ego, cell.intent, cell.relation, cell.road, *speeds, row.encounters, row.failures, *shown))
    return csv_text(COVERAGE_COLUMNS, (plain_row(dict(zip(COVERAGE_COLUMNS, line, strict=True))) for line in lines))


def campaign_coverage(folder: Path, runs: Sequence[Path], packed: Mapping[str, str], bank: Path) -> Coverage:
    """Compute the coverage of the runs in a campaign's folder.

    Args:
        folder: The campaign's folder.
        runs: The folders of the runs.
        packed: The ``outcome.json`` texts of packed runs, by id.
        bank: The bank whose intents make the cells if the campaign's folder has no bank.

    Returns:
        The coverage.

    Raises:
        UsageError: The campaign's plan is damaged.
        BankError: The bank cannot be read.
    """
    own = folder / BANK_FILE
    with MemoryBank.open(own if own.is_file() else bank, read_only=True) as opened:
        library = opened.intents()
    return make_coverage(_outcomes(runs, packed), library, _odds(folder / PLAN_FILE))


def write_coverage(target: Path, coverage: Coverage) -> Path:
    """Write ``coverage.csv`` into the folder of the pages.

    Args:
        target: The folder.
        coverage: What is written.

    Returns:
        The file.

    Raises:
        UsageError: The file cannot be written.
    """
    write_document(target / COVERAGE_FILE, coverage_csv(coverage))
    return target / COVERAGE_FILE


def _outcomes(runs: Sequence[Path], packed: Mapping[str, str]) -> Iterator[dict[str, Any]]:
    """Yield the outcomes that can be read; a damaged one is skipped, because it is reported when its page is made."""
    for run in runs:
        try:
            file = run / OUTCOME_FILE
            document = read_json(file) if file.is_file() else parse_json(packed[run.name])
            check_schema(document, file, None if file.is_file() else file.parents[2])
            _ = document["encounter"], document["attempts"], document["ego"]["controller"]
            yield document
        except (OSError, ValueError, KeyError, TypeError):
            continue


def _odds(plan: Path) -> list[Odd]:
    """Return the ODDs of a campaign's variants; none if a variant lacks one. Raise UsageError if the plan is bad."""
    if not plan.is_file():
        return []
    try:
        odds = [variant.get("odd") for variant in read_json(plan).get("settings", ())]
        return [Odd.model_validate(odd) for odd in odds] if all(odds) else []
    except (ValueError, AttributeError) as error:
        raise UsageError(f"{plan} is damaged ({error}); restore it from a copy.") from error
