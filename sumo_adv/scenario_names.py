"""Name traffic scenarios by three lists of the field, and say which of them this program can show.

=========== =========================================================================================================
list        source
=========== =========================================================================================================
NHTSA       37 pre-crash scenarios: Najm, Smith and Yanagisawa 2007, "Pre-Crash Scenario Typology for Crash Avoidance
            Research", DOT HS 810 767; by its numbers
ISO 34502   24 traffic disturbances on roads without crossings: ISO 34502:2022 and JAMA, "Automated Driving Safety
            Evaluation Framework", version 3.0 (2022): 3 road geometries x 2 behaviours of the ego x 4 motions of the
            other vehicle
Euro NCAP   test protocols AEB Car-to-Car 4.x and AEB/LSS VRU 4.x (2023), and the cut-in and the cut-out of the
            protocol Assisted Driving
=========== =========================================================================================================

``words/naming.py`` decides which of them an attempt is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import product
from typing import Any

from sumo_adv.datatypes import NamedScenario, RoadGeometry

NHTSA: Mapping[int, str] = {
    1: "Vehicle failure",
    2: "Control loss with prior vehicle action",
    3: "Control loss without prior vehicle action",
    4: "Running red light",
    5: "Running stop sign",
    6: "Road edge departure with prior vehicle maneuver",
    7: "Road edge departure without prior vehicle maneuver",
    8: "Road edge departure while backing up",
    9: "Animal crash with prior vehicle maneuver",
    10: "Animal crash without prior vehicle maneuver",
    11: "Pedestrian crash with prior vehicle maneuver",
    12: "Pedestrian crash without prior vehicle maneuver",
    13: "Pedalcyclist crash with prior vehicle maneuver",
    14: "Pedalcyclist crash without prior vehicle maneuver",
    15: "Backing up into another vehicle",
    16: "Vehicle(s) turning - same direction",
    17: "Vehicle(s) parking - same direction",
    18: "Vehicle(s) changing lanes - same direction",
    19: "Vehicle(s) drifting - same direction",
    20: "Vehicle(s) making a maneuver - opposite direction",
    21: "Vehicle(s) not making a maneuver - opposite direction",
    22: "Following vehicle making a maneuver",
    23: "Lead vehicle accelerating",
    24: "Lead vehicle moving at lower constant speed",
    25: "Lead vehicle decelerating",
    26: "Lead vehicle stopped",
    27: "Left turn across path from opposite directions at signalized junctions",
    28: "Vehicle turning right at signalized junctions",
    29: "Left turn across path from opposite directions at non-signalized junctions",
    30: "Straight crossing paths at non-signalized junctions",
    31: "Vehicle(s) turning at non-signalized junctions",
    32: "Evasive action with prior vehicle maneuver",
    33: "Evasive action without prior vehicle maneuver",
    34: "Non-collision incident",
    35: "Object crash with prior vehicle maneuver",
    36: "Object crash without prior vehicle maneuver",
    37: "Other",
}
NEVER_SHOWN = frozenset({1, 2, 3, 5, 6, 7, 8, 9, 10, 15, 17, 32, 33, 34, 35, 36})
"""NHTSA's scenarios that no attack shows.

These are failures, control loss, animals, objects, backing up, parking, and evasive action before the conflict. Stop
signs (5) count as crossing paths (30) and turns (31).
"""


class EgoBehaviour(StrEnum):
    """Behaviours of the ego in ISO 34502."""

    KEEP = "lane keep"
    CHANGE = "lane change"


class Disturbance(StrEnum):
    """Motions of the other vehicle in ISO 34502.

    ``DECELERATION`` includes a vehicle that drives beside an ego that wants to change lanes, at the ego's speed (sync).
    """

    CUT_IN = "cut-in"
    CUT_OUT = "cut-out"
    ACCELERATION = "acceleration"
    DECELERATION = "deceleration"


def disturbance(geometry: RoadGeometry, behaviour: EgoBehaviour, motion: Disturbance) -> str:
    """Return the name of one of the 24 disturbances."""
    return f"{geometry}, {behaviour}, {motion}"


ISO_34502 = tuple(disturbance(*each) for each in product(RoadGeometry, EgoBehaviour, Disturbance))
EURO_NCAP: Mapping[str, str] = {
    "CCRs": "car-to-car rear, stationary",
    "CCRm": "car-to-car rear, moving",
    "CCRb": "car-to-car rear, braking",
    "CCFtap": "car-to-car front, turn across path: the ego turns",
    "CCCscp": "car-to-car crossing, straight crossing path",
    "CCFhos": "car-to-car front, head-on straight",
    "CCFhol": "car-to-car front, head-on lane change",
    "CMRs": "car-to-motorcyclist rear, stationary",
    "CMRb": "car-to-motorcyclist rear, braking",
    "CMFtap": "car-to-motorcyclist front, turn across path: the ego turns",
    "CMCscp": "car-to-motorcyclist crossing, straight crossing path",
    "CPNA": "car-to-pedestrian, from the near side",
    "CPNCO": "car-to-pedestrian, from the near side behind an obstruction; the protocol has a child",
    "CPFA": "car-to-pedestrian, from the far side",
    "CPLA": "car-to-pedestrian, longitudinal",
    "CPTA": "car-to-pedestrian, the ego turns",
    "CBNA": "car-to-bicyclist, from the near side",
    "CBNAO": "car-to-bicyclist, from the near side behind an obstruction",
    "CBFA": "car-to-bicyclist, from the far side",
    "CBLA": "car-to-bicyclist, longitudinal",
    "CBTA": "car-to-bicyclist, the ego turns",
    "cut-in": "a vehicle of the next lane cuts in (Assisted Driving)",
    "cut-out": "the leader leaves the lane (Assisted Driving)",
}
LISTS = ("NHTSA", "ISO 34502", "Euro NCAP")
COLUMNS = ("motion", "nhtsa", "iso_34502", "euro_ncap")
"""Columns of tables that name a scenario. A cell is empty if the list has no name for it."""


@dataclass(frozen=True, slots=True, order=True)
class ScenarioName:
    """An entry of a list.

    Attributes:
        list: One of ``LISTS``.
        name: The name of the scenario in the list.
        shown: Whether an attack of this program can show the scenario.
    """

    list: str
    name: str
    shown: bool = True


EVERY: Sequence[ScenarioName] = (
    *(ScenarioName("NHTSA", f"{k} {name}", k not in NEVER_SHOWN) for k, name in NHTSA.items()),
    *(ScenarioName("ISO 34502", name) for name in ISO_34502),
    *(ScenarioName("Euro NCAP", name) for name in EURO_NCAP),
)
"""All entries of the three lists."""


def columns_of(scenario: NamedScenario | None) -> dict[str, str | None]:
    """Return the cells of ``COLUMNS`` for a scenario; None for each cell without a name."""
    if scenario is None:
        return dict.fromkeys(COLUMNS)
    number = scenario.nhtsa
    return {
        "motion": scenario.motion, "nhtsa": None if number is None else f"{number} {NHTSA[number]}",
        "iso_34502": scenario.iso_34502 or None, "euro_ncap": scenario.euro_ncap or None,
    }  # fmt: skip


def names_in(cells: Mapping[str, Any]) -> list[ScenarioName]:
    """Return the entries that the cells of ``COLUMNS`` in a row name."""
    keys = dict(zip(COLUMNS[1:], LISTS, strict=True))
    return [ScenarioName(keys[key], str(cells[key])) for key in keys if cells.get(key)]


def wanted(words: Iterable[str]) -> tuple[ScenarioName, ...]:
    """Find the entries that the words of a filter mean.

    Args:
        words: Names of Euro NCAP (``CCFtap``), a motion of ISO 34502 (``cut-in``), a geometry or a behaviour (``merge
            zone``), or NHTSA's number (``nhtsa-25``). Upper and lower case are the same.

    Returns:
        The entries, each once.

    Raises:
        ValueError: A word names no scenario that an attack can show. The message is a sentence.
    """
    chosen = list[ScenarioName]()
    for word in words:
        own = [each for each in EVERY if _means(word.strip().lower(), each)]
        if not own:
            raise ValueError(
                f"there is no scenario '{word}'; give names of Euro NCAP ({', '.join(list(EURO_NCAP)[:5])} ...), "
                f"ISO 34502 ({', '.join(Disturbance)}, {', '.join(RoadGeometry)}) or NHTSA (nhtsa-1 to nhtsa-37)"
            )
        if not any(each.shown for each in own):
            raise ValueError(f"no attack shows the scenario '{word}' ({own[0].name})")
        chosen += own
    return tuple(dict.fromkeys(chosen))


def _means(word: str, entry: ScenarioName) -> bool:
    """Return whether a word in lower case means an entry: by its name, its number, or a part between commas."""
    name = entry.name.lower()
    if entry.list == "NHTSA":
        return word in (f"nhtsa-{name.split()[0]}", name, name.partition(" ")[2])
    return word == name or (entry.list == "ISO 34502" and word in name.split(", "))


def is_one_of(cells: Mapping[str, Any], names: Iterable[ScenarioName]) -> bool:
    """Return whether the cells of ``COLUMNS`` in a row name one of these scenarios."""
    return not {(each.list, each.name) for each in names}.isdisjoint((n.list, n.name) for n in names_in(cells))
