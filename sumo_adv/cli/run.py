"""``run``: one encounter, from a network to a dangerous one."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sumo_adv import app
from sumo_adv.cli.memory_common import Metric
from sumo_adv.config import Settings, Until, load_settings
from sumo_adv.datatypes import FAILED_ENDINGS
from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from sumo_adv.episode.episode import Episode
    from sumo_adv.report.folder import RunFolder
    from sumo_adv.simulation.inputs import RunInput

EXAMPLE = "Example: sumo-adv run priority_crossing --seed 3 --ego idm --until valid --out runs/mine"
OF_A_REPLAY = {"replay", "out", "force", "as_json", "ego"}  # options that count with --replay; ego confirms a class


def run(
    context: typer.Context,
    source: Annotated[
        Path | None,
        typer.Argument(metavar="INPUT", help="net.xml(.gz), .sumocfg, scenario .toml, .tfrecord, or a shipped name."),
    ] = None,
    record: Annotated[str | None, typer.Option(help="Of a .tfrecord: id, or place from 0 (default: 0).")] = None,
    ego: Annotated[
        str | None, typer.Option(help="krauss, idm, eidm, careful, lattice, blind, fiss_plus, replay, module:Class.")
    ] = None,
    ego_id: Annotated[str | None, typer.Option(help="The vehicle under test (default: chosen).")] = None,
    adversary: Annotated[str | None, typer.Option(help="The only vehicle that may attack.")] = None,
    trigger: Annotated[float | None, typer.Option(help="Attack from this time on, s (default: found).")] = None,
    begin: Annotated[float | None, typer.Option(help="Simulation begin, s (default: first departure).")] = None,
    end: Annotated[float | None, typer.Option(help="Look for an encounter until this time, s.")] = None,
    until: Annotated[
        Until | None, typer.Option(help="Level that an attempt must reach (default: critical, alias ttc).")
    ] = None,
    attempts: Annotated[int | None, typer.Option(help="At most so many attempts (default: 25).")] = None,
    diverse: Annotated[
        int | None, typer.Option(help="Go on until this many attacks of different kinds succeeded (default: 1).")
    ] = None,
    ttc: Annotated[float | None, typer.Option(help="Critical is a min TTC of at most this, s (default: 1).")] = None,
    tuner: Annotated[str | None, typer.Option(help="builtin or off.")] = None,
    llm: Annotated[
        str | None,
        typer.Option(help="A language model for all three parts: deepseek-chat, ollama:NAME, replay:FILE .."),
    ] = None,
    analyzer: Annotated[str | None, typer.Option(help="builtin or a model, for this part alone.")] = None,
    generator: Annotated[str | None, typer.Option(help="builtin or a model.")] = None,
    modifier: Annotated[str | None, typer.Option(help="builtin or a model.")] = None,
    fallback: Annotated[
        str | None, typer.Option(help="builtin: the expert goes on where a model fails (default: off).")
    ] = None,
    samples: Annotated[int | None, typer.Option(help="Ask the analyzer's model so many times (default: 1).")] = None,
    evidence: Annotated[str | None, typer.Option(help="on or off: show a model the predictor's figures.")] = None,
    instruction: Annotated[
        str | None, typer.Option(help="In words, how generated planners are to shape their trajectories.")
    ] = None,
    show_prompts: Annotated[
        bool, typer.Option("--show-prompts", help="Print what a model would be asked here, and ask nothing.")
    ] = False,
    learn: Annotated[str | None, typer.Option(help="on or off: keep what was critical in the bank.")] = None,
    recall: Annotated[
        str | None, typer.Option(help="intent, or scene: try first what worked in a like scene, asking nobody.")
    ] = None,
    memory: Annotated[
        Path | None, typer.Option(help="Memory bank; a copy of the shipped one if it is not there.")
    ] = None,
    metric: Metric = None,
    density: Annotated[float | None, typer.Option(help="Generated demand: departures a minute.")] = None,
    background: Annotated[
        str | None,
        typer.Option(
            help="log, sumo or mixed (SUMO drives those near the adversary): who drives recorded vehicles "
            "(default: as the input says, else log for a replayed ego)."
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of SUMO, demand, search and planners (default: 0).")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write (default: runs/<input>-<seed>).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace another run's folder.")] = False,
    settings_file: Annotated[Path | None, typer.Option("--settings", help="TOML file of settings.")] = None,
    replay: Annotated[
        Path | None, typer.Option(help="Run the attempt of that folder again, from its manifest.")
    ] = None,
    no_fork: Annotated[bool, typer.Option("--no-fork", help="Load and repeat instead of forking (slower).")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Turn an encounter into a dangerous one and write what happened."""
    if replay is not None:
        _refuse_what_a_replay_ignores(context, source)
        _replay(replay, out, ego, force=force, as_json=as_json)
        return
    given, driver = _input(source, record, ego)
    settings = load_settings(
        settings_file, ego=driver, ego_id=ego_id, adversary=adversary, trigger=trigger,
        begin=begin, end=end, until=until, attempts=attempts, diverse=diverse, ttc=ttc, tuner=tuner, learn=learn,
        recall=recall, memory=memory, metric=metric, seed=seed, llm=llm, analyzer=analyzer, generator=generator,
        modifier=modifier, fallback=fallback, samples=samples, evidence=evidence, instruction=instruction,
        density=density, background=background, horizon=given.horizon, fork=False if no_fork else None,
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
        raise UsageError("Give an INPUT: a net.xml, a .sumocfg, a scenario, or the name of a shipped one.")
    given = app.load(source, record)
    return given, trusted_driver(ego, given.ego_controller, given.source)


def _show_prompts(given: RunInput, settings: Settings, *, as_json: bool) -> None:
    from sumo_adv.cli.prompts import show

    show(given, settings, as_json=as_json)


def _run(given: RunInput, settings: Settings, target: Path, *, force: bool, as_json: bool) -> None:
    from sumo_adv.cli.interrupts import Interrupts
    from sumo_adv.cli.progress import make_reporter
    from sumo_adv.report.folder import staged

    reporter = make_reporter(quiet=as_json)
    with (
        Interrupts() as interrupts,
        staged(target, force=force) as folder,
        tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch,
    ):
        tell = interrupts.checked(reporter.tell)
        with reporter:
            episode = app.play(given, settings, folder.stage, Path(scratch), tell, interrupts.hold)
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
    if episode.ending in FAILED_ENDINGS:
        typer.echo(f"sumo-adv: {result['reason']}", err=True)
        raise typer.Exit(1)


def _refuse_what_a_replay_ignores(context: typer.Context, source: Path | None) -> None:
    """Raises UsageError for an INPUT, and for the first option that a replay takes from the manifest."""
    if source is not None:
        raise UsageError("Give either an INPUT or --replay DIR, not both.")
    for parameter in context.command.params:
        given = context.get_parameter_source(str(parameter.name))
        if parameter.name not in OF_A_REPLAY and given is not None and given.name == "COMMANDLINE":
            raise UsageError(
                f"{parameter.opts[0]} has no effect on a replay, which takes everything from the run's manifest: "
                "leave it out, or give the INPUT for a new run."
            )


def _replay(source: Path, out: Path | None, ego: str | None, *, force: bool, as_json: bool) -> None:
    from sumo_adv.drivers.registry import trusted_driver
    from sumo_adv.report.folder import staged
    from sumo_adv.report.manifest import read_manifest

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
