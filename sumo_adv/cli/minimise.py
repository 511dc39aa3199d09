"""``minimise``: the mildest variant of a found attack that still reaches its level."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sumo_adv import app
from sumo_adv.config import Until
from sumo_adv.errors import UsageError

EXAMPLE = "Example: sumo-adv minimise runs/priority_crossing-3"
ATTEMPTS = 25


def minimise(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run with a collision.")],
    until: Annotated[
        Until | None, typer.Option(help="Level that a variant must reach (default: the level of the attack).")
    ] = None,
    attempts: Annotated[int, typer.Option(min=1, help="Maximum number of simulations.")] = ATTEMPTS,
    ego: Annotated[
        str | None, typer.Option(help="Needed if a class drove the run: the class again, module:Class.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder to write (default: RUN-mildest).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace another run's folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Find the mildest variant of an attack (later, gentler, slower) that still reaches its level against this ego."""
    from sumo_adv.cli.progress import make_reporter
    from sumo_adv.cli.run import finish
    from sumo_adv.drivers.registry import trusted_driver
    from sumo_adv.report.manifest import read_manifest
    from sumo_adv.report.read import read_run, reading
    from sumo_adv.report.staging import staged

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
    target = out or run.with_name(f"{run.resolve().name}-mildest")
    reporter = make_reporter(quiet=as_json)
    with staged(target, force=force) as folder:
        with reporter:
            episode = app.minimise(recorded, settings, reporter.tell)
        finish(folder, episode, force=force, as_json=as_json)
