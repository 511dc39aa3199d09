"""With ``--real-time`` the world does not wait for a decision: it is used while the scene holds, and else dropped."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cli_samples import TESTS
from serve_samples import needs_sumo

from sumo_adv.agents.agents import Agents
from sumo_adv.agents.teams import Teamwork
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Intent, LibraryEntry
from sumo_adv.episode.run import Run
from sumo_adv.episode.task import make_task
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.intents import Selection
from sumo_adv.search.search import AttackSearch
from sumo_adv.serve import Options
from sumo_adv.serve.events import Events, ResultWriter
from sumo_adv.serve.gate import Gate
from sumo_adv.serve.server import MAX_DECISION_AGE_S, EgoServer, ServerDependencies
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.network import read_network
from sumo_adv.situation import Situation

pytestmark = needs_sumo
TRIGGER = 3.2  # s, soon after the ego's warm-up
MAKES_UP = 1.1  # s, a step and the second beyond which Pace lets it slip


class Slow(Agents):
    """Thinks for a while before it answers as the expert."""

    seconds = 0.0

    def analyze(
        self,
        search: AttackSearch,
        situations: Mapping[float, Situation],
        library: Sequence[LibraryEntry],
        *,
        selection: Selection,
        remembered: Mapping[str, str],
        teamwork: Teamwork | None = None,
    ) -> list[Intent]:
        """The expert's ranking, late."""
        time.sleep(self.seconds)
        return super().analyze(
            search, situations, library, selection=selection, remembered=remembered, teamwork=teamwork
        )


@dataclass
class Told:
    """What a server told, and the runs it kept."""

    events: list[dict[str, Any]]
    runs: list[Run]

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [e for e in self.events if e["event"] == kind]


def served(folder: Path, seconds: float, *, kill: bool = False) -> Told:
    """One encounter in real time, with an analyzer that takes ``seconds``; ``kill``: the client, while it thinks."""
    run_input = load_input(Path("motorway_cut_in_left"))
    settings = load_settings(None, ego="external", trigger=TRIGGER, learn="off")
    log = Told([], [])
    clients: list[subprocess.Popen[bytes]] = []

    def tell(event: Mapping[str, Any]) -> None:
        log.events.append(dict(event))
        if kill and event["event"] == "encounter":
            clients[0].kill()

    events = Events(tell)

    def write(run: Run, number: int) -> Mapping[str, Any]:
        log.runs.append(run)
        return {"outcome": None, "ending": "", "reason": "", "adversaries": [], "intent": None, "attempts": [],
                "folder": number}  # fmt: skip

    task = make_task(run_input, settings, folder)
    with (
        MemoryBank.open(folder / "bank.sqlite", seed_from=data_folder("memory_bank.sqlite")) as bank,
        Sandbox() as sandbox,
        Gate() as gate,
    ):
        agents = Slow(settings, sandbox)
        agents.seconds = seconds
        writer = ResultWriter(write, events)
        clients.append(subprocess.Popen([sys.executable, str(TESTS / "serve_client.py"), str(gate.port)]))
        try:
            parts = ServerDependencies(
                run_input, Options(real_time=True, encounters=1), lambda _: task, read_network(task.spec.network),
                agents, bank, gate, events, writer, lambda: None,
            )  # fmt: skip
            assert EgoServer(parts).run() is None
        finally:
            writer.close()
            clients[0].kill()
            clients[0].wait()
    return log


def test_an_answer_that_comes_too_late_is_dropped(tmp_path: Path) -> None:
    log = served(tmp_path, MAX_DECISION_AGE_S + 0.5)
    (decided,) = log.of("decided")
    (dropped,) = log.of("dropped")
    assert decided["age"] > MAX_DECISION_AGE_S and decided["seconds"] > MAX_DECISION_AGE_S
    assert dropped["reason"] == f"the decision is {decided['age']:.1f} s old"
    assert log.of("attack") == [] and log.runs == []


def test_an_answer_that_comes_in_time_is_used(tmp_path: Path) -> None:
    log = served(tmp_path, 0.3)
    (decided,) = log.of("decided")
    assert 0.3 <= decided["age"] <= MAX_DECISION_AGE_S  # the world went on meanwhile
    assert log.of("dropped") == []
    (attack,) = log.of("attack")
    assert attack["time"] >= TRIGGER + decided["age"] - 0.11
    (run,) = log.runs
    record = run.best
    assert record is not None and record.prefix is not None and record.prefix.snapshots[-1].time == TRIGGER
    result = record.results[0]
    assert result.snapshots[0].time == 3.3 and result.start >= TRIGGER + decided["age"] - 0.01
    clock = [e["clock"] for e in log.events if e["event"] in ("attack", "released")]
    times = [e["time"] for e in log.events if e["event"] in ("attack", "released")]
    # A second lasts a second; only what a stall of the machine had made late, at most MAKES_UP, is made up for.
    assert clock[1] - clock[0] > times[1] - times[0] - MAKES_UP - 0.01


def test_a_client_that_goes_while_we_think_costs_no_attempt(tmp_path: Path) -> None:
    log = served(tmp_path, 0.5, kill=True)
    assert [e["reason"] for e in log.of("dropped")] == ["the ego or its client is gone"]
    assert log.of("attack") == [] and log.runs == []
