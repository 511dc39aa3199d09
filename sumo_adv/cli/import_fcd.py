"""``import``: a recording of another program as a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

EXAMPLE = "Example: sumo-adv import fcd.xml --network town.net.xml --ego 17 --out recorded"


def import_fcd(
    recording: Annotated[Path, typer.Argument(metavar="FCD", help="What sumo --fcd-output wrote, packed or not.")],
    network: Annotated[Path, typer.Option(help="The .net.xml that it was driven on.")],
    ego: Annotated[str, typer.Option(help="Id of the vehicle under test.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    types: Annotated[
        list[Path] | None, typer.Option(help="File of vTypes that say how large vehicles are; repeatable.")
    ] = None,
    warm_up: Annotated[
        float, typer.Option(min=0.0, help="How long the recording moves all vehicles after the ego came, s.")
    ] = 3.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier import.")] = False,
) -> None:
    """Make a scenario of floating car data: run it with any ego; the other vehicles become SUMO's, or stay recorded."""
    from sumo_adv.report.staging import staged
    from sumo_adv.simulation.fcd_scenario import SCENARIO, write_scenario
    from sumo_adv.simulation.scan import scan_network

    scan_network(network)
    with staged(out, force=force, marker=SCENARIO) as folder:
        count = write_scenario(folder.stage, recording, network, ego, types or (), warm_up)
        folder.keep(force=force)
    typer.echo(f"{count} objects; run it: sumo-adv run {out / SCENARIO}")
