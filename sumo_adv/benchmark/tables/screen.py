"""Tables for the terminal: the main columns in at most ``WIDTH`` characters, and the file that holds the rest."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

from sumo_adv.benchmark.tables.analysis import Analysis
from sumo_adv.benchmark.tables.compute import Table
from sumo_adv.benchmark.tables.league import Place
from sumo_adv.metrics.statistics import Estimate

WIDTH = 100  # characters
NAME = 26  # characters of a name in front of its figures; a longer one has a line of its own
NONE = "-"
MAIN = {"collision": "collision", "valid": "valid", "strict": "strict", "serious": "serious"}
INTERVALS = "Rates with Wilson's 95 % intervals."


def table_text(table: Table, file: Path) -> str:
    """The rates of the levels of each row, the median number of attempts until the first valid one, and the notes."""
    lines = [table.title]
    for ego in table.egos:
        rows = []
        for row in table.rows:
            size = table.sizes.get((ego, "all", row), 0)
            entries = [table.entry(ego, "all", row, key) for key in (*MAIN, "attempts")]
            if any(entries):
                *rates, attempts = [e.estimate if e is not None else None for e in entries]
                rows.append([row, str(size), *map(rate, rates), _plain(attempts)])
        lines += ["", f"Against {ego}", *aligned(["row", "n", *MAIN.values(), "attempts"], rows)]
    lines += ["", *wrapped(f"{INTERVALS} Attempts: median until the first valid one.")]
    for note in table.notes:
        lines += wrapped(note)
    return "\n".join([*lines, _rest(file)])


def analysis_text(analysis: Analysis, file: Path) -> str:
    """How often each analyzer names the most dangerous intent."""
    lines = [analysis.title]
    for part in analysis.parts:
        rows = [[s.who, str(s.accuracy.n), *(rate(x) for x in (s.accuracy, s.several, s.top2))] for s in part.scores]
        head = ["who", "n", "accuracy", "several", "top-2"]
        lines += ["", f"Against {part.ego}, by {part.criterion}", *aligned(head, rows)]
    lines += ["", *wrapped(f"{INTERVALS} Several: where more than one intent applies.")]
    for note in analysis.notes:
        lines += wrapped(note)
    return "\n".join([*lines, _rest(file)])


def league_text(places: Sequence[Place], title: str, file: Path) -> str:
    """The drivers, hardest to hit first."""
    rows = [
        [p.ego, "known" if p.known else "unknown", _plain(p.attempts), *(rate(p.figures[k]) for k in list(MAIN)[1:])]
        for p in places
    ]
    lines = [title, "", *aligned(["driver", "", "attempts", *list(MAIN.values())[1:]], rows), ""]
    return "\n".join([*lines, *wrapped(f"{INTERVALS} Attempts: mean until the first valid one."), _rest(file)])


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows in columns, numbers to the right. A long name stands on a line of its own, above its figures."""
    widths = [max(len(line[k]) for line in (head, *rows)) for k in range(1, len(head))]
    first = min(max(len(line[0]) for line in (head, *rows)), NAME)
    lines = []
    for name, *figures in (head, *rows):
        if len(name) > first:
            lines.append(name)
        shown = "  ".join(f"{value:>{width}}" for value, width in zip(figures, widths, strict=True))
        lines.append(f"{name if len(name) <= first else '':{first}}  {shown}")
    return lines


def wrapped(sentence: str) -> list[str]:
    """A sentence in lines of the width."""
    return textwrap.wrap(sentence, WIDTH, break_long_words=False)


def rate(estimate: Estimate | None) -> str:
    """``.75 [.70,.80]``; a dash where there is none."""
    if estimate is None:
        return NONE
    value, low, high = (_short(v) for v in (estimate.value, estimate.low, estimate.high))
    return f"{value} [{low},{high}]"


def _short(value: float) -> str:
    """Two decimals without the zero in front."""
    return f"{value:.2f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.1f}"


def _plain(estimate: Estimate | None) -> str:
    return NONE if estimate is None else f"{estimate.value:.1f}"


def _rest(file: Path) -> str:
    return f"All columns, groups and differences: {file}"
