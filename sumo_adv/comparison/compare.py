"""Compare two sides over the encounters that both have: rates, severity, attempts, and the cases that changed.

A side is the episodes of a run, a campaign, a bench or a regression, whichever a path holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.bench import BENCH_FILE, read_cells
from sumo_adv.benchmark.cells import CELL_FAILURES, capped_ttc
from sumo_adv.benchmark.jobs import slug
from sumo_adv.benchmark.table import paired
from sumo_adv.campaigns.store import packed_texts
from sumo_adv.config import Settings
from sumo_adv.datatypes import Level
from sumo_adv.errors import UsageError
from sumo_adv.files import refuse_links
from sumo_adv.metrics.statistics import Estimate, Paired, bootstrap, wilson
from sumo_adv.outcome_schema import check_schema
from sumo_adv.parsing import parse_json, read_json
from sumo_adv.regression.runner import CaseMeasurements, CaseResult, measured_of
from sumo_adv.regression.suite import REGRESSION_FILE, read_results
from sumo_adv.report.index import read_rows
from sumo_adv.report.read import MANIFEST_FILE, OUTCOME_FILE, damaged, read_outcome
from sumo_adv.report.run_outcome import level_named
from sumo_adv.report.staging import PLAN_FILE, RESULTS_FILE

DEFAULT_ATTEMPTS = int(Settings.model_fields["attempts"].default)
COMPARISON_SCHEMA = 1
CASE_BADNESS = {str(CaseResult.FAIL): 1000.0, str(CaseResult.ERROR): 2000.0}
"""How much worse the results of a failed case are than any level; no other result fails a case."""
MIN_PAIRS = 6  # with fewer pairs, no paired test reaches p 0.05 (2 / 2**5 = 0.06), and a bootstrap is meaningless


@dataclass(frozen=True, slots=True)
class Compared:
    """One episode.

    Attributes:
        key: The key that pairs it with an episode of the other side.
        ego: The ego's driver.
        level: The level of the attempt that counts; of failed work, the level that was found before it failed.
        min_ttc: The minimum TTC [s]: at most 10, which is also the value for *never*, and 0 with a collision.
        delta_v: The ego's delta-v [m/s]; 0 without a collision that counts.
        severity: The severity of the collision; None without one.
        until_valid: The number of attempts until the first valid one; None if none was valid.
        failed: Whether the work failed.
        attacked: Whether an attempt was made.
        result: The result of a regression's case; None for other episodes.
        run: The run's folder; None if it was not kept.
    """

    key: str
    ego: str
    level: Level
    min_ttc: float
    delta_v: float
    severity: str | None
    until_valid: int | None = None
    failed: bool = False
    attacked: bool = True
    result: str | None = None
    run: Path | None = None


@dataclass(frozen=True, slots=True)
class ComparedSide:
    """What a path holds.

    Attributes:
        path: The path.
        budget: The maximum number of attempts of an episode.
        episodes: The episodes.
    """

    path: Path
    budget: int
    episodes: Sequence[Compared]

    @property
    def egos(self) -> tuple[str, ...]:
        """The drivers, in order of appearance."""
        return tuple(dict.fromkeys(e.ego for e in self.episodes))


def read_side(path: Path) -> ComparedSide:
    """Read the episodes at a path.

    Args:
        path: The folder of a run, a campaign, a bench or a regression, a folder of runs, or a regression's file.

    Returns:
        The side.

    Raises:
        UsageError: The path holds no episode, or a file is damaged.
    """
    refuse_links(path)
    if path.name == REGRESSION_FILE or (path / REGRESSION_FILE).is_file():
        return _regression(path)
    if (path / BENCH_FILE).is_file():
        return _bench(path)
    if (path / RESULTS_FILE).is_file():
        return _campaign(path)
    runs = [path] if (path / OUTCOME_FILE).is_file() else sorted(p.parent for p in path.glob(f"*/{OUTCOME_FILE}"))
    if not runs:
        raise UsageError(f"{path} holds no run, campaign, bench or regression.")
    read = [(read_outcome(run), run) for run in runs]
    keyed = _numbered((f"{o.get('network')} seed {o.get('seed')}", o, run) for o, run in read)
    return ComparedSide(
        path,
        max(_budget(run / MANIFEST_FILE) if (run / MANIFEST_FILE).is_file() else DEFAULT_ATTEMPTS for run in runs),
        [_of_outcome(*each) for each in keyed],
    )


def _campaign(folder: Path) -> ComparedSide:
    table = read_rows(folder / RESULTS_FILE)
    packed = packed_texts(folder, OUTCOME_FILE)
    read = []
    for row in table.rows:
        name = str(row["id"])
        run = folder / "runs" / name
        is_packed = name in packed and not (run / OUTCOME_FILE).is_file()  # a folder is newer than a pack
        outcome = _packed(folder, name, packed[name]) if is_packed else read_outcome(run)
        varied = " ".join(f"{key.removeprefix('set_')}={row[key]}" for key in table.varied)
        key = f"{row['network']} seed {row['seed']:g} {varied}".strip()
        read.append((key, outcome, None if is_packed else run))
    return ComparedSide(folder, _budget(folder / PLAN_FILE), [_of_outcome(*each) for each in _numbered(read)])


def _packed(folder: Path, run: str, text: str) -> dict[str, Any]:
    """Parse the outcome of a packed run. Raise UsageError if it is damaged."""
    try:
        outcome = dict(parse_json(text))
    except (ValueError, TypeError) as error:
        raise damaged(folder / "packs" / run / OUTCOME_FILE, error) from error
    check_schema(outcome, folder / "packs" / run / OUTCOME_FILE, folder)
    return outcome


def _budget(plan: Path) -> int:
    """Return the largest number of attempts among the settings of a run, a campaign or a bench."""
    try:
        settings = read_json(plan)["settings"]
        variants = settings if isinstance(settings, list) else [settings]
        return max(int(each.get("attempts", DEFAULT_ATTEMPTS)) for each in variants)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise damaged(plan, error) from error


def _bench(folder: Path) -> ComparedSide:
    cells = read_cells(folder)
    methods = {str(cell["row"]) for cell in cells}
    read = []
    for cell in cells:
        run = folder / "runs" / slug(str(cell["ego"])) / slug(str(cell["case"])) / slug(str(cell["row"]))
        method = f" {cell['row']}" if len(methods) > 1 else ""
        outcome = {**cell, "ego": {"controller": cell["ego"]}}
        read.append((f"{cell['case']} seed {cell['seed']}{method}", outcome, run if run.is_dir() else None))
    return ComparedSide(folder, _budget(folder / BENCH_FILE), [_of_outcome(*each) for each in _numbered(read)])


def _numbered(
    read: Iterable[tuple[str, Mapping[str, Any], Path | None]],
) -> list[tuple[str, Mapping[str, Any], Path | None]]:
    """Number keys that one driver has several times (inputs with the same name)."""
    seen: dict[tuple[str, str], int] = {}
    keyed = []
    for key, outcome, run in read:
        ego = _ego(outcome)
        seen[key, ego] = seen.get((key, ego), 0) + 1
        keyed.append((key if seen[key, ego] == 1 else f"{key} #{seen[key, ego]}", outcome, run))
    return keyed


def _ego(outcome: Mapping[str, Any]) -> str:
    return str((outcome.get("ego") or {}).get("controller"))


def _of_outcome(key: str, outcome: Mapping[str, Any], run: Path | None) -> Compared:
    failed = outcome.get("ending") in CELL_FAILURES
    verdict, attempts = outcome.get("outcome") or {}, outcome.get("attempts") or ()
    level = level_named(verdict.get("level"))
    return Compared(
        key, _ego(outcome), level, capped_ttc(verdict),
        float(verdict.get("delta_v") or 0.0) if level >= Level.COLLISION else 0.0, verdict.get("severity"),
        next((k for k, a in enumerate(attempts, 1) if level_named(a.get("level")) >= Level.VALID), None), failed,
        outcome.get("best") is not None, None, run,
    )  # fmt: skip


def _regression(path: Path) -> ComparedSide:
    document = read_results(path)
    folder = path if path.is_dir() else path.parent
    episodes = [_of_case(measured_of(row), str(row.get("result")), folder) for row in document["cases"]]
    return ComparedSide(path, 1, episodes)


def _of_case(m: CaseMeasurements, result: str, folder: Path) -> Compared:
    level, run = level_named(m.level), folder / "runs" / m.case
    verdict = {"collided": m.collided, "min_ttc": m.min_ttc}
    delta_v = m.delta_v or 0.0 if level >= Level.COLLISION else 0.0
    return Compared(
        m.case, m.ego, level, capped_ttc(verdict), delta_v, m.severity, 1 if level >= Level.VALID else None,
        result == CaseResult.ERROR, not m.broken, result, run if run.is_dir() else None,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """One figure of both sides.

    Attributes:
        name: The name.
        unit: The unit; ``rate`` for a rate.
        first: The first side.
        second: The second side.
        difference: The paired difference, second - first; None with fewer than ``MIN_PAIRS`` pairs.
    """

    name: str
    unit: str
    first: Estimate
    second: Estimate
    difference: Paired | None

    @property
    def change(self) -> float:
        """The second value minus the first."""
        return self.second.value - self.first.value


@dataclass(frozen=True, slots=True)
class ChangedCase:
    """An encounter whose level or result changed.

    Attributes:
        key: The key of the encounter.
        first: The first side's episode.
        second: The second side's episode.
    """

    key: str
    first: Compared
    second: Compared

    @property
    def worse(self) -> bool:
        """Whether the second side's episode is worse for the ego."""
        return _badness(self.second) > _badness(self.first)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two sides, paired.

    Attributes:
        names: The names of the sides.
        sides: The sides.
        pairs: The episodes that both sides have.
        figures: The figures.
        changes: The cases that changed, those that got worse first.
        alone: The number of encounters that only the first and only the second side has.
    """

    names: tuple[str, str]
    sides: tuple[ComparedSide, ComparedSide]
    pairs: Sequence[tuple[Compared, Compared]]
    figures: Sequence[ComparedFigure]
    changes: Sequence[ChangedCase]
    alone: tuple[int, int]

    def counts(self, what: Callable[[Compared], bool]) -> tuple[int, int]:
        """Count the paired episodes of each side that meet a condition."""
        return sum(what(a) for a, _ in self.pairs), sum(what(b) for _, b in self.pairs)

    def document(self) -> dict[str, Any]:
        """Return the comparison as plain data."""
        sides = [
            {"name": name, "path": str(side.path), "egos": list(side.egos), "alone": alone}
            for name, side, alone in zip(self.names, self.sides, self.alone, strict=True)
        ]
        return {
            "schema": COMPARISON_SCHEMA, "sides": sides, "encounters": len(self.pairs),
            "figures": [asdict(figure) for figure in self.figures],
            "changes": [
                {"case": c.key, "worse": c.worse, "first": _as_data(c.first), "second": _as_data(c.second)}
                for c in self.changes
            ],
        }  # fmt: skip


def compare(first: ComparedSide, second: ComparedSide, egos: tuple[str, str] | None = None) -> Comparison:
    """Pair two sides.

    Args:
        first: The first side.
        second: The second side.
        egos: The driver to take of each side. None takes all, paired by name if there are several.

    Returns:
        The comparison.

    Raises:
        UsageError: There is no such driver, the drivers cannot be paired, or no encounter is on both sides.
    """
    if egos is not None:
        first, second = (_of_ego(side, ego) for side, ego in zip((first, second), egos, strict=True))
    several = len(first.egos) > 1 or len(second.egos) > 1
    if several and set(first.egos) != set(second.egos):
        raise UsageError(
            f"{first.path} has the egos {', '.join(first.egos)}, {second.path} has {', '.join(second.egos)}: "
            "choose one of each with --egos A,B."
        )
    first_by_key, second_by_key = (
        {f"{e.key} ({e.ego})" if several else e.key: e for e in side.episodes} for side in (first, second)
    )
    both = [key for key in first_by_key if key in second_by_key]
    if not both:
        raise UsageError(f"{first.path} and {second.path} have no encounter in common, so nothing can be compared.")
    pairs = [(first_by_key[key], second_by_key[key]) for key in both]
    changes = [
        ChangedCase(key, a, b)
        for key, (a, b) in zip(both, pairs, strict=True)
        if (a.level, a.result) != (b.level, b.result)
    ]
    changes.sort(key=lambda c: (not c.worse, -abs(_badness(c.second) - _badness(c.first)), c.key))
    budget = max(first.budget, second.budget)
    alone = (len(first_by_key) - len(both), len(second_by_key) - len(both))
    return Comparison(_names(first, second), (first, second), pairs, _figures(pairs, budget), changes, alone)


def _of_ego(side: ComparedSide, ego: str) -> ComparedSide:
    """Keep the episodes of one driver."""
    episodes = [e for e in side.episodes if e.ego == ego]
    if not episodes:
        raise UsageError(f"{side.path} has no ego '{ego}'; it has {', '.join(side.egos)}.")
    return ComparedSide(side.path, side.budget, episodes)


def _names(first: ComparedSide, second: ComparedSide) -> tuple[str, str]:
    """Name the sides by their drivers or, if these are equal, by their folders, or otherwise A and B."""
    egos = (*first.egos, "")[0], (*second.egos, "")[0]
    folders = first.path.resolve().name, second.path.resolve().name
    return next(((a, b) for a, b in (egos, folders) if a != b), ("A", "B"))


def _badness(e: Compared) -> float:
    """Rate how bad an episode is: by level, then by the ego's delta-v; above these, failed cases, and then errors."""
    return 100.0 * e.level + e.delta_v + CASE_BADNESS.get(str(e.result), 0.0)


def _figures(pairs: Sequence[tuple[Compared, Compared]], budget: int) -> list[ComparedFigure]:
    """Compute the figures.

    Rates are over all pairs. An encounter without an attack counts as not hit, failed work counts with the level that
    was found before it failed, and an error of a case counts as a failed case. An encounter without an attack has
    neither a minimum TTC nor a delta-v of an attack. So means are over the pairs in which both or neither were
    attacked, and neither failed.
    """
    alike = [(a, b) for a, b in pairs if a.attacked == b.attacked and not (a.failed or b.failed)]

    def figure(name: str, unit: str, of: Callable[[Compared], float]) -> ComparedFigure:
        rate = unit == "rate"
        first, second = ([float(of(e)) for e in side] for side in zip(*(pairs if rate else alike), strict=True))
        difference = paired(second, first, rate=rate) if len(first) >= MIN_PAIRS else None
        of_first, of_second = (wilson(int(sum(v)), len(v)) if rate else bootstrap(v) for v in (first, second))
        return ComparedFigure(name, unit, of_first, of_second, difference)

    figures = []
    if all(a.result and b.result for a, b in pairs):
        figures.append(figure("case fails", "rate", lambda e: e.result in CASE_BADNESS))
    for level in (Level.COLLISION, Level.VALID, Level.STRICT, Level.SERIOUS):
        figures.append(figure(str(level), "rate", lambda e, least=level: e.level >= least))  # type: ignore[misc]
    if not alike:
        return figures
    figures.append(figure("delta-v, 0 without a collision", "m/s", lambda e: e.delta_v))
    figures.append(figure("min TTC, at most 10", "s", lambda e: e.min_ttc))
    if budget > 1:
        figures.append(figure("attempts until valid", "", lambda e: e.until_valid or budget + 1))
    return figures


def _as_data(e: Compared) -> dict[str, Any]:
    return {
        "ego": e.ego, "level": str(e.level), "result": e.result, "delta_v": e.delta_v, "min_ttc": e.min_ttc,
        "severity": e.severity, "failed": e.failed, "until_valid": e.until_valid,
        "run": None if e.run is None else str(e.run),
    }  # fmt: skip
