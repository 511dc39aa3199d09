"""Read a CommonRoad scenario (XML, formats 2018b and 2020a) as a record for the converter.

Lanelets become lanes with their centre lines, and obstacles become tracks from time step 0 on. The initial state of the
planning problem is the ego, at its own time step. The ego's track ends one step later. ``Record.notes`` says what is
left out.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from sumo_adv.errors import UsageError
from sumo_adv.geometry import Pose
from sumo_adv.womd.commonroad_obstacles import (
    BOUNDARY,
    child,
    make_track,
    obstacle_tracks,
    obstacle_type,
    obstacles,
    plain_box,
    read_pose,
    read_poses,
    time_step,
)
from sumo_adv.womd.commonroad_roads import (
    country,
    is_lit,
    is_walkway,
    lanelet_types,
    other_signs,
    read_crosswalks,
    read_edges,
    read_lanes,
    read_lights,
)
from sumo_adv.womd.record import MAX_RECORD_DURATION_S, RECORD_STEP_S, VEHICLE, Record, check_record

COMMONROAD_VERSIONS = ("2018b", "2020a")
PLANNING_EGO_SIZE_M = 4.508, 1.610  # CommonRoad's vehicle 2, BMW 320i; a planning problem names no size
LEFT_HAND = frozenset(
    {"AUS", "JPN", "HKG", "IND", "JEY", "IMN", "IRL", "JAM", "KEN", "MLT", "MYS", "NPL", "NZL", "ZAF", "SGP", "THA",
     "GBR", "IDN", "MAC", "PAK", "CYP"}
)  # fmt: skip
"""Countries with left-hand traffic, as commonroad-io lists them."""


def read_commonroad(path: Path) -> Record:
    """Read a CommonRoad scenario.

    Args:
        path: The file.

    Returns:
        The scenario as a record.

    Raises:
        UsageError: The file cannot be read, has another format version, or has no lanelets or no planning problem.
    """
    try:
        data = path.read_bytes()
        record = _record(ElementTree.fromstring(data), path, hashlib.sha256(data).hexdigest())
    except OSError as error:
        raise UsageError(f"The file {path} cannot be read: {error.strerror or error}.") from error
    except (ElementTree.ParseError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{path} is not a CommonRoad scenario that can be read ({error}); check the file.") from error
    check_record(record, str(path))
    return record


def _record(root: Element, path: Path, content: str) -> Record:
    """Return the scenario as a record."""
    version = root.get("commonRoadVersion", "")
    if version not in COMMONROAD_VERSIONS:
        named = f"is a CommonRoad scenario of the format {version[:40]}" if version else "names no CommonRoad format"
        raise UsageError(f"{path} {named}: give one of the formats {' and '.join(COMMONROAD_VERSIONS)}.")
    lanelets = [each for each in root.findall("lanelet") if not is_walkway(each)]
    problem = root.find("planningProblem")
    if not lanelets or problem is None:
        raise UsageError(f"{path} has no {'planning problem' if lanelets else 'lanelets'}, so there is nothing to run.")
    step = float(root.attrib["timeStepSize"])
    if not 0.0 < step < 10.0:
        raise ValueError(f"its time step is {step:g} s")
    taken = [(each, still) for each, still in obstacles(root) if obstacle_type(each) != BOUNDARY]
    poses = [read_poses(each, step) for each, _ in taken]
    initial = child(problem, "initialState")
    first = time_step(initial)
    seen = _ego_steps(first, step)
    count = max([seen[-1] + 1, *(max(each) + 1 for each in poses)])
    if count * step > MAX_RECORD_DURATION_S:
        raise UsageError(
            f"{path} spans {count * step:.3g} s, more than the {MAX_RECORD_DURATION_S:g} s that are read: "
            "check its times."
        )
    pose = read_pose(initial)
    ego = Pose(pose.x, pose.y, pose.heading, 0.0 if math.isnan(pose.speed) else pose.speed)
    moved = {k: ego.speed * step * (k - first) for k in seen}
    c, s = math.cos(ego.heading), math.sin(ego.heading)
    own = {k: Pose(ego.x + m * c, ego.y + m * s, ego.heading, ego.speed) for k, m in moved.items()}
    number = int(problem.attrib["id"])
    tracks = [make_track(number, VEHICLE, plain_box(*PLANNING_EGO_SIZE_M), own, count)]
    numbers = itertools.count(
        1 + max(int(each.get("id", "0")) for each in root.iter() if each.get("id", "0").isdigit())
    )
    for (obstacle, still), of in zip(taken, poses, strict=True):
        places = dict.fromkeys(range(count), of[min(of)]) if still else of
        tracks += obstacle_tracks(obstacle, places, numbers, count)
    lanes = read_lanes(root, lanelets, version)
    return Record(
        scenario_id=re.sub(r"[^A-Za-z0-9_.-]", "_", root.attrib["benchmarkID"])[:100] or "scenario",
        time=step * np.arange(count, dtype=np.float64), current=first, sdc=0, tracks=tracks,
        objects_of_interest=(), to_predict=(), lanes=lanes, lines=read_edges(lanelets, max(lanes)), stop_signs=(),
        areas=read_crosswalks(root.findall("lanelet")), signals=read_lights(root, lanelets, lanes, count),
        content=content, notes=_notes(root, path),
    )  # fmt: skip


def _ego_steps(first: int, step: float) -> range:
    """Return the steps of the ego, which drives straight on: those around the first two steps of the 10 Hz grid.

    Args:
        first: The step of the planning problem.
        step: The file's step [s].
    """
    steps = first * step / RECORD_STEP_S
    begin, end = math.floor(steps + 1e-6), math.ceil(steps - 1e-6) + 1  # on the grid
    return range(math.floor(begin * RECORD_STEP_S / step + 1e-6), math.ceil(end * RECORD_STEP_S / step - 1e-6) + 1)


def _notes(root: Element, path: Path) -> Sequence[str]:
    """Return sentences on what is left out, by kind, and on left-hand traffic."""
    lost = other_signs(root)
    lost["further planning problem"] = len(root.findall("planningProblem")) - 1
    lost["prediction as an occupancy set"] = len(root.findall("dynamicObstacle/occupancySet"))
    lost["prediction as an occupancy set"] += len(root.findall("obstacle/occupancySet"))
    lost["traffic light without a cycle"] = sum(not is_lit(each) for each in root.findall("trafficLight"))
    lost["road boundary"] = sum(obstacle_type(each) == BOUNDARY for each, _ in obstacles(root))
    for tag in ("environmentObstacle", "phantomObstacle"):
        lost[tag] = len(root.findall(tag))
    kinds = Counter(kind for each in root.findall("lanelet") for kind in lanelet_types(each))
    lost["sidewalk"], lost["closing of a bus lane to cars"] = kinds["sidewalk"], kinds["busLane"]
    named = ", ".join(f"{number} {kind}" for kind, number in (+lost).items())
    side = f"{path.name} is from {country(root)}: its lanes are kept, but right of way is as in right-hand traffic."
    return (
        *((f"Left out of {path.name}: {named}.",) if named else ()),
        *((side,) if country(root) in LEFT_HAND else ()),
    )
