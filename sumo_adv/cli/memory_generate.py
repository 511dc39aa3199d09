"""``memory generate``: a planner written by a language model from words alone, without any simulation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sumo_adv.app import new_sandbox, open_bank, shipped_prompts
from sumo_adv.cli.memory_common import Bank, Json, answer

if TYPE_CHECKING:
    from sumo_adv.config import Settings
    from sumo_adv.datatypes import LibraryEntry, Planner
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.records import IntentRecord


def generate(
    description: Annotated[str, typer.Argument(help="What the vehicle does, in one to three sentences.")],
    label: Annotated[str | None, typer.Option(help="The intent's label (default: the description's words).")] = None,
    applies: Annotated[
        str | None, typer.Option(help="Of a new intent: relations, e.g. leader,neighbour (default: the nearest's).")
    ] = None,
    llm: Annotated[str | None, typer.Option(help="The model (else that of the settings).")] = None,
    trajectory: Annotated[
        str | None, typer.Option(help="Your instruction for the trajectory, e.g. 'a cubic spline, at most 2 m/s2'.")
    ] = None,
    settings_file: Annotated[Path | None, typer.Option("--settings", help="TOML file of settings.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the planner; keep nothing.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Have a model write a planner, try it in the sandbox, and add it to the bank.

    For an intent that the bank has, it becomes one more mode of it.
    """
    from sumo_adv.config import load_settings
    from sumo_adv.errors import UsageError

    settings = load_settings(settings_file, llm=llm, instruction=trajectory)
    name = settings.player("generator")
    if name is None:
        raise UsageError("Only a language model can write planners from words: name one with --llm.")
    with open_bank(memory, make=not dry_run) as bank:
        intent, near = _intent(bank, label or " ".join(description.split()[:6]), description, applies)
        planner = _free_mode(bank, intent, _written(settings, name, intent, near))
        if not dry_run:
            bank.add(intent, [planner])
    value = {
        "label": intent.label, "applies": list(intent.applies), "mode": planner.mode, "hash": planner.hash,
        "by": planner.origin, "source": planner.source, "added": not dry_run,
    }  # fmt: skip
    done = f"{'Not added' if dry_run else 'Added'}: {intent.label} / {planner.mode} ({planner.hash[:12]})."
    answer(value, as_json, lambda: [planner.source, done])


def _intent(
    bank: MemoryBank, label: str, description: str, applies: str | None
) -> tuple[IntentRecord, list[LibraryEntry]]:
    """The intent as the bank has it or a new one, and the nearest entries as examples."""
    from sumo_adv.datatypes import LibraryEntry
    from sumo_adv.memory.records import IntentRecord

    nearest = [record for name, _ in bank.retrieve(label, description).nearest if (record := bank.intent(name))]
    near = [LibraryEntry(r.label, r.description, r.applies, tuple(bank.planners(r.label))) for r in nearest]
    existing = bank.intent(label)
    if existing is not None and existing.status == "active":
        return existing, near
    words = [word.strip() for word in (applies or "").split(",") if word.strip()] or list(near[0].applies)
    return IntentRecord(label, " ".join(description.split()), tuple(dict.fromkeys(words))), near


def _written(settings: Settings, name: str, intent: IntentRecord, near: list[LibraryEntry]) -> Planner:
    from sumo_adv.agents.generator import ModelGenerator
    from sumo_adv.datatypes import Intent
    from sumo_adv.llm.asking import MeteredModel
    from sumo_adv.llm.chat import Ledger
    from sumo_adv.llm.client import connect
    from sumo_adv.planners.trial import trial

    ledger = Ledger.for_settings(settings)
    with new_sandbox(settings) as sandbox:
        generator = ModelGenerator(
            MeteredModel(connect(name, settings, ledger), ledger), shipped_prompts(), settings.limits.limits(),
            lambda p: trial(sandbox, p, intent.applies, type_check=True), tries=settings.generations,
            instruction=settings.instruction,
        )  # fmt: skip
        return generator.generate(Intent("", intent.label, intent.description, "high", 0.0), None, near)[0]


def _free_mode(bank: MemoryBank, intent: IntentRecord, planner: Planner) -> Planner:
    """The planner with a mode that no other of its intent has."""
    from dataclasses import replace

    taken = {p.mode for p in bank.planners(intent.label)}
    modes = (planner.mode, *(f"{planner.mode}_{k}" for k in range(2, len(taken) + 3)))
    return replace(planner, mode=next(mode for mode in modes if mode not in taken))


COMMANDS = (("generate", generate, "generate 'A lorry ahead drops to walking pace in the bend' --llm deepseek-chat"),)
