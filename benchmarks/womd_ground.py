"""How many logged vehicles leave the drivable area of converted Waymo records.

    python benchmarks/womd_ground.py DIR

The rule is the gate ``off_road``: a corner of the box by more than 0.15 m, at a step at which the vehicle drives faster
than 1 m/s. A vehicle counts if it does so once. Each record is judged twice: by the area of its lanes, and by the area
that its network carries (road edges and driveways). *On the road* are the steps with the box centre within 3 m of a
lane's centre line; the others are on ground that the map does not hold, such as private car parks. Needs records (they
are not part of the project); without DIR it says so and ends. Status 1 if 2 % of the vehicles on the road leave.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Bools, Boxes
from sumo_adv.errors import SumoAdvError
from sumo_adv.metrics.gates import off_road
from sumo_adv.simulation.network import read_network
from sumo_adv.womd.network import convert_network
from sumo_adv.womd.reader import read_records
from sumo_adv.womd.record import TRACK_KINDS, ObjectTrack, Record

MOVING = 1.0  # m/s
ON_ROAD = 3.0  # m from a lane's centre line to the box centre
MOST = 0.02  # share of the vehicles on the road that may leave the area


def main() -> int:
    """A line a record with a vehicle that leaves, then the totals; the status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="where the .tfrecord files are")
    args = parser.parse_args()
    if args.folder is None:
        print("no folder of Waymo records given: nothing to do")
        return 0
    total: Counter[str] = Counter()
    for file in sorted(args.folder.rglob("*.tfrecord*")):
        for record in read_records(file):
            try:
                total += judged(record)
            except SumoAdvError as error:
                print(f"FAILED {record.scenario_id}: {error}")
                total["failed"] += 1
    for place in ("on the road", "anywhere"):
        count = total[place]
        before, after = (total[f"{place}, outside {area}"] for area in ("lanes", "ground"))
        print(
            f"{place}: {count} moving vehicles, outside the lanes {before} ({before / max(count, 1):.1%}), "
            f"outside the area {after} ({after / max(count, 1):.1%})"
        )
    left = total["on the road, outside ground"]
    return int(total["failed"] > 0 or left >= MOST * max(total["on the road"], 1))


def judged(record: Record) -> Counter[str]:
    """Moving vehicles of a record, and those that leave the lanes and the ground."""
    from shapely import LineString, dwithin, points, union_all

    with tempfile.TemporaryDirectory() as folder:
        road = read_network(convert_network(record, Path(folder)).path)
    areas = {"lanes": replace(road, ground=None).drivable(0.0, 0.0, 1e6), "ground": road.drivable(0.0, 0.0, 1e6)}
    middle = union_all([LineString(lane.points[:, :2]) for lane in record.lanes.values() if len(lane.points) > 1])
    counts: Counter[str] = Counter()
    for track in record.tracks:
        moving = track.valid & (np.hypot(track.vx, track.vy) > MOVING)
        if TRACK_KINDS[track.kind] != "vehicle" or not moving.any():
            continue
        near: Bools = np.asarray(dwithin(points(np.column_stack([track.x, track.y])), middle, ON_ROAD))
        out = {name: off_road(_boxes(track), moving, area) for name, area in areas.items()}
        for place, judged_steps in {"anywhere": moving, "on the road": moving & near}.items():
            counts[place] += bool(judged_steps.any())
            for name, outside in out.items():
                counts[f"{place}, outside {name}"] += bool((outside & judged_steps).any())
        if (out["ground"] & near).any():
            print(
                f"{record.scenario_id}: vehicle {track.id} leaves in {(out['ground'] & near).sum()} steps", flush=True
            )
    return counts


def _boxes(track: ObjectTrack) -> Boxes:
    """A vehicle's boxes with its median size."""
    length, width = (float(np.median(size[track.valid])) for size in (track.length, track.width))
    return Boxes(track.x, track.y, track.heading, np.hypot(track.vx, track.vy), length, width)


if __name__ == "__main__":
    sys.exit(main())
