"""A sweep over an attack's numbers: which points are measured, the border, the picture, and the command."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence

import numpy as np
import pytest
from cli_samples import Program

from sumo_adv.regression.sweep import Axis, Index, Point, PointResult, Sweep, border, changes_nothing, swept
from sumo_adv.report.figures import save
from sumo_adv.report.sweep_figure import draw_sweep


class Driver:
    """Fails where the sum of the indices is below a limit."""

    def __init__(self, limit: int) -> None:
        self.limit, self.measured = limit, list[Index]()

    def __call__(self, some: Sequence[Index]) -> list[Point]:
        self.measured += some
        return [Point(PointResult.FAIL if sum(i) < self.limit else PointResult.PASS) for i in some]


def test_only_points_between_different_results_are_measured() -> None:
    """17 points, failing below 6. First 0, 4, 8, 12, 16; between 4 and 8 then 6; between 4 and 6 then 5."""
    driver = Driver(6)
    points = swept(driver, 1, 17)
    assert driver.measured == [(0,), (4,), (8,), (12,), (16,), (6,), (5,)]
    assert [k for (k,), p in points.items() if p.result is PointResult.FAIL] == [0, 1, 2, 3, 4, 5]
    assert border(points) == [(5.5,)]
    assert not points[1,].measured and points[5,].measured


def test_with_two_numbers_the_refined_grid_has_the_results_of_the_whole_one() -> None:
    """The border is a diagonal, so that cells along it are refined and corners are not."""
    few, every = Driver(9), Driver(9)
    refined, whole = swept(few, 2, 17), swept(every, 2, 17, whole=True)
    assert {i: p.result for i, p in refined.items()} == {i: p.result for i, p in whole.items()}
    assert len(every.measured) == 17 * 17 and len(few.measured) < 120


def test_points_that_do_not_halve_are_a_whole_grid() -> None:
    driver = Driver(3)
    swept(driver, 1, 6)
    assert len(driver.measured) == 6


def test_a_border_passes_over_points_without_a_result() -> None:
    """Pass, pass, invalid, fail: half-way between 1 and 3. At the end, nothing follows the last invalid point."""
    results = [PointResult.PASS, PointResult.PASS, PointResult.INVALID, PointResult.FAIL, PointResult.INVALID]
    assert border({(k,): Point(result) for k, result in enumerate(results)}) == [(2.0,)]


def test_the_document_has_the_border_in_numbers() -> None:
    """Gap from 5 to 20 m in 16 points: 1 m apart, so 5.5 steps are 10.5 m."""
    done = Sweep("cut", (Axis("gap", 5.0, 20.0, "m"),), 16, {"idm": swept(Driver(6), 1, 16)})
    assert done.document()["drivers"]["idm"]["border"] == [{"gap": 10.5}]
    assert done.rows()[0] == {
        "driver": "idm", "gap": 5.0, "result": "fail", "level": "none", "min_ttc": None, "delta_v": None,
        "measured": True,
    }  # fmt: skip


def test_the_lines_say_the_share_of_passes_and_the_border() -> None:
    """With two numbers of 5 points each, the sum of the indices is below 3 at 6 of 25 points.

    Its border is half a step from the points (0, 2) and (2, 0), so at most 2.5 steps of 1 m along each axis.
    """
    gap, slower = Axis("gap", 5.0, 9.0, "m"), Axis("slower", 0.0, 4.0, "m/s")
    one = Sweep("cut", (gap,), 5, {"idm": swept(Driver(3), 1, 5)})
    assert one.lines(["gap"]) == [
        "idm: 2 pass, 3 fail, 0 invalid, 0 no encounter, 0 error (40 % pass); 5 of 5 points were measured.",
        "  border at gap = 7.5 m",
    ]
    two = Sweep("cut", (gap, slower), 5, {"idm": swept(Driver(3), 2, 5)})
    first, second = two.lines(["gap", "slower"])
    assert "(76 % pass); 25 of 25" in first
    assert second == "  border at gap from 5 to 7.5 m, slower from 0 to 2.5 m/s"


def test_a_number_that_changes_nothing_for_a_driver_is_named_with_the_others() -> None:
    """The second driver's min TTC differs in the fifth digit, so the number changes something."""
    same = Point(PointResult.FAIL, min_ttc=1.0192, delta_v=1.8161)
    drivers = {
        "mine": {(k,): same for k in range(3)},
        "idm": {(k,): Point(PointResult.FAIL, min_ttc=1.0192 + k * 1e-5, delta_v=1.8161) for k in range(3)},
    }
    lines = Sweep("cut", (Axis("ahead", 12.0, 50.0, "m"),), 3, drivers).lines(["ahead", "slower", "delay"])
    assert lines[1] == "  ahead changes nothing for mine; the case also has slower, delay"
    assert lines[3] == "  no border in the range"
    assert not changes_nothing({(k,): Point(PointResult.NO_ENCOUNTER) for k in range(3)})


@pytest.mark.parametrize("axes", [1, 2])
def test_a_picture_of_one_number_and_of_two(axes: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    values = [np.linspace(5.0, 20.0, 5)] * axes
    results = np.where(np.add.reduce(np.indices((5,) * axes)) < 3, 1.0, 0.0)
    picture = draw_sweep("cut", ["gap [m]", "speed [m/s]"][:axes], values, {"mine": results, "careful": 0.0 * results})
    target = tmp_path_factory.mktemp("picture") / "sweep.svg"
    save(picture, target, "svg")
    assert "<svg" in target.read_text()


def test_a_run_is_swept_from_the_command_line(program: Program) -> None:
    found = ("--until", "collision", "--learn", "off", "--ego", "idm", "--out", "run")
    assert program.here("run", "leader_brakes_hard", *found).status == 0
    options = ("--ego", "idm", "--points", "3", "--out", "swept")
    done = program.here("sweep", "run", "--over", "acceleration=-8:-1", *options, "--json")
    assert done.status == 0, done.err
    told = json.loads(done.out)
    assert list(told["drivers"]) == ["idm", "careful"] and told["drivers"]["careful"]["measured"] == 3
    with (program.folder / "swept" / "sweep.csv").open(newline="") as text:
        assert [float(r["acceleration"]) for r in csv.DictReader(text)] == [-8.0, -4.5, -1.0] * 2
    assert (program.folder / "swept" / "sweep.png").is_file()
    for over, why in (
        (["gap"], "takes NAME=LOW:HIGH"), (["delay=3:1"], "a LOW below its HIGH"),
        (["size=1:2"], "has no number 'size'"),
        (["acceleration=-20:0"], "goes from -12 to 8 m/s2"), (["delay=0:1"] * 2, "names 'delay' twice"),
        (["delay=0:1"] * 3, "one number or two"),
    ):  # fmt: skip
        refused = program.here(
            "sweep", "run", *(word for each in over for word in ("--over", each)), "--ego", "idm", "--out", "other"
        )
        assert refused.status == 2 and why in refused.err, refused.err
    again = program.here("sweep", "run", "--over", "delay=0:1", *options)
    assert (again.status, "holds a sweep already" in again.err) == (2, True)
