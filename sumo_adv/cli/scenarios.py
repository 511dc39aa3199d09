"""``scenarios``: what is shipped and can be run by its name."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from sumo_adv.simulation.shipped import ShippedScenario

EXAMPLE = "Example: sumo-adv scenarios"
MEANS = (
    "Adversary, level and intent are those of the best attack: sumo-adv run SCENARIO --until serious --learn off,\n"
    "with --adversaries 2 for one of 2."
)


def scenarios(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """List the shipped scenarios with road, best attack and a description, and the shipped networks."""
    from sumo_adv.simulation.shipped import shipped_files, shipped_scenarios

    shipped, networks = shipped_scenarios(), shipped_files("networks", ".net.xml")
    if as_json:
        typer.echo(json.dumps({"scenarios": [asdict(s) for s in shipped], "networks": networks}))
        return
    rows = [("scenario", "road", "adversary", "level", "intent")]
    rows += [(s.name, s.road, _adversary(s), s.level or "-", s.intents[0]) for s in shipped]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    typer.echo(lines[0])
    for line, s in zip(lines[1:], shipped, strict=True):
        typer.echo(f"{line}\n    {s.description}")
    typer.echo(f"Networks: {', '.join(networks)}\n{MEANS}")


def _adversary(scenario: ShippedScenario) -> str:
    """The collider's relation, and how many adversaries there are if there are several."""
    relation = scenario.relation or "-"
    return relation if scenario.adversaries == 1 else f"{relation}, of {scenario.adversaries}"
