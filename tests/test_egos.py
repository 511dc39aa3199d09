"""Ego controllers: stories with numbers worked out by hand."""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sumo_adv.datatypes import DriverModel, Role, Track, VehicleState
from sumo_adv.drivers import (
    CarefulEgo,
    LaneSpeed,
    Observation,
    Pose,
    ReplayEgo,
    Steer,
    apply_steer,
    make_ego,
    model_of,
)
from sumo_adv.drivers.protocol import read_wishes, wishes_of
from sumo_adv.drivers.registry import UserEgo, trusted_driver
from sumo_adv.errors import SimulationError, UsageError

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def car(
    id: str, x: float, y: float, heading: float = 0.0, speed: float = 0.0, acceleration: float = 0.0
) -> VehicleState:
    return VehicleState(id, x, y, heading, speed, acceleration, 5.0, 2.0, "")


# ---- SUMO's own drivers


def test_defaults_are_written_out_and_parameters_override() -> None:
    ego = make_ego("krauss", {"tau": 1.5})
    assert ego.sumo_type == {
        "carFollowModel": "Krauss", "tau": "1.5", "accel": "2.6", "decel": "4.5", "emergencyDecel": "9",
        "minGap": "2.5", "speedFactor": "1", "speedDev": "0", "sigma": "0",
    }  # fmt: skip
    assert not ego.needs_observation
    assert ego.forkable
    assert make_ego("idm", {}).sumo_type["carFollowModel"] == "IDM"
    assert make_ego("eidm", {}).sumo_type["sigmagap"] == "0"


@pytest.mark.parametrize(
    ("name", "parameters", "sentence"),
    [
        ("idm", {"sigma": 0.5}, "no parameter 'sigma'; it knows tau, accel"),
        ("krauss", {"tau": 0}, "'tau' to be above zero"),
        ("krauss", {"minGap": -1}, "'minGap' to be zero or more"),
        ("eidm", {"accel": "fast"}, "finite number for 'accel', not 'fast'"),
        ("idm", {"accel": math.nan}, "finite number for 'accel'"),
        ("careful", {"driver": "me"}, "no driver 'me'; choose one of krauss, idm, eidm"),
        ("wild", {}, "There is no ego 'wild'"),
    ],
)
def test_wrong_names_and_values_are_named(name: str, parameters: dict[str, object], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        make_ego(name, parameters)


@pytest.fixture
def polite(tmp_path: Path, user_module: str) -> str:
    """The class of an installed package with the entry point ``polite``."""
    (tmp_path / "theirs-1.0.dist-info").mkdir()
    (tmp_path / "theirs-1.0.dist-info" / "METADATA").write_text("Name: theirs\nVersion: 1.0\n")
    entry = f"[sumo_adv.drivers]\npolite = {user_module}:Good\n"
    (tmp_path / "theirs-1.0.dist-info" / "entry_points.txt").write_text(entry)
    return f"{user_module}:Good"


def test_drivers_of_other_packages_are_found_by_their_entry_point(polite: str) -> None:
    assert make_ego("polite", {"gain": 2.0}).name == polite
    with pytest.raises(
        UsageError, match="choose krauss, idm, eidm, blind, careful, fiss_plus, lattice, replay, polite or module:Class"
    ):
        make_ego("wild", {})


def test_a_file_alone_makes_no_class_drive_the_ego_however_it_names_it(polite: str) -> None:
    source = Path("case.toml")
    for name in (polite, "polite"):
        with pytest.raises(UsageError, match=f"case.toml wants the class '{name}' .* with --ego {name}"):
            trusted_driver(None, name, source)
        assert trusted_driver(name, name, source) == name
    assert trusted_driver(None, "idm", source) == "idm"
    assert trusted_driver("krauss", "polite", source) == "krauss"
    assert trusted_driver(None, None, source) is None


# ---- how drivers are predicted

NUMBERS = DriverModel("idm", 2.0, 4.0, 1.2, 2.0, 15.0, known=False)


@pytest.mark.parametrize("name", ["krauss", "idm", "eidm", "careful", "replay"])
def test_drivers_that_sumo_moves_are_predicted_by_their_kind_and_keep_its_lane_rules(name: str) -> None:
    model = model_of(make_ego(name, {}), NUMBERS)
    assert model == DriverModel(name, 2.0, 4.0, 1.2, 2.0, 15.0, known=True)


def test_the_lattice_driver_is_asked_and_not_predicted() -> None:
    assert model_of(make_ego("lattice", {}), NUMBERS) == NUMBERS
    assert not NUMBERS.known


def test_a_users_class_is_unknown_unless_it_says_how_it_is_predicted(user_module: str) -> None:
    assert model_of(make_ego(f"{user_module}:Good", {}), NUMBERS) == NUMBERS
    assert model_of(make_ego(f"{user_module}:Predicted", {}), NUMBERS) == replace(NUMBERS, kind="krauss")
    with pytest.raises(SimulationError, match="returned 'krauss'; model_of must return a DriverModel"):
        model_of(make_ego(f"{user_module}:Vague", {}), NUMBERS)


# ---- the bicycle


def test_straight_braking_and_standstill() -> None:
    after = apply_steer(car("ego", 0, 0, speed=10.0), Steer(-4.0, 0.0), dt=0.5)
    assert (after.x, after.y, after.speed, after.acceleration) == (4.5, 0.0, 8.0, -4.0)  # 10*0.5 - 4*0.25/2
    stopped = apply_steer(car("ego", 0, 0, speed=2.0), Steer(-8.0, 0.0), dt=1.0)
    assert (stopped.x, stopped.speed, stopped.acceleration) == (0.25, 0.0, -2.0)  # 4 / 16, not backwards


def test_full_left_is_a_circle() -> None:
    # tan 0.5 = 0.546302, slip = atan(0.273151) = 0.266659, curvature = cos(slip) * 0.546302 / 2.8 = 0.188213 1/m
    state, steer = car("ego", 0, 0, speed=5.0), Steer(0.0, 0.5)
    turned = apply_steer(state, steer, dt=0.1)
    assert turned.heading == pytest.approx(0.188213 * 0.5, abs=1e-6)
    around = 2 * math.pi / 0.188213 / 5.0
    for _ in range(100):
        state = apply_steer(state, steer, dt=around / 100)
    assert math.hypot(state.x, state.y) < 1e-3
    assert abs(state.heading) < 1e-4


def test_pedals_and_wheel_are_limited() -> None:
    wild = apply_steer(car("ego", 0, 0, speed=10.0), Steer(50.0, -3.0), dt=0.1)
    assert wild == apply_steer(car("ego", 0, 0, speed=10.0), Steer(4.0, -0.6), dt=0.1)
    assert apply_steer(car("ego", 0, 0, speed=10.0), Steer(-50.0, 0.0), dt=0.1).speed == pytest.approx(9.1)


# ---- replay


def track(heading: list[float]) -> Track:
    time = np.array([0.0, 1.0, 2.0])
    zero = np.zeros(3)
    return Track("ego", Role.EGO, time, 10 * time, zero, np.array(heading), np.full(3, 10.0), zero, 5.0, 2.0)


def test_replay_answers_with_the_end_of_the_step() -> None:
    ego = ReplayEgo()
    look = Observation(0.4, 0.1, car("ego", 4, 0), ())
    assert ego.act(look) is None  # nothing loaded: the unattacked run, SUMO drives
    ego.load(track([0.0, 0.2, 0.2]))
    pose = ego.act(look)
    assert isinstance(pose, Pose)
    assert (pose.x, pose.y, pose.heading, pose.speed) == pytest.approx((5.0, 0.0, 0.1, 10.0))
    last = ego.act(Observation(7.0, 0.1, car("ego", 4, 0), ()))
    assert isinstance(last, Pose)
    assert (last.x, last.heading, last.speed) == pytest.approx((20.0, 0.2, 0.0))  # stands after its last


def test_replay_turns_the_short_way() -> None:
    ego = ReplayEgo()
    ego.load(track([3.1, -3.1, -3.1]))  # 0.083 rad across pi, not 6.2 back through zero
    pose = ego.act(Observation(0.4, 0.1, car("ego", 0, 0), ()))
    assert isinstance(pose, Pose)
    assert abs(pose.heading) == pytest.approx(math.pi, abs=1e-9)


# ---- the careful driver


def drive(ego: CarefulEgo, scene: list[list[VehicleState]]) -> list[LaneSpeed | None]:
    """Its actions; each scene's first vehicle is the ego; steps of 0.1 s."""
    answers = []
    for step, (me, *others) in enumerate(scene):
        action = ego.act(Observation(step / 10, 0.1, me, others))
        assert action is None or isinstance(action, LaneSpeed)
        answers.append(action)
    return answers


def test_a_standing_car_is_braked_for_after_the_reaction_time() -> None:
    # 40 m ahead in the lane: 20^2 / (2 * 35) = 5.7 m/s2 > 4.5, understood after 0.4 s, braked for 0.75 s later
    scene = [[car("ego", 0, 0, speed=20.0), car("bv", 40, 0)] for _ in range(20)]
    answers = drive(CarefulEgo(), scene)
    assert answers[:11] == [None] * 11  # steps that end at 1.1 s or before
    # over the step 1.1..1.2 s only 0.05 s of the ramp: 7.593 / 0.6 * 0.05^2 / 2 = 0.0158 m/s
    assert answers[11] is not None and answers[11].speed == pytest.approx(20 - 0.0158, abs=1e-4)
    assert answers[18] is not None and answers[18].speed == pytest.approx(20 - 0.7593, abs=1e-4)  # full from 1.75 s


def test_standing_with_the_danger_still_there_it_holds() -> None:
    scene = [[car("ego", 0, 0, speed=20.0), car("bv", 40, 0)]] * 20 + [[car("ego", 33, 0), car("bv", 40, 0)]] * 5
    assert drive(CarefulEgo(), scene)[-1] == LaneSpeed(None, 0.0)


def test_following_and_overtaking_do_not_alarm() -> None:
    following = [[car("ego", 2 * s, 0, speed=20.0), car("bv", 25 + 2 * s, 0, speed=20.0)] for s in range(40)]
    assert drive(CarefulEgo(), following) == [None] * 40  # one second behind its leader
    passing = [[car("ego", 2 * s, 0, speed=20.0), car("bv", 20 + s, 3.2, speed=10.0)] for s in range(40)]
    assert drive(CarefulEgo(), passing) == [None] * 40


def test_a_cut_in_is_a_danger_half_a_metre_after_0_375_m() -> None:
    """1 m/s sideways, 10 m/s slower, 20 m ahead: 0.1 m a step, past 0.375 m at 0.4 s and 0.5 m
    beyond that at 0.9 s, reached in 1.5 s."""
    ego, dangers = CarefulEgo(), []
    for step in range(12):
        others = [car("bv", 20 + 1.0 * step, 3.2 - 0.1 * step, heading=-0.1, speed=10.0)]
        ego.act(Observation(step / 10, 0.1, car("ego", 2.0 * step, 0, speed=20.0), others))
        dangers.append(ego.dangers)
    assert dangers.index(frozenset({"bv"})) == 9
    assert dangers[9:] == [frozenset({"bv"})] * 3


@pytest.mark.parametrize(("sideways", "alarmed"), [(0.0, False), (1.5, True)])
def test_an_oncoming_car_is_a_danger_only_over_the_line(sideways: float, alarmed: bool) -> None:
    ego, seen = CarefulEgo(), False
    for step in range(30):
        h = 0.1 - math.pi if sideways else math.pi
        bv = car("bv", 100 - 1.5 * step, 3.2 - sideways * step / 10, heading=h, speed=15.0)
        ego.act(Observation(step / 10, 0.1, car("ego", 1.5 * step, 0, speed=15.0), [bv]))
        seen |= bool(ego.dangers)
    assert seen is alarmed


@pytest.mark.parametrize(("speed", "alarmed"), [(12.0, True), (5.0, False)])
def test_a_crossing_car_is_a_danger_once_it_cannot_stop_short(speed: float, alarmed: bool) -> None:
    """Both would be at x = 28 m after 2 s. 12 m/s needs 144 / 6 = 24 m, 5 m/s 4.2 m; 24.5 m are left at first."""
    ego = CarefulEgo()
    for step in range(6):
        bv = car("bv", 28, -28 + speed * step / 10, math.pi / 2, speed)
        ego.act(Observation(step / 10, 0.1, car("ego", 1.4 * step, 0, speed=14.0), [bv]))
    assert bool(ego.dangers) is alarmed


# ---- a user's class

USER = """
class Good:
    def __init__(self, gain=1.0): self.gain = gain
    def reset(self, seed): self.seed = seed
    def act(self, seen): return None
class Breaks(Good):
    def reset(self, seed): raise RuntimeError("no road")
    def act(self, seen): return 1 / 0
class Text(Good):
    def act(self, seen): return "left"
class Wild(Good):
    def act(self, seen):
        from sumo_adv.drivers import Steer
        return Steer(float("nan"), 0.0)
class NoAct:
    def reset(self, seed): pass
class Looks(Good):
    needs_road = True

class Predicted(Good):
    def model_of(self, numbers):
        from dataclasses import replace
        return replace(numbers, kind="krauss")
class Vague(Good):
    def model_of(self, numbers): return "krauss"

class Touches:
    def __init__(self, path):
        open(path, "w").close()

from threading import Thread
Number = 3
"""


@pytest.fixture
def user_module(tmp_path: Path) -> Iterator[str]:
    (tmp_path / "users_own_egos.py").write_text(USER, encoding="utf-8")
    sys.path.insert(0, str(tmp_path))
    yield "users_own_egos"
    sys.path.remove(str(tmp_path))
    sys.modules.pop("users_own_egos", None)


LOOK = Observation(3.0, 0.1, car("ego", 0, 0), ())


def test_a_users_class_drives(user_module: str) -> None:
    ego = make_ego(f"{user_module}:Good", {"gain": 2.0})
    ego.reset(1)
    assert ego.act(LOOK) is None
    assert (ego.name, ego.forkable, ego.needs_observation) == ("users_own_egos:Good", False, True)
    assert ego.sumo_type["carFollowModel"] == "IDM"


@pytest.mark.parametrize(
    ("name", "parameters", "sentence"),
    [
        ("Missing", {}, "has no class 'Missing'"),
        ("Number", {}, "has no class 'Number'"),
        ("NoAct", {}, "has no method 'act'"),
        ("Good", {"speed": 1}, "could not be made: TypeError: .*speed"),
    ],
)
def test_a_users_class_that_cannot_be_used(
    user_module: str, name: str, parameters: dict[str, float], sentence: str
) -> None:
    with pytest.raises(UsageError, match=sentence):
        make_ego(f"{user_module}:{name}", parameters)


@pytest.mark.parametrize("name", ["subprocess:Popen", "unittest.mock:MagicMock", "users_own_egos:Thread"])
def test_a_class_of_pythons_own_is_refused_before_it_is_made(user_module: str, tmp_path: Path, name: str) -> None:
    proof = tmp_path / "proof"
    with pytest.raises(UsageError, match="is a class of Python's standard library: name a class of your own"):
        make_ego(name, {"args": f"touch {proof}", "shell": True})
    assert not proof.exists()


def test_a_class_without_the_methods_is_never_made(user_module: str, tmp_path: Path) -> None:
    proof = tmp_path / "proof"
    with pytest.raises(UsageError, match="has no method 'reset'"):
        make_ego(f"{user_module}:Touches", {"path": str(proof)})
    assert not proof.exists()


def test_a_users_class_may_ask_for_the_road(user_module: str) -> None:
    assert [wishes_of(make_ego(f"{user_module}:{n}", {})).needs_road for n in ("Good", "Looks")] == [False, True]


@pytest.mark.parametrize(
    ("attributes", "sentence"),
    [
        ({"wheelbase": 0.0}, "has wheelbase = 0.0; it must be a finite number above zero"),
        ({"max_braking": math.inf}, "has max_braking = inf; it must be"),
        ({"max_acceleration": "4"}, "has max_acceleration = '4'; it must be"),
        ({"max_steering": 1.6}, "has max_steering = 1.6 rad; it must be below pi / 2"),
    ],
)
def test_a_bicycle_that_cannot_be(attributes: dict[str, object], sentence: str) -> None:
    driver = type("Driver", (), attributes)()
    with pytest.raises(UsageError, match=sentence):
        read_wishes(driver, "mine:Driver")


def test_a_drivers_bicycle_moves_its_car() -> None:
    """Twice the wheelbase turns half as far: 10 m/s for 0.1 s at tan d = 0.28 are 1 m x 0.28 / 5.6 m = 0.05 rad, times
    the cosine of the slip, atan(0.14). With the centre on the rear axle there is no slip."""
    steer, state = Steer(0.0, math.atan(0.28)), car("ego", 0, 0, speed=10.0)
    long = read_wishes(type("Driver", (), {"wheelbase": 5.6})(), "mine:Driver").bicycle
    assert apply_steer(state, steer, 0.1, long).heading == pytest.approx(0.05 * math.cos(math.atan(0.14)))
    behind = replace(long, rear_axle=1e-9)
    assert apply_steer(state, steer, 0.1, behind).heading == pytest.approx(0.05)
    weak = replace(long, max_braking=3.0, max_acceleration=1.0)
    assert apply_steer(state, Steer(-9.0, 0.0), 0.1, weak).speed == pytest.approx(9.7)
    assert apply_steer(state, Steer(9.0, 0.0), 0.1, weak).speed == pytest.approx(10.1)


def test_a_module_that_is_not_there() -> None:
    with pytest.raises(UsageError, match=r"could not be imported .*ModuleNotFoundError"):
        make_ego("no_such_module_anywhere:Driver", {})
    with pytest.raises(UsageError, match="not of the form 'module:Class'"):
        make_ego("module:", {})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("import argparse\nargparse.ArgumentParser(prog='me').parse_args(['--x'])\n",
         "reads the command line when it is imported (SystemExit: 2; it wrote 'me: error: unrecognized arguments: "
         "--x'): "
         "put that code below if __name__ == '__main__'."),
        ("import getopt\ngetopt.getopt(['-x'], '')\n",
         "reads the command line when it is imported (GetoptError: option -x not recognized)"),
        ("print('no licence')\nraise SystemExit(3)\n",
         "ends the program when it is imported (SystemExit: 3; it wrote 'no licence')"),
        ("class Stop(BaseException): ...\nraise Stop('here')\n", "Python's path: Stop: here."),
        ("import sys\nprint('loading w.pt', file=sys.stderr)\nopen('w.pt')\n", "it wrote 'loading w.pt'."),
    ],
)  # fmt: skip
def test_a_module_that_ends_when_it_is_imported_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], text: str, says: str
) -> None:
    (tmp_path / "ends_early.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UsageError) as refused:
        make_ego("ends_early:Driver", {})
    assert str(refused.value).startswith("The module of the ego 'ends_early:Driver' ") and says in str(refused.value)
    assert capsys.readouterr() == ("", "")  # the sentence is all


def test_what_a_module_prints_goes_to_stderr(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also a logger that is set up at import goes on: it keeps the stream that it found."""
    text = "import logging\nlogging.getLogger('talks').addHandler(logging.StreamHandler())\nprint('hello')\n"
    (tmp_path / "talks.py").write_text(text + USER, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    make_ego("talks:Good", {"gain": 2.0})
    assert capsys.readouterr() == ("", "hello\n")
    logging.getLogger("talks").warning("still here")
    assert capsys.readouterr().err == "still here\n"


def test_a_users_errors_are_one_sentence(user_module: str) -> None:
    breaks = make_ego(f"{user_module}:Breaks", {})
    place = r"\(users_own_egos\.py, line \d+\)\."
    with pytest.raises(SimulationError, match=rf"Breaks' failed in reset: RuntimeError: no road {place}"):
        breaks.reset(0)
    with pytest.raises(SimulationError, match=rf"failed in act at 3\.0 s: ZeroDivisionError: division by zero {place}"):
        breaks.act(LOOK)
    with pytest.raises(SimulationError, match="returned str; act must return Steer, LaneSpeed, Pose or None"):
        make_ego(f"{user_module}:Text", {}).act(LOOK)
    with pytest.raises(SimulationError, match="its numbers must be finite"):
        make_ego(f"{user_module}:Wild", {}).act(LOOK)
    with pytest.raises(UsageError, match=r"has no class 'Wilt' .*; it has .*Breaks.*Wild"):
        make_ego(f"{user_module}:Wilt", {})
    with pytest.raises(UsageError, match="names a file; name its module: my_driver:Acc"):
        make_ego("my_driver.py:Acc", {})


class Numpy:
    """Answers always the same."""

    def __init__(self, answer: object) -> None:
        self.answer = answer

    def reset(self, seed: int) -> None: ...

    def act(self, seen: Observation) -> object:
        return self.answer


def test_numbers_of_numpy_are_numbers() -> None:
    def answered(action: object) -> object:
        return UserEgo("mine:Numpy", Numpy(action)).act(LOOK)

    assert answered(Steer(np.float32(0.5), np.array(0.25))) == Steer(0.5, 0.25)  # type: ignore[arg-type]
    assert answered(LaneSpeed(np.int64(1), 3)) == LaneSpeed(1, 3)  # type: ignore[arg-type]
    whole = answered(LaneSpeed(np.float64(1), 3.0))  # type: ignore[arg-type]
    assert isinstance(whole, LaneSpeed) and type(whole.lane) is int and whole.lane == 1
    with pytest.raises(SimulationError, match=r"returned the lane 1\.5 at 3\.0 s; give its index\."):
        answered(LaneSpeed(1.5, 3.0))  # type: ignore[arg-type]
    with pytest.raises(SimulationError, match=r"one of its numbers has the type NoneType"):
        answered(LaneSpeed(1, None))  # type: ignore[arg-type]
    with pytest.raises(
        SimulationError, match=r"at 3\.0 s; one of its numbers has the type ndarray: use float\(\.\.\.\)"
    ):
        answered(Steer(np.array([0.0, 1.0]), 0.0))  # type: ignore[arg-type]


def test_attributes_of_a_type_may_be_numbers() -> None:
    class Idm(Numpy):
        sumo_type: object = {"carFollowModel": "IDM", "tau": 1.5}

    class Words(Numpy):
        sumo_type = "IDM"

    assert UserEgo("mine:Idm", Idm(None)).sumo_type == {"carFollowModel": "IDM", "tau": "1.5"}
    with pytest.raises(UsageError, match=r"'mine:Words' has a sumo_type of type str; give a dictionary\."):
        UserEgo("mine:Words", Words(None))


@pytest.fixture
def examples_on_path() -> Iterator[None]:
    sys.path.insert(0, str(EXAMPLES))
    yield
    sys.path.remove(str(EXAMPLES))


@pytest.mark.usefixtures("examples_on_path")
def test_the_example_brakes_for_what_is_near() -> None:
    ego = make_ego("cautious_ego:CautiousEgo", {"cruise": 15.0})
    ego.reset(0)
    assert ego.act(Observation(0, 0.1, car("ego", 0, 0, speed=10.0), [])) == LaneSpeed(None, 15.0)
    far = Observation(0, 0.1, car("ego", 0, 0, speed=10.0), [car("bv", 35, 0)])
    assert ego.act(far) == LaneSpeed(None, 10.0)  # 30 m / 3 s
    near = Observation(0, 0.1, car("ego", 0, 0, speed=10.0), [car("bv", 7, 1.0)])
    assert ego.act(near) == Steer(-8.0, -0.05)  # 2 m left, vehicle to the left: to the right
