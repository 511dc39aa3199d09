"""What ``bench`` composes for its workers: functions importable by name, since they go to other processes."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.jobs import Parts
from sumo_adv.cli.models import open_agents
from sumo_adv.cli.records import load
from sumo_adv.episode.episode import Episode
from sumo_adv.files import sentences
from sumo_adv.report.folder import raw_figures, staged, write_run
from sumo_adv.report.outcome import outcome
from sumo_adv.report.verdicts import figures, judge_best


def full_outcome(episode: Episode) -> dict[str, Any]:
    """What ``outcome.json`` holds of an episode, without writing anything."""
    judged = judge_best(episode)
    realism = judged.realism if judged is not None else None
    return outcome(episode, raw_figures(episode), figures(judged), realism)


def keep_run(target: Path, episode: Episode) -> None:
    """The whole folder of a run. Raises UsageError."""
    with staged(target, force=True) as folder:
        write_run(folder, episode)
        folder.keep(force=True)


def draw_example(target: Path, episode: Episode) -> None:
    """The encounter without and with the attack, as ``figure`` draws a run. Raises UsageError."""
    from sumo_adv.report.figures.paper import draw_paper, save
    from sumo_adv.report.figures.story import read_story

    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch, sentences(target):
        with staged(Path(scratch) / "run", force=False) as folder:
            write_run(folder, episode, figure=False)
            folder.keep(force=False)
        target.parent.mkdir(parents=True, exist_ok=True)
        save(draw_paper(read_story(folder.target)), target, "png")


def bench_parts() -> Parts:
    """All of them."""
    return Parts(load, open_agents, full_outcome, keep_run, draw_example)
