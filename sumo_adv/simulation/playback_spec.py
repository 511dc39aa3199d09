"""What a run plays back beside SUMO's traffic, as a scenario names it and as a manifest keeps it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.geometry import Pose
from sumo_adv.simulation.scan import scan_routes
from sumo_adv.simulation.scenario import Background, Scenario
from sumo_adv.simulation.signals import read_signals
from sumo_adv.simulation.tracks import LoggedTrack, read_tracks


@dataclass(frozen=True, slots=True)
class Prop:
    """A scenario's box: x, y centre [m] at ``start`` [s], heading [rad], speed [m/s]; it is gone after ``end`` [s]."""

    id: str
    x: float
    y: float
    heading: float
    speed: float
    length: float
    width: float
    start: float = 0.0
    end: float = math.inf
    kind: str = "other"  # pedestrian | cyclist | parked | other

    def pose(self, time: float) -> Pose | None:
        """Where it is at ``time`` [s]; None before it comes and after it left."""
        if not self.start - 1e-6 <= time <= self.end + 1e-6:
            return None
        gone = self.speed * (time - self.start)
        return Pose(
            self.x + gone * math.cos(self.heading), self.y + gone * math.sin(self.heading), self.heading, self.speed
        )


@dataclass(frozen=True, slots=True)
class PlayedObject:
    """An object of a log; its grid begins at ``begin`` [s] with steps of ``step`` [s]."""

    track: LoggedTrack
    begin: float
    step: float

    @property
    def id(self) -> str:
        return self.track.id

    @property
    def length(self) -> float:
        return self.track.length

    @property
    def width(self) -> float:
        return self.track.width

    def pose(self, time: float) -> Pose | None:
        """Where the log has it at a time of its grid; None where it is not valid."""
        k, t = round((time - self.begin) / self.step), self.track
        if not 0 <= k < len(t.valid) or not t.valid[k]:
            return None
        return Pose(float(t.x[k]), float(t.y[k]), float(t.heading[k]), float(t.speed[k]))


@dataclass(frozen=True, slots=True)
class PlaybackSpec:
    """What is played back. Paths exist and hold what they should.

    background: what drives recorded BVs from the hand-over on; None: not said yet (``with_background`` decides).
    routes: edges of recorded vehicles, by id; vehicles, obstacles: ids of vehicles and of other objects; begin, end
    [s]: of the log, 0 and inf without one.
    """

    tracks: Path | None = None
    background: Background | None = "sumo"
    signals: Path | None = None
    props: tuple[Prop, ...] = ()
    routes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    vehicles: frozenset[str] = frozenset()
    obstacles: frozenset[str] = frozenset()
    begin: float = 0.0
    end: float = math.inf

    @property
    def follows_log(self) -> bool:
        return self.background == "log"

    @property
    def files(self) -> tuple[Path, ...]:
        """All that a manifest must copy."""
        return tuple(file for file in (self.tracks, self.signals) if file is not None)


def make_playback(
    tracks: Path | None, background: Background | None, signals: Path | None, props: Sequence[Prop],
    route_files: Sequence[Path],
) -> PlaybackSpec | None:  # fmt: skip
    """The spec with what its files say; None without anything to play back. Raises UsageError: a file is missing,
    damaged or wrong, two things have one id, or there is no log where one is needed."""
    if background == "log" and tracks is None:
        raise UsageError("The background 'log' needs recorded tracks: give a scenario with 'tracks', or choose 'sumo'.")
    if tracks is None and signals is None and not props:
        return None
    if signals is not None:
        read_signals(signals)
    ids = frozenset(p.id for p in props)
    if tracks is None:
        return PlaybackSpec(None, background, signals, tuple(props), obstacles=ids)
    log = read_tracks(tracks)
    twice = sorted(ids & log.tracks.keys())
    if twice:
        raise UsageError(f"The tracks {tracks} use the id '{twice[0]}', which is an obstacle's: give it another.")
    vehicles = frozenset(n for n, t in log.tracks.items() if t.kind == "vehicle")
    routes = {n: edges for n, edges in scan_routes(route_files).items() if n in vehicles and edges}
    return PlaybackSpec(
        tracks, background, signals, tuple(props), routes, vehicles, ids | (log.tracks.keys() - vehicles),
        float(log.time[0]), log.end,
    )  # fmt: skip


def with_background(
    spec: PlaybackSpec | None, background: Background | None, *, replayed: bool = False
) -> PlaybackSpec | None:
    """The spec with another background, if one is given; else its own; else the log for an ego that is ``replayed``
    (it would drive into vehicles that go otherwise than recorded) and SUMO for any other.

    Raises UsageError: there are no tracks to take it from.
    """
    if background is None:
        if spec is None or spec.background is not None:
            return spec
        return replace(spec, background="log" if replayed and spec.tracks is not None else "sumo")
    if spec is None or spec.tracks is None:
        raise UsageError(f"--background {background} needs recorded tracks: give a scenario with 'tracks'.")
    return replace(spec, background=background)


def scenario_playback(scenario: Scenario) -> PlaybackSpec | None:
    """What a scenario plays back. Raises UsageError as :func:`make_playback` does."""
    kinds = {"parked": scenario.parked, "pedestrian": scenario.pedestrians, "cyclist": scenario.cyclists}
    props = [
        Prop(f"{kind}{k}", b.x, b.y, b.heading, b.speed, b.length, b.width, *(b.times or (0.0, math.inf)), kind)
        for kind, boxes in kinds.items() for k, b in enumerate(boxes)
    ]  # fmt: skip
    return make_playback(scenario.tracks, scenario.background, scenario.signals.log, props, scenario.demand.files)
