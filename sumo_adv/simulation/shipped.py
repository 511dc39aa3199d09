"""The shipped scenarios, each with its description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sumo_adv.simulation.inputs import data_folder, input_name
from sumo_adv.simulation.scenario import load_scenario


@dataclass(frozen=True, slots=True)
class ShippedScenario:
    """One scenario. road: the name of its network.

    intents: those held to be the most dangerous. relation, level: of an attack with one of them that a run until this
    level finds in at most 400 attempts with ``adversaries`` and a bank that has learnt nothing.
    """

    name: str
    description: str
    road: str
    intents: tuple[str, ...]
    relation: str | None
    level: str | None
    adversaries: int


def shipped_scenarios() -> list[ShippedScenario]:
    return [_read(path) for path in sorted(data_folder("scenarios").glob("*.toml"))]


def _read(path: Path) -> ShippedScenario:
    scenario = load_scenario(path)
    label = scenario.label
    assert label is not None, "each shipped scenario has a label"
    return ShippedScenario(
        input_name(path), _opening(path), input_name(scenario.network), label.intents,
        label.relation, label.level, label.adversaries,
    )  # fmt: skip


def _opening(path: Path) -> str:
    """The comment that opens a file, as one line."""
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# "))
    return " ".join(lines)
