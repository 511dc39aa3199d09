"""One side of a comparison: the episodes of a run, a campaign, a bench or a regression, whichever a path holds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.bench import PLAN as BENCH_PLAN
from sumo_adv.benchmark.bench import read_cells
from sumo_adv.benchmark.cells import FAILED, capped_ttc
from sumo_adv.benchmark.jobs import slug
from sumo_adv.campaigns.store import packed_texts
from sumo_adv.config import Settings
from sumo_adv.datatypes import Level
from sumo_adv.errors import UsageError
from sumo_adv.regression.measured import Measured, Result, measured_of
from sumo_adv.regression.suite import RESULTS, read_results
from sumo_adv.report.index.rows import RESULTS as TABLE
from sumo_adv.report.index.rows import read_rows
from sumo_adv.report.page.read import MANIFEST, OUTCOME, damaged, read_outcome

BATCH_PLAN = "plan.json"
ATTEMPTS = int(Settings.model_fields["attempts"].default)


@dataclass(frozen=True, slots=True)
class Compared:
    """One episode. ``key``: what it is paired by.

    level: of the attempt that counts; min_ttc [s]: 10 if never, 0 with a collision; delta_v [m/s]: 0 without a
    collision that counts; until_valid: attempts until the first valid one, None if none was; failed: the work failed;
    attacked: an attempt was made; result: of a regression; run: its folder, None if it was not kept.
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
class Side:
    """What a path holds. ``budget``: attempts that an episode may make."""

    path: Path
    budget: int
    episodes: Sequence[Compared]

    @property
    def egos(self) -> tuple[str, ...]:
        """The drivers, in order of appearance."""
        return tuple(dict.fromkeys(e.ego for e in self.episodes))


def read_side(path: Path) -> Side:
    """The episodes at a path. Raises UsageError: it holds none, or a file is damaged."""
    if path.name == RESULTS or (path / RESULTS).is_file():
        return _regression(path)
    if (path / BENCH_PLAN).is_file():
        return _bench(path)
    if (path / TABLE).is_file():
        return _campaign(path)
    runs = [path] if (path / OUTCOME).is_file() else sorted(p.parent for p in path.glob(f"*/{OUTCOME}"))
    if not runs:
        raise UsageError(f"{path} holds no run, campaign, bench or regression.")
    read = [(read_outcome(run), run) for run in runs]
    keyed = _numbered((f"{o.get('network')} seed {o.get('seed')}", o, run) for o, run in read)
    return Side(path, max(_attempts_of(run) for run in runs), [_of_outcome(*each) for each in keyed])


def _attempts_of(run: Path) -> int:
    """The budget of a run: a setting in its manifest."""
    file = run / MANIFEST
    try:
        return int(json.loads(file.read_text(encoding="utf-8"))["settings"]["attempts"]) if file.is_file() else ATTEMPTS
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise damaged(file, error) from error


def _campaign(folder: Path) -> Side:
    table = read_rows(folder / TABLE)
    packed = packed_texts(folder, OUTCOME) if (folder / "packs").is_dir() else {}
    read = []
    for row in table.rows:
        name = str(row["id"])
        run = folder / "runs" / name
        outcome = json.loads(packed[name]) if name in packed else read_outcome(run)
        varied = " ".join(f"{key.removeprefix('set_')}={row[key]}" for key in table.varied)
        key = f"{row['network']} seed {row['seed']:g} {varied}".strip()
        read.append((key, outcome, None if name in packed else run))
    return Side(folder, _budget(folder / BATCH_PLAN), [_of_outcome(*each) for each in _numbered(read)])


def _budget(plan: Path) -> int:
    """The largest number of attempts among the settings of a campaign or a bench."""
    try:
        settings = json.loads(plan.read_text(encoding="utf-8"))["settings"]
        variants = settings if isinstance(settings, list) else [settings]
        return max(int(each.get("attempts", ATTEMPTS)) for each in variants)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise damaged(plan, error) from error


def _bench(folder: Path) -> Side:
    cells = read_cells(folder)
    methods = {str(cell["row"]) for cell in cells}
    read = []
    for cell in cells:
        run = folder / "runs" / slug(str(cell["ego"])) / slug(str(cell["case"])) / slug(str(cell["row"]))
        method = f" {cell['row']}" if len(methods) > 1 else ""
        outcome = {**cell, "ego": {"controller": cell["ego"]}}
        read.append((f"{cell['case']} seed {cell['seed']}{method}", outcome, run if run.is_dir() else None))
    return Side(folder, _budget(folder / BENCH_PLAN), [_of_outcome(*each) for each in _numbered(read)])


def _numbered(
    read: Iterable[tuple[str, Mapping[str, Any], Path | None]],
) -> list[tuple[str, Mapping[str, Any], Path | None]]:
    """The same with a number behind keys that one driver has twice (inputs of one name)."""
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
    failed = outcome.get("ending") in FAILED
    verdict = {} if failed else outcome.get("outcome") or {}
    attempts = () if failed else outcome.get("attempts") or ()
    level = _level(verdict.get("level"))
    return Compared(
        key, _ego(outcome), level, capped_ttc(verdict),
        float(verdict.get("delta_v") or 0.0) if level >= Level.COLLISION else 0.0, verdict.get("severity"),
        next((k for k, a in enumerate(attempts, 1) if _level(a.get("level")) >= Level.VALID), None), failed,
        outcome.get("best") is not None, None, run,
    )  # fmt: skip


def _level(name: Any) -> Level:
    return Level[str(name or "none").upper()]


def _regression(path: Path) -> Side:
    document = read_results(path)
    folder = path if path.is_dir() else path.parent
    episodes = [_of_case(measured_of(row), str(row.get("result")), folder) for row in document["cases"]]
    return Side(path, 1, episodes)


def _of_case(m: Measured, result: str, folder: Path) -> Compared:
    level, run = _level(m.level), folder / "runs" / m.case
    verdict = {"collided": m.collided, "min_ttc": m.min_ttc}
    delta_v = m.delta_v or 0.0 if level >= Level.COLLISION else 0.0
    return Compared(
        m.case, m.ego, level, capped_ttc(verdict), delta_v, m.severity, 1 if level >= Level.VALID else None,
        result == Result.ERROR, not m.broken, result, run if run.is_dir() else None,
    )  # fmt: skip
