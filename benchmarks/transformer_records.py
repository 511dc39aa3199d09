"""Scenes for the motion predictor from Waymo records: for a user's own training. Weights from them are never shipped.

A record has 1.1 s of history, which ends at its current step, and up to 8 s of future. Its lanes are the map's own.
Lights are taken as unknown, and lanes that others join or leave as being on a junction where the map interpolates them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import transformer_scenes as scenes

from sumo_adv.errors import UsageError
from sumo_adv.transformer import scene
from sumo_adv.womd.reader import read_records
from sumo_adv.womd.record import BIKE, VEHICLE, Record, evenly_sampled

MIN_LANE_TURN_RAD = 0.5  # between the directions of a lane's ends: it turns


def make_from_records(source: Path, folder: Path, progress: Callable[[int, int], None]) -> int:
    """A file of scenes for each TFRecord file of ``source``; every eighth one is held out. Returns how many there are.

    Raises:
        UsageError: there is no record, or one cannot be read; the folder holds other scenes.
    """
    files = sorted(path for path in source.iterdir() if ".tfrecord" in path.name) if source.is_dir() else []
    if not files:
        raise UsageError(f"{source} is no folder with .tfrecord files.")
    scenes.begin(folder, f"womd, {len(files)} files")
    for number, file in enumerate(files):
        kept = (number + 1) % scenes.TRAINING_RUNS_PER_HELD_OUT == 0
        kind = scenes.HELD_OUT if kept else scenes.TRAIN
        target = folder / f"{kind}-{number:04d}.npz"
        if not target.exists():
            found = [made for record in read_records(file) if (made := scene_of_record(record)) is not None]
            if found:
                scenes.save(scenes.together(found), target)
        progress(number + 1, len(files))
    return len(files)


def scene_of_record(record: Record) -> scenes.Scene | None:
    """The scene of a record around its ego (see ``scenes.scene_of``); None where its history is too short."""
    record, _ = evenly_sampled(record)
    first = record.current - scene.HISTORY_COUNT + 1
    ego = record.tracks[record.sdc]
    if first < 0 or not ego.valid[record.current]:
        return None
    current = record.current
    there = [t for t in record.tracks if t.kind == VEHICLE and t.valid[current] and t.valid[first]]
    far = {t.id: float(np.hypot(t.x[current] - ego.x[current], t.y[current] - ego.y[current])) for t in there}
    near = (t for t in there if far[t.id] < scenes.SCENE_RADIUS_M)
    chosen = sorted(near, key=lambda t: far[t.id])[: scene.MAX_AGENTS]
    if not chosen:
        return None
    place = np.full((len(chosen), scene.HISTORY_COUNT + scene.FUTURE_COUNT, 2), np.nan)
    for i, track in enumerate(chosen):
        steps = min(scene.HISTORY_COUNT + scene.FUTURE_COUNT, len(track.x) - first)
        valid = track.valid[first : first + steps]
        place[i, :steps][valid] = np.column_stack([track.x, track.y])[first : first + steps][valid]
    agents = scene.SceneVehicles(
        place[:, :scene.HISTORY_COUNT], np.array([t.heading[current] for t in chosen]),
        np.array([np.hypot(t.vx[current], t.vy[current]) for t in chosen]),
        np.array([(t.length[current], t.width[current]) for t in chosen]),
        np.array([scene.light_of(None) for _ in chosen]),
    )  # fmt: skip
    return scenes.scene_of(agents, place[:, scene.HISTORY_COUNT :], _segments(record))


def _segments(record: Record) -> scene.Segments:
    pieces = []
    lit = {state.lane for states in record.signals for state in states}
    yields = {lane for sign in record.stop_signs for lane in sign.lanes}
    for lane in record.lanes.values():
        if lane.kind == BIKE or len(lane.points) < 2:
            continue
        shape = lane.points[:, :2]
        (ax, ay), (bx, by) = shape[1] - shape[0], shape[-1] - shape[-2]
        turn = float(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))
        inner = lane.interpolating
        left, right = turn > MIN_LANE_TURN_RAD, turn < -MIN_LANE_TURN_RAD
        about = inner, inner and left, inner and right, lane.id in yields, lane.id in lit
        length = scene.JUNCTION_SEGMENT_M if inner else scene.ROAD_SEGMENT_M
        pieces.append((shape, length, (*about, lane.speed_limit / scene.LIMIT_SCALE_M_S)))
    return scene.cut(pieces)
