"""Export a bank to a folder of text and import it: ``memory export`` writes it, ``memory import`` and ``memory build``
read it.

The text depends only on the bank's content (no time stamps, everything sorted), so that it can be compared and reviewed
like code. Settings are left out, because epsilon is calibrated where a bank is used.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import tempfile
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from sumo_adv.datatypes import Planner
from sumo_adv.errors import BankError
from sumo_adv.files import toml_lines, toml_text
from sumo_adv.memory.bank import MemoryBank, all_compositions
from sumo_adv.memory.build import (
    COMPOSITIONS_FILE,
    EVERYTHING,
    EVIDENCE_FILE,
    Parse,
    read_compositions,
    read_folder,
    write_evidence,
)
from sumo_adv.memory.edits import Absorbed, free_mode
from sumo_adv.memory.records import Composition, IntentRecord, StoredIntent, canonical, plain_composition
from sumo_adv.memory.store import as_bank_errors

Verify = Callable[[IntentRecord, Planner], str | None]
"""Tries a planner in a place where it can do no harm; returns None, or what is wrong with it."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A planner that an import refused.

    Attributes:
        label: The label of its intent, or the name of a folder or file that cannot be read.
        mode: Its mode, or ``EVERYTHING``.
        reason: Why it was refused.
    """

    label: str
    mode: str
    reason: str


def export_bank(bank: MemoryBank, folder: Path, *, force: bool = False) -> int:
    """Write the bank to a folder, whole or not at all.

    Args:
        bank: The bank to export.
        folder: The path of the folder.
        force: Whether to replace an earlier export.

    Returns:
        The number of intents.

    Raises:
        BankError: The folder exists without ``force``, or holds anything but an export.
    """
    if folder.exists() and not (force and _is_export(folder)):
        sentence = (
            "is not an export, so it is not replaced; give another folder"
            if force
            else "already exists; give --force to replace an earlier export"
        )
        raise BankError(f"The folder {folder} {sentence}.")
    stored_intents = sorted(bank.stored_intents(), key=lambda stored: canonical(stored.intent.label))
    slugs: set[str] = set()
    with as_bank_errors(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as scratch:
            fresh, old = Path(scratch) / "new", Path(scratch) / "old"
            fresh.mkdir()
            for stored in stored_intents:
                slug = free_mode(_slug(stored.intent.label), slugs)
                slugs.add(slug)
                _write_intent(fresh / slug, stored)
            if composed := all_compositions(bank):
                _write(fresh / COMPOSITIONS_FILE, "\n".join(map(_composition, composed)))
            if folder.exists():
                folder.replace(old)
            try:
                fresh.replace(folder)
            except OSError:
                if old.exists():
                    shutil.move(old, folder)
                raise
    return len(stored_intents)


def import_bank(
    bank: MemoryBank, folder: Path, parse: Parse, verify: Verify, *, skip_refused: bool = False
) -> tuple[Absorbed, list[Refused]]:
    """Add what the bank lacks of an export, in one transaction, after ``verify`` has examined each planner.

    Args:
        bank: The bank to add to.
        folder: The folder of the export.
        parse: Reads a planner's PARAMETERS table without running the planner.
        verify: Tries a planner; returns None, or what is wrong with it.
        skip_refused: Whether to import the rest if planners are refused or files cannot be read. Without it, nothing is
            added after a refusal.

    Returns:
        The additions and the refusals.

    Raises:
        BankError: The folder cannot be read.
    """
    refused: list[Refused] = []
    taken = []

    def refuse(label: str, mode: str, error: BankError) -> None:
        refused.append(Refused(label, mode, str(error)))

    for stored in read_folder(folder, parse, refuse if skip_refused else None):
        bad: set[str] = set()
        for planner in stored.planners:
            if (reason := verify(stored.intent, planner)) is not None:
                refused.append(Refused(stored.intent.label, planner.mode, reason))
                bad.add(planner.hash)
        kept = tuple(planner for planner in stored.planners if planner.hash not in bad)
        evidence = tuple(each for each in stored.evidence if each.planner_hash not in bad)
        if kept or stored.merged_into is not None:
            taken.append(replace(stored, planners=kept, evidence=evidence))
    try:
        composed = read_compositions(folder)
    except BankError as error:
        if not skip_refused:
            raise
        composed = []
        refuse(COMPOSITIONS_FILE, EVERYTHING, error)
    if refused and not skip_refused:
        return Absorbed(), refused
    return bank.absorb(taken, compositions=composed), refused


def _is_export(folder: Path) -> bool:
    """Return whether the folder holds only what an export writes."""
    if folder.is_symlink() or not folder.is_dir():
        return False
    for entry in folder.iterdir():
        if entry.name == COMPOSITIONS_FILE and entry.is_file() and not entry.is_symlink():
            continue
        if entry.is_symlink() or not (entry / "intent.toml").is_file():
            return False
        if any(not f.is_file() or (f.suffix != ".py" and f.name not in ("intent.toml", EVIDENCE_FILE))
               for f in entry.iterdir()):  # fmt: skip
            return False
    return True


def _write_intent(folder: Path, stored: StoredIntent) -> None:
    """Write the folder of an intent."""
    folder.mkdir()
    names: dict[str, str] = {}
    for planner in stored.planners:
        names[planner.hash] = free_mode(_slug(planner.mode), set(names.values()))
        _write(folder / f"{names[planner.hash]}.py", planner.text)
    _write(folder / "intent.toml", _toml(stored, names))
    if stored.evidence:
        _write(folder / EVIDENCE_FILE, write_evidence(stored.evidence, names))


def _composition(c: Composition) -> str:
    """Return the TOML text of a composition."""
    plain = plain_composition(c)
    parts = plain.pop("parts")
    lines = ["[[compositions]]", *toml_lines(plain)]
    for part in parts:
        lines += ["", "[[compositions.parts]]", *toml_lines(part)]
    return "\n".join(lines) + "\n"


def _write(file: Path, text: str) -> None:
    """Write a text file without changing line ends."""
    file.write_text(text, encoding="utf-8", newline="")


def _slug(name: str) -> str:
    """Return a file name of lower-case letters and digits, or with part of a hash if the name has neither."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return plain[:80] or f"intent_{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def _toml(stored: StoredIntent, names: dict[str, str]) -> str:
    """Return the text of an ``intent.toml``."""
    intent = stored.intent
    words = toml_text(" ".join(intent.description.split()))[1:-1]
    wrapped = "\n".join(textwrap.wrap(words, 118, break_long_words=False, break_on_hyphens=False))
    status = None if intent.status == "active" else intent.status
    lines = [
        f"label = {toml_text(intent.label)}", f'description = """\n{wrapped}\n"""',
        *toml_lines({"applies": intent.applies, "status": status, "merged_into": stored.merged_into}),
    ]  # fmt: skip
    for planner in stored.planners:
        name = names[planner.hash]
        more = {
            "mode": planner.mode if planner.mode != name else None,
            "origin": planner.origin if planner.origin != "seed" else None,
            "parent": planner.parent,
            "status": "retired" if planner.hash in stored.retired else None,
        }
        if fields := toml_lines(more):
            lines += ["", f"[planners.{name}]", *fields]
    return "\n".join(lines) + "\n"
