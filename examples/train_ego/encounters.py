"""With which encounters the ego is trained, and with which it is measured."""

from __future__ import annotations

import re
from pathlib import Path

from sumo_adv.simulation.inputs import data_folder

NEVER_SEEN = frozenset({
    "straight_4lane", "curved_road", "rural_crossing", "t_junction_wide", "signalised_wide", "roundabout_large",
    "yield_merge",
})  # fmt: skip
"""Networks with which nothing is trained."""

OTHER_USERS = re.compile(r"cyclist|pedestrian")


def network_of(scenario: Path) -> str:
    """The name of a scenario's network."""
    found = re.search(r'^network = ".*?([A-Za-z0-9_]+)(\.net\.xml)?"', scenario.read_text(), re.MULTILINE)
    return "" if found is None else found[1]


def training() -> list[Path]:
    """Every other encounter of ``suite81`` and the shipped scenarios with vehicles, on other networks."""
    shipped = [f for f in sorted(data_folder("scenarios").glob("*.toml")) if not OTHER_USERS.search(f.stem)]
    return [f for f in [*_suite()[::2], *shipped] if network_of(f) not in NEVER_SEEN]


def held_out() -> list[Path]:
    """The encounters of ``suite81`` that nothing is trained with: every other one, and all on ``NEVER_SEEN``."""
    own = set(training())
    return [f for f in _suite() if f not in own]


def _suite() -> list[Path]:
    return sorted(f for f in (data_folder("suites") / "suite81").glob("*.toml") if f.stem != "suite")
