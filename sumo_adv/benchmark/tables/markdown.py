"""A table as Markdown: a section for each ego, in it one narrow table for each group of columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sumo_adv.benchmark.tables import paper
from sumo_adv.benchmark.tables.columns import BY_PART, COMPARED, MEAN, MEDIAN, RATE, SECTIONS, Column
from sumo_adv.benchmark.tables.compute import Entry, Table
from sumo_adv.metrics.statistics import Estimate, Paired

NONE = "–"
HOW = {
    RATE: "Rates: Wilson's 95 % interval.",
    MEAN: "Means and medians: bootstrap over encounters, 95 %.",
}


def to_markdown(table: Table) -> str:
    """The whole table as text."""
    lines = [f"# {table.title}", ""]
    lines += [*(f"- {note}" for note in table.notes), ""] if table.notes else []
    lines += [" ".join(HOW.values()) + " Egos are never pooled.", ""]
    named = [[f"`{row}`", table.words[row]] for row in table.rows if row in table.words]
    lines += grid(["row", "what it is"], named, words=True) if named else []
    for ego in table.egos:
        lines += [f"## Ego: {ego}", ""]
        for section in SECTIONS:
            lines += _section(table, ego, section)
        lines += [*_by_part(table, ego), *_differences(table, ego), *_beside_the_paper(table, ego)]
    return "\n".join([*lines, *_meanings(table)]) + "\n"


def grid(head: Sequence[str], rows: Iterable[Sequence[str]], *, words: bool = False) -> list[str]:
    """A Markdown table, numbers to the right (unless it is of ``words``), and an empty line."""
    rule = ["---", *["---" if words else "---:"] * (len(head) - 1)]
    return [*("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in (head, rule, *rows)), ""]


def number(estimate: Estimate | None, digits: int = 2) -> str:
    """``0.75 (0.70–0.80)``; a dash where there is none."""
    if estimate is None:
        return NONE
    between = "–" if estimate.low >= 0 else " to "
    return f"{estimate.value:.{digits}f} ({estimate.low:.{digits}f}{between}{estimate.high:.{digits}f})"


def signed(difference: Paired | None, digits: int = 2) -> str:
    """``+0.10 (+0.02 to +0.18), p 0.03``."""
    if difference is None:
        return NONE
    p = "p < 0.001" if difference.p < 0.001 else f"p {difference.p:.3f}"
    return f"{difference.difference:+.{digits}f} ({difference.low:+.{digits}f} to {difference.high:+.{digits}f}), {p}"


def _figure(entry: Entry | None, column: Column, size: int) -> str:
    """The figure; with how many encounters it rests on where that is not all of them."""
    if entry is None:
        return NONE
    rests = f", n {entry.estimate.n}" if entry.estimate.n != size else ""
    return number(entry.estimate, column.digits) + rests


def _section(table: Table, ego: str, section: str) -> list[str]:
    columns = [c for c in table.columns if c.section == section]
    rows = []
    for row in table.rows:
        size = table.sizes.get((ego, "all", row), 0)
        entries = [table.entry(ego, "all", row, c.key) for c in columns]
        if any(entries):
            shown = [_figure(e, c, size) for e, c in zip(entries, columns, strict=True)]
            rows.append([f"`{row}`", str(size), *shown])
    if not rows:
        return []
    return [f"### {section}", "", *grid(["row", "n", *(c.title for c in columns)], rows)]


def _by_part(table: Table, ego: str) -> list[str]:
    columns = [c for c in table.columns if c.key in BY_PART]
    rows = []
    for part in table.parts(ego)[1:]:
        for row in table.rows:
            size = table.sizes.get((ego, part, row))
            if size:
                shown = [_figure(table.entry(ego, part, row, c.key), c, size) for c in columns]
                rows.append([part, f"`{row}`", str(size), *shown])
    head = ["encounters", "row", "n", *(c.title if c.key != "mean_min_ttc" else "mean min TTC [s]" for c in columns)]
    return ["### By group and kind", "", *grid(head, rows)] if rows else []


def _differences(table: Table, ego: str) -> list[str]:
    columns = [c for c in table.columns if c.key in COMPARED and c.paired]
    rows = []
    for row in table.rows:
        entries = [table.entry(ego, "all", row, c.key) for c in columns]
        if any(e is not None and e.difference is not None for e in entries):
            n = max(e.difference.n for e in entries if e is not None and e.difference is not None)
            shown = [signed(e.difference if e else None) for e in entries]
            rows.append([f"`{row}`", str(n), *shown])
    if not rows:
        return []
    head = ["row", "pairs", *(c.title if c.key != "mean_min_ttc" else "mean min TTC [s]" for c in columns)]
    return [
        f"### Differences to `{table.reference}`", "", "Over the encounters that both rows have; p by McNemar's exact "
        "test for rates and the paired bootstrap for means, not corrected for how many there are.", "",
        *grid(head, rows),
    ]  # fmt: skip


def _beside_the_paper(table: Table, ego: str) -> list[str]:
    """The paper's Table I and, where a row of ours stands for one of its rows, ours beside it."""
    keys = ("mean_min_ttc", "collision", "paper_collision")
    rows = []
    for reported in paper.TABLE_I:
        ours = [row for row in table.rows if paper.counterpart(row) == reported.row]
        for row in ours or [NONE]:
            entries = [table.entry(ego, "all", row, k) for k in keys]
            shown = [number(e.estimate if e else None) for e in entries]
            name = row if row == NONE else f"`{row}`"
            rows.append([reported.row, f"{reported.mean_min_ttc:.2f}", f"{reported.collision:.2f}", name, *shown])
    head = ["the paper's row (Table I)", "mean min TTC [s]", "collision rate", "our row"]
    head += ["mean min TTC [s]", "collision rate", "collision rate (paper)"]
    return ["### Beside the paper", "", *grid(head, rows), *_realism_beside(table, ego), paper.COLLISION_NOTE, "",
            paper.TTC_NOTE, "", paper.REALISM_NOTE, ""]  # fmt: skip


def _realism_beside(table: Table, ego: str) -> list[str]:
    reference = {**paper.DIVERGENCES, "abnormal_lateral": paper.ABNORMAL_LATERAL}
    columns = [c for c in table.columns if c.key in reference]
    rows = [["the paper (section IV-C)", *(f"{reference[c.key]:.{c.digits}f}" for c in columns)]]
    for row in table.rows:
        entries = [table.entry(ego, "all", row, c.key) for c in columns]
        if any(entries):
            shown = [number(e.estimate if e else None, c.digits) for e, c in zip(entries, columns, strict=True)]
            rows.append([f"`{row}`", *shown])
    return grid(["row", *(c.title for c in columns)], rows) if columns else []


def _meanings(table: Table) -> list[str]:
    of = {RATE: "share", MEAN: "mean", MEDIAN: "median"}
    rows = [[c.section, c.title, "pooled" if c.pooled else of[c.summary], c.meaning] for c in table.columns]
    return ["## The columns", "", *grid(["section", "column", "figure", "meaning"], rows, words=True)]
