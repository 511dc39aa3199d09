"""``memory``: look into a memory bank, and build the shipped one from its sources."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

if TYPE_CHECKING:
    from sumo_adv.memory.bank import MemoryBank

app = typer.Typer(
    no_args_is_help=True, help="Look into a memory bank of intents and planners.",
    epilog="Example: sumo-adv memory find 'squeezes in just ahead of us'",
)  # fmt: skip
Bank = Annotated[Path | None, typer.Option("--memory", help="The bank [default: the one in the user's data folder].")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]


def _open(path: Path | None) -> MemoryBank:
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.paths import default_bank_path
    from sumo_adv.world.inputs import data_folder

    return MemoryBank.open(path or default_bank_path(), seed_from=data_folder("memory_bank.sqlite"))


@app.command("list", epilog="Example: sumo-adv memory list --json")
def list_(memory: Bank = None, as_json: Json = False) -> None:
    """The intents of the bank, with their planners' modes and how often they were critical."""
    with _open(memory) as bank:
        rows = [
            {
                "label": r.label, "applies": list(r.applies), "status": r.status,
                "modes": [p.mode for p in bank.planners(r.label)], "evidence": len(bank.evidence(r.label)),
            }
            for r in bank.intents()
        ]  # fmt: skip
    if as_json:
        typer.echo(json.dumps({"intents": rows}))
        return
    for r in rows:
        modes = ", ".join(str(m) for m in cast(list[str], r["modes"]))
        typer.echo(f"{r['label']}: modes {modes}; evidence {r['evidence']}; {r['status']}")


@app.command("show", epilog="Example: sumo-adv memory show 'Straight Lane Shift'")
def show(label: str, memory: Bank = None) -> None:
    """An intent with its planners' source."""
    from sumo_adv.errors import UsageError

    with _open(memory) as bank:
        record = bank.intent(label)
        if record is None:
            known = ", ".join(r.label for r in bank.intents())
            raise UsageError(f"The bank has no intent '{label}'; it has: {known}.")
        typer.echo(f"{record.label}\n{record.description}\napplies to: {', '.join(record.applies)}")
        for planner in bank.planners(record.label):
            typer.echo(f"\n--- {planner.mode} ({planner.origin}, {planner.hash[:12]})\n{planner.source}")


@app.command("find", epilog="Example: sumo-adv memory find 'cuts in and brakes' --json")
def find(text: str, memory: Bank = None, as_json: Json = False) -> None:
    """The nearest intents to a description, their distance, the epsilon in force, and whether it is a hit."""
    with _open(memory) as bank:
        found = bank.retrieve(text, text)
    nearest = [{"label": label, "distance": round(d, 4)} for label, d in found.nearest]
    if as_json:
        typer.echo(json.dumps({"hit": found.hit, "epsilon": found.epsilon, "nearest": nearest}))
        return
    typer.echo(f"{'Hit: ' + found.hit if found.hit else 'No hit'} (epsilon {found.epsilon:.2f})")
    for n in nearest[:5]:
        typer.echo(f"  {n['distance']:.3f}  {n['label']}")


@app.command("build", epilog="Example: sumo-adv memory build memory_bank memory_bank.sqlite")
def build(folder: Path, target: Path) -> None:
    """Build a bank from text sources: a folder an intent, with intent.toml and a planner a mode."""
    from sumo_adv.memory.build import build as build_bank
    from sumo_adv.planning.source import parse_parameters

    build_bank(folder, target, parse_parameters)
    typer.echo(f"Built {target}.")
