"""Group the failures of a hunt into cells, and represent each cell by its most serious failure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from sumo_adv.datatypes import Level
from sumo_adv.metrics.severity import is_near_touch
from sumo_adv.report.coverage import SPEED_BANDS_M_S, band_of
from sumo_adv.report.run_outcome import level_named
from sumo_adv.scenario_names import COLUMNS as SCENARIO

FAILURE_COLUMNS = (
    "rank", "level", "intent", "relation", "road", "speed_band", "side", "delta_v", "count", "network", "seed",
    "adversary", "preventable_by", "run", "cause", "cause_sentence", "robust", "humanlike", "fault", "red_light",
    "right_of_way", "overlap", "warning", "impact_speed", "near_touch", *SCENARIO,
)  # fmt: skip


class FailureCell(NamedTuple):
    """The features that make two failures different.

    Attributes:
        intent: The intent of the attack.
        relation: The relation of the adversary to the ego.
        road: The kind of road.
        speed_band: The speed band of the ego.
        side: The side of the ego that is hit.
        cause: The kind of cause (``metrics/cause.py``).
    """

    intent: str
    relation: str
    road: str
    speed_band: str
    side: str
    cause: str


@dataclass(frozen=True, slots=True)
class Failure:
    """A cell with its representative. Features are None if they are not known.

    Attributes:
        cell: The cell.
        level: The level of the failure.
        delta_v: The delta-v of the ego [m/s].
        network: The name of the input.
        seed: The seed of the run.
        adversary: The id of the adversary.
        preventable_by: The reference drivers that avoid the collision.
        run: The folder of the run.
        why: The cause in a sentence; empty if it is not known.
        robust: Whether most neighbours of the attack also succeed; None if none was simulated.
        humanlike: Whether the adversary moved as a person could.
        fault: Who was at fault: ``ego`` or ``adversary``.
        red_light: Who passed a red light: ``adversary``, ``ego``, ``both`` or ``none``.
        right_of_way: Who took the right of way from the other.
        overlap: The overlap as a share of the narrower of the two touching faces.
        warning: The time from the alarm of ``cc_human`` to the contact [s].
        impact_speed: The speed at which a pedestrian, a cyclist or a motorcyclist is hit [m/s]; None otherwise.
        motion: What the adversary does; None for episodes of an earlier version.
        nhtsa: The name of the scenario at NHTSA (``scenario_names.py``).
        iso_34502: Its name in ISO 34502.
        euro_ncap: Its name at Euro NCAP.
        count: The number of failures found in the cell.
    """

    cell: FailureCell
    level: Level
    delta_v: float
    network: str
    seed: int
    adversary: str
    preventable_by: str
    run: Path
    why: str = ""
    robust: bool | None = None
    humanlike: bool | None = None
    fault: str | None = None
    red_light: str | None = None
    right_of_way: str | None = None
    overlap: float | None = None
    warning: float | None = None
    impact_speed: float | None = None
    motion: str | None = None
    nhtsa: str | None = None
    iso_34502: str | None = None
    euro_ncap: str | None = None
    count: int = 1

    @property
    def near_touch(self) -> bool:
        """Whether the contact was negligible."""
        return is_near_touch(self.delta_v, self.impact_speed)

    @property
    def hardness(self) -> float:
        """The impact speed if there is one, or the delta-v of the ego [m/s]."""
        return self.delta_v if self.impact_speed is None else self.impact_speed

    @property
    def worth(self) -> tuple[bool, int, bool, bool, float]:
        """A key that sorts failures; the one to look at first comes last.

        In this order, it compares whether the failure is more than a near-touch, its level, whether it is both robust
        and humanlike, whether it is at least one of them, and how hard it is.
        """
        robust, human = self.robust is True, self.humanlike is True
        return (not self.near_touch, int(self.level), robust and human, robust or human, self.hardness)

    @property
    def words(self) -> str:
        """The failure in a sentence."""
        c = self.cell
        does = f"{self.motion or c.intent} ({c.relation}, {c.road})"
        hit = f"{self.level}: {does}, hit on the {c.side} with {self.hardness:.1f} m/s"
        return f"{hit}. {self.why.removesuffix('.')}" if self.why else hit


def failure_of(row: Mapping[str, Any], runs: Path) -> Failure | None:
    """Read the failure of an episode.

    Args:
        row: The episode's row of ``results.csv``.
        runs: The folder of the runs.

    Returns:
        The failure; None if no collision of level ``valid`` or higher counts.
    """
    level = level_named(row["level"])
    if level < Level.VALID:
        return None
    band = "unknown"
    if row["ego_speed"] is not None:
        low, high = SPEED_BANDS_M_S[band_of(float(row["ego_speed"]))]
        band = f"from {low:g} m/s" if math.isinf(high) else f"{low:g}-{high:g} m/s"
    side = str(row["kind"] or "").rsplit(" / ", 1)[-1] or "unknown"
    words = (row["composition"] or row["intent"], row["relation"], row["road"], row.get("cause"))
    intent, relation, road, cause = (str(word or "unknown") for word in words)
    cell = FailureCell(intent, relation, road, band, side, cause)
    return Failure(
        cell, level, float(row["delta_v"] or 0.0), str(row["network"]), int(row["seed"]), str(row["adversary"]),
        str(row["preventable_by"] or ""), runs / str(row["id"]), str(row.get("cause_sentence") or ""),
        robust=row.get("robust"), humanlike=row.get("humanlike"), fault=row.get("fault"),
        red_light=row.get("red_light"), right_of_way=row.get("right_of_way"), overlap=row.get("overlap"),
        warning=row.get("warning"), impact_speed=row.get("impact_speed"), motion=row.get("motion"),
        nhtsa=row.get("nhtsa"), iso_34502=row.get("iso_34502"), euro_ncap=row.get("euro_ncap"),
    )  # fmt: skip


def distinct(failures: Iterable[Failure]) -> list[Failure]:
    """Choose one failure of each cell: the one to look at first (``Failure.worth``), or of equal ones the first one
    found.

    Args:
        failures: All failures.

    Returns:
        The chosen failures, the one to look at first in front.
    """
    cells: dict[FailureCell, Failure] = {}
    for failure in failures:
        best = cells.get(failure.cell)
        if best is None:
            cells[failure.cell] = failure
        else:
            chosen = failure if failure.worth > best.worth else best
            cells[failure.cell] = replace(chosen, count=best.count + failure.count)
    return sorted(sorted(cells.values(), key=lambda f: f.cell), key=lambda f: f.worth, reverse=True)


def table(found: Sequence[Failure], folder: Path) -> list[dict[str, Any]]:
    """Make a row for each distinct failure.

    Args:
        found: The failures, in order of rank.
        folder: The folder of the hunt. Paths are relative to it.

    Returns:
        The rows, with the keys ``FAILURE_COLUMNS``.
    """
    return [
        {
            "rank": k + 1, "level": str(f.level), **f.cell._asdict(), "delta_v": round(f.delta_v, 3), "count": f.count,
            "network": f.network, "seed": f.seed, "adversary": f.adversary, "preventable_by": f.preventable_by,
            "run": f.run.relative_to(folder).as_posix(), "cause_sentence": f.why,
            **{key: getattr(f, key) for key in FAILURE_COLUMNS[FAILURE_COLUMNS.index("robust") :]},
        }
        for k, f in enumerate(found)
    ]  # fmt: skip
