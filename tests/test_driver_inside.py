"""What a driver shows of its inside: checked, recorded, in the run's folder, on the page and in an export."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from page_samples import make_run, meeting
from test_report_page import data_of, read_back

import sumo_adv
from sumo_adv import LaneSpeed, Observation, PlannedPose, Pose, Steer
from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import Action, UserEgo
from sumo_adv.errors import DriverError
from sumo_adv.report.page import make_page
from sumo_adv.report.read import read_run

EGO = VehicleState("ego", 0.0, 0.0, 0.0, 10.0, 0.0, 4.5, 1.8, "lane")


class Answering:
    def __init__(self, answer: Action) -> None:
        self.answer = answer

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> Action:
        return self.answer


def answered(answer: Action) -> Action:
    return UserEgo("answering", Answering(answer)).act(Observation(0.0, 0.1, EGO, ()))


def test_plans_and_notes_become_plain_numbers() -> None:
    steer = answered(Steer(np.float64(1.0), 0.0, plan=np.array([[1.0, 2.0, 9.0], [3.0, 4.0, 9.0]]), notes={"cost": 3}))  # type: ignore[arg-type]
    assert steer == Steer(1.0, 0.0, plan=((1.0, 2.0), (3.0, 4.0)), notes={"cost": 3.0})
    assert answered(LaneSpeed(None, 9.0, notes={"gap": 2.0})) == LaneSpeed(None, 9.0, notes={"gap": 2.0})
    pose = answered(PlannedPose(1.0, 0.0, 0.0, 10.0, plan=[(1.0, 0.0)]))
    assert isinstance(pose, Pose) and pose == PlannedPose(1.0, 0.0, 0.0, 10.0, plan=((1.0, 0.0),))


@pytest.mark.parametrize(
    ("plan", "notes", "sentence"),
    [
        ([1.0, 2.0], {}, "its plan must be finite points"),
        ([(0.0, float("nan"))], {}, "its plan must be finite points"),
        ([(0.0, 0.0)] * 1001, {}, "its plan has 1001 points; 1000 are the most"),
        (None, {"cost": float("inf")}, "its notes must be finite numbers"),
        (None, {str(k): 0.0 for k in range(21)}, "its notes must be a mapping of at most 20 names"),
    ],
)
def test_what_is_no_plan_or_note_is_refused_by_name(plan: object, notes: dict[str, float], sentence: str) -> None:
    with pytest.raises(DriverError, match=sentence):
        answered(Steer(0.0, 0.0, plan, notes))  # type: ignore[arg-type]


class Planning:
    """Keeps its speed and shows where it will be in 1, 2 and 3 s."""

    forkable = True

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> Steer:
        ego = seen.ego
        plan = [
            (ego.x + k * ego.speed * np.cos(ego.heading), ego.y + k * ego.speed * np.sin(ego.heading))
            for k in (1, 2, 3)
        ]
        return Steer(0.0, 0.0, plan=plan, notes={"speed": ego.speed})


def test_a_run_keeps_the_plan_of_each_step_of_the_attempt_that_counts(tmp_path: Path) -> None:
    """At the time of an answer the ego is as far before the first point of its plan as it goes in a second."""
    result = sumo_adv.run(
        "motorway_cut_in_left", ego=Planning, out=tmp_path / "run", memory=str(tmp_path / "bank.sqlite"), learn="off",
        attempts=2, seconds=20.0,
    )  # fmt: skip
    run = read_run(result.folder)
    ego = next(track for track in run.best if track.id == "ego")
    assert len(run.inside) >= len(ego.time) - 2
    shown = run.inside[len(run.inside) // 2]
    k = int(np.argmin(np.abs(ego.time - shown.time)))
    assert shown.notes["speed"] == pytest.approx(float(ego.speed[k]), abs=1e-3)
    assert shown.plan[0][0] - float(ego.x[k]) == pytest.approx(float(ego.speed[k] * np.cos(ego.heading[k])), abs=0.01)


def test_the_page_has_the_plan_of_a_frame_and_the_notes_by_name(tmp_path: Path) -> None:
    """The grid begins at 0.1 s, so an answer at 0.5 s is frame 4. Plans are in centimetres from the origin."""
    folder = make_run(tmp_path / "run", vehicles=2, frames=30, pose=meeting)
    lines = [
        {"time": 0.5, "plan": [[5.0, -1.6], [15.0, -1.6], [25.0, -1.6]], "notes": {"cost": 2.5}},
        {"time": 0.6, "plan": [], "notes": {"gap": 7.0}},
    ]
    content = "".join(json.dumps(line) + "\n" for line in lines)
    (folder / "driver.jsonl.gz").write_bytes(gzip.compress(content.encode()))
    scene = data_of(make_page(folder))["scene"]
    assert scene["plans"] == [[4, 3], [5, 0]]
    assert scene["notes"] == [["cost", [2.5, None]], ["gap", [None, 7.0]]]
    counts = [(3, 1), (0, 1), (3, 1), (0, 1)]
    numbers = read_back(scene["blob"], counts_before(scene) + counts)[-4:]
    x, y = scene["origin"]
    assert numbers == [[round(100 * (v - x)) for v in (5, 15, 25)], [], [round(100 * (-1.6 - y))] * 3, []]


def counts_before(scene: dict[str, object]) -> list[tuple[int, int]]:
    """Length and order of the columns before the plans."""
    attempts = scene["attempts"]
    segments = [s[1] for a in attempts for v in a["vehicles"] for s in v[4]]  # type: ignore[attr-defined]
    curves = [(a["curves"][1], 1) for a in attempts if a["curves"] for _ in range(6)]  # type: ignore[attr-defined]
    lines = [
        [(n, 1) for n in lengths]
        for lengths in (
            [each[0] for each in scene["lanes"]],  # type: ignore[attr-defined]
            [each[0] for each in scene["markings"]],  # type: ignore[attr-defined]
            [2 for _ in scene["stops"]],  # type: ignore[attr-defined]
        )
    ]
    return [(n, 2) for _ in range(3) for n in segments] + curves + [pair for each in lines for pair in each * 2]
