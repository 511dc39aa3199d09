"""An acceleration is a number or up to four knots: on its way to the planner, into files, the bank and back."""

from __future__ import annotations

import contextlib
import json
import math
import sqlite3
from pathlib import Path

import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, evidence
from cli_samples import Program
from situation_samples import neighbour, situation
from test_bank_build import parse

from sumo_adv.datatypes import Limits, Proposal, acceleration_at, acceleration_of, plain_acceleration
from sumo_adv.episode.attempt import PlannedAdversary
from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import read_evidence, write_evidence
from sumo_adv.memory.exchange import export_bank, import_bank
from sumo_adv.memory.migrations import APPLICATION_ID, MIGRATIONS, migrate
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.text import make_planner
from sumo_adv.search.rollouts import predict

KNOTS = ((1.0, 2.0), (3.0, -6.0))  # 2 m/s2 until 1 s, then falling by 4 m/s3, -6 m/s2 from 3 s on


def test_between_knots_it_changes_evenly_and_outside_it_stays() -> None:
    assert [acceleration_at(KNOTS, t) for t in (0.0, 1.0, 2.0, 2.5, 3.0, 9.0)] == [2.0, 2.0, -2.0, -4.0, -6.0, -6.0]
    assert acceleration_at(-7.5, 4.0) == -7.5
    assert acceleration_at(((2.0, 1.5),), 0.0) == 1.5


def test_what_is_written_reads_back() -> None:
    for value in (KNOTS, -7.5, ((0.0, 1.0),)):
        assert acceleration_of(json.loads(json.dumps(plain_acceleration(value)))) == value
    assert plain_acceleration(KNOTS) == [[1.0, 2.0], [3.0, -6.0]]
    assert acceleration_of([[0, 4], [2, -8]], Limits()) == ((0.0, 4.0), (2.0, -8.0))


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([], "1 to 4 knots"),
        ([[0, 1], [1, 1], [2, 1], [3, 1], [4, 1]], "1 to 4 knots"),
        ([1.0, 2.0], "1 to 4 knots"),
        ([[0, 1, 2]], "1 to 4 knots"),
        ([[-1, 1]], "0 or more, and ascending"),
        ([[1, 1], [1, 2]], "0 or more, and ascending"),
        ([[2, 1], [1, 2]], "0 or more, and ascending"),
        ([[0, math.nan]], "finite"),
        ([[math.inf, 1.0]], "finite"),
        ("hard", "finite"),
        (True, "finite"),
        (None, "finite"),
        (4.5, "beyond the limits, -8 to 4"),
        ([[0, 1], [1, -9]], "-9 m/s2 is beyond the limits"),
    ],
)
def test_what_is_none_is_refused_in_a_sentence(value: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        acceleration_of(value, Limits())


TELLS = """\
PARAMETERS = {}

def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": bv["x"] + 20.0, "y": bv["y"], "heading": 0.0, "speed": 10.0 + acc, "time": 2.0}
"""


def test_the_planner_gets_the_number_that_holds_at_its_time() -> None:
    planner = make_planner("Tells", "plain", TELLS, "person")
    sit = situation([neighbour()])
    proposal = Proposal("bv", "Tells", planner, {}, KNOTS, 0.0)
    speeds: list[float] = []
    with Sandbox() as sandbox, Sessions(sandbox, Roads({0.0: sit}), [proposal], 0) as sessions:
        adversary = PlannedAdversary(sit, "bv", Limits(), lambda seen: sessions.answer(proposal, seen))
        alone = []
        for time in (0.0, 2.0, 4.0):
            assert adversary.replan(time, (0.0, 0.0, 10.0, 0.0)) is None
            alone.append(adversary.goal.v)

        def ask(rows: object, observations: object) -> object:
            answers = sessions.answers([proposal], [0], observations)  # type: ignore[arg-type]
            assert answers[0] is not None
            speeds.append(answers[0].endpoint.speed)
            return answers

        predict({0.0: sit}, [proposal], ask, limits=Limits(), steps=50, replan=20)  # type: ignore[arg-type]
    assert alone == speeds == [12.0, 8.0, 4.0]


# ---- the bank


def test_evidence_with_knots_is_kept_exported_and_read_back(tmp_path: Path) -> None:
    given = evidence(acceleration=KNOTS)
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.record(given, intent=BRAKING, planner=BRAKE_PLANNER)
        bank.record(evidence(seed=8))
        before = bank.content_hash()
        export_bank(bank, tmp_path / "out")
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        assert [e.acceleration for e in bank.evidence()] == [KNOTS, -6.0]
        assert bank.content_hash() == before
    with contextlib.closing(sqlite3.connect(tmp_path / "bank.sqlite")) as connection:
        rows = connection.execute("SELECT acceleration, knots FROM evidence ORDER BY id").fetchall()
    assert rows == [(2.0, "[[1.0, 2.0], [3.0, -6.0]]"), (-6.0, None)]
    with MemoryBank.open(tmp_path / "back.sqlite") as bank:
        import_bank(bank, tmp_path / "out", parse, lambda intent, planner: None)
        assert {e.acceleration for e in bank.evidence()} == {KNOTS, -6.0}


def test_a_row_with_what_is_no_acceleration_is_refused() -> None:
    names = {BRAKE_PLANNER.hash: "plain"}
    text = write_evidence([evidence(acceleration=KNOTS)], names)
    assert read_evidence(text, BRAKING.label, {"plain": BRAKE_PLANNER.hash}, "x.csv")[0].acceleration == KNOTS
    for wrong in ('"[[3.0, 2.0], [1.0, -6.0]]"', "NaN", "[", '"[[1.0]]"'):
        with pytest.raises(BankError, match=r"x\.csv, line 2, is not evidence"):
            read_evidence(
                text.replace('"[[1.0, 2.0], [3.0, -6.0]]"', wrong),
                BRAKING.label,
                {"plain": BRAKE_PLANNER.hash},
                "x.csv",
            )


def test_a_bank_of_the_first_version_keeps_its_evidence(tmp_path: Path) -> None:
    path = tmp_path / "old.sqlite"
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        assert migrate(connection, "old", migrations=MIGRATIONS[:1]) == [MIGRATIONS[0].name]
        connection.execute(
            "INSERT INTO intents"
            " VALUES (1, 'emergencybraking', 'Emergency Braking', 'It brakes.', '[\"leader\"]', 'active', '')"
        )
        connection.execute(
            "INSERT INTO planners VALUES (1, 1, 'plain', ?, '[]', ?, NULL, 'seed', 'active', '')",
            (BRAKE_PLANNER.text, BRAKE_PLANNER.hash),
        )
        connection.execute(
            "INSERT INTO evidence VALUES (1, 1, ?, 'straight', 'leader', '{}', 'idm', '{}', -7.5, 0.0, 1, NULL,"
            " 0, 0, 1, 0, NULL, NULL, '0.1', 'n', 0, '')",
            (BRAKE_PLANNER.hash,),
        )
    with MemoryBank.open(path) as bank:
        assert [e.acceleration for e in bank.evidence()] == [-7.5]
        bank.record(evidence(acceleration=KNOTS))
        assert [e.acceleration for e in bank.evidence()] == [-7.5, KNOTS]


# ---- a run's files


def test_knots_are_replayed_and_written_as_a_list_of_lists(program: Program) -> None:
    first = program.here("run", "leader_middle_lane", "--attempts", "1", "--out", "out", "--json")
    assert first.status == 0, first.err
    number = first.manifest["attempt"]["acceleration"]
    assert isinstance(number, float)
    knots = [[0.0, number], [9.0, number]]  # the same at all times, so the same run
    file = first.folder / "manifest.json"
    file.write_text(json.dumps({**first.manifest, "attempt": {**first.manifest["attempt"], "acceleration": knots}}))
    again = program.here("run", "--replay", first.folder, "--out", "again", "--json")
    assert again.status == 0, again.err
    outcome = json.loads((program.folder / "again" / "outcome.json").read_text())
    assert outcome["intent"]["acceleration"] == outcome["attempts"][0]["acceleration"] == knots
    assert json.loads((program.folder / "again" / "manifest.json").read_text())["attempt"]["acceleration"] == knots
    states = [(program.folder / name / "states.csv.gz").read_bytes() for name in ("out", "again")]
    assert states[0] == states[1]
    file.write_text(
        json.dumps({**first.manifest, "attempt": {**first.manifest["attempt"], "acceleration": [[2, 1], [1, 1]]}})
    )
    refused = program.here("run", "--replay", first.folder, "--out", "never", "--json")
    assert refused.status == 2
    assert "ascending" in refused.err and len(refused.err.splitlines()) == 1
