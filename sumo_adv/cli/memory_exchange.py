"""``memory export | import | build``: banks as folders of text."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from sumo_adv.app import open_bank
from sumo_adv.cli.memory_common import Bank, Json, answer, parse_parameters


def export(
    folder: Annotated[Path, typer.Argument(help="Folder to write.")],
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export there.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Write the bank as text: a folder an intent, with a planner a mode and its evidence; and the compositions."""
    from sumo_adv.memory.exchange import export_bank

    with open_bank(memory) as bank:
        count = export_bank(bank, folder, force=force)
        value = {"folder": str(folder), "intents": count, "hash": bank.content_hash()}
    answer(value, as_json, lambda: [f"Exported {count} intents to {folder}."])


def import_(
    folder: Annotated[Path, typer.Argument(help="Folder that export wrote.")],
    skip: Annotated[bool, typer.Option("--skip-refused", help="Take the rest where something is refused.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Add what the bank lacks of an export. If a planner fails in the sandbox, nothing is added."""
    from sumo_adv.errors import UsageError
    from sumo_adv.memory.exchange import import_bank
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.planners.trial import trier

    with open_bank(memory, make=True) as bank, Sandbox() as sandbox:
        added, refused = import_bank(bank, folder, parse_parameters, trier(sandbox), skip_refused=skip)
    if refused and not skip:
        named = "; ".join(f"{each.label} / {each.mode}: {each.reason.rstrip('.')}" for each in refused[:5])
        raise UsageError(
            f"Nothing of {folder} is imported, {len(refused)} of its planners fail in the sandbox ({named})."
        )
    value = {**asdict(added), "refused": [asdict(each) for each in refused]}
    answer(value, as_json, lambda: [
        f"Added {added.intents} intents, {added.planners} planners, {added.evidence} pieces of evidence"
        f"{f', {added.compositions} compositions' if added.compositions else ''}.",
        *(f"Refused {each.label} / {each.mode}: {each.reason}" for each in refused),
    ])  # fmt: skip


def build(
    folder: Annotated[Path, typer.Argument(help="Folder of the sources.")],
    target: Annotated[Path, typer.Argument(help="The bank to write.")],
) -> None:
    """Build a bank from text sources: a folder an intent, with intent.toml and a planner a mode."""
    from sumo_adv.memory.build import build as build_bank

    build_bank(folder, target, parse_parameters)
    typer.echo(f"Built {target}.")


COMMANDS = (
    ("export", export, "export my_bank --force"),
    ("import", import_, "import their_bank"),
    ("build", build, "build memory_bank memory_bank.sqlite"),
)
