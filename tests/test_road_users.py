"""Pedestrians and cyclists: sizes, limits, injury risk, line of sight, ways and planners."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from cli_samples import ROOT
from metrics_tracks import TIME, car, cruise
from situation_samples import EGO_PATH, situation
from sumo_samples import make_spec, vehicle

from sumo_adv.agents.scene_text import Aliases, relative_words, road_words
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Boxes, Level, Track, VehicleState
from sumo_adv.drivers import CarefulEgo, Observation, Vehicle
from sumo_adv.episode.memory_access import unprotected_library
from sumo_adv.episode.unprotected import crossing_risk, unprotected_ways
from sumo_adv.geometry import Pose
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import build, read_folder
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.gates import failed_gates, kinematic_gates
from sumo_adv.metrics.preventability import preventability
from sumo_adv.metrics.reference.view import hidden, seen
from sumo_adv.metrics.severity import TENTH_RISK_SPEED_KMH, crash, hardness, unprotected_risk
from sumo_adv.metrics.verdict import judge_attempt
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import is_trusted
from sumo_adv.planners.text import parse_parameters
from sumo_adv.planners.trial import trial
from sumo_adv.report.export.openscenario import kind
from sumo_adv.road_users import UNPROTECTED_LIMITS, RoadUser, road_user
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.situation import Target

PERSON, BICYCLE = {"length": 0.5, "width": 0.5}, {"length": 1.8, "width": 0.6}
NORTH = math.pi / 2


@dataclass
class Box:
    length: float
    width: float


@pytest.mark.parametrize(
    ("length", "width", "user"),
    [
        (0.215, 0.478, "pedestrian"), (0.6, 0.6, "pedestrian"), (1.2, 1.2, "pedestrian"), (1.6, 0.65, "cyclist"),
        (1.8, 0.8, "cyclist"), (2.1, 0.8, "vehicle"), (2.2, 0.9, "vehicle"), (5.0, 1.8, "vehicle"),
    ],
)  # fmt: skip
def test_the_size_says_what_a_road_user_is(length: float, width: float, user: str) -> None:
    """SUMO's pedestrian, a log's, the largest one; SUMO's bicycle, a log's; SUMO's moped, motorcycle and car."""
    assert road_user(Box(length, width)) == user


def test_settings_change_the_limits_of_vehicles_alone() -> None:
    limits = load_settings(None, limits={"braking": 6.0}).limits
    assert (limits.of(Box(5.0, 1.8)).braking, limits.of(Box(0.5, 0.5)).braking) == (6.0, 5.0)
    assert limits.of(Box(1.8, 0.6)) == UNPROTECTED_LIMITS[RoadUser.CYCLIST]


# ---- gates


def turning_on_the_spot(**size: float) -> Track:
    """It stands for a second, turns by a quarter in a tenth of a second, and sets off north at 2 s, with 1.5 m/s2."""
    pace = np.clip((TIME - 2.0) * 1.5, 0.0, 1.5)
    gone = np.concatenate([[0.0], np.cumsum((pace[1:] + pace[:-1]) / 2 * 0.1)])
    return car("adversary", 50.0, gone - 5.0, pace, np.where(TIME < 1.0, 0.0, NORTH), **size)


def test_a_pedestrian_turns_on_the_spot_and_a_car_does_not() -> None:
    for size, expected in ((PERSON, False), ({}, True)):
        track = turning_on_the_spot(**size)
        limits = load_settings().limits.of(track)
        broken = kinematic_gates(track.boxes(), track.acceleration, track.time, limits)
        assert any(steps.any() for steps in broken.values()) is expected


def test_a_pedestrian_may_be_beside_the_road() -> None:
    """The road is as wide as y = -3 to 3; the pedestrian comes from y = -5."""
    ego = cruise("ego", 0.0, 0.0, 10.0)
    for size, expected in ((PERSON, ()), ({"length": 2.6, "width": 1.2}, ("off_road",))):
        walks = cruise("adversary", 60.0, -5.0, 1.5, NORTH, **size)
        failed = failed_gates(
            walks,
            UNPROTECTED_LIMITS[RoadUser.PEDESTRIAN],
            on_road=lambda x, y: np.abs(y) < 3.0,
            ego=ego,
            others=(),
            end=3.0,
        )
        assert failed == expected


# ---- severity


def test_a_tenth_of_pedestrians_hit_at_29_kmh_and_of_cyclists_at_44_is_seriously_injured() -> None:
    pedestrian, cyclist = TENTH_RISK_SPEED_KMH[RoadUser.PEDESTRIAN], TENTH_RISK_SPEED_KMH[RoadUser.CYCLIST]
    assert unprotected_risk(pedestrian, 29.0 / 3.6) == pytest.approx(0.1)
    assert unprotected_risk(cyclist, 44.0 / 3.6) == pytest.approx(0.1)
    # 10 km/h more: odds 1/9 * exp(0.9) = 0.2733
    assert unprotected_risk(pedestrian, 39.0 / 3.6) == pytest.approx(0.2733 / 1.2733, abs=1e-4)


def test_the_impact_speed_is_along_the_normal() -> None:
    """A car of 5 m at 10 m/s meets a pedestrian that crosses at 1 m/s, with its front at x = 52.5 and t = 5 s."""
    ego = cruise("ego", 0.0, 0.0, 10.0)
    ahead = crash(ego, cruise("adversary", 52.75, -5.0, 1.0, NORTH, **PERSON), 5.0)
    assert ahead.impact_speed == pytest.approx(10.0) and ahead.ego_side == "front"
    assert hardness(ahead, RoadUser.PEDESTRIAN) == pytest.approx(36.0 / 29.0)
    beside = crash(ego, cruise("adversary", 50.0, -6.25, 1.0, NORTH, **PERSON), 5.0)
    assert beside.impact_speed == pytest.approx(1.0) and beside.ego_side == "right"
    assert crash(ego, cruise("adversary", 55.0, 0.0, 0.0), 5.0).impact_speed is None


# ---- line of sight, and when a driver notices


def boxes(x: float, y: float, length: float, width: float) -> Boxes:
    motion = np.array([[x]]), np.array([[y]]), np.zeros((1, 1)), np.zeros((1, 1))
    return Boxes(*motion, length, width)


@pytest.mark.parametrize(("y", "away"), [(0.0, True), (1.0, True), (2.6, False), (5.0, False)])
def test_a_van_hides_what_is_right_behind_it(y: float, away: bool) -> None:
    """The eye is at the origin, the van is at x = 8 to 12, y = -1 to 1: at x = 20 it hides up to y = 1 * 20 / 8 = 2.5.

    A person of 0.5 m at y = 2.6 has corners beyond that, at y = 1 none."""
    van = boxes(10.0, 0.0, 4.0, 2.0)
    screen = Boxes(van.x[None], van.y[None], van.heading[None], van.speed[None], 4.0, 2.0)
    sizes = {"length": np.full((1, 1, 1), 4.0), "width": np.full((1, 1, 1), 2.0)}
    is_hidden = hidden(boxes(0.0, 0.0, 5.0, 2.0), boxes(20.0, y, 0.5, 0.5), replace(screen, **sizes))
    assert is_hidden.tolist() == [[away]]


def crossing(start: float, **size: float) -> Track:
    """It leaves y = -9 at ``start`` [s] and walks north over the ego's path at x = 80, after 1 s with 1.5 m/s."""
    since = np.clip(TIME - start, 0.0, None)
    gone = np.where(since < 1.0, 0.75 * since**2, 1.5 * since - 0.75)
    return car("adversary", 80.0, gone - 9.0, np.clip(1.5 * since, 0.0, 1.5), NORTH, **size)


def parked(x: float, y: float) -> Track:
    """A van of 6 x 2 m."""
    return car("van", x, y, 0.0, length=6.0)


def test_a_careful_driver_notices_a_pedestrian_once_it_moves_towards_the_path_and_is_near() -> None:
    """The ego's front is at 10 t + 2.5; 2 s from the pedestrian's near edge (79.75) it is at t = 5.725, seen at 5.8.
    A van at x = 73 to 79 with its left side at y = -2.5 hides the pedestrian up to y = -2.9, until 6.4 s; 0.4 s later
    it is perceived, too late."""
    ego, walks = cruise("ego", 0.0, 0.0, 10.0), crossing(1.9, **PERSON)
    contact = 7.8
    open_, behind = (preventability(Case(ego, walks, others, 2.0), contact) for others in ((), (parked(76.0, -3.5),)))
    assert open_.alarms["cc_human"] == pytest.approx(5.8) and open_.answers["cc_human"] == "avoids"
    assert behind.alarms["cc_human"] == pytest.approx(6.9, abs=0.15) and behind.answers["cc_human"] == "collides"


def test_a_lorry_that_moves_away_hides_no_more() -> None:
    """A lorry of 4 m by 6 m at x = 10 hides up to y = 3 * 20 / 8 = 7.5 at x = 20. Then it is at y = 20. Reference
    drivers do not see the person behind it, and see a car there."""
    still = np.zeros((1, 2))
    ego, person = Boxes(still, still, still, still, 5.0, 2.0), Boxes(still + 20.0, still, still, still, 0.5, 0.5)
    y = np.array([[[0.0, 20.0]]])
    lorry = Boxes(0.0 * y + 10.0, y, 0.0 * y, 0.0 * y, np.full((1, 1, 1), 4.0), np.full((1, 1, 1), 6.0))
    assert hidden(ego, person, lorry).tolist() == [[True, False]]
    assert np.isnan(seen(ego, person, lorry).x).tolist() == [[True, False]]
    a_car = replace(person, length=4.5, width=1.8)
    assert hidden(ego, a_car, lorry).tolist() == [[True, False]] and not np.isnan(seen(ego, a_car, lorry).x).any()


def test_vehicles_are_noticed_whatever_is_in_the_way() -> None:
    """The reference drivers' sources know no occlusion: for a car the van changes nothing."""
    ego, crosses = cruise("ego", 0.0, 0.0, 10.0), crossing(1.9, length=4.5, width=1.8)
    alarms = [preventability(Case(ego, crosses, others, 2.0), 7.6).alarms for others in ((), (parked(68.0, -4.5),))]
    assert alarms[0] == alarms[1]


class Hides:
    """Senses of a step in which one road user is hidden."""

    def visible(self, vehicle: str) -> bool:
        return vehicle != "hidden"


def test_the_careful_ego_does_not_see_through_a_van() -> None:
    """It brakes for the pedestrian that walks into its lane if that one is in sight."""
    speeds = {}
    for name in ("seen", "hidden"):
        ego = CarefulEgo()
        for k in range(20):
            walker = Vehicle(name, 22.0, -4.0 + 0.15 * k, NORTH, 1.5, 0.0, 0.5, 0.5, "", senses=Hides())  # type: ignore[arg-type]
            me = VehicleState("ego", 0.0, 0.0, 0.0, 10.0, 0.0, 5.0, 2.0, "")
            speeds[name] = ego.act(Observation(0.1 * k, 0.1, me, (walker,), 0.0, 0.0, None, None))
    assert speeds["seen"] is not None and speeds["hidden"] is None


def test_serious_depends_on_the_impact_speed() -> None:
    """The front of the ego meets the pedestrian at 10 m/s, which is more than 8.06; at 7 m/s it is strict."""
    for speed, expected in ((10.0, Level.SERIOUS), (7.0, Level.STRICT)):
        ego, walks = cruise("ego", 80.0 - 10.0 * speed, 0.0, speed), crossing(3.2, **PERSON)
        verdict = judge_attempt(Case(ego, walks, (), 2.0), limits=UNPROTECTED_LIMITS[RoadUser.PEDESTRIAN])
        assert verdict.collided and verdict.feasible
        assert verdict.impact_speed == pytest.approx(speed, abs=0.01) and verdict.humanlike
        assert verdict.level is expected


# ---- ways


def person(x: float, y: float, heading: float, speed: float, **size: float) -> VehicleState:
    return VehicleState("walker", x, y, heading, speed, 0.0, *({**PERSON, **size}).values(), "")


def test_one_that_stands_goes_straight_across() -> None:
    (way,) = unprotected_ways(person(60.0, -6.0, 0.0, 0.0), EGO_PATH)
    assert way.movement == "across" and way.conflict is not None
    assert (way.conflict.bv_s, way.conflict.ego_s) == pytest.approx((6.0, 60.0), abs=0.5)
    assert way.conflict.angle == pytest.approx(NORTH, abs=0.01)


@pytest.mark.parametrize(("size", "speed"), [(PERSON, 1.4), (BICYCLE, 4.5)])
@pytest.mark.parametrize(("y", "heading"), [(-6.0, math.pi), (6.0, 0.0)])
def test_one_that_moves_has_ways_that_begin_as_it_moves_and_that_it_can_follow(
    size: dict[str, float], speed: float, y: float, heading: float
) -> None:
    state = person(60.0, y, heading, speed, **size)
    ways = unprotected_ways(state, EGO_PATH)
    assert [w.movement for w in ways] == ["along"] + ["across"] * 5
    limits = UNPROTECTED_LIMITS[road_user(state)]
    for way in ways:
        assert (way.path.x[0], way.path.y[0]) == pytest.approx((60.0, y))
        assert math.cos(way.path.heading[0] - heading) > math.cos(0.1)
        assert np.abs(way.path.curvature).max() <= limits.curvature
        assert (way.path.speed**2 * np.abs(way.path.curvature)).max() <= limits.lateral
    meets = [w.conflict.bv_s for w in ways[1:] if w.conflict is not None]
    assert np.diff(meets) == pytest.approx([speed] * 4, abs=0.5)


def test_it_is_dangerous_if_it_can_be_in_the_way_before_the_ego() -> None:
    """The ego is 60 m away at 10 m/s: 6 s. A pedestrian 6 m beside its path needs 0.5 + 6 / 4 = 2 s."""
    ego = VehicleState("ego", 0.0, 0.0, 0.0, 10.0, 0.0, 5.0, 2.0, "")
    near, soon = person(60.0, -6.0, 0.0, 0.0), person(18.0, -6.0, 0.0, 0.0)
    assert crossing_risk(unprotected_ways(near, EGO_PATH), near, ego) == pytest.approx(0.95 * math.exp(-0.25), abs=0.02)
    assert crossing_risk(unprotected_ways(soon, EGO_PATH), soon, ego) == 0.0


def test_intents_apply_by_what_it_is() -> None:
    state = person(60.0, -6.0, 0.0, 0.0)
    target = Target(state, "crossing", unprotected_ways(state, EGO_PATH), 0.0, 0.0, 0.0, ())
    assert target.applies() == ("pedestrian",) and target.fastest == 4.0
    assert replace(target, hidden=True).applies() == ("pedestrian", "pedestrian_hidden")


def test_prompts_say_what_it_is() -> None:
    state = person(60.0, -6.0, 0.0, 0.0)
    given = situation([Target(state, "crossing", unprotected_ways(state, EGO_PATH), 0.0, 0.0, 0.0, (), hidden=True)])
    aliases = Aliases.of(given)
    words = relative_words(given, aliases, {"Steps Out": ["pedestrian"], "Cut-in": ["neighbour"]})
    assert "60.0 m ahead, 6.0 m to the right, hidden from EGO now. It is a pedestrian: at most 4 m/s" in words
    assert "serious where it is hit at 8.1 m/s" in words and "apply: Steps Out." in words
    assert "BV1 going across: crosses EGO's path at (60.0," in road_words(given, aliases)


# ---- the shipped planners


def test_the_shipped_bank_is_built_from_its_text_and_its_planners_are_trusted(tmp_path: Path) -> None:
    build(ROOT / "unprotected_bank", tmp_path / "built.sqlite", parse_parameters)
    with (
        MemoryBank.open(tmp_path / "built.sqlite", read_only=True) as built,
        MemoryBank.open(ROOT / "unprotected_bank.sqlite", read_only=True) as shipped,
    ):
        assert built.content_hash() == shipped.content_hash()
    planners = [p for entry in unprotected_library() for p in entry.planners]
    assert len(planners) == 9 and all(is_trusted(p) for p in planners)


def test_every_planner_passes_its_trial() -> None:
    with Sandbox() as sandbox:
        for source in read_folder(ROOT / "unprotected_bank", parse_parameters):
            for planner in source.planners:
                assert trial(sandbox, planner, source.intent.applies) is None


# ---- SUMO, and files


def test_sumos_drivers_brake_for_a_bicycle_where_bicycles_are_not_allowed(tmp_path: object) -> None:
    """On the car lane of the street it would be on no lane, and the car would drive through it."""
    bicycle = '<vType id="bicycle" vClass="bicycle" length="1.8" width="0.6" maxSpeed="5"/>'
    spec = make_spec(tmp_path, "urban_street", [  # type: ignore[arg-type]
        bicycle, vehicle("car", "eastbound", 2, 50.0, 13.0), vehicle("rider", "eastbound", 1, 110.0, 5.0, "bicycle"),
    ])  # fmt: skip
    simulation = Simulation(spec)
    try:
        for k in range(60):
            simulation.inject({"rider": Pose(100.0 + 0.4 * k, -1.6, 0.0, 4.0)})
            simulation.step()
        raw = simulation.read().raw
        assert raw["rider"][4] == "eastbound_2" and raw["car"][3] < 8.0
        assert simulation.vehicle_class("rider") == "bicycle"
    finally:
        simulation.close()


def test_exports_know_a_pedestrian_that_attacks() -> None:
    assert [kind(crossing(2.0, **size)) for size in (PERSON, BICYCLE, {})] == ["pedestrian", "bicycle", "car"]
