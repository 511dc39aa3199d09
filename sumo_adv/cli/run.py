"""Define ``run`` and ``minimise``.

``run`` finds an encounter in an input and attacks the ego in it. ``minimise`` finds the mildest variant of an attack.
"""

from __future__ import annotations

import json
import tempfile
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv import app
from sumo_adv.app import new_engine, new_sandbox, open_for_run, shipped_prompts
from sumo_adv.cli import options as opt
from sumo_adv.cli.groups import grouped, named_settings
from sumo_adv.cli.interrupts import Interrupts
from sumo_adv.config import Settings, Until, load_settings
from sumo_adv.datatypes import FAILED_ENDINGS
from sumo_adv.errors import UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.report.staging import RunFolder, scratch_folder, staged

if TYPE_CHECKING:
    from sumo_adv.episode.engine import EpisodeEngine
    from sumo_adv.episode.prepared_encounter import PreparedEncounter
    from sumo_adv.episode.run import Run
    from sumo_adv.llm.prompts import Prompt
    from sumo_adv.simulation.inputs import RunInput

EXAMPLE = "Example: sumo-adv run priority_crossing --seed 3 --ego idm --until valid --out runs/mine"
OF_A_REPLAY = {"replay", "out", "force", "as_json", "ego"}  # options that --replay uses; ego confirms a class


@grouped
def run(
    context: typer.Context, attack: opt.AttackOptions, where: opt.InputOptions, driver: opt.EgoOptions,
    search: opt.SearchOptions, models: opt.ModelOptions, output: opt.OutputOptions, source: opt.Source = None,
) -> None:  # fmt: skip
    """Find an encounter, attack the ego in it, and write what happened."""
    if where.replay is not None:
        _refuse_what_a_replay_ignores(context, source)
        _replay(where.replay, driver.ego, output)
        return
    from sumo_adv.simulation.inputs import own_simulation
    from sumo_adv.simulation.sumo_options import parse_options

    run_input, ego = _input(source, where.record, driver.ego)
    named = named_settings(attack, where, driver, search, models)
    settings = load_settings(
        where.settings_file,
        **{
            **own_simulation(run_input), **run_input.settings(named), **named, "ego": ego,
            "fork": False if search.no_fork else None,
            "sumo_options": parse_options(where.sumo_option) if where.sumo_option else None,
        },
    )  # fmt: skip
    if models.show_prompts:
        show_prompts_of(run_input, settings, as_json=output.as_json)
        return
    _run(run_input, settings, output)


def _input(source: Path | None, record: str | None, ego: str | None) -> tuple[RunInput, str | None]:
    """Load the input, and choose the driver of its ego.

    Raises:
        UsageError: No input is given, or it is bad.
    """
    from sumo_adv.drivers.registry import trusted_driver

    if source is None:
        raise UsageError("Give an INPUT: a net.xml, a .sumocfg, a scenario, a map, or the name of a shipped one.")
    run_input = app.load(source, record)
    return run_input, trusted_driver(ego, run_input.ego_controller, run_input.path)


def _run(run_input: RunInput, settings: Settings, output: opt.OutputOptions) -> None:
    from sumo_adv.cli.progress import RunProgress

    target = output.out or Path("runs") / f"{run_input.name}-{settings.seed}"
    reporter = RunProgress(quiet=output.as_json, seconds=settings.seconds)
    with Interrupts() as interrupts, staged(target, force=output.force) as folder, scratch_folder() as scratch:
        tell = interrupts.checked(reporter.tell)
        with reporter:
            played = app.play(run_input, settings, folder.stage, scratch, tell, interrupts.hold)
        for note in () if output.as_json else run_input.notes:
            typer.echo(note)
        finish(folder, played, force=output.force, as_json=output.as_json)


def finish(folder: RunFolder, run: Run, *, force: bool, as_json: bool) -> None:
    """Write the folder of a run and print the result.

    Args:
        folder: The folder to write.
        run: The run.
        force: Whether an existing folder is replaced.
        as_json: Whether the output is JSON.

    Raises:
        typer.Exit: The run failed.
    """
    from sumo_adv.cli.progress import summary
    from sumo_adv.report.folder import write_run

    result = write_run(folder, run)
    folder.keep(force=force)
    if as_json:
        typer.echo(json.dumps({**result, "folder": str(folder.target)}))
    else:
        typer.echo(summary(result, folder.target))
    if run.ending in FAILED_ENDINGS or run.declined:
        typer.echo(f"sumo-adv: {result['reason']}", err=True)
        raise typer.Exit(1)


def _refuse_what_a_replay_ignores(context: typer.Context, source: Path | None) -> None:
    """Refuse what a replay takes from the manifest.

    Raises:
        UsageError: An INPUT or such an option is given. The message names the first one.
    """
    if source is not None:
        raise UsageError("Give either an INPUT or --replay DIR, not both.")
    for parameter in context.command.params:
        source_of = context.get_parameter_source(str(parameter.name))
        if parameter.name not in OF_A_REPLAY and source_of is not None and source_of.name == "COMMANDLINE":
            raise UsageError(
                f"{parameter.opts[0]} has no effect on a replay, which takes everything from the run's manifest: "
                "leave it out, or give the INPUT for a new run."
            )


def _replay(path: Path, ego: str | None, output: opt.OutputOptions) -> None:
    """Repeat the attempt that a run's manifest records."""
    from sumo_adv.drivers.registry import trusted_driver
    from sumo_adv.report.manifest import read_manifest

    recorded = read_manifest(path)
    driver = recorded.task.ego_driver
    if trusted_driver(ego, driver, path) != driver:
        raise UsageError(
            f"The run in {path} was driven by {driver!r}, and a replay repeats it: leave out --ego {ego}, "
            "or give the INPUT for a new run with that driver."
        )
    target = output.out or path.with_name(f"{path.resolve().name}-replay")
    with staged(target, force=output.force) as folder:
        finish(folder, app.replay(recorded), force=output.force, as_json=output.as_json)


def show_prompts_of(run_input: RunInput, settings: Settings, *, as_json: bool) -> None:
    """Print the prompts that models would get in an encounter of the input.

    These are the analyzer's, the generator's as if the first intent were new, and the modifier's after one attempt of
    the search.

    Args:
        run_input: The input.
        settings: The settings of the run.
        as_json: Whether the output is JSON.

    Raises:
        UsageError: There is nothing to ask about.
    """
    prompts = _prompts(run_input, settings)
    if as_json:
        entries = [{"agent": p.agent, "tokens": p.tokens, "system": p.system, "user": p.user} for p in prompts]
        typer.echo(json.dumps({"prompts": entries}))
        return
    for p in prompts:
        typer.echo(f"==== {p.agent}: system\n{p.system}\n\n==== {p.agent}: user\n{p.user}\n")
    typer.echo(
        "Estimated length (a quarter of the characters): " + ", ".join(f"{p.agent} {p.tokens} tokens" for p in prompts)
    )


def _prompts(run_input: RunInput, settings: Settings) -> list[Prompt]:
    from sumo_adv.agents.agents import Agents
    from sumo_adv.episode.encounter_finder import EncounterFinder
    from sumo_adv.episode.task import make_task

    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        task = make_task(run_input, settings, Path(scratch))
        with open_for_run(settings) as bank, new_sandbox(settings) as sandbox, new_engine() as engine:
            finder = EncounterFinder(run_input, settings, task, engine, lambda *_: None)
            prepared = finder.find_attackable(sandbox, bank)
            if prepared is None or not prepared.search.pool:
                why = "" if finder.stop is None else finder.stop.reason
                raise UsageError(f"There is no encounter to show prompts of. {why}".rstrip())
            return [
                _analyzer(prepared, settings, bank),
                *_writers(prepared, settings, Agents(settings, sandbox), engine),
            ]


def _analyzer(prepared: PreparedEncounter, settings: Settings, bank: Any) -> Prompt:
    """Make the analyzer's prompt."""
    from sumo_adv.agents.analyzer import analyzer_prompt
    from sumo_adv.agents.ways import evidence_words
    from sumo_adv.episode.memory_access import remembered

    recalled = remembered(bank, prepared.library, prepared.scene)
    evidence = partial(evidence_words, prepared.search.pool, library=prepared.library, remembered=recalled)
    library = prepared.selection.of(prepared.library)
    return analyzer_prompt(
        shipped_prompts(), prepared.found.situations, library, settings.limits.limits(),
        evidence if settings.evidence == "on" else None, prepared.teamwork, settings.ask or "",
    )  # fmt: skip


def _writers(prepared: PreparedEncounter, settings: Settings, agents: Any, engine: EpisodeEngine) -> list[Prompt]:
    """Make the generator's prompt and, if an attempt can be made, the modifier's."""
    from sumo_adv.agents.generator import generator_prompt
    from sumo_adv.agents.modifier import modifier_prompt
    from sumo_adv.episode.assessment import AttemptRunner
    from sumo_adv.episode.refinement import Refinement, Refiner
    from sumo_adv.episode.repairs import report_of, scene_of

    prompts, limits = shipped_prompts(), settings.limits.limits()
    intent = prepared.search.ranking(prepared.library)[0]
    near = sorted(prepared.library, key=lambda e: e.label != intent.label)
    generator = generator_prompt(prompts, intent, prepared.found.first, near, limits, settings.instruction)
    once = settings.model_copy(update={"attempts": 1})
    refinement = Refinement()
    runner = AttemptRunner(engine, agents.sandbox, prepared.found, settings.seed)
    Refiner(runner, prepared.found, prepared.search, agents, prepared.library, once, lambda *_: None).run(
        [intent], refinement
    )
    if not refinement.attempts:
        return [generator]
    tried = refinement.attempts[0].proposal
    entry = next(e for e in prepared.library if e.label == tried.label)
    reports = [report_of(refinement.attempts[0], refinement.results[0], prepared.found, settings)]
    scene = scene_of(tried.bv, entry, refinement.attempts, prepared.found, prepared.library)
    return [generator, modifier_prompt(prompts, tried.planner, reports, scene, limits, settings)]


MINIMISE_EXAMPLE = "Example: sumo-adv minimise runs/priority_crossing-3"
MINIMISE_ATTEMPTS = 25


def minimise(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run with a collision.")],
    until: Annotated[
        Until | None, typer.Option(help="Level that a variant must reach (default: the level of the attack).")
    ] = None,
    attempts: Annotated[int, typer.Option(min=1, help="Maximum number of simulations.")] = MINIMISE_ATTEMPTS,
    ego: Annotated[
        str | None, typer.Option(help="The class that drove the run, module:Class; a replay needs it.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write (default: runs/RUN-mildest).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace another run's folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Find the mildest variant of an attack (later, gentler, slower) that still reaches its level against this ego."""
    from sumo_adv.cli.progress import RunProgress
    from sumo_adv.drivers.registry import trusted_driver
    from sumo_adv.report.manifest import read_manifest
    from sumo_adv.report.read import read_run, reading

    recorded = read_manifest(run)
    driver = recorded.task.ego_driver
    if trusted_driver(ego, driver, run) != driver:
        raise UsageError(f"The run in {run} was driven by {driver!r}: leave out --ego {ego}.")
    with reading(run):
        reached = str((read_run(run).outcome.get("outcome") or {}).get("level") or "none")
        own = None if reached in ("none", "critical") else Until(reached)
    level = until or own
    if level is None:
        raise UsageError(f"The attack of {run} reached the level {reached}; minimise takes one with a collision.")
    if level.level < Until.COLLISION.level:
        raise UsageError("Minimise keeps a collision: choose --until collision, valid, strict or serious.")
    settings = recorded.settings.model_copy(update={"until": level, "attempts": attempts, "learn": "off"})
    target = out or Path("runs") / f"{run.resolve().name}-mildest"
    reporter = RunProgress(quiet=as_json)
    with staged(target, force=force) as folder:
        with reporter:
            mildest = app.minimise(recorded, settings, reporter.tell)
        finish(folder, mildest, force=force, as_json=as_json)
