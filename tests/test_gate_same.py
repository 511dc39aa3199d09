"""The same stock ``traci`` script, as native SUMO's second client and through the gate: equal answers."""

from __future__ import annotations

import json
from pathlib import Path

import traci
from gate_samples import Script, attached, needs_sumo, opened, spec

from sumo_adv.serve.gate import EventKind, Stepper
from sumo_adv.serve.sumo_process import SumoProcess

pytestmark = needs_sumo
READER = Path(__file__).parent / "gate_reader.py"
STEPS = 9


def native(folder: Path) -> list[list[str]]:
    """What the script hears of SUMO itself."""
    with SumoProcess(spec(folder).arguments()) as sumo:
        script = Script(sumo.port, READER)
        ours = None
        while ours is None:
            try:
                ours = traci.connect(sumo.port, numRetries=0, host="127.0.0.1")
            except traci.FatalTraCIError:
                assert sumo.alive, sumo.last_error
        ours.setOrder(1)
        for _ in range(STEPS + 3):
            ours.simulationStep()
        answers: list[list[str]] = json.loads(script.end())
        ours.close()
        return answers


def test_the_same_answers(tmp_path: Path) -> None:
    with opened(tmp_path, deadline=30.0) as (gate, events), attached(gate, events, tmp_path) as simulation:
        script = Script(gate.port, READER)
        assert gate.wait_connected(20.0)
        simulation.step(STEPS + 3)
        through = json.loads(script.end())
        assert gate.stepped_by is Stepper.GATE and gate.own == {"ego"}
        assert simulation.kinds() == [EventKind.CONNECTED, EventKind.CLOSED]
        simulation.end()
    straight = native(tmp_path)
    assert len(through) > 900
    assert [label for label, _ in through] == [label for label, _ in straight]
    assert [(a, b) for a, b in zip(through, straight, strict=True) if a != b] == []
