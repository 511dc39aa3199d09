"""List the shipped scenarios, each with its description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sumo_adv.simulation.inputs import data_folder, input_name
from sumo_adv.simulation.scenario import load_scenario


@dataclass(frozen=True, slots=True)
class ShippedScenario:
    """One scenario.

    A run with ``level`` as its goal finds an attack with one of the intents, this relation and this level in at most
    400 attempts, starting from a bank that has learnt nothing.

    Attributes:
        name: The name of the scenario.
        description: Its description.
        road: The name of its network.
        intents: The intents considered the most dangerous.
        relation: The relation of such an attack.
        level: The level of such an attack.
        adversaries: The number of adversaries of such an attack.
    """

    name: str
    description: str
    road: str
    intents: tuple[str, ...]
    relation: str | None
    level: str | None
    adversaries: int


def shipped_scenarios() -> list[ShippedScenario]:
    """Return all shipped scenarios, sorted by name."""
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
    """Return the comment at the beginning of a file, as one line."""
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# "))
    return " ".join(lines)
