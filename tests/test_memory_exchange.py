"""Export and import: there and back, the same text for the same content, nothing of an untrusted folder is believed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, CUT_IN, CUT_PLANNER, evidence
from test_bank_build import parse

from sumo_adv.datatypes import Parameter, Planner
from sumo_adv.errors import BankError, PlannerSyntaxError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import build
from sumo_adv.memory.exchange import Refused, export_bank, import_bank
from sumo_adv.memory.records import IntentRecord

ODD = IntentRecord('Ein "Überholer" \\ 超車', 'It says "go" \\ and passes.', ("oncoming", "merging"))
ODD_PLANNER = Planner(ODD.label, "../..//x", "PARAMETERS = {}\n# ü\n", (), "some/model", parent="ab" * 32)
TWIN = replace(ODD_PLANNER, mode="x", text="PARAMETERS = {}\n# twin")


def fine(intent: IntentRecord, planner: Planner) -> str | None:
    return None


def fill(path: Path, order: list[int]) -> Path:
    """A bank with odd names, a retired planner, a merged intent and evidence."""
    with MemoryBank.open(path) as bank:
        for i in order:
            bank.add(*((BRAKING, [BRAKE_PLANNER]), (CUT_IN, [CUT_PLANNER]), (ODD, [ODD_PLANNER, TWIN]))[i])
        never = evidence(min_ttc=math.inf, critical=False, collided=False, valid=None, strict=None, parameters={})
        for i in order:
            bank.record((evidence(), evidence(), never)[i])
        bank.retire(ODD.label, "x")
        bank.add(IntentRecord("Old Braking", "As it was called once.", ("leader",)), [replace(BRAKE_PLANNER, mode="o")])
        bank.merge("Old Braking", BRAKING.label)
    return path


def texts(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_there_and_back_again(tmp_path: Path) -> None:
    with MemoryBank.open(fill(tmp_path / "one.sqlite", [0, 1, 2])) as bank:
        assert export_bank(bank, tmp_path / "out" / "one") == 4
        expected_hash = bank.content_hash()
    with MemoryBank.open(fill(tmp_path / "two.sqlite", [2, 1, 0])) as bank:
        export_bank(bank, tmp_path / "out" / "two")
    exported = texts(tmp_path / "out" / "one")
    assert exported == texts(tmp_path / "out" / "two")
    folders = {name.partition("/")[0] for name in exported}
    assert {"aggressive_cut_in", "emergency_braking", "old_braking"} < folders
    assert sum(name.endswith(".py") for name in exported) == 4
    assert exported["emergency_braking/evidence.csv"].count(b"\n") == 4
    with MemoryBank.open(tmp_path / "back.sqlite") as bank:
        added, refused = import_bank(bank, tmp_path / "out" / "one", parse, fine)
        assert (added.intents, added.planners, added.evidence, refused) == (4, 4, 3, [])
        assert bank.content_hash() == expected_hash
        again, _ = import_bank(bank, tmp_path / "out" / "one", parse, fine)
        assert (again.intents, again.planners, again.evidence) == (0, 0, 0)
        assert bank.content_hash() == expected_hash
        assert bank.retrieve("old braking").hit == BRAKING.label
    build(tmp_path / "out" / "one", tmp_path / "built.sqlite", parse)
    with MemoryBank.open(tmp_path / "built.sqlite") as built, MemoryBank.open(tmp_path / "back.sqlite") as back:
        assert sorted(built.stored_intents(), key=str) == sorted(back.stored_intents(), key=str)
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"one", "two"}


def test_an_export_replaces_only_an_export(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        export_bank(bank, out)
        with pytest.raises(BankError, match="give --force"):
            export_bank(bank, out)
        bank.add(CUT_IN, [CUT_PLANNER])
        assert export_bank(bank, out, force=True) == 2
        (out / "diary.txt").write_text("mine")
        with pytest.raises(BankError, match="is not an export"):
            export_bank(bank, out, force=True)
        assert (out / "diary.txt").read_text() == "mine"
    assert {p.name for p in tmp_path.iterdir()} == {"bank.sqlite", "out"}


def test_an_import_keeps_what_is_there_and_renames_a_mode_that_is_taken(tmp_path: Path) -> None:
    their_planner = replace(BRAKE_PLANNER, text=BRAKE_PLANNER.text + "# theirs\n")
    with MemoryBank.open(tmp_path / "theirs.sqlite") as bank:
        bank.add(replace(BRAKING, label="emergency-braking", description="Theirs."), [their_planner])
        bank.record(evidence(planner_hash=their_planner.hash))
        export_bank(bank, tmp_path / "theirs")
    with MemoryBank.open(tmp_path / "mine.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        added, _ = import_bank(bank, tmp_path / "theirs", parse, fine)
        assert (added.intents, added.planners, added.evidence) == (0, 1, 1)
        assert bank.intents() == [BRAKING]
        assert [p.mode for p in bank.planners(BRAKING.label)] == ["plain", "plain-2"]
        assert bank.evidence()[0].planner_hash == their_planner.hash


def test_of_the_evidence_of_two_banks_what_both_have_counts_once(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "theirs.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        bank.record(evidence(seed=1))
        bank.record(evidence(seed=2))
        export_bank(bank, tmp_path / "theirs")
    with MemoryBank.open(tmp_path / "mine.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        bank.record(evidence(seed=2))
        bank.record(evidence(seed=3))
        added, _ = import_bank(bank, tmp_path / "theirs", parse, fine)
        assert (added.evidence, sorted(e.seed for e in bank.evidence())) == (1, [1, 2, 3])


def test_what_fails_in_the_sandbox_is_refused_by_name(tmp_path: Path) -> None:
    def wary(intent: IntentRecord, planner: Planner) -> str | None:
        return "It attacks." if planner.hash == CUT_PLANNER.hash else None

    with MemoryBank.open(fill(tmp_path / "bank.sqlite", [0, 1, 2])) as bank:
        export_bank(bank, tmp_path / "out")
    with MemoryBank.open(tmp_path / "mine.sqlite") as bank:
        before = bank.content_hash()
        added, refused = import_bank(bank, tmp_path / "out", parse, wary)
        assert refused == [Refused("Aggressive Cut-in", "side", "It attacks.")]
        assert added.intents == 0
        assert bank.content_hash() == before
        added, refused = import_bank(bank, tmp_path / "out", parse, wary, skip_refused=True)
        assert (added.intents, len(refused)) == (3, 1)
        assert bank.intent("Aggressive Cut-in") is None


def test_what_cannot_be_read_is_left_out_when_asked(tmp_path: Path) -> None:
    def strict(text: str) -> tuple[Parameter, ...]:
        if text.endswith("{"):
            raise PlannerSyntaxError("It ends early.")
        return parse(text)

    out = tmp_path / "out"
    with MemoryBank.open(tmp_path / "one.sqlite") as bank:
        bank.add(CUT_IN, [CUT_PLANNER])
        bank.add(BRAKING, [BRAKE_PLANNER, replace(BRAKE_PLANNER, mode="other", text="PARAMETERS = {}\n# other\n")])
        bank.record(evidence())
        export_bank(bank, out)
    (out / "emergency_braking" / "plain.py").write_text("PARAMETERS = {")
    (out / "aggressive_cut_in" / "intent.toml").write_text("label = ")
    with MemoryBank.open(tmp_path / "mine.sqlite") as bank:
        with pytest.raises(BankError, match="cannot be read as TOML"):
            import_bank(bank, out, strict, fine)
        added, refused = import_bank(bank, out, strict, fine, skip_refused=True)
        assert (added.intents, added.planners, added.evidence) == (1, 1, 0)
        assert [(each.label, each.mode) for each in refused] == [
            ("aggressive_cut_in", "everything"), ("Emergency Braking", "plain"),
        ]  # fmt: skip
        assert "is not a planner" in refused[1].reason
        assert [planner.mode for planner in bank.planners("Emergency Braking")] == ["other"]


def test_wrong_and_hostile_folders_are_refused_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with MemoryBank.open(tmp_path / "one.sqlite") as bank:
        bank.add(CUT_IN, [CUT_PLANNER])
        bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
        export_bank(bank, out)
    secret = tmp_path / "secret.py"
    secret.write_text(BRAKE_PLANNER.text)
    braking = out / "emergency_braking"
    toml, rows = (braking / "intent.toml").read_text(), (braking / "evidence.csv").read_text()
    cases = [
        ("evidence.csv", rows.replace("plain,straight", "other,straight"), "line 2, is not evidence: there is no plan"),
        ("evidence.csv", rows.replace(",7\n", ",\n"), "line 2, is not evidence"),
        ("evidence.csv", rows.replace('""closing"": -1.25', '""closing"": NaN'), "a number in it is not finite"),
        ("evidence.csv", rows.replace("planner,", "planer,"), "must have the columns planner,"),
        ("evidence.csv", rows.replace(",1,1,1,0,1,0,", ",1,1,2,0,1,0,"), "1 or 0"),
        ("intent.toml", toml + "[planners.nobody]\norigin = 'x'\n", "wrong table for the planner 'nobody'"),
        ("intent.toml", toml + "[planners.plain]\norigin = 1\n", "short texts"),
        ("intent.toml", toml.replace('label = "Em', 'label = "\\u001b[31mEm'), "that can be printed"),
        ("intent.toml", toml + "status = 'asleep'\n", "it is active or retired"),
        ("intent.toml", toml + "merged_into = 'Nobody'\n", "'Nobody', which does not exist"),
        ("plain.py", "x" * 300_000, "larger than"),
    ]
    with MemoryBank.open(tmp_path / "mine.sqlite") as bank:
        before = bank.content_hash()
        for name, text, sentence in cases:
            kept = (braking / name).read_text()
            (braking / name).write_text(text)
            with pytest.raises(BankError, match=sentence):
                import_bank(bank, out, parse, fine)
            (braking / name).write_text(kept)
        (braking / "link.py").symlink_to(secret)
        with pytest.raises(BankError, match="not a plain file"):
            import_bank(bank, out, parse, fine)
        (braking / "link.py").unlink()
        assert bank.content_hash() == before
        import_bank(bank, out, parse, fine)
        assert len(bank.evidence()) == 1
