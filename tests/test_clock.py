"""Where the wall time of a run goes: each second counts for one part, and the parts come to the total."""

from __future__ import annotations

import json

import pytest
from cli_samples import Program

from sumo_adv.episode.clock import PartsClock


class Hands:
    """The hands of a clock that are moved by hand [s]."""

    def __init__(self) -> None:
        self.at = 0.0

    def __call__(self) -> float:
        return self.at


def test_a_second_within_a_nested_part_counts_for_that_part_alone() -> None:
    """Attempts take 2 s, then reference drivers 3 s, then attempts 1 s more."""
    hands = Hands()
    clock = PartsClock(hands)
    with clock.part("attempts"):
        hands.at = 2.0
        with clock.part("references"):
            hands.at = 5.0
        hands.at = 6.0
    assert clock.seconds == {"references": 3.0, "attempts": 3.0}
    clock.move(1.0, "attempts", "robustness")
    assert clock.seconds == {"references": 3.0, "attempts": 2.0, "robustness": 1.0}


def test_a_part_that_an_error_ends_is_counted() -> None:
    hands = Hands()
    clock = PartsClock(hands)
    with pytest.raises(ValueError, match="late"), clock.part("attempts"):
        hands.at = 4.0
        raise ValueError("late")
    assert clock.seconds == {"attempts": 4.0}


@pytest.mark.parametrize("ego", ["idm", "ego_samples:BrakingEgo"])
def test_the_parts_of_a_run_come_to_its_total(program: Program, ego: str) -> None:
    """Each of the numbers is rounded to 0.1 ms."""
    done = program.here("run", "leader_two_lanes", "--ego", ego, "--attempts", "4", "--until", "valid", "--json")
    assert done.status == 0, done.err
    timing = {part: seconds for part, seconds in json.loads(done.out)["timing"].items() if part != "first_success"}
    total = timing.pop("total")
    assert sum(timing.values()) == pytest.approx(total, abs=1e-3)
    assert {"input", "start", "seek", "unattacked", "prediction", "attempts", "learning", "files"} <= timing.keys()
    assert min(timing.values()) >= 0.0
