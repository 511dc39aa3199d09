"""The planner sandbox in honest use: calls, batches, helpers, determinism, limits, and a planner's text."""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from sumo_adv.datatypes import Planner
from sumo_adv.errors import (
    PlannerLimitError,
    PlannerResultError,
    PlannerRuntimeError,
    PlannerSyntaxError,
    SandboxError,
)
from sumo_adv.planners.sandbox import Jail, Sandbox, make_jail, wrapper_script
from sumo_adv.planners.session import SandboxLimits
from sumo_adv.planners.text import HELPERS_TEXT, make_planner, parse_parameters

TABLE = 'PARAMETERS = {"gap": (2.0, 0.5, 8.0, "m", "ahead of the ego")}\n'
HEAD = TABLE + "def endpoint(bv, ego, road, parameters, acc, horizon):\n"
CUT_IN = (
    HEAD
    + """\
    x, y, heading, speed = at(ego["path"], horizon)
    px, py = offset((x, y, heading), ego["length"] + parameters["gap"], road["side"])
    return {"x": px, "y": py, "heading": heading, "speed": clip(speed + acc, 0.0, 30.0), "time": horizon}
"""
)
# The ego drives along x at 10 m/s: at 2 s it is at x = 20.
EGO = {"length": 5.0, "path": [(float(t), 10.0 * t, 0.0, 0.0, 10.0) for t in range(5)]}
BV = {"x": -4.0, "y": 3.5, "heading": 0.0, "speed": 12.0}
ROADS = {"a": {"side": 0.0}, "b": {"side": 3.5}}
SMALL = SandboxLimits(call_seconds=0.1, batch_seconds=1.0, grace_seconds=0.3)


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox(SMALL) as box:
        yield box


@pytest.fixture(scope="module")
def patient() -> Iterator[Sandbox]:
    """For tests of the text: no call is stopped because the machine is busy."""
    with Sandbox(SandboxLimits(call_seconds=10.0)) as box:
        yield box


def planner(body: str) -> Planner:
    return make_planner("test", "plain", body, "person")


def returning(expression: str, before: str = "") -> Planner:
    return planner(
        TABLE + before + f"\ndef endpoint(bv, ego, road, parameters, acc, horizon):\n    return {expression}\n"
    )


def point(**values: str) -> str:
    """An endpoint as source text; all numbers 1.0 but those given."""
    items = {"x": "1.0", "y": "1.0", "heading": "1.0", "speed": "1.0", "time": "1.0"} | values
    return "{" + ", ".join(f'"{key}": {value}' for key, value in items.items()) + "}"


def test_endpoint_is_what_the_planner_computes(sandbox: Sandbox) -> None:
    with sandbox.session(planner(CUT_IN), ROADS) as session:
        # 20 m + 5 m of length + 2 m of gap; 10 m/s + 1.5
        ahead = session.endpoint("a", BV, EGO, {"gap": 2.0}, 1.5, 2.0)
        beside = session.endpoint("b", BV, EGO, {"gap": 3.0}, 1.5, 2.5)
    assert ahead == {"x": 27.0, "y": 0.0, "heading": 0.0, "speed": 11.5, "time": 2.0}
    assert beside == {"x": 33.0, "y": 3.5, "heading": 0.0, "speed": 11.5, "time": 2.5}


def test_batch_equals_single_calls_and_one_failure_harms_no_other(sandbox: Sandbox) -> None:
    source = HEAD + "    if horizon == 3.0:\n        return 1 / 0\n" + CUT_IN.removeprefix(HEAD)
    with sandbox.session(planner(source), ROADS) as session:
        calls = [("a", BV, EGO, {"gap": 2.0}, 0.0, h) for h in (1.0, 2.0, 3.0, 3.5)]
        results = session.endpoints(calls)
        assert [results[0], results[1], results[3]] == [session.endpoint(*calls[i]) for i in (0, 1, 3)]
    assert isinstance(results[2], PlannerRuntimeError)
    assert "line 4" in str(results[2]) and "ZeroDivisionError" in str(results[2])


def test_a_batch_of_whole_states_gives_planners_what_single_calls_give(sandbox: Sandbox) -> None:
    source = (
        HEAD
        + '    last = 0.0 if bv["last"] is None else bv["last"]["x"]\n'
        + '    path = ego["path"]\n'
        + '    return {"x": bv["x"] + last, "y": path[1][1] + len(path), "heading": sum(ego["arrivals"]),'
        + ' "speed": ego["speed"] + parameters["gap"], "time": 1 + len(list(bv)) + len(list(ego))}\n'
    )
    path = [[float(t), 10.0 * t, 0.0, 0.0, 10.0] for t in range(3)]
    ego = {"speed": 10.0, "path": path, "arrivals": [0.5, 0.25]}
    calls = [
        ("a", {"x": 1.0, "last": None}, ego, {"gap": 2.0}, 0.0, 1.0),
        ("b", {"x": 2.0, "last": {"x": 4.0}}, {**ego, "arrivals": [2.0]}, {"gap": 3.0}, 0.0, 1.0),
    ]
    with sandbox.session(planner(source), ROADS) as session:
        first, second = session.endpoints(calls)
        assert [first, second] == [session.endpoint(*call) for call in calls]
    # 2 names of the vehicle, 3 of the ego; the ego is at 10 m after 1 s, and its path has 3 places
    assert first == {"x": 1.0, "y": 13.0, "heading": 0.75, "speed": 12.0, "time": 6.0}
    assert second == {"x": 6.0, "y": 13.0, "heading": 2.0, "speed": 13.0, "time": 6.0}


def test_batch_longer_than_a_feed(sandbox: Sandbox) -> None:
    with sandbox.session(planner(CUT_IN), ROADS) as session:
        results = session.endpoints([("a", BV, EGO, {"gap": i / 100}, 0.0, 1.0) for i in range(600)])
    # 10 m + 5 m + the gap
    assert [r["x"] for r in results if isinstance(r, dict)] == pytest.approx([15.0 + i / 100 for i in range(600)])


def test_batch_with_an_endless_call_keeps_the_others_and_its_time(sandbox: Sandbox) -> None:
    source = HEAD + "    while horizon == 3.0:\n        pass\n" + CUT_IN.removeprefix(HEAD)
    with sandbox.session(planner(source), ROADS) as session:
        begin = time.monotonic()
        results = session.endpoints([("a", BV, EGO, {"gap": 2.0}, 0.0, h) for h in (1.0, 3.0, 2.0)])
        assert time.monotonic() - begin < 2.0
        assert isinstance(results[1], PlannerLimitError)
        assert isinstance(results[0], dict) and results[0]["x"] == 17.0
        assert isinstance(results[2], dict) and results[2]["x"] == 27.0
        endless = session.endpoints([("a", BV, EGO, {"gap": 2.0}, 0.0, 3.0)] * 40)
        assert time.monotonic() - begin < 4.0
    assert all(isinstance(error, PlannerLimitError) for error in endless)
    assert "time is used up" in str(endless[-1])


def test_result_errors_in_a_batch_stay_at_their_place(sandbox: Sandbox) -> None:
    with sandbox.session(returning(point(speed="-1.0 if horizon > 1 else 5")), ROADS) as session:
        good, bad = session.endpoints([("a", BV, EGO, {}, 0, 1.0), ("a", BV, EGO, {}, 0, 2.0)])
    assert isinstance(good, dict) and good["speed"] == 5.0
    assert isinstance(bad, PlannerResultError) and "speed" in str(bad)


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("at(P, 0.5)", (5.0, 0.0, 0.0, 10.0)),
        ("at(P, -1.0)", (0.0, 0.0, 0.0, 10.0)),
        ("at(P, 99.0)", (30.0, 0.0, 0.0, 10.0)),
        ("at(P, 3.0)", (30.0, 0.0, 0.0, 10.0)),
        ("at(P[:1], 3.0)", (0.0, 0.0, 0.0, 10.0)),
        # an uneven grid: 1 s of the 9 s between
        ("at([(0, 0, 0, 0, 0), (1, 8, 0, 0, 1), (10, 17, 9, 0, 10)], 2)", (9.0, 1.0, 0.0, 2.0)),
        # by the shorter way from 3 to -3 rad: half of 0.283 beyond 3 is pi
        ("at([(0, 0, 0, 3.0, 0), (1, 0, 0, -3.0, 0)], 0.5)", (0.0, 0.0, math.pi, 0.0)),
        ("(*offset((1.0, 2.0, 0.5 * 3.141592653589793), 2.0, 1.0), 0, 0)", (0.0, 4.0, 0.0, 0.0)),
        ("(clip(-2, 0, 1), clip(2, 0, 1), clip(0.5, 0, 1), 0)", (0.0, 1.0, 0.5, 0.0)),
        ("(wrap(4.0), wrap(-3.141592653589793), wrap(0.1), 0)", (4.0 - 2 * math.pi, math.pi, 0.1, 0.0)),
    ],
)
def test_helpers(sandbox: Sandbox, expression: str, expected: tuple[float, ...]) -> None:
    before = "P = [(float(t), 10.0 * t, 0.0, 0.0, 10.0) for t in range(4)]\n"
    with sandbox.session(returning(f"show({expression})", before + SHOW), ROADS) as session:
        got = session.endpoint("a", BV, EGO, {}, 0, 1.0)
    assert tuple(got[k] for k in ("x", "y", "heading", "speed")) == pytest.approx(expected, abs=1e-12)


SHOW = "def show(v):\n    return {'x': v[0], 'y': v[1], 'heading': v[2], 'speed': v[3], 'time': 1}\n"


def test_helpers_are_documented() -> None:
    assert all(f"{name}(" in HELPERS_TEXT for name in ("at", "offset", "clip", "wrap"))


def test_random_is_seeded_clock_frozen_sleep_zero(sandbox: Sandbox) -> None:
    before = "import random\nimport time\n"
    drawing = returning(
        point(x="random.random()", y="time.time() - 1735689600.0", heading="time.sleep(50) or 0"), before
    )

    def run(seed: int) -> list[dict[str, float]]:
        with sandbox.session(drawing, ROADS, seed=seed) as session:
            return [session.endpoint("a", BV, EGO, {}, 0, 1.0) for _ in range(2)]

    first, again, reseeded = run(1), run(1), run(2)
    assert first == again
    assert first[0]["x"] != first[1]["x"] and first[0]["x"] != reseeded[0]["x"]
    assert first[0]["y"] == first[1]["y"] == reseeded[0]["y"] == 0.0  # 2025-01-01T00:00Z


def test_globals_are_fresh_in_each_session(sandbox: Sandbox) -> None:
    before = "SEEN = []\ndef count(v):\n    SEEN.append(v)\n    return len(SEEN)\n"
    counting = returning(point(x="count(horizon)"), before)
    for _ in range(2):
        with sandbox.session(counting, ROADS) as session:
            assert [session.endpoint("a", BV, EGO, {}, 0, 1.0)["x"] for _ in range(2)] == [1.0, 2.0]


def test_trajectory(sandbox: Sandbox) -> None:
    source = (
        CUT_IN
        + "def trajectory(bv, endpoint, road, dt):\n    return [(bv['x'] + i, road['side'], 0, 10.0) for i in N]\n"
    )
    with sandbox.session(planner(source + "N = range(3)\n"), ROADS) as session:
        assert session.has_trajectory
        states = session.trajectory("b", BV, {"x": 1.0}, 0.1)
    assert states == [(-4.0, 3.5, 0.0, 10.0), (-3.0, 3.5, 0.0, 10.0), (-2.0, 3.5, 0.0, 10.0)]
    for numbers, word in (
        ("range(401)", "400"),
        ("[]", "400"),
        ("[float('nan')]", "finite"),
        ("[2e5]", "within"),
    ):
        with (
            sandbox.session(planner(source + f"N = {numbers}\n"), ROADS) as session,
            pytest.raises(PlannerResultError, match=word),
        ):
            session.trajectory("a", BV, {"x": 1.0}, 0.1)


def test_trajectory_of_a_planner_without_one(sandbox: Sandbox) -> None:
    with sandbox.session(planner(CUT_IN), ROADS) as session:
        assert not session.has_trajectory
        with pytest.raises(PlannerResultError, match="built-in"):
            session.trajectory("a", BV, {"x": 1.0}, 0.1)


def test_numpy_values_are_sent_as_plain_numbers(sandbox: Sandbox) -> None:
    path = np.array(EGO["path"])
    with sandbox.session(planner(CUT_IN), {"a": {"side": np.float64(1.5)}}) as session:
        got = session.endpoint("a", {"lane": np.int64(1)}, {"length": 5.0, "path": path}, {"gap": 2.0}, 0.0, 2.0)
        with pytest.raises(SandboxError, match="cannot be sent"):
            session.endpoint("a", {"lane": object()}, EGO, {}, 0.0, 2.0)
    assert got["x"] == 27.0 and got["y"] == 1.5


def test_session_ends_at_a_time_limit_and_the_sandbox_does_not(sandbox: Sandbox) -> None:
    with sandbox.session(planner(HEAD + "    while True:\n        pass\n"), ROADS) as session:
        with pytest.raises(PlannerLimitError, match="time limit"):
            session.endpoint("a", BV, EGO, {}, 0, 1.0)
        for _ in range(2):
            with pytest.raises(PlannerLimitError, match="has ended"):
                session.endpoint("a", BV, EGO, {}, 0, 1.0)
        with pytest.raises(PlannerLimitError, match="has ended"):
            session.endpoints([("a", BV, EGO, {}, 0, 1.0)])
    with sandbox.session(planner(CUT_IN), ROADS) as session:
        assert session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)["x"] == 27.0


def test_a_killed_worker_is_a_limit_error_and_the_sandbox_goes_on(sandbox: Sandbox) -> None:
    with sandbox.session(planner(CUT_IN), ROADS) as session:
        worker = session.worker
        assert worker is not None
        os.kill(worker, signal.SIGKILL)
        end = time.monotonic() + 5.0
        with pytest.raises(PlannerLimitError, match="worker was stopped"):
            while time.monotonic() < end:
                session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)
    with sandbox.session(planner(CUT_IN), ROADS) as session:
        assert session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)["x"] == 27.0


def test_workers_outlive_the_thread_that_asked_for_them() -> None:
    with Sandbox(SMALL) as box:
        made = []
        thread = threading.Thread(target=lambda: made.append(box.session(planner(CUT_IN), ROADS)))
        thread.start()
        thread.join()
        time.sleep(0.1)
        with made[0] as session:
            assert session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)["x"] == 27.0


def test_type_check_reports_line_and_reason(patient: Sandbox) -> None:
    with patient.session(planner(CUT_IN), ROADS, type_check=True) as session:
        assert session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)["x"] == 27.0
    with pytest.raises(PlannerSyntaxError, match=r"planner.py:3:.*math.*sine"):
        wrong = TABLE + "import math\nA = math.sine(1)\n" + CUT_IN.removeprefix(TABLE)
        patient.session(planner(wrong), ROADS, type_check=True)
    with pytest.raises(PlannerSyntaxError, match="unresolved-reference"):
        patient.session(returning(point(x="nowhere")), ROADS, type_check=True)


def test_what_the_subset_lacks_is_a_syntax_error_with_its_line(patient: Sandbox) -> None:
    for body, word in (
        ("def f():\n    yield 1\n", "yield"),
        ("import numpy\n", "numpy"),
        ("class A(B):\n    x = 1\n", "inherit"),
    ):
        with pytest.raises(PlannerSyntaxError, match=word) as caught:
            patient.session(planner(TABLE + body + CUT_IN.removeprefix(TABLE)), ROADS)
        assert "line " in str(caught.value)


def test_errors_of_use(sandbox: Sandbox) -> None:
    with sandbox.session(planner(CUT_IN), ROADS) as session, pytest.raises(SandboxError, match="No road"):
        session.endpoint("nobody", BV, EGO, {}, 0, 1.0)
    closed = Sandbox(SMALL)
    closed.close()
    closed.close()
    with pytest.raises(SandboxError, match="closed"):
        closed.session(planner(CUT_IN), ROADS)
    with Sandbox(SMALL, workers=1) as single:
        session = single.session(planner(CUT_IN), ROADS)
        session.close()
        session.close()
        with pytest.raises(PlannerLimitError, match="ended"):
            session.endpoint("a", BV, EGO, {}, 0, 1.0)


def test_a_forked_process_is_told_to_ask_the_owner(sandbox: Sandbox) -> None:
    with sandbox.session(planner(CUT_IN), ROADS) as session:
        child = os.fork()
        if child == 0:
            try:
                session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)
            except SandboxError as error:
                os._exit(7 if "another process" in str(error) else 1)
            os._exit(2)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
        assert session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)["x"] == 27.0


def test_isolation_is_said_and_can_be_turned_off() -> None:
    with Sandbox(SMALL, bubblewrap=False) as plain:
        assert plain.isolation == "process"
        assert "turned off" in plain.note
        with plain.session(planner(CUT_IN), ROADS) as session:
            assert session.endpoint("a", BV, EGO, {"gap": 2.0}, 0, 2.0)["x"] == 27.0
    jail = make_jail()
    assert jail.isolation in ("bubblewrap", "process")
    assert jail.note.endswith(".")


def test_wrapper_quotes_its_words_and_limits_memory() -> None:
    script = wrapper_script(Jail(("/a b/monty", "$x"), "process", ""), 64 * 1024 * 1024)
    assert "exec '/a b/monty' '$x' \"$@\"" in script
    assert "ulimit -v 1114112" in script  # 1 GiB + 64 MiB, in KiB


# --- the text ---------------------------------------------------------------------------------------------------------


def test_parameters_are_read_from_the_table() -> None:
    source = '"""Doc."""\n# note\nPARAMETERS = {"gap": (2, -1.5, 8, "m", "how far"), "t": (1.0, 1.0, 1.0, "s")}\n'
    source += HEAD.removeprefix(TABLE) + "    return {}\n"
    gap, t = parse_parameters(source)
    assert (gap.name, gap.default, gap.low, gap.high, gap.unit, gap.meaning) == ("gap", 2.0, -1.5, 8.0, "m", "how far")
    assert t.default == 1.0 and t.meaning == ""
    made = make_planner("cut-in", "late", source, "person", "abc")
    assert made.defaults() == {"gap": 2.0, "t": 1.0} and made.parent == "abc"


END = HEAD.removeprefix(TABLE) + "    return {}\n"


@pytest.mark.parametrize(
    ("source", "word"),
    [
        ("", "must begin with the table"),
        ("import math\n" + TABLE + END, "line 1.*must begin"),
        ("PARAMETERS = dict(a=1)\n" + END, "must begin"),
        ("PARAMETERS = {'a': (1, 0, 2)}\n" + END, "must give the parameter a"),
        ("PARAMETERS = {'a': (3, 0, 2, 'm', '')}\n" + END, "low <= default <= high"),
        ("PARAMETERS = {'a': (True, 0, 2, 'm', '')}\n" + END, "as numbers"),
        ("PARAMETERS = {'a': ('1', 0, 2, 'm', '')}\n" + END, "as numbers"),
        ("PARAMETERS = {'a': (1, 0, 1e999, 'm', '')}\n" + END, "not finite"),
        ("PARAMETERS = {'a': (1, -1e308, 1e308, 'm', '')}\n" + END, "the parameter a a number beyond 1e"),
        ("PARAMETERS = {'a': (1, 0, 1" + "0" * 400 + ", 'm', '')}\n" + END, "too large"),
        ("PARAMETERS = {'a': (1, 0, 2, 3, '')}\n" + END, "as short text"),
        ("PARAMETERS = {'a b': (1, 0, 2, 'm', '')}\n" + END, "identifier"),
        ("PARAMETERS = {'class': (1, 0, 2, 'm', '')}\n" + END, "identifier"),
        ("PARAMETERS = {5: (1, 0, 2, 'm', '')}\n" + END, "identifier"),
        ("PARAMETERS = {'a': (1, 0, 2, 'm', ''), 'a': (1, 0, 2, 'm', '')}\n" + END, "twice"),
        ("PARAMETERS = {**{}}\n" + END, "identifier|literals"),
        ("PARAMETERS = {'a': (print(1), 0, 2, 'm', '')}\n" + END, "literals"),
        ("PARAMETERS = {" + ", ".join(f"'a{i}': (1, 0, 2, 'm', '')" for i in range(13)) + "}\n" + END, "at most 12"),
        (TABLE, "does not define endpoint"),
        (TABLE + "endpoint = lambda *a: 1\n", "does not define endpoint"),
        (TABLE + "async " + END, "does not define endpoint"),
        (TABLE + "def endpoint(bv, ego):\n    return 1\n", "line 2.*just these arguments"),
        (TABLE + END + "def trajectory(bv, *rest):\n    return 1\n", "just these arguments"),
        (TABLE + END + "x = (\n", "does not parse"),
        (TABLE + END + "x = eval('1')\n", "uses eval"),
        (TABLE + END + "x = locals()\n", "uses locals"),
        (TABLE + END + "f = exec\n", "uses exec"),
        (TABLE + END + "\0", "character"),
        (TABLE + END + "# \x1b[2J", "character"),
        (TABLE + END + "'\ud800'", "character"),
        (TABLE + END + "#" * 33_000, "at most 32768 bytes"),
        (TABLE + END + "#" + "é" * 17_000, "at most 32768 bytes"),
        (TABLE + END + "x = " + "(" * 5000, "nest"),
        (TABLE + END + "x = " + "-" * 30_000 + "1", "cannot be parsed"),
        (TABLE + END + "x = a" + ".b" * 15_000, "cannot be parsed"),
        (TABLE + END + "x = 1" + "+1" * 15_000, "cannot be parsed"),
        (TABLE + END + "x = " + "lambda:" * 4_000 + "1", "cannot be parsed"),
        (TABLE + END + "x = " + "9" * 5000, "does not parse"),
    ],
)
def test_bad_text_is_refused_with_the_reason(source: str, word: str) -> None:
    with pytest.raises(PlannerSyntaxError, match=word):
        parse_parameters(source)
