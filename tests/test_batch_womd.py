"""A batch of Waymo records: real ones where they are (shared/womd), and a corrupt one among them."""

from __future__ import annotations

from pathlib import Path

import pytest
from batch_samples import QUICK, clean, table
from cli_samples import Done, Program

frame = pytest.importorskip("womd_samples", reason="protobuf is not installed: pip install 'sumo-adv[womd]'").frame

SHARED = Path(__file__).parents[2] / "shared" / "womd"
EGOS = ("replay", "idm")
pytestmark = pytest.mark.skipif(not SHARED.is_dir(), reason="the Waymo records (shared/womd) are not here")


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> tuple[Program, Done, list[str]]:
    """The three smallest records in one file, a file without a scenario between them, each with two drivers; and what
    the three are called."""
    program = Program(tmp_path_factory.mktemp("womd"), caches)
    small = sorted(SHARED.glob("*.tfrecord"), key=lambda p: p.stat().st_size)[:3]
    first, second, third = (file.read_bytes() for file in small)
    (program.folder / "all.tfrecord").write_bytes(first + frame(b"no scenario") + second + third)
    options = ("--egos", ",".join(EGOS), *QUICK, "--workers", "2", "--out", "out")
    return program, program.here("batch", "all.tfrecord", *options), [p.name.partition(".")[0] for p in small]


def test_records_are_run_and_a_corrupt_one_fails_by_name(done: tuple[Program, Done, list[str]]) -> None:
    program, batch, names = done
    assert (batch.status, "Traceback" in batch.err) == (0, False)
    rows = table(batch.folder)
    good = [r for r in rows if not r["failure"]]
    bad = [r for r in rows if r["failure"]]
    assert sorted((r["network"], r["ego"]) for r in good) == sorted((name, ego) for name in names for ego in EGOS)
    assert [r["ending"] for r in bad] == ["simulation_failed"] * 2
    assert all("all.tfrecord" in r["failure"] and "Record 1" in r["failure"] for r in bad)
    assert len(batch.err.splitlines()) == 2
    for row in good:
        files = {p.name for p in (batch.folder / "runs" / row["id"]).iterdir()}
        assert files >= {"outcome.json", "manifest.json", "inputs"}
        assert row["ending"] in ("critical", "attempts_exhausted", "no_encounter", "ego_left")
    clean(program, "all.tfrecord")


def test_going_on_converts_and_runs_nothing_again(done: tuple[Program, Done, list[str]]) -> None:
    program, batch, _ = done
    before = table(batch.folder)
    again = program.here("batch", "all.tfrecord", "--egos", ",".join(EGOS), *QUICK, "--out", "out", "--json")
    assert '"ran": 0' in again.out
    assert table(batch.folder) == before
