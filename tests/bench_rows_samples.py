"""An encounter made by hand for the opponents of the benchmark, and attempts that came to what a test needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from situation_samples import situation

from sumo_adv.benchmark.nouns import Encounter
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, LibraryEntry, Proposal, Verdict
from sumo_adv.planners.text import make_planner
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation, Target

SOURCE = """
PARAMETERS = {"gap": (2.0, -3.0, 4.0, "m", "where")}


def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}
"""

NETWORK = data_folder("networks") / "straight_3lane.net.xml"


def entry(label: str, applies: tuple[str, ...], modes: Sequence[str] = ("side",)) -> LibraryEntry:
    """A behaviour with a planner of one number for each mode."""
    planners = tuple(make_planner(label, mode, f"# {mode}\n{SOURCE}", "seed") for mode in modes)
    return LibraryEntry(label, f"What {label} does.", applies, planners)


LIBRARY = (
    entry("Straight Lane Shift", ("neighbour", "leader"), ("left", "right")),
    entry("Aggressive Cut-in", ("neighbour",)),
    entry("Emergency Braking", ("leader",)),
)


def everywhere() -> Drivable:
    """A square of 2 km that is all road."""
    from shapely.geometry import box

    return Drivable(box(-1000.0, -1000.0, 1000.0, 1000.0))


def encounter(
    targets: Sequence[Target],
    *,
    seed: int = 0,
    delays: Sequence[float] = (0.0,),
    library: Sequence[LibraryEntry] = LIBRARY,
    **changed: Any,
) -> Encounter:
    """The hand-made situation with these vehicles at every delay; ``changed`` goes to ``situation``."""
    hand_made: Situation = situation(targets, **changed)
    return Encounter(dict.fromkeys(delays, hand_made), library, everywhere(), Settings(), seed, NETWORK)


def attempt(proposal: Proposal, index: int = 0, **changed: Any) -> Attempt:
    """An attempt that missed by 10 m unless ``changed`` says otherwise of its verdict."""
    verdict = {
        "min_ttc": 5.0, "min_distance": 10.0, "collided": False, "critical": False, "feasible": True, "rear_end": False,
    } | changed  # fmt: skip
    return Attempt(index, "row", proposal, 100.0, Verdict(**verdict), "passed")


def first_proposals(row: Any, many: int) -> list[Proposal]:
    """The first proposals of a row if all attempts miss."""
    tried: list[Attempt] = []
    while len(tried) < many and (proposal := row.propose(tried)) is not None:
        tried.append(attempt(proposal, len(tried)))
    return [a.proposal for a in tried]
