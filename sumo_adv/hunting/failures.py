"""Distinct failures: one representative of each cell, the most serious one, and how many others it stands for."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from sumo_adv.datatypes import Level
from sumo_adv.report.coverage import SPEED_BANDS_M_S, band_of
from sumo_adv.report.run_outcome import level_named
from sumo_adv.scenario_names import COLUMNS as SCENARIO

FAILURE_COLUMNS = (
    "rank", "level", "intent", "relation", "road", "speed_band", "side", "delta_v", "count", "network", "seed",
    "adversary", "preventable_by", "run", "cause", "cause_sentence", "robust", "humanlike", "fault", "red_light",
    "right_of_way", "overlap", "warning", "near_touch", *SCENARIO,
)  # fmt: skip
NEAR_TOUCH_DELTA_V_M_S = 0.447
"""Delta-v [m/s] (1 mph) below which a collision is a near-touch: it is listed apart, behind all others."""


class FailureCell(NamedTuple):
    """What makes two failures different: intent, relation of the adversary, kind of road, speed band of the ego, the
    side of the ego that is hit, and the kind of cause (``metrics/cause.py``)."""

    intent: str
    relation: str
    road: str
    speed_band: str
    side: str
    cause: str


@dataclass(frozen=True, slots=True)
class Failure:
    """A cell with its representative. run: its folder; why: its cause in a sentence, empty where it is not known;
    count: how many failures of the cell were found."""

    cell: FailureCell
    level: Level
    delta_v: float  # m/s, of the ego
    network: str
    seed: int
    adversary: str
    preventable_by: str
    run: Path
    why: str = ""
    robust: bool | None = None  # whether most of its neighbours succeed, too; None where none was simulated
    humanlike: bool | None = None  # whether the adversary moved as a person could
    fault: str | None = None  # ego | adversary
    red_light: str | None = None  # who passed one: adversary | ego | both | none
    right_of_way: str | None = None  # who took it from the other
    overlap: float | None = None  # share of the touching face
    warning: float | None = None  # s from the alarm of cc_human to the contact
    motion: str | None = None  # what the adversary does; None for episodes of an earlier version
    nhtsa: str | None = None  # the names of the scenario (``scenario_names.py``)
    iso_34502: str | None = None
    euro_ncap: str | None = None
    count: int = 1

    @property
    def near_touch(self) -> bool:
        """Whether the contact was negligible."""
        return self.delta_v < NEAR_TOUCH_DELTA_V_M_S

    @property
    def worth(self) -> tuple[bool, int, bool, bool, float]:
        """Sorts failures, the one to look at first last: no near-touch, by level, robust and humanlike, by delta-v."""
        robust, human = self.robust is True, self.humanlike is True
        return (not self.near_touch, int(self.level), robust and human, robust or human, self.delta_v)

    @property
    def words(self) -> str:
        c = self.cell
        does = f"{self.motion or c.intent} ({c.relation}, {c.road})"
        hit = f"{self.level}: {does}, hit on the {c.side} with {self.delta_v:.1f} m/s"
        return f"{hit}. {self.why.removesuffix('.')}" if self.why else hit


def failure_of(row: Mapping[str, Any], runs: Path) -> Failure | None:
    """The failure of an episode from its row of ``results.csv``; None if no valid collision counts."""
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
        warning=row.get("warning"), motion=row.get("motion"), nhtsa=row.get("nhtsa"),
        iso_34502=row.get("iso_34502"), euro_ncap=row.get("euro_ncap"),
    )  # fmt: skip


def distinct(failures: Iterable[Failure]) -> list[Failure]:
    """One failure of each cell, the one to look at first first (``Failure.worth``); of equals the first one found."""
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
    """A row for each distinct failure, with ``FAILURE_COLUMNS``; ``folder``: of the hunt, paths count from it."""
    return [
        {
            "rank": k + 1, "level": str(f.level), **f.cell._asdict(), "delta_v": round(f.delta_v, 3), "count": f.count,
            "network": f.network, "seed": f.seed, "adversary": f.adversary, "preventable_by": f.preventable_by,
            "run": f.run.relative_to(folder).as_posix(), "cause_sentence": f.why,
            **{key: getattr(f, key) for key in FAILURE_COLUMNS[FAILURE_COLUMNS.index("robust") :]},
        }
        for k, f in enumerate(found)
    ]  # fmt: skip
