"""Compositions in a bank: exported, imported, merged, listed and checked; a damaged one is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, CUT_IN, CUT_PLANNER
from cli_samples import Program
from hostile_banks import bank_of, spoil
from test_bank_build import parse
from test_memory_exchange import fine, texts

from sumo_adv.datatypes import Duty
from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank, all_compositions, compositions
from sumo_adv.memory.build import build, write_part
from sumo_adv.memory.exchange import Refused, export_bank, import_bank
from sumo_adv.memory.records import MAX_FAILURES_IN_A_ROW, Composition, IntentRecord, Part

BLOCK = Part(Duty.BLOCK_LEFT, "Escape Block Left", "beside")
SQUEEZE = Composition(
    "Squeeze", 'One cuts in, the "other" blocks.', (Part(Duty.COLLIDER, CUT_IN.label, CUT_PLANNER.mode), BLOCK)
)
TRAP = Composition(
    "Trap", "The leader brakes and the others stay.",
    (Part(Duty.COLLIDER, BRAKING.label, BRAKE_PLANNER.mode), BLOCK, Part(Duty.HIDE, "View Screen", "")),
)  # fmt: skip


def filled(path: Path) -> MemoryBank:
    """A bank with two compositions, of which the second is forgotten."""
    bank = MemoryBank.open(path)
    bank.add(BRAKING, [BRAKE_PLANNER])
    bank.add(CUT_IN, [CUT_PLANNER])
    bank.record_composition(SQUEEZE, [True, True, False])
    bank.record_composition(TRAP, [True] + [False] * MAX_FAILURES_IN_A_ROW)
    return bank


def test_compositions_survive_export_import_and_build(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with filled(tmp_path / "bank.sqlite") as bank:
        export_bank(bank, out)
        export_bank(bank, out, force=True)
        expected_hash = bank.content_hash()
        assert all_compositions(bank) == [
            replace(SQUEEZE, succeeded=2, failed=1), replace(TRAP, succeeded=1, failed=MAX_FAILURES_IN_A_ROW),
        ]  # fmt: skip
    with MemoryBank.open(tmp_path / "back.sqlite") as back:
        added, refused = import_bank(back, out, parse, fine)
        assert (added.compositions, refused, back.content_hash()) == (2, [], expected_hash)
        back.record_composition(SQUEEZE, [True])
        assert import_bank(back, out, parse, fine)[0].compositions == 0
        assert compositions(back) == [replace(SQUEEZE, succeeded=3)]  # the import changed nothing
    build(out, tmp_path / "built.sqlite", parse)
    with MemoryBank.open(tmp_path / "built.sqlite") as built:
        export_bank(built, tmp_path / "again")
    assert texts(tmp_path / "again") == texts(out)


@pytest.mark.parametrize("without", [{"label": "-"}, {"description": " "}])
def test_a_composition_needs_a_label_and_a_description(without: dict[str, str]) -> None:
    with pytest.raises(BankError, match="needs a label and a description"):
        replace(SQUEEZE, **without)


def test_a_part_of_a_bank_has_the_compositions_of_its_intents(tmp_path: Path) -> None:
    with filled(tmp_path / "bank.sqlite") as bank:
        write_part(bank, tmp_path / "part.sqlite", [CUT_IN.label], lambda: "now")
    with MemoryBank.open(tmp_path / "part.sqlite") as part:
        assert all_compositions(part) == [replace(SQUEEZE, succeeded=2, failed=1)]  # Trap's collider brakes


def test_a_composition_follows_an_intent_that_is_merged(tmp_path: Path) -> None:
    """The planner's mode is taken in the other intent, so it gets a number there."""
    stop_planner = replace(BRAKE_PLANNER, label="Stop", text=BRAKE_PLANNER.text + "# theirs\n")
    with filled(tmp_path / "bank.sqlite") as bank:
        bank.add(IntentRecord("Stop", "It stops.", ("leader",)), [stop_planner])
        stop = replace(SQUEEZE, label="Stop Trap", parts=(Part(Duty.COLLIDER, "Stop", stop_planner.mode), BLOCK))
        bank.record_composition(stop, [True])
        bank.merge("Stop", BRAKING.label)
        (after,) = (c for c in compositions(bank) if c.label == "Stop Trap")
        assert after.parts == (Part(Duty.COLLIDER, BRAKING.label, f"{stop_planner.mode}-2"), BLOCK)
        assert [c.parts for c in compositions(bank) if c.label == "Squeeze"] == [SQUEEZE.parts]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('role = "block_left"', 'role = "ram"', "the role of a part"),
        ('role = "block_left"', 'role = "collider"', "a collider, then supports"),
        ("succeeded = 2", "succeeded = -2", "whole numbers of 0 or more"),
        ("succeeded = 2", "succeeded = true", "succeeded in a composition has the wrong type"),
        ("succeeded = 2", "succeeded = 2\nplanner = 'import os'", "and nothing else"),
        ('label = "Trap"', 'label = "squeeze"', "holds a composition twice"),
        ('label = "Trap"', 'label = "\\u001b[31mTrap"', "that can be printed"),
        ("[[compositions]]", "[[compositions]", "cannot be read"),
        ("[[compositions]]", f"x = {'[' * 5000}", "cannot be read"),
    ],
)
def test_a_wrong_file_of_compositions_is_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    with filled(tmp_path / "bank.sqlite") as bank:
        export_bank(bank, tmp_path / "out")
    file = tmp_path / "out" / "compositions.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with MemoryBank.open(tmp_path / "mine.sqlite") as receiver:
        before = receiver.content_hash()
        with pytest.raises(BankError, match=sentence) as raised:
            import_bank(receiver, tmp_path / "out", parse, fine)
        assert "\n" not in str(raised.value) and receiver.content_hash() == before
        added, refused = import_bank(receiver, tmp_path / "out", parse, fine, skip_refused=True)
        assert (added.intents, added.compositions) == (2, 0)
        assert refused == [Refused("compositions.toml", "everything", str(raised.value))]


def test_a_link_out_of_an_export_is_refused(tmp_path: Path) -> None:
    with filled(tmp_path / "bank.sqlite") as bank:
        export_bank(bank, tmp_path / "out")
    file = tmp_path / "out" / "compositions.toml"
    file.rename(tmp_path / "secret.toml")
    file.symlink_to(tmp_path / "secret.toml")
    with MemoryBank.open(tmp_path / "mine.sqlite") as receiver, pytest.raises(BankError, match="not a plain file"):
        import_bank(receiver, tmp_path / "out", parse, fine)


@pytest.mark.parametrize("value", [7, {"label": "Squeeze"}, {"label": "Other", "description": "Two.", "parts": []}])
def test_a_bank_with_what_is_no_composition_is_damaged(tmp_path: Path, value: object) -> None:
    path = bank_of(tmp_path / "bank.sqlite")
    spoil(path, (f"INSERT INTO settings VALUES ('{SQUEEZE.key}', '{json.dumps(value)}')",))
    with pytest.raises(BankError, match="damaged in its setting") as raised:
        MemoryBank.open(path)
    assert "\n" not in str(raised.value)


def test_the_commands_list_show_and_check_compositions(program: Program) -> None:
    path = program.folder / "bank.sqlite"
    with filled(path) as bank:
        bank.retire(CUT_IN.label)
    listed = program.here("memory", "list", "--memory", path)
    assert "Squeeze: composed of Aggressive Cut-in + Escape Block Left; 2 attempts succeeded, 1 failed" in listed.out
    assert "; forgotten" in listed.out
    shown = json.loads(program.here("memory", "show", "squeeze", "--json", "--memory", path).out)
    assert [part["role"] for part in shown["parts"]] == ["collider", "block_left"]
    assert "hide: View Screen\n" in program.here("memory", "show", "Trap", "--memory", path).out
    checked = json.loads(program.here("memory", "verify", "--json", "--memory", path).out)
    assert checked["compositions"] == [
        {"label": "Squeeze", "ok": False, "failure": f"there is no active {CUT_IN.label} / {CUT_PLANNER.mode}."}
    ]  # fmt: skip
