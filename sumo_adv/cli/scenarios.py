"""``scenarios``: what is shipped and can be run by its name."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

EXAMPLE = "Example: sumo-adv scenarios"


def scenarios(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """List the shipped scenarios with road, intent and a description, and the shipped networks."""
    from sumo_adv.simulation.shipped import shipped_files, shipped_scenarios

    found, networks = shipped_scenarios(), shipped_files("networks", ".net.xml")
    if as_json:
        typer.echo(json.dumps({"scenarios": [asdict(s) for s in found], "networks": networks}))
        return
    names, roads = (max(map(len, words)) for words in ([s.name for s in found], [s.road for s in found]))
    typer.echo(f"{'scenario':{names}}  {'road':{roads}}  intent")
    for s in found:
        typer.echo(f"{s.name:{names}}  {s.road:{roads}}  {', '.join(s.intents)}\n    {s.description}")
    typer.echo(f"Networks: {', '.join(networks)}")
