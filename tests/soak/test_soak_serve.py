"""Encounter after encounter in one server: nothing fails, nothing piles up, and both sides keep the same time."""

from __future__ import annotations

import json
import statistics
import time
from typing import Any

import pytest
from cli_samples import TESTS, Program, own_memory
from serve_samples import Server, needs_sumo, serving

CLIENT = TESTS / "serve_client.py"
FLAT = 0.05  # share of its memory by which the server may grow in the last three fifths of a run
pytestmark = needs_sumo


def served(program: Program, count: int, patience: float) -> tuple[Server, list[float], dict[str, Any]]:
    """A server after ``count`` encounters, its memory after each of them, and what its client saw."""
    seen = program.folder / "seen.jsonl"
    with serving(program, "straight_3lane", "--encounters", str(count), "--end", "100000", "--json") as server:
        client = server.client(CLIENT, str(seen))
        memory, until = [], time.monotonic() + patience
        while server.process.poll() is None and time.monotonic() < until:
            if len(server.events("outcome")) > len(memory) and (now := own_memory(server.process.pid)):
                memory.append(now)
            time.sleep(0.5)
        code, out, err = server.end()
        client.wait()
        assert (code, err) == (0, "") and json.loads(out)["encounters"] == count
        (row,) = [json.loads(line) for line in seen.read_text().splitlines()]
        return server, memory, row


def nothing_fails_or_drifts(server: Server, row: dict[str, Any], count: int) -> None:
    outcomes = server.outcomes()
    assert [o["ending"] for o in outcomes if o["ending"] not in ("critical", "attempts_exhausted")] == []
    assert len(outcomes) == count and server.simulators() == []
    assert server.events("client")[0]["state"] == "connected" and len(server.events("client")) <= 4
    ended = server.events("simulation")[-1]
    assert row["last"] - row["first"] == pytest.approx(0.1 * (row["steps"] - 1), abs=1e-6)  # no step was missed
    assert row["last"] == pytest.approx(ended["time"], abs=0.11)
    assert 0 <= ended["steps"] - ended["client_steps"] <= 1


def test_a_few_encounters_in_a_row(program: Program) -> None:
    server, _, row = served(program, 3, 120.0)
    nothing_fails_or_drifts(server, row, 3)
    assert list(program.temporary.iterdir()) == []


@pytest.mark.soak
def test_five_hundred_encounters_in_a_row(program: Program) -> None:
    server, memory, row = served(program, 500, 3600.0)
    nothing_fails_or_drifts(server, row, 500)
    parts = [
        statistics.median(memory[k : k + len(memory) // 5]) for k in range(0, len(memory) // 5 * 5, len(memory) // 5)
    ]
    settled = parts[2:]  # the first two load what the rest uses: measured 137, 136, 141, 143 and 143 MB
    assert max(settled) - settled[0] <= FLAT * settled[0], parts
    critical = sum(o["ending"] == "critical" for o in server.outcomes())
    assert critical >= 400, critical
