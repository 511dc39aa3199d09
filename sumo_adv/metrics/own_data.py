"""Users' own data: tracks from arrays or a table, as verdicts need them; and standard cut-ins.

The cut-ins serve to compare reference drivers with other implementations of them. Lanes are 3.5 m wide, both boxes
4.3 x 1.9 m, and steps 0.1 s. The other vehicle is in the lane beside the ego's, ``gap`` m ahead (bumper to bumper), at
constant speed. It moves sideways at a constant speed until it is in the middle of the ego's lane. The ego keeps its
speed unless a driver reacts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sumo_adv.consistency import GivenMotion, find_fault, off_grid, unordered
from sumo_adv.datatypes import Boxes, Floats, Ints, Role, Track
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.boxes import first_contact
from sumo_adv.metrics.contact import Side, contact_sides
from sumo_adv.metrics.reference import BRAKERS, MANOEUVRE, REFERENCE_DRIVERS
from sumo_adv.metrics.reference.counterfactual import Counterfactual, Encounters
from sumo_adv.road_users import unprotected

NEEDED_COLUMNS = ("time", "x", "y", "heading", "speed")
DEFAULT_LENGTH_M, DEFAULT_WIDTH_M = 4.8, 1.8  # if the table has no such column
MIN_TRACK_STATES = 4


def track_of(name: str, columns: Mapping[str, Any], role: Role) -> Track:
    """Make a track from columns.

    Args:
        name: The vehicle's id.
        columns: The columns by name: time [s] on a regular grid; x, y of the box centre [m]; heading [rad]; speed
            [m/s].
            Optional: length and width [m], lane, and z, the height of the road [m].
        role: The vehicle's role.

    Raises:
        UsageError: A column is missing, too short or of another length, the times are not regular, or the track is
            implausible (``consistency.py``): a number is not finite, or a unit is wrong.
    """
    values = {}
    for key in (*NEEDED_COLUMNS, *(["z"] if "z" in columns else [])):
        if key not in columns:
            raise UsageError(f"The track of {name!r} has no column '{key}': it needs {', '.join(NEEDED_COLUMNS)}.")
        values[key] = _numbers(name, key, columns[key])
    time = values["time"]
    if len(time) < MIN_TRACK_STATES or any(len(v) != len(time) for v in values.values()):
        raise UsageError(f"The track of {name!r} needs {MIN_TRACK_STATES} states or more, and columns of one length.")
    if wrong := unordered(time):
        raise UsageError(f"The times of {name!r} must ascend in even steps: state {wrong[0]} {wrong[1]}.")
    if (k := off_grid(time)) is not None:
        raise UsageError(
            f"The times of {name!r} must ascend in even steps: state {k} at {time[k]:g} s is off; resample the track."
        )
    dt = float(np.mean(np.diff(time)))
    length = _size(name, "length", columns, DEFAULT_LENGTH_M)
    width = _size(name, "width", columns, DEFAULT_WIDTH_M)
    kind = "other" if unprotected(length, width) else "vehicle"
    x, y, heading, speed = (values[key] for key in NEEDED_COLUMNS[1:])
    motion = GivenMotion(name, kind, time, x, y, heading, speed, length, width)
    if fault := find_fault([motion], noisy=False):
        at = f"state {fault.index} at {fault.time:g} s"
        raise UsageError(f"The track of {name!r} cannot be right: {at} {fault.says}.")
    acceleration = np.diff(speed, prepend=speed[:1]) / dt
    lane = tuple(str(v) for v in columns["lane"]) if "lane" in columns else ()
    return Track(
        name, role, np.round(time, 6), x, y, wrap_below_pi(heading), speed, acceleration, length, width, lane,
        values.get("z", 0.0),
    )  # fmt: skip


def columns_by_vehicle(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Split a table by its column ``id``.

    Args:
        table: The columns by name.

    Returns:
        The columns of each vehicle, in order of appearance.

    Raises:
        UsageError: The table has no column ``id``, or a column of another length.
    """
    if "id" not in table:
        raise UsageError("The table has no column 'id', which tells the vehicles apart: add it.")
    names = np.array([str(v) for v in table["id"]])
    given = [key for key in (*NEEDED_COLUMNS, "z", "length", "width", "lane") if key in table]
    uneven = [key for key in given if np.size(table[key]) != len(names)]
    if uneven:
        raise UsageError(f"The table's column '{uneven[0]}' is not as long as its column 'id'.")
    columns_of: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(names.tolist()):
        rows = names == name
        columns_of[name] = {key: np.asarray(table[key])[rows] for key in given}
    return columns_of


def _numbers(name: str, key: str, values: Any) -> Floats:
    try:
        numbers = np.asarray(values, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise UsageError(f"The column '{key}' of {name!r} must hold numbers ({error}).") from error
    if not np.isfinite(numbers).all():
        k = int(np.flatnonzero(~np.isfinite(numbers))[0])
        raise UsageError(
            f"The column '{key}' of {name!r} holds a number that is not finite, {numbers[k]:g} in state {k}: leave "
            "such states out."
        )
    return numbers


def _size(name: str, key: str, columns: Mapping[str, Any], default: float) -> float:
    if key not in columns:
        return default
    sizes = _numbers(name, key, columns[key])
    if not len(sizes):
        raise UsageError(f"The column '{key}' of {name!r} is empty.")
    return float(sizes[0])


CASE_LANE_WIDTH_M, CASE_CAR_LENGTH_M, CASE_CAR_WIDTH_M, CASE_STEP_S = 3.5, 4.3, 1.9, 0.1
CASE_COLUMNS = ("ego_kmh", "other_kmh", "gap_m", "lateral_ms")
ANSWERING_DRIVERS = ("unchanged", *REFERENCE_DRIVERS)
CASE_BATCH_SIZE = 100
MAX_CONTACT_TIME_S = 120.0  # a contact that would come later counts as none
CASE_AFTER_CONTACT_S = 8.0  # how long a case continues after the unchanged ego's contact
NO_DRIVER = "none"


def judge_cut_ins(cases: Floats) -> list[dict[str, str]]:
    """Judge standard cut-ins.

    Args:
        cases: Rows of ``CASE_COLUMNS`` ``(n, 4)``.

    Returns:
        For each case, the kind of contact of the unchanged ego and of each reference driver, by name: ``none``,
        ``front_to_rear`` (the ego runs into the other vehicle's rear) or ``side``.

    Raises:
        UsageError: The numbers make no cut-in.
    """
    bad = (cases[:, :2] < 0) | ~np.isfinite(cases[:, :2])
    if bad.any() or not np.isfinite(cases).all() or (cases[:, 2:] <= 0).any():
        raise UsageError("A cut-in needs speeds of 0 km/h or more, and a gap and a lateral speed above 0.")
    rows_by_case: list[dict[str, str]] = [{} for _ in cases]
    for rows, duration in _batches(cases):
        for row, answer in zip(rows, _batch(cases[rows], duration), strict=True):
            rows_by_case[int(row)] = answer
    return rows_by_case


def _batches(cases: Floats) -> Iterator[tuple[Ints, float]]:
    """Group rows that take about equally long; yield them with the duration [s] for which they are rolled out."""
    ego, leader, gap, lateral = cases.T
    closing = np.maximum((ego - leader) / 3.6, 1e-9)
    until = np.minimum(np.maximum(gap / closing, 0.0), MAX_CONTACT_TIME_S)
    until = np.maximum(until, CASE_LANE_WIDTH_M / np.maximum(lateral, 0.05))
    order = np.argsort(until, kind="stable")
    for first in range(0, len(order), CASE_BATCH_SIZE):
        rows = order[first : first + CASE_BATCH_SIZE]
        yield rows, float(min(until[rows].max() + CASE_AFTER_CONTACT_S, MAX_CONTACT_TIME_S + CASE_AFTER_CONTACT_S))


def _batch(cases: Floats, duration: float) -> list[dict[str, str]]:
    check = Counterfactual(encounters(cases, duration), beyond=0.0)
    kinds = {"unchanged": _kinds(check, check.ego)}
    alarm = np.full(len(cases), np.inf)
    for name, driver in BRAKERS.items():
        station, speed, shown = check.roll_out(driver)
        x, y, heading = check.paths.poses(station)
        kinds[name] = _kinds(check, Boxes(x, y, heading, speed, CASE_CAR_LENGTH_M, CASE_CAR_WIDTH_M))
        alarm = shown if name == "cc_human" else alarm
    answer, _ = check.manoeuvring(alarm)
    kinds[MANOEUVRE] = [
        NO_DRIVER if avoids else kind for avoids, kind in zip(answer.avoids, kinds["unchanged"], strict=True)
    ]
    return [{name: kinds[name][k] for name in ANSWERING_DRIVERS} for k in range(len(cases))]


def encounters(cases: Floats, duration: float) -> Encounters:
    """Roll out cut-ins.

    Args:
        cases: Rows of ``CASE_COLUMNS`` ``(n, 4)``.
        duration: For how long they are rolled out [s].
    """
    time = np.arange(round(duration / CASE_STEP_S) + 1) * CASE_STEP_S
    ego, leader = cases[:, :1] / 3.6, cases[:, 1:2] / 3.6
    zero = np.zeros((len(cases), len(time)))
    ego_boxes = Boxes(ego * time, zero, zero, ego + zero, CASE_CAR_LENGTH_M, CASE_CAR_WIDTH_M)
    aside = np.maximum(CASE_LANE_WIDTH_M - cases[:, 3:4] * time, 0.0)
    size = CASE_CAR_LENGTH_M, CASE_CAR_WIDTH_M
    leader_boxes = Boxes(cases[:, 2:3] + size[0] + leader * time, aside, zero, leader + zero, *size)
    n = len(cases)
    first, last, half_lane = np.zeros(n, int), np.full(n, len(time) - 1), CASE_LANE_WIDTH_M / 2
    return Encounters(ego_boxes, leader_boxes, first, last, CASE_STEP_S, None, half_lane)


def _kinds(check: Counterfactual, ego: Boxes) -> Sequence[str]:
    when = first_contact(ego, check.adversary, check.time)
    kinds = []
    for row, time in enumerate(when):
        if not np.isfinite(time):
            kinds.append(NO_DRIVER)
            continue
        side, _ = contact_sides(_at(ego, row, float(time)), _at(check.adversary, row, float(time)))
        kinds.append("front_to_rear" if side is Side.FRONT else "side")
    return kinds


def _at(b: Boxes, row: int, time: float) -> Boxes:
    """Return a box at a time between steps, as 0-d arrays."""
    k = min(int(time / CASE_STEP_S + 1e-9), b.x.shape[1] - 2)
    part = time / CASE_STEP_S - k
    x, y, heading, speed = (
        np.asarray(v[row, k] + part * (v[row, k + 1] - v[row, k])) for v in (b.x, b.y, b.heading, b.speed)
    )
    return Boxes(x, y, heading, speed, CASE_CAR_LENGTH_M, CASE_CAR_WIDTH_M)
