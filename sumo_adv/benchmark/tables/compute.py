"""From cells to a table: each ego for itself, each row, each column with its interval, differences paired."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sumo_adv.benchmark.nouns import Case, Cell
from sumo_adv.benchmark.tables.cells import RAW, Key, counted, first_valid, is_raw, key, names, parts
from sumo_adv.benchmark.tables.columns import BY_PART, COLUMNS, RATE, Column
from sumo_adv.metrics.statistics import Estimate, Paired, mcnemar, paired_bootstrap, wilson

FIXED, BEST_FIXED = "fixed:", "best-fixed"
SHOWN = 6  # names of missing encounters in a sentence


@dataclass(frozen=True, slots=True)
class Entry:
    """One figure. ``part``: all, a group or a kind. ``difference``: to the reference row, over the same encounters."""

    ego: str
    part: str
    row: str
    column: str
    estimate: Estimate
    difference: Paired | None = None


@dataclass(frozen=True, slots=True)
class Table:
    """A table of rows for every ego, never pooled.

    ``entries``: by ego, part, row and column; ``sizes``: cells by ego, part and row; ``words``: what rows are.
    """

    title: str
    egos: tuple[str, ...]
    rows: tuple[str, ...]
    columns: tuple[Column, ...]
    entries: Mapping[tuple[str, str, str, str], Entry]
    sizes: Mapping[tuple[str, str, str], int]
    reference: str | None
    notes: tuple[str, ...] = ()
    words: Mapping[str, str] = field(default_factory=dict)

    def parts(self, ego: str) -> list[str]:
        """The parts of an ego's encounters: all, groups, kinds."""
        return list(dict.fromkeys(part for e, part, _ in self.sizes if e == ego))

    def entry(self, ego: str, part: str, row: str, column: str) -> Entry | None:
        """One figure, None where there is none."""
        return self.entries.get((ego, part, row, column))


def make_table(
    cells: Sequence[Cell],
    *,
    title: str,
    cases: Sequence[Case] | None = None,
    egos: Sequence[str] | None = None,
    rows: Sequence[str] | None = None,
    reference: str | None = None,
    columns: Sequence[Column] = COLUMNS,
    words: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
) -> Table:
    """The table of cells of any egos, rows and seeds.

    ``cases``: the suite's, so that missing cells are told; ``egos`` and ``rows``: those wanted, in order (left out:
    those of the cells); ``reference``: the row others are compared with (left out: the first that attacks); ``notes``:
    said before those on the cells.
    """
    listed = tuple(rows or names(cells, "row"))
    cells = [cell for cell in cells if cell["row"] in listed]
    best, hindsight = best_fixed(cells)
    cells, shown = [*cells, *best], listed + ((BEST_FIXED,) if best else ())
    reference = reference or next((row for row in shown if row != RAW), None)
    entries: list[Entry] = []
    sizes: dict[tuple[str, str, str], int] = {}
    drivers = list(egos or names(cells, "ego"))
    for ego in drivers:
        for part, part_cells in parts(c for c in cells if c["ego"] == ego).items():
            part_columns = [q for q in columns if part == "all" or q.key in BY_PART]
            by_row = {row: [c for c in part_cells if c["row"] == row] for row in shown}
            sizes |= {(ego, part, row): len(row_cells) for row, row_cells in by_row.items() if row_cells}
            entries += [e for row in shown for e in _entries(ego, part, row, by_row, part_columns, reference)]
    notes = (*notes, *_missing(cells, drivers, listed, cases), *hindsight, *_never_valid(cells, drivers))
    indexed = {(e.ego, e.part, e.row, e.column): e for e in entries}
    return Table(title, tuple(drivers), shown, tuple(columns), indexed, sizes, reference, notes, words or {})


def best_fixed(cells: Sequence[Cell]) -> tuple[list[Cell], list[str]]:
    """For each ego the cells of its ``fixed:LABEL`` row with most valid encounters, of those that all such rows have,
    as one row; and what to say of it.

    Empty where there are not two such rows to choose from.
    """
    best_cells: list[Cell] = []
    notes = []
    for ego in names(cells, "ego"):
        fixed = [c for c in cells if c["ego"] == ego and str(c["row"]).startswith(FIXED)]
        rows = names(fixed, "row")
        if len(rows) < 2:
            continue
        common = set.intersection(*({key(c) for c in fixed if c["row"] == row} for row in rows))
        won = [str(c["row"]) for c in fixed if key(c) in common and counted(c).get("valid") is True]
        best = max(rows, key=won.count)
        best_cells += [{**c, "row": BEST_FIXED} for c in fixed if c["row"] == best]
        notes.append(
            f"{BEST_FIXED} against {ego} is {best}, the best of {len(rows)} chosen in hindsight, which flatters it."
        )
    return best_cells, notes


def _never_valid(cells: Sequence[Cell], egos: Sequence[str]) -> list[str]:
    """A sentence for each ego about encounters that no row makes valid: they stay in every denominator."""
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
) -> list[Entry]:  # fmt: skip
    entries = []
    for column in columns:
        estimate = column.estimate(by_row[row])
        if estimate is None:
            continue
        compared = column.paired and reference is not None and row not in (reference, RAW)
        difference = compare(column, by_row[row], by_row.get(reference or "", ())) if compared else None
        entries.append(Entry(ego, part, row, column.key, estimate, difference))
    return entries


def compare(column: Column, first: Sequence[Cell], second: Sequence[Cell]) -> Paired | None:
    """``first`` - ``second`` over the encounters that both have; None without any.

    The interval resamples encounters; p is McNemar's for rates, the bootstrap's for means.
    """
    left, right = column.values(first), column.values(second)
    common = [name for name in left if name in right]
    if not common:
        return None
    return paired([left[name] for name in common], [right[name] for name in common], rate=column.summary == RATE)


def paired(left: Sequence[float], right: Sequence[float], *, rate: bool) -> Paired:
    """The difference of two lists of the same encounters."""
    interval = paired_bootstrap(left, right)
    if not rate:
        return interval
    p = mcnemar([v > 0.5 for v in left], [v > 0.5 for v in right])
    return Paired(interval.difference, interval.low, interval.high, p, interval.n)


def _missing(
    cells: Sequence[Cell], egos: Sequence[str], rows: Sequence[str], cases: Sequence[Case] | None
) -> list[str]:
    """A sentence for each ego and row of which cells are not there."""
    notes = []
    expected = list(dict.fromkeys(names(cells, "case") if cases is None else [case.name for case in cases]))
    for ego in egos:
        own_cells = [c for c in cells if c["ego"] == ego]
        seeds = sorted({int(c["seed"]) for c in own_cells}) or [0]
        keys: list[Key] = [(case, seed) for case in expected for seed in seeds]
        for row in rows:
            there = {key(c) for c in own_cells if c["row"] == row}
            gone = [name for name in keys if name not in there]
            if gone:
                notes.append(_sentence(row, ego, [_name(g, len(seeds) > 1) for g in gone], len(keys)))
    return notes


def _name(cell: Key, with_seed: bool) -> str:
    return f"{cell[0]} (seed {cell[1]})" if with_seed else cell[0]


def _sentence(row: str, ego: str, gone: Sequence[str], of: int) -> str:
    listed = ", ".join(gone[:SHOWN]) + (f" and {len(gone) - SHOWN} more" if len(gone) > SHOWN else "")
    return (
        f"{row} against {ego}: {len(gone)} of {of} cells are missing ({listed}); its figures rest on the others. "
        "The same command again runs what is missing."
    )
