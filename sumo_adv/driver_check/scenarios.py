"""The scenarios in which a driver is checked, and which vehicle it drives in each.

``run`` attacks the ego of the scenario, which mostly has the right of way. The check has the driver drive another
vehicle there, because it is to turn, wait and give way.
"""

from __future__ import annotations

from dataclasses import replace

from sumo_adv.simulation.inputs import RunInput, data_folder, load_input

TWELVE = (
    ("check/stop_and_go", "ego"),  # follows, stops behind a leader, goes on; traffic in the other direction
    ("motorway_cut_in_left", "ego"),  # a motorway with traffic beside it
    ("onramp_cut_in", "ego"),  # passes an on-ramp from which others merge
    ("oncoming_in_bend", "ego"),  # a bend with traffic in the other direction
    ("priority_straight_from_left", "from_north"),  # gives way, then crosses
    ("priority_left_turn_oncoming", "turning"),  # turns left through traffic that has priority
    ("t_junction_left_from_stem", "from_south"),  # turns left from the minor road
    ("t_junction_left_from_stem", "south_second"),  # turns right from the minor road
    ("signals_red_light", "red_south"),  # waits for a light, then goes on
    ("signals_left_turn", "turning"),  # turns left at a light through traffic that has green, too
    ("allway_stop_from_right", "ego"),  # all must stop
    ("roundabout_entry", "entering"),  # enters a roundabout and goes half around
)
"""Shipped scenarios, with the vehicle that is driven."""


def twelve() -> tuple[RunInput, ...]:
    """The inputs; each is named ``scenario:vehicle``. Raises UsageError: shipped files are missing."""
    return tuple(named(scenario, vehicle) for scenario, vehicle in TWELVE)


def named(scenario: str, vehicle: str) -> RunInput:
    """The input of a shipped scenario with another vehicle for its ego."""
    given = load_input(data_folder("scenarios") / f"{scenario}.toml")
    return replace(given, name=f"{given.name}:{vehicle}", ego=vehicle)
