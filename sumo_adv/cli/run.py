"""``run``: one encounter, from a network to a dangerous one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from sumo_adv import app
from sumo_adv.cli import options as shared
from sumo_adv.cli import run_options as own
from sumo_adv.config import Settings, load_settings
from sumo_adv.datatypes import FAILED_ENDINGS
from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from sumo_adv.episode.episode import Episode
    from sumo_adv.report.staging import RunFolder
    from sumo_adv.simulation.inputs import RunInput

EXAMPLE = "Example: sumo-adv run priority_crossing --seed 3 --ego idm --until valid --out runs/mine"
OF_A_REPLAY = {"replay", "out", "force", "as_json", "ego"}  # options that count with --replay; ego confirms a class


def run(
    context: typer.Context, source: own.Source = None, ask: own.Ask = None, record: own.Record = None,
    begin: own.Begin = None,
    end: own.End = None, density: own.Density = None, background: own.Background = None,
    sumo_option: own.SumoOption = None,
    settings_file: shared.SettingsFile = None, replay: own.Replay = None, ego: own.Ego = None,
    ego_id: own.EgoId = None, ego_deadline: own.EgoDeadline = None,
    until: shared.UntilLevel = None, ttc: shared.Ttc = None,
    critical_ttc: shared.CriticalTtc = None, min_delta_v: shared.MinDeltaV = None, intents: shared.Intents = None,
    exclude: shared.Exclude = None, kind: shared.Kind = None, adversary: own.Adversary = None,
    adversaries: shared.Adversaries = None,
    trigger: own.Trigger = None, diverse: shared.Diverse = None, attempts: shared.Attempts = None,
    seconds: shared.Seconds = None, total_seconds: own.TotalSeconds = None,
    tuner: own.Tuner = None, seed: own.Seed = None, learn: own.Learn = None, recall: own.Recall = None,
    memory: own.Memory = None, no_fork: own.NoFork = False, llm: own.Llm = None,
    analyzer: own.Analyzer = None, generator: own.Generator = None, modifier: own.Modifier = None,
    fallback: own.Fallback = None, samples: own.Samples = None, evidence: own.Evidence = None,
    instruction: own.Instruction = None, show_prompts: own.ShowPrompts = False, out: own.Out = None,
    force: own.Force = False, as_json: shared.AsJson = False,
) -> None:  # fmt: skip
    """Find an encounter, attack the ego in it, and write what happened."""
    if replay is not None:
        _refuse_what_a_replay_ignores(context, source)
        _replay(replay, out, ego, force=force, as_json=as_json)
        return
    from sumo_adv.simulation.inputs import own_simulation
    from sumo_adv.simulation.sumo_options import parse

    given, driver = _input(source, record, ego)
    named = shared.given(context.params, list(Settings.model_fields))
    settings = load_settings(
        settings_file,
        **{
            **own_simulation(given), **given.settings(named), **named, "ego": driver,
            "fork": False if no_fork else None, "sumo_options": parse(sumo_option) if sumo_option else None,
        },
    )  # fmt: skip
    if show_prompts:
        _show_prompts(given, settings, as_json=as_json)
        return
    target = out or Path("runs") / f"{given.name}-{settings.seed}"
    _run(given, settings, target, force=force, as_json=as_json)


def _input(source: Path | None, record: str | None, ego: str | None) -> tuple[RunInput, str | None]:
    """The input and the driver of its ego. Raises UsageError without an input."""
    from sumo_adv.drivers.registry import trusted_driver

    if source is None:
        raise UsageError("Give an INPUT: a net.xml, a .sumocfg, a scenario, a map, or the name of a shipped one.")
    given = app.load(source, record)
    return given, trusted_driver(ego, given.ego_controller, given.source)


def _show_prompts(source: RunInput, settings: Settings, *, as_json: bool) -> None:
    from sumo_adv.cli.prompts import show

    show(source, settings, as_json=as_json)


def _run(source: RunInput, settings: Settings, target: Path, *, force: bool, as_json: bool) -> None:
    from sumo_adv.cli.interrupts import Interrupts
    from sumo_adv.cli.progress import make_reporter
    from sumo_adv.report.staging import scratch_folder, staged

    reporter = make_reporter(quiet=as_json, seconds=settings.seconds)
    with (
        Interrupts() as interrupts,
        staged(target, force=force) as folder,
        scratch_folder() as scratch,
    ):
        tell = interrupts.checked(reporter.tell)
        with reporter:
            episode = app.play(source, settings, folder.stage, scratch, tell, interrupts.hold)
        for note in () if as_json else source.notes:
            typer.echo(note)
        finish(folder, episode, force=force, as_json=as_json)


def finish(folder: RunFolder, episode: Episode, *, force: bool, as_json: bool) -> None:
    """Write the folder of an episode and say what it came to. Raises typer.Exit if it failed."""
    from sumo_adv.cli.progress import summary
    from sumo_adv.report.folder import write_run

    result = write_run(folder, episode)
    folder.keep(force=force)
    if as_json:
        typer.echo(json.dumps({**result, "folder": str(folder.target)}))
    else:
        typer.echo(summary(result, folder.target))
    if episode.ending in FAILED_ENDINGS or (episode.declined and episode.best is None):
        typer.echo(f"sumo-adv: {result['reason']}", err=True)
        raise typer.Exit(1)


def _refuse_what_a_replay_ignores(context: typer.Context, source: Path | None) -> None:
    """Raises UsageError for an INPUT, and for the first option that a replay takes from the manifest."""
    if source is not None:
        raise UsageError("Give either an INPUT or --replay DIR, not both.")
    for parameter in context.command.params:
        source_of = context.get_parameter_source(str(parameter.name))
        if parameter.name not in OF_A_REPLAY and source_of is not None and source_of.name == "COMMANDLINE":
            raise UsageError(
                f"{parameter.opts[0]} has no effect on a replay, which takes everything from the run's manifest: "
                "leave it out, or give the INPUT for a new run."
            )


def _replay(source: Path, out: Path | None, ego: str | None, *, force: bool, as_json: bool) -> None:
    from sumo_adv.drivers.registry import trusted_driver
    from sumo_adv.report.manifest import read_manifest
    from sumo_adv.report.staging import staged

    recorded = read_manifest(source)
    driver = recorded.task.ego_driver
    if trusted_driver(ego, driver, source) != driver:
        raise UsageError(
            f"The run in {source} was driven by {driver!r}, and a replay repeats it: leave out --ego {ego}, "
            "or give the INPUT for a new run with that driver."
        )
    target = out or source.with_name(f"{source.resolve().name}-replay")
    with staged(target, force=force) as folder:
        episode = app.replay(recorded)
        finish(folder, episode, force=force, as_json=as_json)
