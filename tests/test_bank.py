"""The memory bank: what goes in comes out, hashes, retrieval, many writers, a killed writer."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import bank_samples
import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, CUT_IN, CUT_PLANNER, evidence

from sumo_adv.datatypes import Planner, Verdict
from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.curate import statistics
from sumo_adv.memory.records import IntentRecord, SceneSignature, evidence_of
from sumo_adv.memory.store import default_bank_path

WRITER = Path(bank_samples.__file__)


def clock(time: str) -> Callable[[], str]:
    return lambda: time


def test_evidence_reads_back_as_it_was_written(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "folders" / "bank.sqlite"
    never = evidence(min_ttc=math.inf, collided=False, critical=False, valid=None, strict=None, seed=8)
    with MemoryBank.open(path, clock=clock("2026-01-02T03:04:05+00:00")) as bank:
        bank.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
        bank.record(never)
        assert bank.evidence() == [evidence(), never]
        hash_in_ram = bank.content_hash()
    with MemoryBank.open(path) as bank:
        assert bank.evidence("emergency-braking") == [evidence(), never]
        assert bank.evidence()[0].created == "2026-01-02T03:04:05+00:00"
        assert bank.evidence("Aggressive Cut-in") == []
        assert bank.intents() == [BRAKING]
        assert bank.planners("Emergency Braking") == [BRAKE_PLANNER]
        assert bank.content_hash() == hash_in_ram
    assert [file.name for file in path.parent.iterdir()] == ["bank.sqlite"]


def test_evidence_of_a_verdict_keeps_its_fields() -> None:
    verdict = Verdict(0.4, 0.1, False, True, True, False)
    scene = SceneSignature("crossing", "crossing_left", {"gap": 3.0}, "krauss")
    kept = evidence_of(
        verdict, label="X", planner_hash="h", scene=scene, attempts=2, version="0.1", network="n", seed=1, delay=0.5
    )
    assert (kept.min_ttc, kept.critical, kept.valid, kept.delay) == (0.4, True, None, 0.5)
    assert kept.success
    assert not replace(kept, rear_end=True).success


def test_evidence_about_the_unknown_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        with pytest.raises(BankError, match="lacks the intent"):
            bank.record(evidence())
        with pytest.raises(BankError, match="lacks the planner"):
            bank.record(evidence(), intent=BRAKING)
        with pytest.raises(BankError, match="another planner"):
            bank.record(evidence(), intent=BRAKING, planner=CUT_PLANNER)
        with pytest.raises(BankError, match="the intent given is"):
            bank.record(evidence(), intent=CUT_IN, planner=BRAKE_PLANNER)
        with pytest.raises(BankError, match="min_ttc must be a number of 0 or more"):
            bank.record(evidence(min_ttc=math.nan), intent=BRAKING, planner=BRAKE_PLANNER)
        with pytest.raises(BankError, match="finite"):
            bank.record(evidence(parameters={"a": math.inf}), intent=BRAKING, planner=BRAKE_PLANNER)
        bank.refresh()
        assert bank.intents() == []
        assert statistics(bank)["evidence"] == 0


def test_planners_come_by_mode_then_age_and_one_source_may_serve_two_intents(tmp_path: Path) -> None:
    late = replace(BRAKE_PLANNER, mode="late", text="# late\n", parent=BRAKE_PLANNER.hash)
    newer = replace(BRAKE_PLANNER, text="# plain, newer\n")
    shared = replace(CUT_PLANNER, text=BRAKE_PLANNER.text, parameters=BRAKE_PLANNER.parameters)
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER, newer, late])
        bank.add(CUT_IN, [shared])
        assert bank.planners("EMERGENCY braking") == [late, BRAKE_PLANNER, newer]
        assert bank.planners("Aggressive Cut-in") == [shared]
        assert bank.planners("Flying") == []


def test_the_content_hash_counts_content_only(tmp_path: Path) -> None:
    def made(name: str, time: str, order: list[int], controller: str = "idm") -> str:
        intents = [(BRAKING, [BRAKE_PLANNER]), (CUT_IN, [CUT_PLANNER])]
        with MemoryBank.open(tmp_path / name, clock=clock(time)) as bank:
            for i in order:
                bank.add(*intents[i])
            for i in order:
                scene = SceneSignature("straight", "leader", {"gap": 1.0}, controller)
                bank.record(evidence(seed=i, scene=scene))
            return bank.content_hash()

    first = made("a", "2026-01-01T00:00:00+00:00", [0, 1])
    assert made("b", "2031-12-31T00:00:00+00:00", [1, 0]) == first
    assert made("c", "2026-01-01T00:00:00+00:00", [0, 1], controller="krauss") != first
    with MemoryBank.open(tmp_path / "a") as bank:
        bank.set_epsilon(0.5, "nothing")
        assert bank.content_hash() != first
        assert bank.epsilon() == (0.5, "nothing")
    with MemoryBank.open(tmp_path / "b") as bank:
        bank.add(BRAKING, [replace(BRAKE_PLANNER, mode="other", text=BRAKE_PLANNER.text + "# other\n")])
        before = bank.content_hash()
        bank.retire(BRAKING.label, "other")
        assert bank.content_hash() != before


def test_what_is_there_stays_and_another_spelling_is_the_same_intent(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        respelt = IntentRecord("emergency  BRAKING", "Something else.", ("follower",))
        bank.record(evidence(label=respelt.label), intent=respelt)
        assert bank.intents() == [BRAKING]
        assert bank.evidence()[0].label == "Emergency Braking"


def test_success_wakes_a_retired_intent_and_failure_does_not(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(replace(BRAKING, status="retired"), [BRAKE_PLANNER])
        assert bank.retrieve("Emergency Braking").hit is None
        bank.record(evidence(critical=False))
        assert bank.retrieve("Emergency Braking").hit is None
        bank.record(evidence())
        assert bank.retrieve("Emergency Braking").hit == "Emergency Braking"


def test_retrieval_takes_the_label_in_any_spelling_first(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        assert bank.retrieve("Emergency Braking").hit is None
        bank.add(BRAKING, [BRAKE_PLANNER])
        bank.add(CUT_IN, [CUT_PLANNER])
        retrieval = bank.retrieve("aggressive CUT in", "the vehicle ahead brakes hard")
        assert (retrieval.hit, retrieval.distance) == ("Aggressive Cut-in", 0.0)
        assert [label for label, _ in retrieval.nearest] == ["Aggressive Cut-in", "Emergency Braking"]
        like = bank.retrieve("Sudden stop of the leader", "It slams its brakes in front of the ego.")
        assert like.hit == "Emergency Braking"
        assert 0.0 < like.distance <= like.epsilon
        novel = bank.retrieve("Door opening", "A parked delivery van opens its door.")
        assert novel.hit is None
        assert novel.distance > novel.epsilon


def test_a_novel_intent_is_found_as_soon_as_it_is_recorded(tmp_path: Path) -> None:
    novel = IntentRecord("Ambush at the Roundabout", "It waits inside the roundabout and dashes out.", ("merging",))
    planner = Planner(novel.label, "wait", "# wait\n", (), "some-model", parent="abc")
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        assert bank.retrieve("Roundabout ambush", "").hit is None
        bank.record(evidence(label=novel.label, planner_hash=planner.hash), intent=novel, planner=planner)
        assert bank.retrieve("Roundabout ambush", "").hit == novel.label
        assert bank.planners(novel.label) == [planner]


def test_statistics_count_by_hand(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(CUT_IN, [CUT_PLANNER])
        bank.record(evidence(attempts=3), intent=BRAKING, planner=BRAKE_PLANNER)
        bank.record(evidence(attempts=4, rear_end=True, valid=False))
        counts = statistics(bank)
    by_label = counts.pop("by_label")
    assert counts == {"intents": 2, "active": 2, "planners": 2, "evidence": 2}
    braking = by_label["Emergency Braking"]
    assert [braking[name] for name in ("successes", "collisions", "valid", "attempts")] == [1, 2, 1, 7]
    assert by_label["Aggressive Cut-in"]["evidence"] == 0


def test_an_open_bank_sees_others_rows_only_after_refresh(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as first, MemoryBank.open(path) as second:
        before = first.content_hash()
        second.record(evidence(), intent=BRAKING, planner=BRAKE_PLANNER)
        assert first.content_hash() == before
        first.refresh()
        assert first.content_hash() == second.content_hash() != before


def writer(path: Path, count: int, name: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(WRITER), str(path), str(count), name],
        stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent.parent,
    )  # fmt: skip


def test_two_processes_write_fifty_rows_each(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    processes = [writer(path, 50, name) for name in ("one", "two")]
    for process in processes:
        process.communicate(timeout=60)
        assert process.returncode == 0
    with MemoryBank.open(path) as bank:
        rows = {(e.network, e.seed) for e in bank.evidence()}
        assert rows == {(name, seed) for name in ("one", "two") for seed in range(50)}
        assert len(bank.evidence()) == 100
        assert len(bank.intents()) == 1


def test_a_writer_killed_while_writing_leaves_a_whole_bank(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    process = writer(path, 0, "victim")
    assert process.stdout is not None
    printed = 0
    while printed < 30:
        printed = int(process.stdout.readline())
    process.kill()
    printed += len(process.stdout.read().split())
    process.wait(timeout=30)
    process.stdout.close()
    with MemoryBank.open(path) as bank:
        seeds = [e.seed for e in bank.evidence()]
        assert seeds == list(range(len(seeds)))
        assert printed <= len(seeds) <= printed + 1
        bank.record(evidence(seed=-1))
        assert statistics(bank)["evidence"] == len(seeds) + 1


def test_the_users_bank_is_in_the_users_data_folder(tmp_path: Path) -> None:
    data = tmp_path / "data"
    assert default_bank_path({"XDG_DATA_HOME": str(data)}, "linux", tmp_path) == data / "sumo_adv/memory_bank.sqlite"
    assert default_bank_path({"XDG_DATA_HOME": "x"}, "linux", tmp_path).is_relative_to(tmp_path / ".local/share")
    assert default_bank_path({}, "darwin", tmp_path).is_relative_to(tmp_path / "Library/Application Support")
    assert default_bank_path({"LOCALAPPDATA": str(data)}, "win32", tmp_path).is_relative_to(data)
