"""Scenarios, plans, lists of suites and settings in TOML with wrong values, lines and bytes.

``python tests/soak/fuzz_toml.py --seed 1 --count 1500``
"""

from __future__ import annotations

import random
import re
from functools import cache
from pathlib import Path

from fuzz import main, one_of, wrong_bytes

from cli_samples import ROOT  # isort: skip

from sumo_adv.app import batch_parts
from sumo_adv.benchmark.suites import load_suite
from sumo_adv.campaigns.plan import make_plan, read_plan
from sumo_adv.config import load_settings
from sumo_adv.episode.task import make_task
from sumo_adv.simulation.inputs import load_input

PLAN = """\
schema = 1
inputs = ["a.toml", "motorway"]
records = [0, "19a486cd29abd7a7"]
seeds = 2
egos = ["idm", "careful"]
learn = "after"
memory = "bank.sqlite"
figures = false
[settings]
attempts = 3
[settings.limits]
braking = 8.0
[vary]
delays = [[0.0], [0.0, 1.0]]
"""
SETTINGS = """\
attempts = 3
ego = "idm"
ttc = 1.5
until = "valid"
delays = [0.0, 1.0]
step_length = 0.1
[limits]
braking = 8.0
lateral = 6.0
[ego_parameters]
tau = 1.0
"""
SUITE = """\
schema = 1
name = "few"
version = "1"
seed = 1
[[cases]]
name = "one"
kind = "leader"
group = "straight"
file = "a.toml"
"""
VALUES = (
    "0", "-1", "-5", "1" + "0" * 400, "-9223372036854775809", "1e308", "inf", "-inf", "nan", "true", '""', '"x"',
    r'"a\u0000b"', '"../../../x"', '"/"', f'"{"x" * 5000}"', "[]", "[[]]", "{}", "{ a = 1 }", "[" * 400 + "]" * 400,
    "[" * 5000, "1979-05-27", "07:32:00", "'''\n'''", "[1, 'a', 2.5]", '"subprocess:Popen"', '"\U0001f697"',
)  # fmt: skip


@cache
def scenarios() -> tuple[str, ...]:
    """The shipped scenarios, with paths that hold anywhere."""
    texts = [p.read_text(encoding="utf-8") for p in sorted((ROOT / "scenarios").glob("*.toml"))]
    return tuple(
        t.replace('"../', f'"{ROOT}/').replace('"demand/', f'"{ROOT}/scenarios/demand/') for t in texts
    )  # fmt: skip


def attack(rng: random.Random, folder: Path) -> str:
    """Write one wrong file of one kind, and read it as the commands do."""
    kind = one_of(rng, ("scenario", "scenario", "plan", "settings", "suite"))
    text = {"scenario": one_of(rng, scenarios()), "plan": PLAN, "settings": SETTINGS, "suite": SUITE}[kind]
    (folder / "a.toml").write_text(scenarios()[0], encoding="utf-8")
    file = folder / "wrong.toml"
    file.write_bytes(_wrong(rng, text))
    if kind == "scenario":
        run_input = load_input(file)
        make_task(run_input, load_settings(None), folder)
    elif kind == "plan":
        table = read_plan(file)
        plan = make_plan(table, folder, str(file), batch_parts())
        if plan.size < 10_000:
            list(plan.jobs)
    elif kind == "settings":
        load_settings(file)
    else:
        load_suite(str(file))
    return "taken"


def _wrong(rng: random.Random, text: str) -> bytes:
    if rng.random() < 0.2:
        return wrong_bytes(rng, text.encode())
    lines = text.splitlines()
    for _ in range(rng.randint(1, 3)):
        k = rng.randrange(len(lines))
        change = rng.randrange(6)
        if change == 0:
            lines[k : k + 1] = []
        elif change == 1:
            lines.insert(rng.randrange(len(lines)), lines[k])
        elif change == 2:
            lines[k] = re.sub(r"^\w+", one_of(rng, ("x", "schema", '""', "ego", "[[a]]\nb")), lines[k])
        elif "=" in lines[k]:
            lines[k] = f"{lines[k].split('=')[0]}= {one_of(rng, VALUES)}"
        if not lines:
            lines = [""]
    return "\n".join(lines).encode()


if __name__ == "__main__":
    main(attack, 1500)
