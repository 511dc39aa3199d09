"""``run --show-prompts``: what a model would be asked about an encounter, without asking it."""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from sumo_adv.app import new_engine, new_sandbox, open_for_run, shipped_prompts
from sumo_adv.config import Settings

if TYPE_CHECKING:
    from sumo_adv.agents.prompts import Prompt
    from sumo_adv.episode.planned_encounter import PlannedEncounter
    from sumo_adv.simulation.engine import Engine
    from sumo_adv.simulation.inputs import RunInput


def show(given: RunInput, settings: Settings, *, as_json: bool) -> None:
    """Print the analyzer's prompt, the generator's as if the first intent were new, and the modifier's after one
    attempt of the search's."""
    prompts = _prompts(given, settings)
    if as_json:
        entries = [{"agent": p.agent, "tokens": p.tokens, "system": p.system, "user": p.user} for p in prompts]
        typer.echo(json.dumps({"prompts": entries}))
        return
    for p in prompts:
        typer.echo(f"==== {p.agent}: system\n{p.system}\n\n==== {p.agent}: user\n{p.user}\n")
    typer.echo("About (a quarter of the characters): " + ", ".join(f"{p.agent} {p.tokens} tokens" for p in prompts))


def _prompts(given: RunInput, settings: Settings) -> list[Prompt]:
    from sumo_adv.agents.agents import Agents
    from sumo_adv.episode.episode import Episode
    from sumo_adv.episode.planned_encounter import find_attackable
    from sumo_adv.episode.task import make_task
    from sumo_adv.errors import UsageError

    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
        episode = Episode(given, settings, make_task(given, settings, Path(scratch)))
        with (
            open_for_run(settings) as bank,
            new_sandbox(settings) as sandbox,
            new_engine() as engine,
        ):
            planned = find_attackable(episode, engine, sandbox, bank, lambda *_: None)
            if planned is None or not planned.search.pool:
                raise UsageError(f"There is nothing to ask about here. {episode.reason}".rstrip())
            return [_analyzer(episode, planned, bank), *_writers(planned, settings, Agents(settings, sandbox), engine)]


def _analyzer(episode: Any, planned: PlannedEncounter, bank: Any) -> Prompt:
    from sumo_adv.agents.analyzer import analyzer_prompt
    from sumo_adv.agents.ways import evidence_words
    from sumo_adv.episode.memory_access import remembered, selection_of
    from sumo_adv.episode.planned_encounter import teamwork

    settings = episode.settings
    recalled = remembered(bank, planned.library, planned.scene)
    evidence = partial(evidence_words, planned.search.pool, library=planned.library, remembered=recalled)
    library = selection_of(episode, bank).of(planned.library)
    return analyzer_prompt(
        shipped_prompts(), planned.found.situations, library, settings.limits.limits(),
        evidence if settings.evidence == "on" else None, teamwork(episode, bank), settings.ask or "",
    )  # fmt: skip


def _writers(planned: PlannedEncounter, settings: Settings, agents: Any, engine: Engine) -> list[Prompt]:
    from sumo_adv.agents.generator import generator_prompt
    from sumo_adv.agents.modifier import modifier_prompt
    from sumo_adv.episode.assessment import AttemptRunner
    from sumo_adv.episode.refinement import Refinement, Refiner
    from sumo_adv.episode.repairs import report_of, scene_of

    prompts, limits = shipped_prompts(), settings.limits.limits()
    intent = planned.search.ranking(planned.library)[0]
    near = sorted(planned.library, key=lambda e: e.label != intent.label)
    generator = generator_prompt(prompts, intent, planned.found.first, near, limits, settings.instruction)
    once = settings.model_copy(update={"attempts": 1})
    refinement = Refinement()
    runner = AttemptRunner(engine, agents.sandbox, planned.found, settings.seed)
    Refiner(runner, planned.found, planned.search, agents, planned.library, once, lambda *_: None).run(
        [intent], refinement
    )
    if not refinement.attempts:
        return [generator]
    tried = refinement.attempts[0].proposal
    entry = next(e for e in planned.library if e.label == tried.label)
    reports = [report_of(refinement.attempts[0], refinement.results[0], planned.found, settings)]
    scene = scene_of(tried.bv, entry, refinement.attempts, planned.found, planned.library)
    return [generator, modifier_prompt(prompts, tried.planner, reports, scene, limits, settings)]
