"""Makes ``recording.jsonl``: ``python examples/novel_behaviour/make_recording.py``.

The answers are written by hand (no model was asked); the questions are the program's own, so a change of the prompts,
of the scenario or of the bank needs a new recording.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from sumo_adv.agents.agents import AGENT_ROLES, Agents
from sumo_adv.app import shipped_prompts
from sumo_adv.config import load_settings
from sumo_adv.episode.engine import episode_worker
from sumo_adv.episode.loop import run_episode
from sumo_adv.episode.task import make_task
from sumo_adv.llm.chat import BudgetedModel, ChatReply, ChatRequest, Ledger
from sumo_adv.llm.recording import Recorder
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import data_folder, load_input

HERE = Path(__file__).resolve().parent
NOTE = "The answers were written by hand for this example; no language model was asked."
ANALYSIS = {
    "analysis": "Both vehicles turn left side by side. EGO keeps the outer lane and looks where it goes; BV1 is in the "
    "inner lane, a little behind, where EGO's driver does not look. A cut-in would show early and a slow drift needs "
    "BV1 beside EGO for long. Faster than EGO before the bend and swinging out in it, BV1 meets EGO's side.",
    "intents": [
        {
            "bv": "BV1", "label": "Blind-Side High-Speed Merge", "novel": True,
            "description": "While both vehicles turn left side by side, the one in the inner turning lane speeds up in "
            "the ego's blind side and swings out into the ego's path before the bend ends.",
            "risk": "high", "acceleration": [[0.0, 3.0], [2.0, 0.0]],
            "reason": "It comes from the blind side at speed, and the bend leaves EGO no room.",
        },
    ],
}  # fmt: skip
SAME = {"same_as": None, "reason": "None of the known ones merges from the inner lane of a dual turn at speed."}
DIAGNOSIS = "It stayed beside the ego: a lead of 7 m is never reached before the bend. Merge into its side instead."


class Author:
    """Answers from this file and the two planners."""

    name = "written-for-the-example"

    def __init__(self) -> None:
        self._planners = [(HERE / "planners" / f"{name}.py").read_text() for name in ("first", "second")]

    def complete(self, request: ChatRequest) -> ChatReply:
        """The next answer of that kind."""
        if request.agent == "analyzer":
            return _said(ANALYSIS if request.schema_name == "Analysis" else SAME)
        second = request.agent == "modifier"
        answer = {"source": self._planners[second]}
        return _said(answer | ({"diagnosis": DIAGNOSIS} if second else {"mode": "swing"}))


def _said(answer: object) -> ChatReply:
    return ChatReply(json.dumps(answer))


def main() -> None:
    """Run the story once and keep the exchanges."""
    run_input = load_input(Path("dual_left_turn_blind_side"))
    settings = load_settings(None, llm=Author.name, tuner="off", horizon=run_input.horizon)
    ledger = Ledger()
    with (
        tempfile.TemporaryDirectory() as scratch,
        MemoryBank.open(Path(scratch) / "bank.sqlite", seed_from=data_folder("memory_bank.sqlite")) as bank,
        Sandbox() as sandbox,
        Engine(episode_worker) as engine,
        Recorder(HERE / "recording.jsonl", Author.name, note=NOTE) as recorder,
    ):
        model = recorder.wrap(BudgetedModel(Author(), ledger))
        agents = Agents(settings, sandbox, dict.fromkeys(AGENT_ROLES, model), ledger, shipped_prompts())
        run = run_episode(
            run_input, settings, make_task(run_input, settings, Path(scratch)), engine, agents, bank, lambda *_: None
        )
    attempts = () if run.best is None else run.best.attempts
    print(f"{run.ending}: {[(a.proposal.by, round(a.verdict.min_ttc, 2)) for a in attempts]}")


if __name__ == "__main__":
    main()
