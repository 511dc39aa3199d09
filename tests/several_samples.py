"""An attack of a collider and a support, and a run of it."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from bank_samples import shipped_planners

import sumo_adv.app as app
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Duty, Proposal
from sumo_adv.episode.task import make_task
from sumo_adv.report.folder import write_run
from sumo_adv.report.manifest import RecordedRun
from sumo_adv.report.staging import staged
from sumo_adv.search.support_intents import SUPPORT_INTENTS

INPUT, COLLIDER, SUPPORT = "neighbour_ahead_left", "left_ahead", "right_behind"


def pinch(collider: str, support: str, mode: str = "side", ahead: float = -4.0) -> Proposal:
    """One vehicle cuts in, another one keeps beside the ego on its right."""
    cut_in = shipped_planners()["Aggressive Cut-in", mode]
    (keep,) = SUPPORT_INTENTS[Duty.BLOCK_RIGHT][0].planners
    numbers = {**keep.defaults(), "ahead": ahead}
    helper = Proposal(support, keep.label, keep, numbers, 0.0, 0.0, duty=Duty.BLOCK_RIGHT)
    return Proposal(
        collider, cut_in.label, cut_in, cut_in.defaults(), 0.0, 0.0, supports=(helper,), composition="Pinch"
    )


@cache
def pinched() -> Path:
    """The folder of a run in which SUMO's IDM is hit by the vehicle that was ahead on its left."""
    home = Path(tempfile.mkdtemp(prefix="sumo_adv-tests-"))
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    run_input = app.load(Path(INPUT), None)
    settings = load_settings(None, duration=12.0, delays=(0.0,), adversaries=2)
    recorded = RecordedRun(run_input, settings, make_task(run_input, settings, home), pinch(COLLIDER, SUPPORT), 0)
    run = app.replay(recorded)
    with staged(home / "run", force=False) as folder:
        write_run(folder, run, figure=False)
        folder.keep(force=False)
    return home / "run"
