"""What a bench runs at once, which rows share a simulation, and the banks that rows have."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT

from sumo_adv.benchmark.jobs import (
    ABLATIONS,
    FIXED_LIBRARY,
    REFERENCE,
    BenchJob,
    BenchParts,
    BenchSetup,
    Method,
    bank_of,
    cell_path,
    example_path,
    examples_of,
    known_place,
    make_jobs,
    method_of,
    slug,
)
from sumo_adv.benchmark.nouns import SuiteCase
from sumo_adv.errors import UsageError
from sumo_adv.memory.bank import MemoryBank

CASES = [SuiteCase(name, Path(f"{name}.toml"), None, "leader", "straight") for name in ("one", "two", "three")]
SHIPPED = ROOT / "memory_bank.sqlite"


@contextmanager
def no_agents(*_: Any) -> Iterator[None]:
    yield None


def unused(path: Path, episode: Any) -> None:
    return None


PARTS = BenchParts(lambda path, record: None, no_agents, lambda episode: {}, unused, unused)  # type: ignore[arg-type, return-value]


def test_rows_that_change_nothing_of_the_simulation_share_it_and_those_that_learn_are_chains() -> None:
    rows = ("raw", "expert", "expert+learn=off", "random", "expert+replan=60+learn=off")
    free, chains = make_jobs(CASES, ("idm", "krauss"), rows, 7)
    assert {job.rows for job in free} == {("raw", "expert+learn=off", "random"), ("expert+replan=60+learn=off",)}
    assert len(free) == 2 * 3 * 2  # groups of rows x encounters x egos
    assert [[(job.case.name, job.place) for job in chain] for chain in chains] == [
        [("one", 0), ("two", 1), ("three", 2)]
    ] * 2
    assert {job.seed for job in free} == {7}


def test_examples_are_the_first_of_two_kinds_of_each_group() -> None:
    kinds = {
        "a": ("leader", "straight"), "b": ("leader", "straight"), "c": ("oncoming", "straight"),
        "d": ("follower", "straight"), "e": ("lights", "intersection"),
    }  # fmt: skip
    cases = [SuiteCase(name, Path(f"{name}.toml"), None, kind, group) for name, (kind, group) in kinds.items()]
    assert examples_of(cases) == {"a", "c", "e"}
    assert example_path(Path("out"), "my:Ego", "a", "expert").name == f"example-{slug('my:Ego')}-expert-a.png"


def test_a_row_in_words() -> None:
    assert method_of("random") is None and method_of("my_module:Generator") is None
    assert method_of("expert") == Method("expert", {}, learns=True)
    assert method_of("llm-f") == Method("llm-f", {}, fixed=True)
    named = method_of("llm-a:deepseek-chat+evidence=off")
    assert named is not None and (named.settings, named.learns) == (
        {"llm": "deepseek-chat", "evidence": "off"}, True
    )  # fmt: skip
    early = method_of("expert+shift=-1.5+learn=off")
    assert early is not None and (early.shift, early.learns, dict(early.settings)) == (-1.5, False, {})


@pytest.mark.parametrize("row", [*ABLATIONS, REFERENCE])
def test_every_ablation_is_a_row_of_the_program(row: str) -> None:
    assert method_of(row) is not None


@pytest.mark.parametrize("row", ["expert+shift=soon", "expert+", "llm-f+until=ttc", "expert+attempts=3"])
def test_what_cannot_be_changed_is_said(row: str) -> None:
    with pytest.raises(UsageError, match=r"^The row '"):
        method_of(row)


def test_names_of_files_are_safe_and_stay_apart() -> None:
    assert slug("expert+learn=off") == "expert+learn=off"
    slashed, dashed = slug("../../etc:passwd"), slug("..-..-etc-passwd")
    assert slashed != dashed and "/" not in slashed and not slashed.startswith(".")
    assert cell_path(Path("b"), "idm", "one", "raw") == Path("b/cells/idm/one/raw.json")


def _setup(folder: Path) -> BenchSetup:
    return BenchSetup(folder, "own", SHIPPED, {}, PARTS)


def test_llm_f_has_two_intents_and_the_library_keeps_its_seven(tmp_path: Path) -> None:
    job = BenchJob(CASES[0], "idm", 0, ("llm-f",))
    with (
        MemoryBank.open(SHIPPED, read_only=True) as library,
        bank_of(Method("llm-f", fixed=True), job, _setup(tmp_path), library, tmp_path) as bank,
    ):
        assert {i.label for i in bank.intents() if i.status == "active"} == set(FIXED_LIBRARY)
        assert sum(i.status == "active" for i in library.intents()) == 7


def test_an_encounter_that_was_cut_off_begins_from_the_same_bank_again(tmp_path: Path) -> None:
    """Encounter 1 is broken off after it changed its bank: its second try finds what encounter 0 had left."""
    setup, method = _setup(tmp_path), Method("expert", learns=True)
    jobs = [BenchJob(CASES[k], "idm", 0, ("expert",), place=k) for k in range(3)]
    folder = tmp_path / "banks" / "idm" / "expert"
    with MemoryBank.open(SHIPPED, read_only=True) as library:
        with bank_of(method, jobs[0], setup, library, tmp_path) as bank:
            bank.retire("Emergency Braking")
            left = bank.content_hash()
        with pytest.raises(KeyboardInterrupt), bank_of(method, jobs[1], setup, library, tmp_path) as bank:
            assert bank.content_hash() == left
            bank.retire("Aggressive Cut-in")
            raise KeyboardInterrupt
        with bank_of(method, jobs[1], setup, library, tmp_path) as bank:
            assert bank.content_hash() == left
            bank.retire("Straight Lane Shift")
            left = bank.content_hash()
        shutil.copyfile(folder / "2.sqlite", tmp_path / "kept.sqlite")
        with bank_of(method, jobs[2], setup, library, tmp_path) as bank:
            assert bank.content_hash() == left
    with MemoryBank.open(tmp_path / "kept.sqlite", read_only=True) as bank:
        assert {i.label for i in bank.intents() if i.status != "active"} == {"Emergency Braking", "Straight Lane Shift"}


def _learnt(tmp_path: Path, place: int, label: str) -> str:
    """The bank that the encounter at ``place`` begins with, by its hash; it retires ``label``."""
    job = BenchJob(CASES[place % 3], "idm", 0, ("expert",), place=place)
    with (
        MemoryBank.open(SHIPPED, read_only=True) as library,
        bank_of(Method("expert", learns=True), job, _setup(tmp_path), library, tmp_path) as bank,
    ):
        content_hash = bank.content_hash()
        bank.retire(label)
        return content_hash


def test_an_encounter_that_broke_or_was_none_hands_on_the_bank_it_had(tmp_path: Path) -> None:
    """Encounter 1 makes no bank; encounter 2 has that of encounter 0, and nothing of a log that a process which
    was killed left beside its own."""
    _learnt(tmp_path, 0, "Emergency Braking")
    folder = tmp_path / "banks" / "idm" / "expert"
    left = folder / "3.part-wal"
    left.write_bytes(b"of a process that was killed")
    assert known_place(BenchJob(CASES[2], "idm", 0, ("expert",), place=2), _setup(tmp_path)) == 1
    with MemoryBank.open(folder / "1.sqlite", read_only=True) as bank:
        after_the_first = bank.content_hash()
    assert _learnt(tmp_path, 2, "Aggressive Cut-in") == after_the_first
    assert sorted(p.name for p in folder.iterdir()) == ["1.sqlite", "3.sqlite"]


def test_a_row_that_learns_begins_at_the_first_encounter_where_the_banks_are_of_later_ones(tmp_path: Path) -> None:
    first = _learnt(tmp_path, 0, "Emergency Braking")
    _learnt(tmp_path, 1, "Aggressive Cut-in")
    _learnt(tmp_path, 2, "Straight Lane Shift")
    folder = tmp_path / "banks" / "idm" / "expert"
    assert sorted(p.name for p in folder.iterdir()) == ["2.sqlite", "3.sqlite"]
    assert known_place(BenchJob(CASES[1], "idm", 0, ("expert",), place=1), _setup(tmp_path)) == 0
    assert _learnt(tmp_path, 0, "Emergency Braking") == first
    assert sorted(p.name for p in folder.iterdir()) == ["0.sqlite", "1.sqlite"]  # nothing of the first time
