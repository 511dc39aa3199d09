"""What a record may span. One wrong coordinate or time stamp would cost gigabytes: roads are filled in metre by metre,
and records are resampled step by step. Records of the dataset span less than a kilometre and 20 s."""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.womd.record import Record

MOST_EXTENT = 20_000.0  # m between any two places; of the dataset: 600 m
MOST_ROAD = 500_000.0  # m of lanes and lines together; of the dataset: 20 km
FARTHEST = 1e6  # m from the origin, where a float still tells micrometres apart
LONGEST = 3600.0  # s from the first time stamp to the last


def check_bounds(record: Record, where: str) -> None:
    """Refuse a record that spans more than any does. ``where`` names it. Raises UsageError."""
    span = float(record.time[-1] - record.time[0])
    if span > LONGEST:
        raise UsageError(f"{where} spans {span:.3g} s, more than the {LONGEST:g} s that are read: its times are wrong.")
    lines = [lane.points[:, :2] for lane in record.lanes.values()]
    lines += [line.points[:, :2] for line in record.lines.values()]
    lines += [area.points[:, :2] for area in record.areas]
    lines += [sign.position[None, :2] for sign in record.stop_signs]
    states = [np.stack([t.x[t.valid], t.y[t.valid]], axis=1) for t in record.tracks]
    for kind, places in (("map point", lines), ("position of an object", states)):
        _check_places(np.concatenate([np.empty((0, 2)), *places]), kind, where)
    _check_places(np.concatenate([np.empty((0, 2)), *lines, *states]), "position of an object", where)
    road = sum(float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines)
    if road > MOST_ROAD:
        raise UsageError(
            f"{where} has {road / 1000:.4g} km of lines, more than the {MOST_ROAD / 1000:g} that are read."
        )


def _check_places(places: Floats, kind: str, where: str) -> None:
    if not len(places):
        return
    far = float(np.abs(places).max())
    if far > FARTHEST:
        raise UsageError(f"{where} has a {kind} {far:.3g} m from the origin: that is no place on a map in metres.")
    extent = float(np.ptp(places, axis=0).max())
    if extent > MOST_EXTENT:
        raise UsageError(f"{where} has a {kind} {extent / 1000:.4g} km from another place, which no record spans.")
