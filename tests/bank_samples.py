"""Small made-up contents for the tests of the memory bank; run as a program it is a writer process.

``python bank_samples.py BANK COUNT NAME`` records COUNT pieces of evidence (for ever if 0), printing a line after each.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from sumo_adv.datatypes import Parameter, Planner
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import read_folder
from sumo_adv.memory.records import Evidence, IntentRecord, SceneSignature
from sumo_adv.planners.text import parse_parameters

SHIPPED = Path(__file__).parents[1] / "memory_bank"

BRAKING = IntentRecord("Emergency Braking", "The vehicle ahead of the ego brakes hard without warning.", ("leader",))
CUT_IN = IntentRecord(
    "Aggressive Cut-in", "A vehicle beside the ego moves sharply into the gap in front of it.", ("neighbour", "leader")
)
BRAKE_PLANNER = Planner(
    "Emergency Braking",
    "plain",
    'PARAMETERS = {"hardness": (6.0, 2.0, 8.0, "m/s2", "how hard")}\n',
    (Parameter("hardness", 6.0, 2.0, 8.0, "m/s2", "how hard"),),
    "seed",
)
CUT_PLANNER = Planner("Aggressive Cut-in", "side", "PARAMETERS = {}\n", (), "expert")


@lru_cache
def shipped_planners() -> dict[tuple[str, str], Planner]:
    """The planners of ``memory_bank/`` by label and mode, shared texts filled in."""
    return {(p.label, p.mode): p for stored in read_folder(SHIPPED, parse_parameters) for p in stored.planners}


def evidence(**changes: object) -> Evidence:
    """A valid collision by BRAKE_PLANNER, with fields changed as given."""
    sample = Evidence(
        label="Emergency Braking",
        planner_hash=BRAKE_PLANNER.hash,
        scene=SceneSignature("straight", "leader", {"gap": 12.5, "closing": -1.25}, "idm"),
        attempts=3,
        min_ttc=0.0,
        collided=True,
        critical=True,
        feasible=True,
        rear_end=False,
        valid=True,
        strict=False,
        version="0.1.0",
        network="straight3",
        seed=7,
        parameters={"hardness": 7.5},
        acceleration=-6.0,
        delay=1.5,
    )
    return replace(sample, **changes)  # type: ignore[arg-type]


def write(path: Path, count: int, name: str) -> None:
    """Record ``count`` pieces of evidence, numbered by their seeds, for ever if 0."""
    with MemoryBank.open(path) as bank:
        number = 0
        while count == 0 or number < count:
            bank.record(evidence(seed=number, network=name), intent=BRAKING, planner=BRAKE_PLANNER)
            number += 1
            sys.stdout.write(f"{number}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    write(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
