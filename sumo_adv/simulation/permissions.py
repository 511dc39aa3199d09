"""SUMO's vehicle classes (``vClass``): which of them drive on roads, and which may use a lane.

The names are those of SUMO's page "Abstract Vehicle Class". A lane or connection that names no class is open to all.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

CAR = "passenger"
EVERYWHERE = "ignoring"
"""The class of vehicles that SUMO lets use every lane."""
CARS = frozenset({
    CAR, "private", "emergency", "authority", "army", "vip", "hov", "taxi", "evehicle", "custom1", "custom2",
})  # fmt: skip
HEAVY = frozenset({"bus", "coach", "delivery", "truck", "trailer"})
TWO_WHEELED = frozenset({"motorcycle", "moped"})
MOTOR = CARS | HEAVY | TWO_WHEELED | {EVERYWHERE}
"""Classes of motor vehicles on roads. Carriageways are for them, and they can attack like a car."""
CYCLES = frozenset({"bicycle", "scooter"})
"""Classes that ride like a bicycle."""
ON_FOOT = frozenset({"pedestrian", "wheelchair"})
OFF_ROAD_CLASSES = frozenset({
    "tram", "rail_urban", "rail", "rail_electric", "rail_fast", "subway", "cable_car", "ship", "container", "aircraft",
    "drone",
})  # fmt: skip
"""Classes that drive on rails, water or in the air."""
ALL_CLASSES = MOTOR | CYCLES | ON_FOOT | OFF_ROAD_CLASSES


def allowed(names: Collection[str]) -> frozenset[str]:
    """Return the classes that a list of allowed ones means.

    Args:
        names: The list as sumolib reads it; ``all`` means every class.

    Returns:
        The classes.
    """
    return ALL_CLASSES if "all" in names else (ALL_CLASSES & frozenset(names)) | {EVERYWHERE}


def classes_of(lane: Mapping[str, str]) -> frozenset[str]:
    """Return the classes that ``allow`` or ``disallow`` of a lane in a net.xml admits."""
    if "allow" in lane:
        return allowed(lane["allow"].split())
    out = frozenset(lane.get("disallow", "").split())
    return allowed(() if "all" in out else ALL_CLASSES - out)


def is_carriageway(classes: Collection[str]) -> bool:
    """Return whether motor vehicles of some class may use a lane for these classes."""
    return not (MOTOR - {EVERYWHERE}).isdisjoint(classes)


def is_paved(classes: Collection[str]) -> bool:
    """Return whether a car that leaves its lane can drive on a lane for these classes.

    It can drive on lanes for motor vehicles or cycles. Sidewalks (for pedestrians alone, or with cycles) and tracks are
    excluded.
    """
    cycle_track = not CYCLES.isdisjoint(classes) and ON_FOOT.isdisjoint(classes)
    return is_carriageway(classes) or cycle_track
