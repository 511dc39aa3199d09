"""``memory add | merge | retire | new``: changing a bank by hand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.app import open_bank, shipped_bank
from sumo_adv.cli.memory_common import Bank, Json, answer, known_intent

if TYPE_CHECKING:
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.records import IntentRecord


def add(
    file: Annotated[Path, typer.Argument(metavar="PLANNER.py", help="The planner: Python in the sandbox's subset.")],
    label: Annotated[str, typer.Option(help="The intent that it realises.")],
    mode: Annotated[str | None, typer.Option(help="Its name among the intent's planners (else the file's).")] = None,
    description: Annotated[str | None, typer.Option(help="Of a new intent: one to three sentences.")] = None,
    applies: Annotated[str | None, typer.Option(help="Of a new intent: relations, e.g. leader,neighbour.")] = None,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Add a planner of your own, after it answered well in made-up situations in the sandbox."""
    from sumo_adv.errors import UsageError
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.planners.source import make_planner
    from sumo_adv.planners.trial import trial

    name = (mode or file.stem).strip()
    if not name or not name.isprintable() or len(name) > 80:
        raise UsageError("A mode is a short name; give another --mode.")
    source = _read(file)
    with open_bank(memory, make=True) as bank:
        intent = _intent_to_add(bank, label, description, applies)
        planner = make_planner(intent.label, name, source, "person")
        for existing in next((s.planners for s in bank.sources() if s.intent.label == intent.label), ()):
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
            raise UsageError(f"The planner {file} is not added. {wrong}")
        bank.add(intent, [planner])
    value = {"label": intent.label, "mode": name, "hash": planner.hash}
    answer(value, as_json, lambda: [f"Added {intent.label} / {name} ({planner.hash[:12]})."])


def _read(file: Path) -> str:
    from sumo_adv.errors import UsageError

    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise UsageError(f"The planner {file} cannot be read: {reason}.") from error


def _intent_to_add(bank: MemoryBank, label: str, description: str | None, applies: str | None) -> IntentRecord:
    """The intent as the bank has it, or a new one."""
    from sumo_adv.errors import UsageError
    from sumo_adv.memory.records import RELATIONS, IntentRecord

    record = bank.intent(label)
    if record is not None:
        if record.status != "active":
            raise UsageError(f"The intent {record.label!r} is retired; bring it back with: memory retire --undo.")
        if description is not None or applies is not None:
            raise UsageError(f"The intent {record.label!r} is there already; leave --description and --applies out.")
        return record
    if description is None or applies is None:
        raise UsageError(
            f"The intent {label!r} is new: give --description, and --applies with some of {', '.join(RELATIONS)}."
        )
    if not label.isprintable() or len(label) > 120:
        raise UsageError("A label has at most 120 characters that can be printed; give another --label.")
    words = tuple(dict.fromkeys(word.strip() for word in applies.split(",") if word.strip()))
    return IntentRecord(label, " ".join(description.split()), words)


def merge(
    label: Annotated[str | None, typer.Argument(metavar="A", help="The intent that is given up.")] = None,
    word: Annotated[str | None, typer.Argument(metavar="INTO", help="The word into.")] = None,
    into: Annotated[str | None, typer.Argument(metavar="B", help="The intent that takes over its planners.")] = None,
    propose: Annotated[bool, typer.Option("--propose", help="Only print what could be merged.")] = False,
    memory: Bank = None,
    as_json: Json = False,
) -> None:
    """Move the planners and the evidence of A into B; A is retired, and its label finds B from then on."""
    from dataclasses import asdict

    from sumo_adv.errors import UsageError
    from sumo_adv.memory.curate import near_duplicates

    if not propose and (label is None or into is None or word is None or word.casefold() != "into"):
        raise UsageError("Say which: memory merge 'A' into 'B', or memory merge --propose.")
    with open_bank(memory) as bank:
        if propose:
            duplicates = near_duplicates(bank)
            answer({"merge": [asdict(each) for each in duplicates]}, as_json, lambda: [
                f"{p.distance:.3f}  {p.label} into {p.into}: {p.reason}" for p in duplicates
            ] or ["Nothing looks alike."])  # fmt: skip
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
    path: Annotated[Path, typer.Argument(help="The new bank; nothing may be there.")],
    only: Annotated[str, typer.Option(help="Labels, with commas between them.")],
    memory: Annotated[Path | None, typer.Option("--memory", help="The bank to take from (else the shipped).")] = None,
    as_json: Json = False,
) -> None:
    """Make a bank with part of a library, such as the two intents of the paper's LLM-F."""
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.build import write_part
    from sumo_adv.memory.migrations import utc_now

    with MemoryBank.open(memory or shipped_bank(), read_only=True) as bank:
        labels = write_part(bank, path, [label.strip() for label in only.split(",") if label.strip()], utc_now)
    answer({"path": str(path), "intents": labels}, as_json, lambda: [f"Made {path} with {', '.join(labels)}."])


COMMANDS = (
    ("add", add, "add push_hard.py --label 'Close Car-following' --mode hard"),
    ("merge", merge, "merge 'Hard Stop' into 'Emergency Braking'"),
    ("retire", retire, "retire 'Straight Lane Shift' --mode side"),
    ("new", new, "new two.sqlite --only 'Emergency Braking,Close Car-following'"),
)
