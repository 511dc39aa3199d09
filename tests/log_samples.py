"""A log written by hand on the shipped ``straight_3lane``: lanes at y = -3.2, 0 and 3.2, eastwards from 0 to 1200 m."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.tracks import LoggedTrack, TrackLog, write_tracks

STEPS = 91  # 0.0 to 9.0 s
STEP = 0.1
RIGHT, MIDDLE, LEFT = -3.2, 0.0, 3.2


def moving(
    name: str, x: float, y: float, speed: float, *, kind: str = "vehicle", heading: float = 0.0,
    size: tuple[float, float] = (4.5, 1.9), gone: tuple[range, ...] = (),
) -> LoggedTrack:  # fmt: skip
    """An object with its centre at (x, y) at time 0, which goes on at ``speed``; not seen in the steps ``gone``."""
    time = STEP * np.arange(STEPS)
    valid = np.ones(STEPS, bool)
    for some in gone:
        valid[some.start : some.stop] = False
    fill = np.ones(STEPS)
    return LoggedTrack(
        name, kind, valid, x + speed * math.cos(heading) * time, y + speed * math.sin(heading) * time, heading * fill,
        speed * fill, *size,
    )  # fmt: skip


def write_scenario(
    folder: Path,
    tracks: list[LoggedTrack],
    *,
    routed: tuple[str, ...] = (),
    more: str = "",
    top: Mapping[str, str] = {},
) -> Path:
    """``case.toml`` with its log and routes; the ego is the track ``e`` and control begins at 1.0 s."""
    write_tracks(folder / "tracks.csv.gz", TrackLog(STEP * np.arange(STEPS), {t.id: t for t in tracks}))
    routes = "".join(f'<route id="{name}" edges="eastbound"/>' for name in routed)
    (folder / "log.rou.xml").write_text(f"<routes>{routes}</routes>")
    keys = "".join(f"{k} = {v}\n" for k, v in top.items())
    network = data_folder("networks") / "straight_3lane.net.xml"
    (folder / "case.toml").write_text(
        f'schema = 1\nnetwork = "{network}"\ntracks = "tracks.csv.gz"\n{keys}'
        f'[demand]\nfiles = ["log.rou.xml"]\n[ego]\nid = "e"\n[window]\nwarm_up = 1.0\n{more}'
    )
    return folder / "case.toml"
