"""Hostile planners: each ends within its limits with a named error, or is shown to be harmless, and harms no other.

An attack is module-level text (``above``) or the body of ``endpoint`` (``inside``) with the error it must end in.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from sumo_adv.errors import (
    PlannerLimitError,
    PlannerResultError,
    PlannerRuntimeError,
    PlannerSyntaxError,
    SandboxError,
)
from sumo_adv.planners.results import check_endpoint, check_trajectory
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.session import Call, SandboxLimits
from sumo_adv.planners.text import make_planner

LIMIT, RUNTIME, RESULT, SYNTAX = PlannerLimitError, PlannerRuntimeError, PlannerResultError, PlannerSyntaxError
TABLE = "PARAMETERS = {}\n"
HEAD = "def endpoint(bv, ego, road, parameters, acc, horizon):\n"
GOOD = "{'x': 1.0, 'y': 2.0, 'heading': 0.0, 'speed': 3.0, 'time': 1.0}"
GOOD_RESULT = {"x": 1.0, "y": 2.0, "heading": 0.0, "speed": 3.0, "time": 1.0}
LIMITS = SandboxLimits(call_seconds=0.1, batch_seconds=0.5, memory=32 * 1024 * 1024, grace_seconds=0.5)
ROAD = {"a": {"lanes": [1.0, 2.0]}}
ARGUMENTS: Call = ("a", {"x": 0.0}, {"path": []}, {}, 0.0, 1.0)


class Attack(NamedTuple):
    name: str
    error: type[SandboxError]
    source: str


def inside(name: str, error: type[SandboxError], body: str) -> Attack:
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    return Attack(name, error, TABLE + HEAD + lines)


def returns(name: str, expression: str, error: type[SandboxError] = RESULT, above: str = "") -> Attack:
    return Attack(name, error, f"{TABLE}{above}\n{HEAD}    return {expression}\n")


def above(name: str, error: type[SandboxError], text: str) -> Attack:
    return Attack(name, error, f"{TABLE}{text}\n{HEAD}    return {GOOD}\n")


def with_x(expression: str) -> str:
    return GOOD.replace("1.0,", f"{expression},", 1)


ENDLESS = [
    inside("while", LIMIT, "while True:\n    pass"),
    inside(
        "catch_base",
        LIMIT,
        "while 1:\n    try:\n        while 1:\n            pass\n    except BaseException:\n        pass",
    ),
    inside("catch_timeout", LIMIT, f"try:\n    while True:\n        pass\nexcept TimeoutError:\n    return {GOOD}"),
    inside("sleep_loop", LIMIT, "import time\nwhile True:\n    time.sleep(1000)"),
    above("module_while", LIMIT, "while True:\n    pass"),
    above("module_class_body", SYNTAX, "class A:\n    while True:\n        pass"),
]

MEMORY = [
    inside("list", LIMIT, "return [0] * 10**9"),
    inside(
        "catch_memory", LIMIT, f"try:\n    a = [0] * 10**9\nexcept BaseException:\n    return {GOOD}\nreturn {GOOD}"
    ),
    inside("kept_memory", LIMIT, "KEEP = [str(i) * 100 for i in range(10**6)]\nreturn KEEP"),
    inside("print_huge", LIMIT, "print('x' * 1000000)"),
    inside("print_many", LIMIT, "for i in range(100000):\n    print('xxxxxxxxxxxxxxxx')"),
]

RECURSION = [
    inside("direct", LIMIT, "def f():\n    return f()\nreturn f()"),
]

REACHING_OUT = [
    inside("open", RUNTIME, "return open('/etc/passwd').read()"),
    inside("os_environ", RUNTIME, "import os\nreturn os.environ['PATH']"),
    inside("subprocess", RUNTIME, "import subprocess\nreturn subprocess.run(['id'])"),
    inside("own_package", RUNTIME, "import sumo_adv\nreturn sumo_adv"),
    inside("dunder_import", SYNTAX, "return __import__('os')"),
    inside("exec_alias", SYNTAX, "f = exec\nf('x = 1')"),
    inside("exec_normalised", SYNTAX, "ｅｘｅｃ('x = 1')"),
    inside("globals", SYNTAX, "return globals()"),
    above("module_import", SYNTAX, "import socket"),
    above("module_star", SYNTAX, "from ctypes import *"),
    above("module_open", RUNTIME, "TEXT = open('/etc/passwd').read()"),
]

LADDERS = [
    inside("class", RUNTIME, "return ().__class__.__base__.__subclasses__()"),
    inside("func_globals", RUNTIME, "return endpoint.__globals__"),
    inside("generator", SYNTAX, "def f():\n    yield 1\nreturn f().gi_frame"),
    inside("metaclass", SYNTAX, "class A(type):\n    pass\nreturn A"),
    inside(
        "exception_class",
        SYNTAX,
        "class E(Exception):\n    def __str__(self):\n        while 1:\n            pass\nraise E()",
    ),
]

RESULTS = [
    returns("none", "None"),
    returns("text", "'x'"),
    returns("list", "[1.0, 2.0, 0.0, 3.0, 1.0]"),
    returns("tuple", "(1.0, 2.0, 0.0, 3.0, 1.0)"),
    returns("number", "1.0"),
    returns("function", "endpoint"),
    returns("type", "dict"),
    returns("ellipsis", "..."),
    returns("missing_key", "{'x': 1.0, 'y': 2.0, 'heading': 0.0, 'speed': 3.0}"),
    returns("extra_key", GOOD[:-1] + ", 'z': 1.0}"),
    returns("wrong_key", GOOD.replace("'x'", "'X'")),
    returns("bytes_key", GOOD.replace("'x'", "b'x'")),
    returns("bool_value", with_x("True")),
    returns("text_value", with_x("'1.0'")),
    returns("none_value", with_x("None")),
    returns("complex_value", with_x("1j")),
    returns("list_value", with_x("[1.0]")),
    returns("nan", with_x("float('nan')")),
    returns("infinity", with_x("float('inf')")),
    returns("minus_infinity", with_x("-1e999")),
    returns("huge_float", with_x("1e308")),
    returns("huge_integer", with_x("10**1000")),
    returns("out_of_range", with_x("100001.0")),
    returns("decimal", with_x("D('1')"), above="from decimal import Decimal as D\n"),
    returns("negative_speed", GOOD.replace("3.0", "-0.1")),
    returns("high_speed", GOOD.replace("3.0", "100.1")),
    returns("wild_heading", GOOD.replace("'heading': 0.0", "'heading': 1e4")),
    returns("zero_time", GOOD.replace("'time': 1.0", "'time': 0.0")),
    returns("minus_zero_time", GOOD.replace("'time': 1.0", "'time': -0.0")),
    returns("long_time", GOOD.replace("'time': 1.0", "'time': 60.1")),
    returns("object", "A()", above="class A:\n    x = 1.0\n    y = 2.0\n"),
    returns("like_a_number", with_x("N()"), above="class N:\n    def __float__(self):\n        return 1.0\n"),
    returns("long_type_name", "A" + "a" * 9000 + "()", above="class A" + "a" * 9000 + ":\n    pass\n"),
    inside("cyclic", RESULT, "a = {}\na['x'] = a\nreturn a"),
    inside("cyclic_list", RESULT, "a = []\na.append(a)\nreturn {'x': a, 'y': a, 'heading': a, 'speed': a, 'time': a}"),
    inside("deep", RESULT, "a = []\nfor i in range(5000):\n    a = [a]\nreturn " + with_x("a")),
    inside("billion_laughs", RESULT, "a = [0]\nfor i in range(40):\n    a = [a, a]\nreturn " + with_x("a")),
    inside("billion_laughs_key", RESULT, "a = (0,)\nfor i in range(40):\n    a = (a, a)\nreturn {a: 1}"),
    inside("colliding_keys", RESULT, "return {i * (2**61 - 1): 0 for i in range(20000)}"),
    inside(
        "hash_liar",
        RESULT,
        "class K:\n    def __hash__(self):\n        return hash('x')\n    def __eq__(self, o):\n        return True\n"
        "return {K(): 1.0, 'y': 2.0, 'heading': 0.0, 'speed': 3.0, 'time': 'x'}",
    ),
]

TRICKS = [
    inside("message_giant", RUNTIME, "raise ValueError('x' * 5000000)"),
    inside("message_control", RUNTIME, "raise ValueError('\\x1b[2J\\x00\\r\\n\\u202e\\x9b31m')"),
    inside("raise_interrupt", RUNTIME, "raise KeyboardInterrupt()"),
    inside("raise_timeout", LIMIT, "raise TimeoutError('mine')"),
    inside(
        "many_missing_names",
        RUNTIME,
        "for i in range(30):\n    try:\n        nowhere\n    except NameError:\n        i\nnowhere",
    ),
    inside(
        "too_many_missing_names", LIMIT, "while True:\n    try:\n        nowhere\n    except NameError:\n        pass"
    ),
    inside("regex_backtracking", RUNTIME, "import re\nreturn re.match('(a|a)*\\\\1b', 'a' * 40)"),
    inside("surrogate", RESULT, "return '\\ud800'"),
    Attack("endpoint_rebound", RUNTIME, f"{TABLE}{HEAD}    return {GOOD}\nendpoint = None\n"),
    Attack("shadow_builtins", RESULT, f"{TABLE}type = len = dict = float = int = lambda *a: 5\n{HEAD}    return 'x'\n"),
    Attack("shadow_exception", RESULT, f"{TABLE}Exception = BaseException = 5\n{HEAD}    return 'x'\n"),
    Attack("module_value", RESULT, f"{TABLE}{HEAD}    return 1\n{{i * (2**61 - 1): 0 for i in range(5000)}}"),
    inside(
        "hash_endless", LIMIT, "class K:\n    def __hash__(self):\n        while 1:\n            pass\nreturn {K(): 1}"
    ),
]

GROUPS = {
    "endless": ENDLESS,
    "memory": MEMORY,
    "recursion": RECURSION,
    "reaching_out": REACHING_OUT,
    "ladders": LADDERS,
    "results": RESULTS,
    "tricks": TRICKS,
}
ATTACKS = [pytest.param(a, id=f"{group}-{a.name}") for group, attacks in GROUPS.items() for a in attacks]


@pytest.fixture(scope="module")
def sandbox() -> Iterator[Sandbox]:
    with Sandbox(LIMITS) as box:
        yield box


def run(sandbox: Sandbox, source: str) -> dict[str, float]:
    planner = make_planner("attack", "plain", source, "person")
    with sandbox.session(planner, ROAD) as session:
        return session.endpoint(*ARGUMENTS)


@pytest.mark.parametrize("attack", ATTACKS)
def test_attack_ends_in_time_with_a_named_error(sandbox: Sandbox, attack: Attack) -> None:
    begin = time.monotonic()
    with pytest.raises(SandboxError) as caught:
        run(sandbox, attack.source)
    assert time.monotonic() - begin < 1.5
    assert caught.type is attack.error
    assert len(str(caught.value)) < 800
    assert str(caught.value).isprintable()
    # and the sandbox serves the next planner
    assert run(sandbox, f"{TABLE}{HEAD}    return {GOOD}\n") == GOOD_RESULT


BY_CALL = [a for a in RESULTS + TRICKS + LADDERS if a.error is not SYNTAX and a.name != "endpoint_rebound"]


@pytest.mark.parametrize("attack", BY_CALL, ids=lambda a: a.name)
def test_attack_in_a_batch_harms_no_other_call(sandbox: Sandbox, attack: Attack) -> None:
    """The attack strikes only where the horizon is 2; its neighbours keep their results."""
    strike = attack.source.replace(HEAD, HEAD.replace("endpoint", "strike"))
    choose = f"    return strike(bv, ego, road, parameters, acc, horizon) if horizon == 2 else {GOOD}\n"
    with sandbox.session(make_planner("attack", "batch", f"{strike}\n{HEAD}{choose}", "person"), ROAD) as session:
        results = session.endpoints([(*ARGUMENTS[:5], horizon) for horizon in (1.0, 2.0, 3.0)])
    assert isinstance(results[1], attack.error)
    assert results[0] == results[2] == GOOD_RESULT


@pytest.mark.parametrize(
    ("name", "body"),
    [
        ("regex_bomb", "import re\nre.match('(a+)+$', 'a' * 40 + 'b')"),
        ("sleep", "import time\ntime.sleep(10**6)"),
        ("async_sleep", "import asyncio\nasync def f():\n    await asyncio.sleep(10**6)\nasyncio.run(f())"),
        ("minus_zero", "bv['x'] = -0.0"),
        ("dynamic_class", "type('X', (), {})"),
        ("caught_recursion", "def f():\n    return f()\ntry:\n    f()\nexcept RecursionError:\n    pass"),
        ("caught_denial", "try:\n    open('/etc/passwd')\nexcept PermissionError:\n    pass"),
        ("change_arguments", "road['lanes'].append('x' * 1000)\nego['path'].append(ego)\nparameters['x'] = bv"),
        ("print_control", "print('\\x1b[2J' * 100)"),
    ],
)
def test_harmless(sandbox: Sandbox, capfd: pytest.CaptureFixture[str], name: str, body: str) -> None:
    begin = time.monotonic()
    road = {"a": {"lanes": [1.0, 2.0]}}
    with sandbox.session(
        make_planner(name, "plain", inside(name, LIMIT, f"{body}\nreturn {GOOD}").source, "x"), road
    ) as session:
        assert session.endpoint(*ARGUMENTS) == GOOD_RESULT
    assert time.monotonic() - begin < 1.0
    assert road == {"a": {"lanes": [1.0, 2.0]}} and ARGUMENTS[2] == {"path": []}
    assert capfd.readouterr() == ("", "")


def test_rebinding_all_visible_helpers_does_not_pass_the_check(sandbox: Sandbox) -> None:
    names = "at offset clip wrap type len dict list tuple float int isinstance repr Exception BaseException range"
    shadow = "".join(f"{name} = endpoint\n" for name in names.split())
    source = f"{TABLE}{HEAD}    return 'free'\n{shadow}"
    with pytest.raises(PlannerResultError, match="must return a dict"):
        run(sandbox, source)


def test_result_changed_after_the_call_is_not_seen(sandbox: Sandbox) -> None:
    source = f"{TABLE}KEEP = {GOOD}\n{HEAD}    KEEP['x'] = KEEP['x'] if horizon < 2 else 'late'\n    return KEEP\n"
    with sandbox.session(make_planner("attack", "late", source, "person"), ROAD) as session:
        results = session.endpoints([(*ARGUMENTS[:5], horizon) for horizon in (1.0, 2.0)])
        assert results[0] == GOOD_RESULT  # reduced to numbers before the second call could change it
        assert isinstance(results[1], PlannerResultError)


def test_sessions_do_not_see_one_another(sandbox: Sandbox) -> None:
    leave = f"{TABLE}SECRET = 5\nimport math\nmath.secret = 5\n{HEAD}    return {GOOD}\n"
    with pytest.raises(PlannerRuntimeError):
        run(sandbox, leave)  # modules cannot be written to
    leave = leave.replace("math.secret = 5\n", "")
    for look in ("SECRET", "math.secret"):
        source = f"{TABLE}import math\n{HEAD}    return {with_x(look)}\n"
        first = sandbox.session(make_planner("attack", "leave", leave, "person"), ROAD)
        assert first.endpoint(*ARGUMENTS) == GOOD_RESULT
        with pytest.raises(PlannerRuntimeError):
            run(sandbox, source)  # beside it
        first.close()
        with pytest.raises(PlannerRuntimeError):
            run(sandbox, source)  # after it, in the same worker


@pytest.mark.parametrize(
    "value",
    [
        None,
        "free",
        (1.0,) * 4,
        (1.0,) * 6,
        [1.0] * 5,
        (1.0, 2.0, 0.0, True, 1.0),
        (1.0, 2.0, 0.0, "3", 1.0),
        {"x": 1.0},
    ],
)
def test_our_side_trusts_no_reducer(value: object) -> None:
    """As if the whole session had been taken over: what it sends must still be five plain numbers."""
    with pytest.raises(PlannerResultError):
        check_endpoint("Planner", value)


@pytest.mark.parametrize("value", [None, "free", [], [1.0] * 5, (1.0,) * 4, [1.0, 1.0, 0.0, True], [0.0] * 1604])
def test_our_side_trusts_no_trajectory(value: object) -> None:
    with pytest.raises(PlannerResultError):
        check_trajectory("Planner", value)


def test_the_jail_shows_no_files_and_no_network(sandbox: Sandbox) -> None:
    """Looked at from outside: the worker's mounts and interfaces, its user and its environment."""
    if sandbox.isolation != "bubblewrap":
        pytest.skip(sandbox.note)
    with sandbox.session(make_planner("a", "b", f"{TABLE}{HEAD}    return {GOOD}\n", "x"), ROAD) as session:
        assert session.worker is not None
        innermost = session.worker
        while children := Path(f"/proc/{innermost}/task/{innermost}/children").read_text().split():
            innermost = int(children[0])
        proc = Path(f"/proc/{innermost}")
        assert {entry.name for entry in (proc / "root").iterdir()} <= {"lib", "lib64", "usr", "monty"}
        assert not list((proc / "root").rglob("passwd"))
        status = dict(line.split(":\t", 1) for line in (proc / "status").read_text().splitlines() if ":\t" in line)
        assert int(status["CapEff"], 16) == 0 and status["NoNewPrivs"].strip() == "1"
        interfaces = [line.split(":")[0].strip() for line in (proc / "net" / "dev").read_text().splitlines()[2:]]
        assert interfaces in (["lo"], [])
        assert b"HOME=" not in (proc / "environ").read_bytes()
