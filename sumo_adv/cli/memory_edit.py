"""Define the commands of ``memory`` that change a bank: by hand, with a language model, or as folders of text.

It also holds what all commands of ``memory`` share.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.app import new_sandbox, open_bank, shipped_bank, shipped_prompts
from sumo_adv.cli.options import words
from sumo_adv.config import Settings, load_settings
from sumo_adv.datatypes import Intent, LibraryEntry, Planner
from sumo_adv.errors import UsageError
from sumo_adv.planners.text import make_planner, parse_parameters

if TYPE_CHECKING:
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.records import IntentRecord

Bank = Annotated[
    Path | None,
    typer.Option(
        "--memory", envvar="SUMO_ADV_MEMORY", show_envvar=False,
        help="The bank (default: SUMO_ADV_MEMORY or, if it is not set, the one in the user's data folder).",
    ),
]  # fmt: skip
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]


def known_intent(bank: MemoryBank, label: str) -> IntentRecord:
    """Return the intent with a label.

    Raises:
        UsageError: The bank has no such intent. The message lists those it has.
    """
    record = bank.intent(label)
    if record is None:
        labels = ", ".join(r.label for r in bank.intents())
        raise UsageError(f"The bank has no intent '{label}'; it has: {labels}.")
    return record


def answer(value: dict[str, Any], as_json: bool, lines: Callable[[], list[str]]) -> None:
    """Print a result.

    Args:
        value: The result as data.
        as_json: Whether the data are printed as JSON.
        lines: Makes the lines for people.
    """
    for line in [json.dumps(value)] if as_json else lines():
        typer.echo(line)


def add(
    file: Annotated[Path, typer.Argument(metavar="PLANNER.py", help="The planner: Python in the sandbox's subset.")],
    label: Annotated[str, typer.Option(help="The intent that it realises.")],
    mode: Annotated[
        str | None, typer.Option(help="Name of the planner within the intent (default: the file's name).")
    ] = None,
    description: Annotated[
        str | None, typer.Option(help="Description of a new intent: one to three sentences.")
    ] = None,
    applies: Annotated[str | None, typer.Option(help="Relations of a new intent, e.g. leader,neighbour.")] = None,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Add a planner of your own, after it answered well in made-up situations in the sandbox."""
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.planners.trial import trial

    name = (mode or file.stem).strip()
    if not name or not name.isprintable() or len(name) > 80:
        raise UsageError("A mode is a short name; give another --mode.")
    text = _read(file)
    with open_bank(memory, make=True) as bank:
        intent = _intent_to_add(bank, label, description, applies)
        planner = make_planner(intent.label, name, text, "person")
        for existing in next((s.planners for s in bank.stored_intents() if s.intent.label == intent.label), ()):
            if existing.hash == planner.hash:
                raise UsageError(
                    f"The bank has this planner for {intent.label!r} already, as the mode {existing.mode!r}."
                )
            if existing.mode == planner.mode:
                raise UsageError(
                    f"The intent {intent.label!r} has a planner of the mode {name!r}; give another --mode."
                )
        with Sandbox() as sandbox:
            wrong = trial(sandbox, planner, intent.applies)
        if wrong is not None:
            raise UsageError(f"The planner {file} is not added. {wrong.rstrip('.')}.")
        bank.add(intent, [planner])
    value = {"label": intent.label, "mode": name, "hash": planner.hash}
    answer(value, as_json, lambda: [f"Added {intent.label} / {name} ({planner.hash[:12]})."])


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise UsageError(f"The planner {file} cannot be read: {reason}.") from error


def _intent_to_add(bank: MemoryBank, label: str, description: str | None, applies: str | None) -> IntentRecord:
    """Return the intent that a planner is added to: an active one of the bank, or a new one.

    Raises:
        UsageError: The intent is retired, or the options do not fit it.
    """
    from sumo_adv.memory.records import RELATIONS, IntentRecord

    record = bank.intent(label)
    if record is not None:
        if record.status != "active":
            raise UsageError(f"The intent {record.label!r} is retired; bring it back with: memory retire --undo.")
        if description is not None or applies is not None:
            raise UsageError(f"The intent {record.label!r} already exists; leave out --description and --applies.")
        return record
    if description is None or applies is None:
        raise UsageError(
            f"The intent {label!r} is new: give --description, and --applies with some of {', '.join(RELATIONS)}."
        )
    if not label.isprintable() or len(label) > 120:
        raise UsageError("A label has at most 120 characters that can be printed; give another --label.")
    return IntentRecord(label, " ".join(description.split()), tuple(dict.fromkeys(words(applies))))


def merge(
    label: Annotated[str | None, typer.Argument(metavar="A", help="The intent to merge.")] = None,
    word: Annotated[str | None, typer.Argument(metavar="INTO", help="The word into.")] = None,
    into: Annotated[str | None, typer.Argument(metavar="B", help="The intent that takes over its planners.")] = None,
    propose: Annotated[bool, typer.Option("--propose", help="Only print what could be merged.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Move the planners and the evidence of A into B; A is retired, and its label finds B from then on."""
    from sumo_adv.memory.curate import near_duplicates

    if not propose and (label is None or into is None or word is None or word.casefold() != "into"):
        raise UsageError("Give two intents: memory merge 'A' into 'B'; or memory merge --propose.")
    with open_bank(memory) as bank:
        if propose:
            duplicates = near_duplicates(bank)
            answer({"merge": [asdict(each) for each in duplicates]}, as_json, lambda: [
                f"{p.distance:.3f}  {p.label} into {p.into}: {p.reason}" for p in duplicates
            ] or ["No intents look alike."])  # fmt: skip
            return
        assert label is not None and into is not None
        merged, kept = known_intent(bank, label), known_intent(bank, into)
        bank.merge(merged.label, kept.label)
        modes = [planner.mode for planner in bank.planners(kept.label)]
    value = {"merged": merged.label, "into": kept.label, "modes": modes}
    answer(
        value, as_json, lambda: [f"Merged {merged.label} into {kept.label}, which has the modes {', '.join(modes)}."]
    )


def retire(
    label: str,
    mode: Annotated[str | None, typer.Option(help="Only the planners of this mode.")] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Make it active again.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Retire an intent or one mode of it: it is kept, but neither found nor driven any more."""
    with open_bank(memory) as bank:
        record = known_intent(bank, label)
        bank.retire(record.label, mode, back=undo)
        status = known_intent(bank, label).status
        modes = [planner.mode for planner in bank.planners(record.label)]
    value: dict[str, Any] = {"label": record.label, "status": status, "modes": modes}
    answer(value, as_json, lambda: [f"{record.label} is {status}; active modes: {', '.join(modes) or 'none'}."])


def new(
    path: Annotated[Path, typer.Argument(help="The new bank; the path must not exist.")],
    only: Annotated[str, typer.Option(help="Labels, with commas between them.")],
    memory: Annotated[
        Path | None, typer.Option("--memory", help="The bank to take the intents from (default: the shipped one).")
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a bank with part of a library, such as the two intents of the paper's LLM-F."""
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.build import write_part
    from sumo_adv.memory.migrations import utc_now

    with MemoryBank.open(memory or shipped_bank(), read_only=True) as bank:
        labels = write_part(bank, path, words(only), utc_now)
    answer({"path": str(path), "intents": labels}, as_json, lambda: [f"Made {path} with {', '.join(labels)}."])


def generate(
    description: Annotated[str, typer.Argument(help="What the vehicle does, in one to three sentences.")],
    label: Annotated[str | None, typer.Option(help="The intent's label (default: the description's words).")] = None,
    applies: Annotated[
        str | None,
        typer.Option(help="Relations of a new intent, e.g. leader,neighbour (default: those of the nearest intent)."),
    ] = None,
    llm: Annotated[str | None, typer.Option(help="The model (default: that of the settings).")] = None,
    trajectory: Annotated[
        str | None, typer.Option(help="Your instruction for the trajectory, e.g. 'a cubic spline, at most 2 m/s2'.")
    ] = None,
    settings_file: Annotated[Path | None, typer.Option("--settings", help="TOML file of settings.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the planner without storing it.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Have a model write a planner, try it in the sandbox, and add it to the bank.

    For an intent that the bank has, it becomes one more mode of it.
    """
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
        "by": planner.origin, "source": planner.text, "added": not dry_run,
    }  # fmt: skip
    done = f"{'Not added' if dry_run else 'Added'}: {intent.label} / {planner.mode} ({planner.hash[:12]})."
    answer(value, as_json, lambda: [planner.text, done])


def _intent(
    bank: MemoryBank, label: str, description: str, applies: str | None
) -> tuple[IntentRecord, list[LibraryEntry]]:
    """Return the bank's active intent or a new one, and the nearest entries as examples."""
    from sumo_adv.memory.records import IntentRecord

    nearest = [record for name, _ in bank.retrieve(label, description).nearest if (record := bank.intent(name))]
    near = [LibraryEntry(r.label, r.description, r.applies, tuple(bank.planners(r.label))) for r in nearest]
    existing = bank.intent(label)
    if existing is not None and existing.status == "active":
        return existing, near
    relations = words(applies or "") or near[0].applies
    return IntentRecord(label, " ".join(description.split()), tuple(dict.fromkeys(relations))), near


def _written(settings: Settings, name: str, intent: IntentRecord, near: list[LibraryEntry]) -> Planner:
    """Have a model write a planner that passes its trial in the sandbox."""
    from sumo_adv.agents.generator import ModelGenerator
    from sumo_adv.llm.asking import MeteredModel
    from sumo_adv.llm.chat import Ledger
    from sumo_adv.llm.client import open_model
    from sumo_adv.planners.trial import trial

    ledger = Ledger.for_settings(settings)
    with new_sandbox(settings) as sandbox:
        generator = ModelGenerator(
            MeteredModel(open_model(name, settings, ledger), ledger), shipped_prompts(), settings.limits.limits(),
            lambda p: trial(sandbox, p, intent.applies, type_check=True), tries=settings.generations,
            instruction=settings.instruction, applies=intent.applies,
        )  # fmt: skip
        return generator.generate(Intent("", intent.label, intent.description, "high", 0.0), None, near)[0]


def _free_mode(bank: MemoryBank, intent: IntentRecord, planner: Planner) -> Planner:
    """Return the planner with a mode that no other planner of its intent has."""
    taken = {p.mode for p in bank.planners(intent.label)}
    modes = (planner.mode, *(f"{planner.mode}_{k}" for k in range(2, len(taken) + 3)))
    return replace(planner, mode=next(mode for mode in modes if mode not in taken))


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
    skip: Annotated[bool, typer.Option("--skip-refused", help="Import the rest if something is refused.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Add what the bank lacks of an export. If a planner fails in the sandbox, nothing is added."""
    from sumo_adv.memory.exchange import import_bank
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.planners.trial import trier

    with open_bank(memory, make=True) as bank, Sandbox() as sandbox:
        added, refused = import_bank(bank, folder, parse_parameters, trier(sandbox), skip_refused=skip)
    if refused and not skip:
        named = "; ".join(f"{each.label} / {each.mode}: {each.reason.rstrip('.')}" for each in refused[:5])
        raise UsageError(
            f"Nothing of {folder} is imported: {len(refused)} of its planners fail in the sandbox ({named})."
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


EDIT_COMMANDS = (
    ("add", add, "add push_hard.py --label 'Close Car-following' --mode hard"),
    ("merge", merge, "merge 'Hard Stop' into 'Emergency Braking'"),
    ("retire", retire, "retire 'Straight Lane Shift' --mode side"),
    ("new", new, "new two.sqlite --only 'Emergency Braking,Close Car-following'"),
    ("generate", generate, "generate 'A lorry ahead drops to walking pace in the bend' --llm deepseek-chat"),
    ("export", export, "export my_bank --force"),
    ("import", import_, "import their_bank"),
    ("build", build, "build memory_bank memory_bank.sqlite"),
)
