"""Mirrored networks and encounters: the y of every place changes its sign, and traffic keeps to the other side."""

from __future__ import annotations

import importlib.util
import math
import re
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import sumo_adv
from sumo_adv.datatypes import Level, Track
from sumo_adv.episode.run import Run
from sumo_adv.episode.warm import WarmEngine, WarmSandboxes
from sumo_adv.regression.case import Expectation, KeptCase, read_case
from sumo_adv.regression.keep import keep_run
from sumo_adv.regression.runner import run_case, settings_for, task_for
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.tracks import tracks_of


def negated(number: str) -> str:
    """``-1.5`` for ``1.5`` and the other way round."""
    return number[1:] if number.startswith("-") else f"-{number}"


def mirrored_network(name: str, folder: Path) -> Path:
    """A shipped network with the sign of y changed, as netconvert makes it with ``--lefthand``."""
    spec = importlib.util.spec_from_file_location("networks_build", data_folder("networks") / "build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    command = [module.netconvert_program(), *module.FLAGS, "--lefthand"]
    for kind, flag in module.SOURCES.items():
        source = data_folder("networks") / "src" / name / f"{name}.{kind}.xml"
        if source.is_file():
            text = re.sub(r'\by="([^"]+)"', lambda m: f'y="{negated(m[1])}"', source.read_text())
            text = re.sub(r'\bshape="([^"]+)"', lambda m: f'shape="{_line(m[1])}"', text)
            plain = folder / source.name
            plain.write_text(text)
            command += [flag, str(plain)]
    target = folder / f"{name}.net.xml"
    subprocess.run([*command, "-o", str(target)], check=True, capture_output=True)
    return target


def _line(shape: str) -> str:
    points = (point.split(",") for point in shape.split())
    return " ".join(f"{x},{negated(y)}" for x, y in points)


@dataclass(frozen=True)
class Attacked:
    """One attempt: the ranking at the trigger (vehicle, relation), the level, the fault, and the tracks by id."""

    ranking: list[tuple[str, str]]
    level: Level
    fault: str | None
    tracks: dict[str, Track]


def both_ways(name: str, folder: Path, attempts: int = 6) -> tuple[Attacked, Attacked]:
    """The best attack of a shipped scenario, and the same proposal in the mirrored network with the same demand."""
    run = sumo_adv.run(
        name,
        until="serious",
        attempts=attempts,
        learn="off",
        memory=folder / "bank.sqlite",
        out=folder / "run",
    )
    assert run.outcome.document["outcome"]["level"] != "none"
    place, _ = keep_run(folder / "run", folder / "suite", Expectation(avoid="serious"))
    case = read_case(place)
    mirrored = folder / "mirrored"
    mirrored.mkdir()
    network = mirrored_network(_network_of(name), mirrored)
    return _attack(case, folder), _attack(replace(case, run_input=replace(case.run_input, network=network)), folder)


def _network_of(name: str) -> str:
    text = (data_folder("scenarios") / f"{name}.toml").read_text()
    found = re.search(r"networks/(\w+)\.net\.xml", text)
    assert found is not None
    return found[1]


def _attack(case: KeptCase, folder: Path) -> Attacked:
    settings = settings_for(case, case.run_input.ego_controller)
    task = task_for(case, settings, folder)
    sandboxes, warm = WarmSandboxes(), WarmEngine()
    try:
        with warm.episode() as engine:
            came = run_case(case, settings, task, engine, sandboxes.of(settings), 1)
    finally:
        warm.close()
        sandboxes.close()
    assert not isinstance(came, str), came
    return _outcome(came[0])


def _outcome(run: Run) -> Attacked:
    record = run.best
    assert record is not None and record.best is not None and record.best_result is not None
    best, found, result = record.best, record.found, record.best_result
    tracks = tracks_of(result.snapshots, result.sizes, {}, run.settings.step_length, (found.ego, best.proposal.bv))
    return Attacked(
        [(bv, relation) for bv, relation, _ in found.ranking], best.verdict.level, best.verdict.fault,
        {t.id: t for t in tracks},
    )  # fmt: skip


def farthest(one: dict[str, Track], other: dict[str, Track], seconds: float = math.inf) -> float:
    """The largest distance [m] between tracks and the mirrored tracks of the same vehicles in their first seconds."""
    assert one.keys() == other.keys()
    return max(
        float(np.hypot(a.x[:n] - b.x[:n], a.y[:n] + b.y[:n]).max())
        for a, b in ((one[k], other[k]) for k in one)
        for n in (min(int((a.time <= a.time[0] + seconds).sum()), len(b.time)),)
    )  # fmt: skip
