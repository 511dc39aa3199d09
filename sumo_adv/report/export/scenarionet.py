"""A run as a ScenarioNet database of one scenario, which MetaDrive replays: a folder of three pickled dictionaries.

Plain dictionaries, lists, text, numbers and numpy arrays. Time 0 is the first exported step; positions are box
centres in the network's coordinates.
"""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.report.export.entities import HEIGHT, kind
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.road import MapLane, map_lanes

SUMMARY, MAPPING = "dataset_summary.pkl", "dataset_mapping.pkl"
TYPES = {"car": "VEHICLE", "truck": "VEHICLE", "obstacle": "VEHICLE", "bicycle": "CYCLIST", "pedestrian": "PEDESTRIAN"}
DATASET, VERSION = "sumo_adv", "1"
PROTOCOL = 4  # of pickle: Python 3.4 and later


def write_scenarionet(folder: Path, piece: Piece) -> None:
    """Write the database into ``folder``. Raises UsageError: the network is unreadable."""
    scenario = description(piece)
    file = f"sd_{DATASET}_{VERSION}_{scenario['id']}.pkl"
    for name, value in ((file, scenario), (SUMMARY, {file: scenario["metadata"]}), (MAPPING, {file: ""})):
        (folder / name).write_bytes(pickle.dumps(value, protocol=PROTOCOL))


def description(piece: Piece) -> dict[str, Any]:
    """MetaDrive's scenario description."""
    length = round((piece.end - piece.begin) / piece.step) + 1
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", piece.name)
    tracks = {track.id: _track(track, piece, length) for track in piece.tracks}
    return {
        "id": name,
        "version": VERSION,
        "length": length,
        "tracks": tracks,
        "dynamic_map_states": {},
        "map_features": {str(key): value for lane in map_lanes(piece) for key, value in _features(lane)},
        "metadata": {
            "id": name, "scenario_id": name, "dataset": DATASET, "coordinate": "right-handed",
            "metadrive_processed": False, "sdc_id": piece.ego, "ts": piece.step * np.arange(length, dtype=np.float64),
            "sample_rate": piece.step, "current_time_index": 0, "source_file": piece.name,
            "tracks_to_predict": {
                t.id: {"track_id": t.id, "object_type": TYPES[kind(t)]} for t in piece.tracks
                if t.role is Role.ADVERSARY
            },
            "object_summary": {
                key: {"type": value["type"], "object_id": key, "track_length": length} for key, value in tracks.items()
            },
        },
    }  # fmt: skip


def _track(track: Track, piece: Piece, length: int) -> dict[str, Any]:
    """States over all steps, zero where the vehicle is not there."""
    first, category = round((float(track.time[0]) - piece.begin) / piece.step), kind(track)
    at = slice(first, first + len(track.time))

    def filled(*columns: Any) -> Any:
        values = np.zeros((length, len(columns)), np.float64)
        values[at] = np.column_stack([np.broadcast_to(c, track.time.shape) for c in columns])
        return values[:, 0] if len(columns) == 1 else values

    valid = np.zeros(length, bool)
    valid[at] = True
    return {
        "type": TYPES[category],
        "state": {
            "position": filled(track.x, track.y, HEIGHT[category] / 2), "heading": filled(track.heading),
            "velocity": filled(track.speed * np.cos(track.heading), track.speed * np.sin(track.heading)),
            "length": filled(track.length), "width": filled(track.width), "height": filled(HEIGHT[category]),
            "valid": valid,
        },
        "metadata": {
            "type": TYPES[category], "object_id": track.id, "dataset": DATASET, "track_length": length,
            "role": str(track.role),
        },
    }  # fmt: skip


def _features(each: MapLane) -> list[tuple[str, dict[str, Any]]]:
    """A lane, and the lines at its sides outside junctions."""
    lane = {
        "type": "LANE_SURFACE_STREET", "polyline": _flat(each.lane.shape),
        "polygon": np.concatenate([each.left, each.right[::-1]]),
        "speed_limit_kmh": each.lane.speed * 3.6, "interpolating": each.lane.internal,
        "entry_lanes": [str(n) for n in each.entries], "exit_lanes": [str(n) for n in each.exits],
        "left_neighbor": [] if each.beside_left is None else [str(each.beside_left)],
        "right_neighbor": [] if each.beside_right is None else [str(each.beside_right)],
    }  # fmt: skip
    features = [(str(each.number), lane)]
    for side, line, beside in (("left", each.left, each.beside_left), ("right", each.right, each.beside_right)):
        if not each.lane.internal:
            sort = "ROAD_EDGE_BOUNDARY" if beside is None else "ROAD_LINE_BROKEN_SINGLE_WHITE"
            features.append((f"{each.number}_{side}", {"type": sort, "polyline": _flat(line)}))
    return features


def _flat(line: Any) -> Any:
    """A line ``(n, 3)`` on the ground."""
    return np.column_stack([line, np.zeros(len(line))])
