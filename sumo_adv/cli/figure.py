"""``figure``: pictures and films of a run; what a hunt found over time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from sumo_adv.errors import UsageError

EXAMPLE = "Example: sumo-adv figure runs/priority_crossing-3 --out encounter.pdf"
PICTURES, FILMS = ("png", "svg", "pdf"), ("gif", "mp4")


def figure(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run or a hunt.")],
    out: Annotated[
        Path | None, typer.Option(help="A .png, .svg, .pdf, .gif or .mp4 file (default: figure.png in DIR).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Draw a run as papers do, without and with the attack, or film the attack. Of a hunt: its failures over time."""
    target = out or folder / "figure.png"
    kind = target.suffix.removeprefix(".").lower()
    if kind not in (*PICTURES, *FILMS):
        kinds = ", ".join(f".{k}" for k in (*PICTURES, *FILMS))
        raise UsageError(f"{target} does not say what to draw; give --out a file that ends in one of {kinds}.")
    if target.is_dir() or (target.exists() and not force):
        raise UsageError(f"{target} is there already; give another --out, or --force to replace a file.")
    from sumo_adv.hunting.hunt import STATE

    if (folder / STATE).is_file():
        _draw_hunt(folder, target, kind)
    else:
        _draw_run(folder, target, kind)
    typer.echo(json.dumps({"out": str(target), "kind": kind}) if as_json else f"Figure: {target}")


def _draw_hunt(folder: Path, target: Path, kind: str) -> None:
    from sumo_adv.files import sentences
    from sumo_adv.hunting.hunt import over_time
    from sumo_adv.report.figures import draw_over_time, save

    if kind in FILMS:
        raise UsageError(f"A hunt has no film: give --out a file that ends in one of .{', .'.join(PICTURES)}.")
    after = over_time(folder)
    with sentences(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        save(draw_over_time(after), target, kind)


def _draw_run(folder: Path, target: Path, kind: str) -> None:
    from sumo_adv.files import sentences
    from sumo_adv.report.figures import read_story
    from sumo_adv.report.read import reading

    with reading(folder), sentences(target):
        story = read_story(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        if kind in FILMS:
            from sumo_adv.report.figures import write_film

            write_film(story, target, kind)
        else:
            from sumo_adv.report.figures import draw_paper, save

            save(draw_paper(story), target, kind)
