"""``make results``: measure the tables of docs/results.md with one revision of the program, and write them there.

    python benchmarks/results.py                    every table of results.toml but those of records: hours
    python benchmarks/results.py --records DIR      Waymo records as well
    python benchmarks/results.py --table drivers --ego idm --suite smoke --attempts 2     a trial: minutes

Each table is one ``sumo-adv bench table``, which keeps its cells: the same command goes on where it stopped. Cells are
below ``runs/results/REVISION``, so figures of two revisions never mix. A table is written as soon as it is complete. A
trial (another suite, ego or budget, or uncommitted changes) is written to a copy of the page beside its cells.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

from sumo_adv.benchmark.columns import TABLE_COLUMNS
from sumo_adv.benchmark.table import DIVERGENCES, TABLE_I

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "results.md"
CODE = (  # what figures depend on
    "sumo_adv", "memory_bank", "memory_bank.sqlite", "prompts", "networks", "suites", "examples/recorded_model",
)  # fmt: skip
FRESH, RECORDS = "fresh:", "records"
SECONDS, ATTEMPTS = 30.0, 400  # the budget of an encounter
COLUMN = {column.key: column for column in TABLE_COLUMNS}
PAIRED = ("valid", "strict", "serious")  # columns with paired differences
OF_PAPER = {"mean_min_ttc": "mean_min_ttc", "collision": "collision"}  # column -> field of paper.Reported


@dataclass(frozen=True, slots=True)
class Table:
    """An entry of results.toml."""

    name: str
    suite: str | Sequence[str]
    egos: Sequence[str]
    rows: Sequence[str]
    until: str
    columns: Sequence[str]
    settings: Sequence[str] = ()
    paper: bool = False
    every: int = 1
    parts: Sequence[str] = ("all",)
    cells: str = ""


def read_tables(file: Path) -> list[Table]:
    """The list of tables."""
    return [Table(**entry) for entry in tomllib.loads(file.read_text(encoding="utf-8"))["table"]]


def revision() -> tuple[str, bool]:
    """The last commit that changed what figures depend on, and whether there are uncommitted changes to it.

    Raises:
        SystemExit: this is no checkout of git.
    """
    commit, changes = _git("log", "-1", "--format=%h", "--", *CODE), _git("status", "--porcelain", "--", *CODE)
    if not changes:
        return commit, False
    mark = hashlib.sha256((changes + _git("diff", "HEAD", "--", *CODE)).encode()).hexdigest()[:8]
    return f"{commit}-changed-{mark}", True


def _git(*words: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit("make results names the revision that it measures: run it in a checkout of git.")
    return done.stdout.strip()


def suites_of(table: Table, folder: Path) -> list[str]:
    """What ``bench table --suite`` takes for a table; where only every n-th encounter of a suite counts, its files. A
    fresh suite is made first, in ``folder``."""
    if not isinstance(table.suite, str):
        return list(table.suite)
    suite = ROOT / "suites" / table.suite
    if table.suite.startswith(FRESH):
        suite = made_suite(table.suite.removeprefix(FRESH), folder)
    elif table.every == 1:
        return [table.suite]
    files = sorted(f for f in suite.glob("*.toml") if f.name != "suite.toml")[:: table.every]
    return [(f.relative_to(ROOT) if f.is_relative_to(ROOT) else f).as_posix() for f in files]


def command(table: Table, suites: Sequence[str], budget: tuple[float, int]) -> list[str]:
    """The bench that makes a table, without the folder of its cells. ``budget``: seconds and attempts an encounter."""
    words = ["bench", "table", *(word for suite in suites for word in ("--suite", suite))]
    words += ["--ego", ",".join(table.egos), "--until", table.until]
    words += [word for row in table.rows for word in ("--row", row)]
    words += [word for setting in table.settings for word in ("--set", setting)]
    return [*words, "--seconds", f"{budget[0]:g}", "--attempts", str(budget[1])]


def made_suite(seed: str, folder: Path) -> Path:
    """A fresh suite, in ``folder``."""
    made = folder / f"fresh-{seed}"
    if not (made / "suite.toml").is_file():
        _run(["bench", "make", "--seed", seed, "--out", str(made)])
    return made


def _run(words: Sequence[str]) -> None:
    print(shlex.join(["sumo-adv", *words]), file=sys.stderr, flush=True)
    if status := subprocess.run([sys.executable, "-m", "sumo_adv", *words], cwd=ROOT, check=False).returncode:
        raise SystemExit(status)


def _about(revision: str, table: Table, suites: Sequence[str], budget: tuple[float, int]) -> str:
    """What stands above a table: the revision, and the command that makes it again."""
    with_model = any(row.startswith("llm") for row in table.rows)
    answers = "recorded answers of a language model" if with_model else "no language model"
    several = len(suites) > 1
    typed = shlex.join(["sumo-adv", *command(table, ["FILE"] if several else suites, budget)])
    note = f" FILE ...: {len(suites)} encounters, listed in `benchmarks/results.toml`." if several else ""
    if several and table.every > 1:
        suite = str(table.suite).replace(FRESH, "fresh-")
        note = f" FILE ...: one in {table.every} of the files of `suites/{suite}`, {len(suites)} in all."
    typed = typed.replace("--suite FILE", "--suite FILE ...")
    return f"Revision {revision}, seed 0, {answers}.{note}\n\n<!-- not run: make results runs it -->\n    {typed}"


def markdown(table: Table, file: Path) -> str:
    """The chosen columns of a bench's table.csv, with intervals; below them the paper's figures."""
    with file.open(newline="", encoding="utf-8") as opened:
        entries = {(r["part"], r["ego"], r["row"], r["column"]): r for r in csv.DictReader(opened)}
    figures = {(ego, row, key): entry for (part, ego, row, key), entry in entries.items() if part == "all"}
    lines = ["| ego | row | " + " | ".join(map(_title, table.columns)) + " |"]
    lines.append("|---|---|" + "---|" * len(table.columns))
    for part, ego, row in product(table.parts, table.egos, table.rows):
        cells = [_figure(entries.get((part, ego, row, key)), COLUMN[key].digits) for key in table.columns]
        name = ego if part == "all" else f"{ego}, {part.replace('_', ' ')}"
        lines.append(f"| {name} | `{row}` | " + " | ".join(cells) + " |")
    for reported in TABLE_I if table.paper else ():
        cells = [f"{getattr(reported, OF_PAPER[key]):.2f}" if key in OF_PAPER else "" for key in table.columns]
        if reported == TABLE_I[-1]:
            cells = [
                f"{DIVERGENCES[k]:.3f}" if k in DIVERGENCES else c for k, c in zip(table.columns, cells, strict=True)
            ]
        lines.append(f"| *the paper* | *{reported.row}* | " + " | ".join(cells) + " |")
    if differences := _differences(table, figures):
        lines += ["", f"Paired differences to the expert: {'; '.join(differences)}."]
    return "\n".join(lines)


def _differences(table: Table, figures: Mapping[tuple[str, str, str], Mapping[str, str]]) -> list[str]:
    """For each row but the expert's, how much more often it succeeds in the same encounters; with intervals."""
    sentences = []
    for ego, row in product(table.egos, table.rows):
        entries = {key: figures.get((ego, row, key)) for key in PAIRED}
        shown = [f"{key} {_difference(entry)}" for key, entry in entries.items() if entry and entry["difference"]]
        if shown:
            against = f"{ego}, " if len(table.egos) > 1 else ""
            sentences.append(f"{against}`{row}` {', '.join(shown)}")
    return sentences


def _title(key: str) -> str:
    """The title of a column, which in a bench's own tables stands below that of its section."""
    column = COLUMN[key]
    return f"min TTC, {column.title}" if column.title.startswith("mean") else column.title


def _difference(entry: Mapping[str, str]) -> str:
    value, low, high = (f"{float(entry[key]):+.2f}" for key in ("difference", "difference_low", "difference_high"))
    return f"{value} [{low}, {high}]"


def _figure(entry: Mapping[str, str] | None, digits: int) -> str:
    if entry is None or not entry["value"]:
        return "-"
    value, low, high = (f"{float(entry[key]):.{digits}f}" for key in ("value", "low", "high"))
    return value if low == high else f"{value} [{low}, {high}]"


def put(page: str, name: str, text: str) -> str:
    """The page with what stands between the marks of a table replaced.

    Raises:
        SystemExit: the page has no such marks.
    """
    begin, end = f"<!-- results: {name} -->", f"<!-- end: {name} -->"
    parts = re.split(f"{re.escape(begin)}.*?{re.escape(end)}", page, flags=re.DOTALL)
    if len(parts) != 2:
        raise SystemExit(f"The page must have the marks {begin} and {end} once, around the place of the table.")
    return f"{parts[0]}{begin}\n\n{text}\n\n{end}{parts[1]}"


def main() -> None:
    """Measure what is asked for, table by table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tables = read_tables(Path(__file__).with_suffix(".toml"))
    parser.add_argument("--table", action="append", choices=[t.name for t in tables], help="only this one; repeatable")
    parser.add_argument("--records", type=Path, help="a folder of Waymo records with manifest.csv")
    parser.add_argument("--suite", help="a trial: this suite for all tables")
    parser.add_argument("--ego", help="a trial: these drivers for all tables, separated by commas")
    parser.add_argument("--seconds", type=float, help="a trial: the budget of each encounter")
    parser.add_argument("--attempts", type=int, help="a trial: the budget of each encounter")
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "results", help="folder of the cells")
    given = parser.parse_args()

    name, changed = revision()
    folder, page = given.out.resolve() / name, PAGE
    budget = (given.seconds or SECONDS, given.attempts or ATTEMPTS)
    trial = (given.suite, given.ego, given.seconds, given.attempts)
    if changed or any(trial):
        folder /= f"trial-{hashlib.sha256(repr(trial).encode()).hexdigest()[:8]}"
        folder.mkdir(parents=True, exist_ok=True)
        page = folder / "results.md"
        shutil.copyfile(PAGE, page)
    for table in tables:
        if given.table and table.name not in given.table:
            continue
        if table.suite == RECORDS and not (given.records or given.suite):
            print(f"{table.name}: left as it is; --records DIR measures it.", file=sys.stderr)
            continue
        own = [given.suite] if given.suite else suites_of(table, folder)
        specs = [f"womd:{given.records}" if s == RECORDS else s for s in own]
        measured = replace(table, egos=given.ego.split(",")) if given.ego else table
        workers = ["--workers", str(given.workers)] if given.workers else []
        cells = folder / (table.cells or table.name)
        _run([*command(measured, specs, budget), *workers, "--out", str(cells)])
        about = _about(name, measured, ["womd:RECORDS" if s == RECORDS else s for s in own], budget)
        text = put(
            page.read_text(encoding="utf-8"), table.name, f"{about}\n\n{markdown(measured, cells / 'table.csv')}"
        )
        page.write_text(text, encoding="utf-8")
        print(f"{table.name}: written to {page}", file=sys.stderr)


if __name__ == "__main__":
    main()
