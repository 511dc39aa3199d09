"""Count the named scenarios that a campaign or a hunt has met: encounters, attempts and levels of each.

Scenarios that were never met are listed, too. An encounter counts in a scenario if one of its attempts shows it. It
counts once, whatever the number of such attempts. Its level in the scenario is the highest one that these attempts
reached.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Level
from sumo_adv.parsing import parse_json, read_json
from sumo_adv.report.document import write_document
from sumo_adv.report.run_outcome import level_named
from sumo_adv.report.tables import csv_text
from sumo_adv.scenario_names import EVERY, LISTS, ScenarioName, names_in

TABLE, OUTCOME = "scenarios.csv", "outcome.json"
LEVELS = (Level.CRITICAL, Level.COLLISION, Level.VALID, Level.STRICT, Level.SERIOUS)
COLUMNS = ("list", "scenario", "encounters", "attempts", *map(str, LEVELS), "shown")


@dataclass(frozen=True, slots=True)
class ScenarioRow:
    """A named scenario with its counts.

    Attributes:
        name: The scenario.
        encounters: Encounters with an attempt that shows the scenario.
        attempts: These attempts.
        reached: For each level, the encounters in which such an attempt reached it or a higher one.
    """

    name: ScenarioName
    encounters: int = 0
    attempts: int = 0
    reached: Mapping[Level, int] = field(default_factory=dict)

    def cells(self) -> dict[str, Any]:
        """Return the row of ``scenarios.csv``; ``shown`` says whether an attack of this program can show it."""
        counts = {str(level): self.reached.get(level, 0) for level in LEVELS}
        name = self.name
        return {
            "list": name.list, "scenario": name.name, "encounters": self.encounters, "attempts": self.attempts,
            **counts, "shown": name.shown,
        }  # fmt: skip


Tally = Mapping[ScenarioName, tuple[int, Level]]
"""One encounter: for each scenario, the number of attempts that show it and their highest level."""


def tallies_of(document: Mapping[str, Any]) -> list[Tally]:
    """Return the tallies of the encounters that an episode attacked.

    Args:
        document: The content of the episode's ``outcome.json``.

    Returns:
        A tally for each encounter with a named scenario.
    """
    listed = document["attempts"]
    here = (document.get("encounter") or {}).get("time")
    found = [_tally([(each.get("named_scenario") or {}, 1, level_named(each.get("level"))) for each in listed])]
    for tried in document.get("encounters_tried", ()):
        if tried["time"] != here or not listed:  # the encounter that counts may be one of these
            own = tried.get("named_scenarios", ())
            found.append(_tally([(each, int(each["attempts"]), level_named(each["level"])) for each in own]))
    return [tally for tally in found if tally]


def _tally(shown: Sequence[tuple[Mapping[str, Any], int, Level]]) -> Tally:
    tally: dict[ScenarioName, tuple[int, Level]] = {}
    for cells, attempts, level in shown:
        for name in names_in(cells):
            before, highest = tally.get(name, (0, Level.NONE))
            tally[name] = before + attempts, max(highest, level)
    return tally


def scenario_rows(tallies: Iterable[Tally]) -> list[ScenarioRow]:
    """Return a row for each scenario of the three lists, in their order."""
    met: dict[ScenarioName, list[tuple[int, Level]]] = {}
    for tally in tallies:
        for name, seen in tally.items():
            met.setdefault(name, []).append(seen)
    rows = []
    for name in EVERY:
        own = met.get(name, [])
        reached = {level: sum(highest >= level for _, highest in own) for level in LEVELS}
        rows.append(ScenarioRow(name, len(own), sum(attempts for attempts, _ in own), reached))
    return rows


def rows_of_runs(runs: Iterable[Path], packed: Mapping[str, str]) -> list[ScenarioRow]:
    """Return the rows of runs. Damaged outcomes are skipped, because they are reported when their pages are made.

    Args:
        runs: The folders of the runs.
        packed: The ``outcome.json`` texts of packed runs, by id.

    Returns:
        A row for each scenario.
    """
    tallies = list[Tally]()
    for run in runs:
        try:
            file = run / OUTCOME
            tallies += tallies_of(read_json(file) if file.is_file() else parse_json(packed[run.name]))
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue
    return scenario_rows(tallies)


def never_met(rows: Sequence[ScenarioRow], list_name: str) -> list[str]:
    """Return the names of a list's scenarios that an attack could show but none did; only numbers for NHTSA's list."""
    names = [row.name.name for row in rows if row.name.list == list_name and row.name.shown and not row.encounters]
    return [name.partition(" ")[0] for name in names] if list_name == LISTS[0] else names


def scenario_csv(rows: Sequence[ScenarioRow]) -> str:
    """Format all rows as CSV."""
    return csv_text(COLUMNS, [{**row.cells(), "shown": str(row.name.shown).lower()} for row in rows])


def write_scenarios(target: Path, rows: Sequence[ScenarioRow]) -> Path:
    """Write ``scenarios.csv`` into a folder.

    Args:
        target: The folder.
        rows: The rows.

    Returns:
        The file.

    Raises:
        UsageError: The file cannot be written.
    """
    write_document(target / TABLE, scenario_csv(rows))
    return target / TABLE


def scenario_section(rows: Sequence[ScenarioRow]) -> str:
    """Make the section of the index page: a table of the scenarios that were met, and the names of the others.

    Args:
        rows: The rows.

    Returns:
        The HTML; empty if no scenario was met.
    """
    if not any(row.encounters for row in rows):
        return ""
    heads = "".join(f'<th scope="col">{escape(head)}</th>' for head in COLUMNS[:-1])
    lines = []
    for row in rows:
        if row.encounters:
            cells = list(row.cells().values())[:-1]
            lines.append("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in cells) + "</tr>")
    missing = "".join(
        f"<p><b>{name}, never met:</b> {escape('; '.join(never_met(rows, name)) or 'none')}</p>" for name in LISTS
    )
    return (
        '<section aria-label="Named scenarios">\n<h2>Named scenarios</h2>\n'
        '<p class="soft">Encounters with an attempt that shows the scenario, these attempts, and the encounters in '
        "which one of them reached the level or a higher one.</p>\n"
        '<div class="scroll" tabindex="0" role="group" aria-label="Table of named scenarios, scrolls"><table>'
        f"<thead><tr>{heads}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>\n{missing}\n</section>\n"
    )
