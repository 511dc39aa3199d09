"""Two sides over the encounters that both have: rates, severity, attempts, and the cases that changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sumo_adv.benchmark.table import paired
from sumo_adv.comparison.side import Compared, Side
from sumo_adv.datatypes import Level
from sumo_adv.errors import UsageError
from sumo_adv.metrics.statistics import Estimate, Paired, bootstrap, wilson
from sumo_adv.regression.measured import Result

SCHEMA = 1
LEAST = 6  # pairs: with fewer no paired test can reach p 0.05 (2 / 2**5 = 0.06), and a bootstrap means nothing


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of both sides; ``difference``: second - first, paired, None with fewer than ``LEAST`` pairs."""

    name: str
    unit: str
    first: Estimate
    second: Estimate
    difference: Paired | None

    @property
    def change(self) -> float:
        """Second - first."""
        return self.second.value - self.first.value


@dataclass(frozen=True, slots=True)
class Change:
    """An encounter that came to another level or result."""

    key: str
    first: Compared
    second: Compared

    @property
    def worse(self) -> bool:
        """Whether the second side is worse."""
        return _badness(self.second) > _badness(self.first)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Both sides, paired. ``names``: what they are called; ``alone``: encounters that only one of them has."""

    names: tuple[str, str]
    sides: tuple[Side, Side]
    pairs: Sequence[tuple[Compared, Compared]]
    figures: Sequence[Figure]
    changes: Sequence[Change]
    alone: tuple[int, int]

    def counts(self, what: Callable[[Compared], bool]) -> tuple[int, int]:
        """Of how many pairs something holds, by side."""
        return sum(what(a) for a, _ in self.pairs), sum(what(b) for _, b in self.pairs)

    def document(self) -> dict[str, Any]:
        """As data."""
        sides = [
            {"name": name, "path": str(side.path), "egos": list(side.egos), "alone": alone}
            for name, side, alone in zip(self.names, self.sides, self.alone, strict=True)
        ]
        return {
            "schema": SCHEMA, "sides": sides, "encounters": len(self.pairs),
            "figures": [asdict(figure) for figure in self.figures],
            "changes": [
                {"case": c.key, "worse": c.worse, "first": _as_data(c.first), "second": _as_data(c.second)}
                for c in self.changes
            ],
        }  # fmt: skip


def compare(first: Side, second: Side, egos: tuple[str, str] | None = None) -> Comparison:
    """Pair two sides. ``egos``: the driver to take of each; by default all, paired by name if there are several.

    Raises UsageError: no such driver, drivers that cannot be paired, or no encounter in common.
    """
    if egos is not None:
        first, second = (_of_ego(side, ego) for side, ego in zip((first, second), egos, strict=True))
    several = len(first.egos) > 1 or len(second.egos) > 1
    if several and set(first.egos) != set(second.egos):
        raise UsageError(
            f"{first.path} has the egos {', '.join(first.egos)}, {second.path} has {', '.join(second.egos)}: "
            "choose one of each with --egos A,B."
        )
    first_by_key, second_by_key = ({_key(e, several): e for e in side.episodes} for side in (first, second))
    both = [key for key in first_by_key if key in second_by_key]
    if not both:
        raise UsageError(f"{first.path} and {second.path} have no encounter in common, so nothing can be compared.")
    pairs = [(first_by_key[key], second_by_key[key]) for key in both]
    changes = [
        Change(key, a, b) for key, (a, b) in zip(both, pairs, strict=True) if (a.level, a.result) != (b.level, b.result)
    ]
    changes.sort(key=lambda c: (not c.worse, -abs(_badness(c.second) - _badness(c.first)), c.key))
    budget = max(first.budget, second.budget)
    alone = (len(first_by_key) - len(both), len(second_by_key) - len(both))
    return Comparison(_names(first, second), (first, second), pairs, _figures(pairs, budget), changes, alone)


def _of_ego(side: Side, ego: str) -> Side:
    episodes = [e for e in side.episodes if e.ego == ego]
    if not episodes:
        raise UsageError(f"{side.path} has no ego '{ego}'; it has {', '.join(side.egos)}.")
    return Side(side.path, side.budget, episodes)


def _key(e: Compared, several: bool) -> str:
    return f"{e.key} ({e.ego})" if several else e.key


def _names(first: Side, second: Side) -> tuple[str, str]:
    """The drivers where they differ, else the folders, else A and B."""
    for a, b in (
        ((*first.egos, "")[0], (*second.egos, "")[0]),
        (first.path.resolve().name, second.path.resolve().name),
    ):
        if a != b:
            return a, b
    return "A", "B"


def _badness(e: Compared) -> float:
    """For the order of changes: by level, then by how hard the ego is hit, then whether a case fails."""
    return 100.0 * e.level + e.delta_v + (1000.0 if e.result == Result.FAIL else 0.0)


def _figures(pairs: Sequence[tuple[Compared, Compared]], budget: int) -> list[Figure]:
    figures = []
    if all(a.result and b.result for a, b in pairs):
        figures.append(_rate("case fails", pairs, lambda e: e.result == Result.FAIL))
    for level in (Level.COLLISION, Level.VALID, Level.STRICT, Level.SERIOUS):
        figures.append(_rate(str(level), pairs, lambda e, least=level: e.level >= least))  # type: ignore[misc]
    figures.append(_mean("delta-v, 0 without a collision", "m/s", pairs, lambda e: e.delta_v))
    figures.append(_mean("min TTC, at most 10", "s", pairs, lambda e: e.min_ttc))
    if budget > 1:
        figures.append(_mean("attempts until valid", "", pairs, lambda e: float(e.until_valid or budget + 1)))
    return figures


def _rate(name: str, pairs: Sequence[tuple[Compared, Compared]], holds: Callable[[Compared], bool]) -> Figure:
    values = [[float(holds(e)) for e in side] for side in zip(*pairs, strict=True)]
    first, second = (wilson(int(sum(v)), len(v)) for v in values)
    return Figure(name, "rate", first, second, _difference(values, rate=True))


def _mean(name: str, unit: str, pairs: Sequence[tuple[Compared, Compared]], of: Callable[[Compared], float]) -> Figure:
    values = [[of(e) for e in side] for side in zip(*pairs, strict=True)]
    first, second = (bootstrap(v) for v in values)
    return Figure(name, unit, first, second, _difference(values, rate=False))


def _difference(values: Sequence[Sequence[float]], *, rate: bool) -> Paired | None:
    return paired(values[1], values[0], rate=rate) if len(values[0]) >= LEAST else None


def _as_data(e: Compared) -> dict[str, Any]:
    return {
        "ego": e.ego, "level": str(e.level), "result": e.result, "delta_v": e.delta_v, "min_ttc": e.min_ttc,
        "severity": e.severity, "until_valid": e.until_valid, "run": None if e.run is None else str(e.run),
    }  # fmt: skip
