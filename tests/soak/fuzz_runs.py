"""Run folders with wrong values in their JSON, wrong bytes in their tables, and files that are missing or folders.

``python tests/soak/fuzz_runs.py --seed 1 --count 40``; each is given to two of the commands that read run folders.
"""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

from fuzz import main, one_of, wrong_bytes, wrong_values
from typer.testing import CliRunner

from run_samples import run_folder  # isort: skip

from sumo_adv.campaigns.results import read_row
from sumo_adv.cli.main import app
from sumo_adv.errors import SumoAdvError
from sumo_adv.report.manifest import read_manifest

COMMANDS = (
    ("judge", "{run}", "--json"), ("report", "{run}", "--json"), ("figure", "{run}", "--out", "{out}/a.png"),
    ("export", "{run}", "--format", "fcd", "--out", "{out}/a.fcd.xml"),
    ("export", "{run}", "--format", "csv", "--out", "{out}/a.csv"),
    ("export", "{run}", "--format", "openscenario", "--out", "{out}/scenario"),
    ("export", "{run}", "--format", "sumo", "--out", "{out}/sumo"),
)  # fmt: skip


def sample() -> Path:
    """The folder of a real run, made once: call it before the clock of the first try starts."""
    return run_folder("straight")


def attack(rng: random.Random, folder: Path) -> str:
    """Damage a run, and read it with each of a few commands."""
    run = folder / "run"
    shutil.copytree(sample(), run)
    for _ in range(rng.choice((1, 1, 2))):
        _damage(rng, run)
    read_row(run)
    words = []
    for command in rng.sample(COMMANDS, 2):
        arguments = [each.format(run=run, out=folder) for each in command]
        done = CliRunner().invoke(app, arguments)
        if isinstance(done.exception, SumoAdvError):
            assert "\n" not in str(done.exception), done.exception
            words.append("refused")
        elif done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        else:
            words.append("taken")
    try:
        read_manifest(run)
    except SumoAdvError:
        words.append("refused")
    return "refused" if "refused" in words else "taken"


def _damage(rng: random.Random, run: Path) -> None:
    """Change one file, remove it, or put a folder in its place."""
    file = one_of(rng, sorted(p for p in run.rglob("*") if p.is_file() and p.suffix != ".png"))
    if rng.random() < 0.6:
        file = one_of(rng, (run / "outcome.json", run / "manifest.json", run / "states.csv.gz"))
    if not file.is_file():
        return
    chance = rng.random()
    if chance < 0.05:
        file.unlink()
    elif chance < 0.1:
        file.unlink()
        file.mkdir()
    elif file.suffix == ".json" and chance < 0.8:
        table = json.loads(file.read_text(encoding="utf-8"))
        wrong_values(rng, table)
        file.write_text(json.dumps(table), encoding="utf-8")
    else:
        file.write_bytes(wrong_bytes(rng, file.read_bytes()))


if __name__ == "__main__":
    sample()
    main(attack, 40)
