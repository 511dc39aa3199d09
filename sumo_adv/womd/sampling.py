"""A record brought to an even 10 Hz, where it was recorded at another rate or its clock jitters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.geometry import wrap, wrap_below_pi
from sumo_adv.womd.record import ObjectTrack, Record

STEP = 0.1  # s
UNEVEN = 0.05  # s that a time stamp may be off an even grid: clocks that are slow by 0.5 % are taken as they are
JITTER = 0.01  # s that a step may be longer or shorter: 0.15 m at 15 m/s, the slack of the gate ``continuity``
LONGEST = 0.35  # s between two states that are joined by a straight line; over a longer gap an object is unseen


@dataclass(frozen=True, slots=True)
class Sampling:
    """How a record was sampled. step: median time between its steps [s]; worst: how far a time stamp is off an even
    10 Hz [s]; jitter: how far the time between two steps is off 0.1 s [s]; resampled: whether it was resampled."""

    step: float
    worst: float
    jitter: float
    resampled: bool

    @property
    def sentence(self) -> str:
        """For the user; empty if the record is taken as it is."""
        if not self.resampled:
            return ""
        return (
            f"resampled to 10 Hz: steps {self.step:.3f} s apart, uneven by up to {self.jitter:.3f} s, "
            f"time stamps up to {self.worst:.3f} s off"
        )


def evenly_sampled(record: Record) -> tuple[Record, Sampling]:
    """The record on the grid ``time[0] + 0.1 k`` s, itself if it is on that already.

    Positions, speeds and sizes are linear between states, headings go the shorter way. An object is valid where the
    states on both sides are. Signals keep the last state. The current step is the nearest to that of the record.
    """
    time = record.time - record.time[0]
    steps = np.diff(time) if len(time) > 1 else np.array([STEP])
    step, jitter = float(np.median(steps)), float(np.abs(steps - STEP).max())
    worst = float(np.abs(time - STEP * np.arange(len(time))).max())
    if worst <= UNEVEN and jitter <= JITTER:
        return record, Sampling(step, worst, jitter, resampled=False)
    grid = np.asarray(STEP * np.arange(int(time[-1] / STEP + 1e-6) + 1), np.float64)
    high = np.clip(np.searchsorted(time, grid - 1e-9), 0, len(time) - 1)
    low = np.maximum(high - (time[high] > grid + 1e-9), 0)
    gap = time[high] - time[low]
    share = np.where(gap > 0.0, (grid - time[low]) / np.maximum(gap, 1e-9), 0.0)
    bridged: Bools = np.asarray(gap <= max(LONGEST, 1.5 * step))
    even = replace(
        record, time=record.time[0] + grid, current=int(np.argmin(np.abs(grid - time[record.current]))),
        tracks=[_track(track, low, high, share, bridged) for track in record.tracks],
        signals=[record.signals[k] for k in low],
    )  # fmt: skip
    return even, Sampling(step, worst, jitter, resampled=True)


def _track(track: ObjectTrack, low: Ints, high: Ints, share: Floats, bridged: Bools) -> ObjectTrack:
    def linear(values: Floats) -> Floats:
        return np.asarray(np.where(share == 0.0, values[low], values[low] * (1 - share) + values[high] * share))

    turn = wrap_below_pi(track.heading[high] - track.heading[low])
    return replace(
        track, valid=track.valid[low] & track.valid[high] & bridged,
        heading=wrap(track.heading[low] + share * turn),
        x=linear(track.x), y=linear(track.y), z=linear(track.z), length=linear(track.length),
        width=linear(track.width), height=linear(track.height), vx=linear(track.vx), vy=linear(track.vy),
    )  # fmt: skip
