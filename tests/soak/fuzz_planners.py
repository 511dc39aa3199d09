"""Planners with wrong text: lines and words of real ones changed, and statements that ask for too much.

``python tests/soak/fuzz_planners.py --seed 1 --count 80``; each is tried as ``memory import`` and ``verify`` do.
"""

from __future__ import annotations

import random
import re
from functools import cache
from pathlib import Path

from fuzz import main, one_of, wrong_bytes

from bank_samples import shipped_planners  # isort: skip
from trajectory_samples import LANE_CHANGE  # isort: skip

from sumo_adv.errors import SandboxError
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.text import make_planner
from sumo_adv.planners.trial import trial

RELATIONS = ("leader", "neighbour", "crossing_left", "oncoming")
STATEMENTS = (
    "while True: pass", "while 0.9 < bv['time'] < 1.9: pass", "x = 'x' * 10**9", "x = [0] * 10**8", "x = 10**10**6",
    "return endpoint(bv, ego, road, parameters, acc, horizon)", "import os", "raise SystemExit", "assert False",
    "return {}", "return None", "return [1] * 10**6", "return {'x': 1e400, 'y': 0, 'heading': 0, 'speed': 0}",
    "print('x' * 10**6)", "bv.clear()", "ego['path'].append(ego['path'])", "road['ways'] = road", "del parameters",
    "[].__class__.__base__.__subclasses__()", "open('x', 'w')", "x = bv\n    while x: x = {'x': x}", "1 / 0",
    "return {'x': bv['x'], 'y': bv['y'], 'heading': 0.0, 'speed': 1.0, 'time': float('nan')}",
    "raise KeyboardInterrupt",
)  # fmt: skip
NUMBERS = ("0", "-1", "1e308", "1e-308", "1e400", "10**400", "float('nan')", "'x'", "None", "[]", "1" + "0" * 400)


@cache
def samples() -> tuple[str, ...]:
    """Texts of the shipped planners, and one with a trajectory of its own."""
    return (*(p.text for p in shipped_planners().values()), LANE_CHANGE, LANE_CHANGE)


@cache
def sandbox() -> Sandbox:
    """One sandbox for all tries; its workers end with this process."""
    return Sandbox()


def attack(rng: random.Random, folder: Path) -> str:
    """Make a planner of a wrong text, and try it on two relations."""
    text = one_of(rng, samples())
    for _ in range(rng.choice((1, 1, 2, 4))):
        text = _wrong(rng, text)
    try:
        planner = make_planner("Odd", "odd", text, "person")
    except SandboxError as error:
        assert str(error).endswith("."), error
        return "no planner"
    fault = trial(sandbox(), planner, rng.sample(RELATIONS, 2))
    assert fault is None or ("\n" not in fault and len(fault) < 2000), fault
    return "passes the trial" if fault is None else "fails the trial"


def _wrong(rng: random.Random, text: str) -> str:
    lines = text.splitlines()
    inside = [k for k, line in enumerate(lines) if line.startswith("    ") and "def " not in line] or [0]
    k = one_of(rng, inside)
    change = rng.randrange(6)
    if change == 0:
        lines[k] = f"    {one_of(rng, STATEMENTS)}"
    elif change == 1:
        lines.insert(k, f"    {one_of(rng, STATEMENTS)}")
    elif change <= 3:
        return _replaced(rng, text, r"-?\b\d+(\.\d+)?\b", NUMBERS)
    elif change == 4:
        return _replaced(rng, text, r"\b[a-z]+\b", ("x", "road", "len", "__import__", "lambda", "ego", "\0", "\u00e9"))
    else:
        return wrong_bytes(rng, text.encode()).decode("utf-8", errors="replace")
    return "\n".join(lines) + "\n"


def _replaced(rng: random.Random, text: str, pattern: str, by: tuple[str, ...]) -> str:
    matches = list(re.finditer(pattern, text))
    if not matches:
        return text
    at = one_of(rng, matches)
    return text[: at.start()] + one_of(rng, by) + text[at.end() :]


if __name__ == "__main__":
    try:
        main(attack, 80)
    finally:
        sandbox().close()
