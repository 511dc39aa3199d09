"""``compare``: two drivers or two revisions, over the encounters that both have met."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from sumo_adv.errors import UsageError

EXAMPLE = "Example: sumo-adv compare runs/regress-main runs/regress-branch --out runs/compared"


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="Folder of a run, a campaign, a bench or a regression.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another one; or the same, with --egos.")],
    egos: Annotated[
        str | None, typer.Option(metavar="A,B", help="The driver to take of each, where a folder has several.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a page with the replays of the cases that changed.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace another comparison's folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Compare two sides: rates, severity, attempts until valid, and which cases changed, paired by encounter.

    Differences are B - A: a negative one means that B is hit less often or less hard.
    """
    from sumo_adv.comparison.compare import compare as compared
    from sumo_adv.comparison.compare import read_side
    from sumo_adv.comparison.page import to_markdown, write_comparison

    done = compared(read_side(first), read_side(second), _two(egos))
    page = None if out is None else write_comparison(out, done, force=force)
    if as_json:
        typer.echo(json.dumps(done.document() | {"page": None if page is None else str(page)}))
        return
    typer.echo(to_markdown(done, lambda episode: None if episode.run is None else str(episode.run)))
    if page is not None:
        typer.echo(f"Page: {page}")


def _two(egos: str | None) -> tuple[str, str] | None:
    if egos is None:
        return None
    names = [name.strip() for name in egos.split(",")]
    if len(names) != 2 or not all(names):
        raise UsageError(f"--egos takes two drivers, such as idm,careful, not '{egos}'.")
    return names[0], names[1]
