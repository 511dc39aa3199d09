"""Standard cut-ins, for comparing reference drivers with other implementations of them.

Lanes are 3.5 m wide, both boxes 4.3 x 1.9 m, steps 0.1 s.  The other vehicle is in the lane beside the ego's, ``gap`` m
ahead (bumper to bumper), at constant speed; it moves sideways at a constant speed until it is in the middle of the
ego's lane.  The ego keeps its speed unless a driver reacts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Ints
from sumo_adv.errors import UsageError
from sumo_adv.metrics.contact import Side, contact_sides
from sumo_adv.metrics.reference import BRAKERS, MANOEUVRE, REFERENCE_DRIVERS
from sumo_adv.metrics.reference.counterfactual import Counterfactual, Encounters

LANE, LENGTH, WIDTH, DT = 3.5, 4.3, 1.9, 0.1  # m, m, m, s
COLUMNS = ("ego_kmh", "other_kmh", "gap_m", "lateral_ms")
ANSWERS = ("unchanged", *REFERENCE_DRIVERS)
AT_ONCE = 100  # cases in one batch
LONGEST = 120.0  # s: a contact that would come later counts as none
AFTER = 8.0  # s that a case goes on after the unchanged ego's contact
NONE = "none"


def judge_cut_ins(cases: Floats) -> list[dict[str, str]]:
    """For each case, a row of ``COLUMNS`` ``(n, 4)``: ``none`` or the kind of contact of the unchanged ego and of each
    reference driver: ``front_to_rear`` (the ego runs into the other's rear), ``side``.

    Raises UsageError: numbers that make no cut-in.
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
    """Rows that take about equally long, and for how long [s] they are rolled out."""
    ego, leader, gap, lateral = cases.T
    closing = np.maximum((ego - leader) / 3.6, 1e-9)
    until = np.minimum(np.maximum(gap / closing, 0.0), LONGEST)
    until = np.maximum(until, LANE / np.maximum(lateral, 0.05))
    order = np.argsort(until, kind="stable")
    for first in range(0, len(order), AT_ONCE):
        rows = order[first : first + AT_ONCE]
        yield rows, float(min(until[rows].max() + AFTER, LONGEST + AFTER))


def _batch(cases: Floats, duration: float) -> list[dict[str, str]]:
    check = Counterfactual(encounters(cases, duration), beyond=0.0)
    kinds = {"unchanged": _kinds(check, check.ego)}
    alarm = np.full(len(cases), np.inf)
    for name, driver in BRAKERS.items():
        station, speed, shown = check.roll_out(driver)
        x, y, heading = check.paths.poses(station)
        kinds[name] = _kinds(check, Boxes(x, y, heading, speed, LENGTH, WIDTH))
        alarm = shown if name == "cc_human" else alarm
    answer, _ = check.manoeuvring(alarm)
    kinds[MANOEUVRE] = [
        NONE if avoids else kind for avoids, kind in zip(answer.avoids, kinds["unchanged"], strict=True)
    ]
    return [{name: kinds[name][k] for name in ANSWERS} for k in range(len(cases))]


def encounters(cases: Floats, duration: float) -> Encounters:
    """The cut-ins of rows of ``COLUMNS``, rolled out for ``duration`` [s]."""
    time = np.arange(round(duration / DT) + 1) * DT
    ego, leader = cases[:, :1] / 3.6, cases[:, 1:2] / 3.6
    zero = np.zeros((len(cases), len(time)))
    ego_boxes = Boxes(ego * time, zero, zero, ego + zero, LENGTH, WIDTH)
    aside = np.maximum(LANE - cases[:, 3:4] * time, 0.0)
    leader_boxes = Boxes(cases[:, 2:3] + LENGTH + leader * time, aside, zero, leader + zero, LENGTH, WIDTH)
    n = len(cases)
    return Encounters(ego_boxes, leader_boxes, np.zeros(n, int), np.full(n, len(time) - 1), DT, None, LANE / 2)


def _kinds(check: Counterfactual, ego: Boxes) -> Sequence[str]:
    from sumo_adv.metrics.boxes import first_contact

    when = first_contact(ego, check.adversary, check.time)
    kinds = []
    for row, time in enumerate(when):
        if not np.isfinite(time):
            kinds.append(NONE)
            continue
        side, _ = contact_sides(_at(ego, row, float(time)), _at(check.adversary, row, float(time)))
        kinds.append("front_to_rear" if side is Side.FRONT else "side")
    return kinds


def _at(b: Boxes, row: int, time: float) -> Boxes:
    """A box at a time between steps, as 0-d arrays."""
    k = min(int(time / DT + 1e-9), b.x.shape[1] - 2)
    part = time / DT - k
    x, y, heading, speed = (
        np.asarray(v[row, k] + part * (v[row, k + 1] - v[row, k])) for v in (b.x, b.y, b.heading, b.speed)
    )
    return Boxes(x, y, heading, speed, LENGTH, WIDTH)
