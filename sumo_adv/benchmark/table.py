"""Make a table of cells, and format it as Markdown beside the figures that the paper reports.

Each ego has its own figures. Each column has an interval, and differences are paired. The notes say why the paper's
figures are not the same quantities as ours.

Mei, Nie, Sun and Tian, "Seeking to Collide: Online Safety-Critical Scenario Generation for Autonomous Driving with
Retrieval Augmented Large Language Models". Its only table is Table I.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from sumo_adv.benchmark.cells import CellKey, first_valid, is_raw, key, names, parts
from sumo_adv.benchmark.columns import BY_PART, COMPARED_COLUMNS, MEAN, MEDIAN, RATE, SECTIONS, TABLE_COLUMNS, Column
from sumo_adv.benchmark.nouns import RAW, Cell, SuiteCase
from sumo_adv.metrics.statistics import Estimate, Paired, paired_means, paired_rates, wilson

MAX_NAMES_SHOWN = 6  # missing encounters that a sentence names


@dataclass(frozen=True, slots=True)
class TableEntry:
    """One figure.

    Attributes:
        ego: The ego's driver.
        part: ``all``, a group or a kind.
        row: The row.
        column: The key of the column.
        estimate: The value with its interval.
        difference: The difference to the reference row, over the same encounters; None if the figure is not compared.
    """

    ego: str
    part: str
    row: str
    column: str
    estimate: Estimate
    difference: Paired | None = None


@dataclass(frozen=True, slots=True)
class BenchTable:
    """A table of rows for every ego; egos are never pooled.

    Attributes:
        title: The title.
        egos: The ego drivers.
        rows: The rows.
        entries: The figures by ego, part, row and column.
        sizes: The number of cells by ego, part and row.
        reference: The row that the others are compared with; None if there is none.
        notes: Sentences for the reader.
        words: The descriptions of rows.
    """

    title: str
    egos: tuple[str, ...]
    rows: tuple[str, ...]
    entries: Mapping[tuple[str, str, str, str], TableEntry]
    sizes: Mapping[tuple[str, str, str], int]
    reference: str | None
    notes: tuple[str, ...] = ()
    words: Mapping[str, str] = field(default_factory=dict)

    def parts(self, ego: str) -> list[str]:
        """Return the parts of an ego, ``all`` first."""
        return list(dict.fromkeys(part for e, part, _ in self.sizes if e == ego))

    def entry(self, ego: str, part: str, row: str, column: str) -> TableEntry | None:
        """Return one figure; None if there is none."""
        return self.entries.get((ego, part, row, column))


def make_table(
    cells: Sequence[Cell],
    *,
    title: str,
    cases: Sequence[SuiteCase] | None = None,
    egos: Sequence[str] | None = None,
    rows: Sequence[str] | None = None,
    reference: str | None = None,
    words: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
) -> BenchTable:
    """Make the table of cells of any egos, rows and seeds.

    Args:
        cells: The cells.
        title: The title.
        cases: The suite's encounters, by which missing cells are reported; None takes those of the cells.
        egos: The ego drivers, in order; None takes those of the cells.
        rows: The rows, in order; None takes those of the cells.
        reference: The row that the others are compared with; None takes the first row that attacks.
        words: The descriptions of rows.
        notes: Sentences that come before those on the cells.

    Returns:
        The table.
    """
    listed = tuple(rows or names(cells, "row"))
    cells = [cell for cell in cells if cell["row"] in listed]
    reference = reference or next((row for row in listed if row != RAW), None)
    entries: list[TableEntry] = []
    sizes: dict[tuple[str, str, str], int] = {}
    drivers = list(egos or names(cells, "ego"))
    for ego in drivers:
        for part, part_cells in parts(c for c in cells if c["ego"] == ego).items():
            part_columns = [q for q in TABLE_COLUMNS if part == "all" or q.key in BY_PART]
            by_row = {row: [c for c in part_cells if c["row"] == row] for row in listed}
            sizes |= {(ego, part, row): len(row_cells) for row, row_cells in by_row.items() if row_cells}
            entries += [e for row in listed for e in _entries(ego, part, row, by_row, part_columns, reference)]
    notes = (*notes, *_missing(cells, drivers, listed, cases), *_never_valid(cells, drivers))
    indexed = {(e.ego, e.part, e.row, e.column): e for e in entries}
    return BenchTable(title, tuple(drivers), listed, indexed, sizes, reference, notes, words or {})


def _never_valid(cells: Sequence[Cell], egos: Sequence[str]) -> list[str]:
    """Say for each ego how many encounters no row makes valid; these encounters stay in every denominator."""
    notes = []
    for ego in egos:
        attacked = [c for c in cells if c["ego"] == ego and not is_raw(c)]
        won = {key(c) for c in attacked if first_valid(c) is not None}
        every = {key(c) for c in attacked}
        if every:
            share = wilson(len(every - won), len(every)).text()
            notes.append(f"No row makes {len(every - won)} of {len(every)} encounters valid against {ego}: {share}.")
    return notes


def _entries(
    ego: str, part: str, row: str, by_row: Mapping[str, Sequence[Cell]], columns: Sequence[Column],
    reference: str | None,
) -> list[TableEntry]:  # fmt: skip
    """Compute the figures of one row and part."""
    entries = []
    for column in columns:
        estimate = column.estimate(by_row[row])
        if estimate is None:
            continue
        compared = column.paired and reference is not None and row not in (reference, RAW)
        difference = compare(column, by_row[row], by_row.get(reference or "", ())) if compared else None
        entries.append(TableEntry(ego, part, row, column.key, estimate, difference))
    return entries


def compare(column: Column, first: Sequence[Cell], second: Sequence[Cell]) -> Paired | None:
    """Compare a column of two rows over the encounters that both have.

    The interval resamples encounters; p is McNemar's for rates, and the sign-flip test's for means.

    Args:
        column: The column.
        first: The cells of the first row.
        second: The cells of the second row.

    Returns:
        ``first`` - ``second``; None if they have no encounter in common.
    """
    left, right = column.values(first), column.values(second)
    common = [name for name in left if name in right]
    if not common:
        return None
    return paired([left[name] for name in common], [right[name] for name in common], rate=column.summary == RATE)


def paired(left: Sequence[float], right: Sequence[float], *, rate: bool) -> Paired:
    """Return ``left`` - ``right``, encounter by encounter, for rates or means."""
    if rate:
        return paired_rates([v > 0.5 for v in left], [v > 0.5 for v in right])
    return paired_means(left, right)


def _missing(
    cells: Sequence[Cell], egos: Sequence[str], rows: Sequence[str], cases: Sequence[SuiteCase] | None
) -> list[str]:
    """Say for each ego and row which cells are missing."""
    notes = []
    expected = list(dict.fromkeys(names(cells, "case") if cases is None else [case.name for case in cases]))
    for ego in egos:
        own_cells = [c for c in cells if c["ego"] == ego]
        seeds = sorted({int(c["seed"]) for c in own_cells}) or [0]
        keys: list[CellKey] = [(case, seed) for case in expected for seed in seeds]
        for row in rows:
            there = {key(c) for c in own_cells if c["row"] == row}
            gone = [f"{k[0]} (seed {k[1]})" if len(seeds) > 1 else k[0] for k in keys if k not in there]
            if gone:
                listed = ", ".join(gone[:MAX_NAMES_SHOWN]) + (
                    f" and {len(gone) - MAX_NAMES_SHOWN} more" if len(gone) > MAX_NAMES_SHOWN else ""
                )
                notes.append(
                    f"{row} against {ego}: {len(gone)} of {len(keys)} cells are missing ({listed}); its figures use "
                    "the others. Rerun the same command to run the missing cells."
                )
    return notes


# -- what the paper reports


@dataclass(frozen=True, slots=True)
class Reported:
    """A row of the paper's Table I, over its 81 scenarios.

    Attributes:
        row: The name of the row.
        mean_min_ttc: The mean of the minimum TTC [s].
        collision: The collision rate [-].
    """

    row: str
    mean_min_ttc: float
    collision: float


TABLE_I = (
    Reported("Raw", 1.62, 0.00),
    Reported("Transformer", 1.73, 0.41),
    Reported("LLM-F (V3)", 2.03, 0.22),
    Reported("LLM-A (V3)", 1.09, 0.65),
    Reported("LLM-A (R1)", 1.08, 0.75),
)
ACCURACY = {"DeepSeek-R1": 0.815, "DeepSeek-V3": 0.741}  # Fig. 3 and section IV-B, against people's labels
DIVERGENCES = {"speed_kl": 0.141, "acceleration_kl": 0.138}  # section IV-C, Fig. 5
HUMAN_ABNORMAL_LATERAL_SHARE = 0.0017  # share with a lateral acceleration above 4 m/s2, section IV-C

COLLISION_NOTE = (
    "The paper calls it a collision when the centres come within an epsilon that it does not give; ours is a touch of "
    "the boxes, and the columns 'collision rate (paper)' add centres within 2.5 and 5 m. The paper does not say which "
    "driver its ego is, whether an adversary's motion had to be feasible, nor whether a contact with the ego's back "
    "counts."
)
TTC_NOTE = (
    "The paper does not define its TTC nor say how collisions and encounters that never close in are averaged: with "
    "75 % collisions at 0 s, a mean of 1.08 s would be 4.3 s over the rest. Ours uses oriented boxes in the plane; a "
    "collision counts as 0 s and no conflict as 10 s. Its encounters are 81 Waymo records with a raw mean min TTC of "
    "1.62 s and no raw collision; in suite81 no encounter is critical before the attack."
)
REALISM_NOTE = (
    "The paper gives neither bins nor smoothing nor which samples it pools. Our bins are 1 m/s and 0.5 m/s2 wide, with "
    "0.1 added to each. We compare the adversaries' steps up to contact with unattacked vehicles near the ego in the "
    "same window."
)
ANALYZER_NOTE = (
    "The paper's labels are its authors' own annotations of one given vehicle in each of 81 records; an oracle's label "
    "is the intent that collides most often in simulation against one ego, with ties as sets; the analyzer also picks "
    "the vehicle."
)


def counterpart(row: str) -> str | None:
    """Find the paper's row that corresponds to one of our rows.

    LLM-A is compared with its better result, which is R1's, except for the model DeepSeek-V3 itself.

    Args:
        row: Our row.

    Returns:
        The paper's row; None for opponents and changed rows, which the paper does not have.
    """
    name = row.lower()
    if "+" in name:
        return None
    if name == RAW:
        return "Raw"
    if name == "transformer":
        return "Transformer"
    if name.startswith("llm-f"):
        return "LLM-F (V3)"
    if name == "expert" or name.startswith("llm-a"):
        return "LLM-A (V3)" if "v3" in name or "deepseek-chat" in name else "LLM-A (R1)"
    return None


# -- Markdown


NO_VALUE = "–"
STATISTICS_NOTES = {
    RATE: "Rates: Wilson's 95 % interval.",
    MEAN: "Means and medians: bootstrap over encounters, 95 %.",
}


def to_markdown(table: BenchTable) -> str:
    """Format the table as Markdown."""
    lines = [f"# {table.title}", ""]
    lines += [*(f"- {note}" for note in table.notes), ""] if table.notes else []
    lines += [" ".join(STATISTICS_NOTES.values()) + " Egos are never pooled.", ""]
    named = [[f"`{row}`", table.words[row]] for row in table.rows if row in table.words]
    lines += grid(["row", "what it is"], named, words=True) if named else []
    for ego in table.egos:
        lines += [f"## Ego: {ego}", ""]
        for section in SECTIONS:
            lines += _section(table, ego, section)
        lines += [*_by_part(table, ego), *_differences(table, ego), *_beside_the_paper(table, ego)]
    return "\n".join([*lines, *_meanings()]) + "\n"


def grid(head: Sequence[str], rows: Iterable[Sequence[str]], *, words: bool = False) -> list[str]:
    """Format a Markdown table, followed by an empty line.

    Args:
        head: The header.
        rows: The rows.
        words: Whether the cells are words; otherwise all columns but the first are aligned to the right.

    Returns:
        The lines.
    """
    rule = ["---", *["---" if words else "---:"] * (len(head) - 1)]
    return [*("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in (head, rule, *rows)), ""]


def number(estimate: Estimate | None, digits: int = 2) -> str:
    """Format an estimate as ``0.75 (0.70–0.80)``; a dash if there is none."""
    if estimate is None:
        return NO_VALUE
    between = "–" if estimate.low >= 0 else " to "
    return f"{estimate.value:.{digits}f} ({estimate.low:.{digits}f}{between}{estimate.high:.{digits}f})"


def signed(difference: Paired | None, digits: int = 2) -> str:
    """Format a difference as ``+0.10 (+0.02 to +0.18), p 0.03``; a dash if there is none."""
    if difference is None:
        return NO_VALUE
    p = "p < 0.001" if difference.p < 0.001 else f"p {difference.p:.3f}"
    return f"{difference.difference:+.{digits}f} ({difference.low:+.{digits}f} to {difference.high:+.{digits}f}), {p}"


def _figure(entry: TableEntry | None, column: Column, size: int) -> str:
    """Format a figure, with the number of encounters that it is based on if that is not all of them."""
    if entry is None:
        return NO_VALUE
    rests = f", n {entry.estimate.n}" if entry.estimate.n != size else ""
    return number(entry.estimate, column.digits) + rests


def _section(table: BenchTable, ego: str, section: str) -> list[str]:
    columns = [c for c in TABLE_COLUMNS if c.section == section]
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


def _by_part(table: BenchTable, ego: str) -> list[str]:
    columns = [c for c in TABLE_COLUMNS if c.key in BY_PART]
    rows = []
    for part in table.parts(ego)[1:]:
        for row in table.rows:
            size = table.sizes.get((ego, part, row))
            if size:
                shown = [_figure(table.entry(ego, part, row, c.key), c, size) for c in columns]
                rows.append([part, f"`{row}`", str(size), *shown])
    head = ["encounters", "row", "n", *(c.title if c.key != "mean_min_ttc" else "mean min TTC [s]" for c in columns)]
    return ["### By group and kind", "", *grid(head, rows)] if rows else []


def _differences(table: BenchTable, ego: str) -> list[str]:
    columns = [c for c in TABLE_COLUMNS if c.key in COMPARED_COLUMNS and c.paired]
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
        "test for rates and the sign-flip test for means, not corrected for multiple comparisons.", "",
        *grid(head, rows),
    ]  # fmt: skip


def _beside_the_paper(table: BenchTable, ego: str) -> list[str]:
    """Return the paper's Table I and, beside each of its rows, the corresponding rows of ours."""
    keys = ("mean_min_ttc", "collision", "paper_collision")
    rows = []
    for reported in TABLE_I:
        ours = [row for row in table.rows if counterpart(row) == reported.row]
        for row in ours or [NO_VALUE]:
            entries = [table.entry(ego, "all", row, k) for k in keys]
            shown = [number(e.estimate if e else None) for e in entries]
            name = row if row == NO_VALUE else f"`{row}`"
            rows.append([reported.row, f"{reported.mean_min_ttc:.2f}", f"{reported.collision:.2f}", name, *shown])
    head = ["the paper's row (Table I)", "mean min TTC [s]", "collision rate", "our row"]
    head += ["mean min TTC [s]", "collision rate", "collision rate (paper)"]
    return ["### Beside the paper", "", *grid(head, rows), *_realism_beside(table, ego), COLLISION_NOTE, "",
            TTC_NOTE, "", REALISM_NOTE, ""]  # fmt: skip


def _realism_beside(table: BenchTable, ego: str) -> list[str]:
    reference = {**DIVERGENCES, "abnormal_lateral": HUMAN_ABNORMAL_LATERAL_SHARE}
    columns = [c for c in TABLE_COLUMNS if c.key in reference]
    rows = [["the paper (section IV-C)", *(f"{reference[c.key]:.{c.digits}f}" for c in columns)]]
    for row in table.rows:
        entries = [table.entry(ego, "all", row, c.key) for c in columns]
        if any(entries):
            shown = [number(e.estimate if e else None, c.digits) for e, c in zip(entries, columns, strict=True)]
            rows.append([f"`{row}`", *shown])
    return grid(["row", *(c.title for c in columns)], rows)


def _meanings() -> list[str]:
    of = {RATE: "share", MEAN: "mean", MEDIAN: "median"}
    rows = [[c.section, c.title, "pooled" if c.pooled else of[c.summary], c.meaning] for c in TABLE_COLUMNS]
    return ["## The columns", "", *grid(["section", "column", "figure", "meaning"], rows, words=True)]
