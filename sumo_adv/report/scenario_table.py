"""The named scenarios that a campaign or a hunt has met: encounters, attempts and levels of each, and those never met.

An encounter counts in a scenario if one of its attempts shows it, and once, however many such attempts there were. Its
level there is the highest one that these attempts reached.
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
    """A named scenario with what was met of it.

    Attributes:
        name: The scenario.
        encounters: Encounters with an attempt that shows it.
        attempts: These attempts.
        reached: By level the encounters in which such an attempt reached it or a higher one.
    """

    name: ScenarioName
    encounters: int = 0
    attempts: int = 0
    reached: Mapping[Level, int] = field(default_factory=dict)

    def cells(self) -> dict[str, Any]:
        """The row of ``scenarios.csv``. shown: whether an attack of this program can show the scenario."""
        counts = {str(level): self.reached.get(level, 0) for level in LEVELS}
        name = self.name
        return {
            "list": name.list, "scenario": name.name, "encounters": self.encounters, "attempts": self.attempts,
            **counts, "shown": name.shown,
        }  # fmt: skip


Tally = Mapping[ScenarioName, tuple[int, Level]]
"""Of one encounter: by scenario the attempts that show it, and the highest level of them."""


def tallies_of(document: Mapping[str, Any]) -> list[Tally]:
    """The tallies of the encounters that an episode attacked, from its ``outcome.json``."""
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
    """A row for each scenario of the three lists, in their order."""
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
    """The rows of runs in their folders; packed: the outcomes of packed runs as text, by id.

    Damaged outcomes are left out; they are told where their pages are made.
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
    """The names of a list that an attack could show and none did; of NHTSA's the numbers."""
    names = [row.name.name for row in rows if row.name.list == list_name and row.name.shown and not row.encounters]
    return [name.partition(" ")[0] for name in names] if list_name == LISTS[0] else names


def scenario_csv(rows: Sequence[ScenarioRow]) -> str:
    """All rows as CSV."""
    return csv_text(COLUMNS, [{**row.cells(), "shown": str(row.name.shown).lower()} for row in rows])


def write_scenarios(target: Path, rows: Sequence[ScenarioRow]) -> Path:
    """Write ``scenarios.csv`` into a folder. Raises UsageError: it cannot be written."""
    write_document(target / TABLE, scenario_csv(rows))
    return target / TABLE


def scenario_section(rows: Sequence[ScenarioRow]) -> str:
    """The section of the index page: a table of what was met, and the names of what was not."""
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
