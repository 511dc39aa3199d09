"""What a run plays back beside SUMO's traffic, as a scenario names it and as a manifest stores it."""

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
    """A box that a scenario places.

    Attributes:
        id: The id of the box.
        x: x of its centre at ``start`` [m].
        y: y of its centre at ``start`` [m].
        heading: Its heading [rad].
        speed: Its speed [m/s].
        length: Its length [m].
        width: Its width [m].
        start: When it appears [s].
        end: When it disappears [s].
        kind: pedestrian, cyclist, parked or other.
    """

    id: str
    x: float
    y: float
    heading: float
    speed: float
    length: float
    width: float
    start: float = 0.0
    end: float = math.inf
    kind: str = "other"

    def pose(self, time: float) -> Pose | None:
        """Return the pose at a time [s]; None before the box appears and after it disappears."""
        if not self.start - 1e-6 <= time <= self.end + 1e-6:
            return None
        gone = self.speed * (time - self.start)
        return Pose(
            self.x + gone * math.cos(self.heading), self.y + gone * math.sin(self.heading), self.heading, self.speed
        )


@dataclass(frozen=True, slots=True)
class PlayedObject:
    """An object of a log.

    Attributes:
        track: Its track.
        begin: The time at which the track's grid begins [s].
        step: The step of the grid [s].
    """

    track: LoggedTrack
    begin: float
    step: float

    @property
    def id(self) -> str:
        """The id of the object."""
        return self.track.id

    @property
    def length(self) -> float:
        """The length of the object [m]."""
        return self.track.length

    @property
    def width(self) -> float:
        """The width of the object [m]."""
        return self.track.width

    def pose(self, time: float) -> Pose | None:
        """Return the logged pose at a time of the grid [s]; None if the log has no valid state then."""
        k, t = round((time - self.begin) / self.step), self.track
        if not 0 <= k < len(t.valid) or not t.valid[k]:
            return None
        return Pose(float(t.x[k]), float(t.y[k]), float(t.heading[k]), float(t.speed[k]))


@dataclass(frozen=True, slots=True)
class PlaybackSpec:
    """What is played back. The files exist and have been checked.

    Attributes:
        tracks: The file of recorded tracks.
        background: What drives recorded BVs from the hand-over on; None if not decided yet (see ``with_background``).
        signals: The file of recorded traffic lights.
        props: The boxes that the scenario places.
        routes: The edges of recorded vehicles by id.
        vehicles: The ids of recorded vehicles.
        obstacles: The ids of other objects.
        begin: When the log begins [s]; 0 without one.
        end: When the log ends [s]; inf without one.
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
        """Whether the log drives the background vehicles."""
        return self.background == "log"

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that a manifest must copy."""
        return tuple(file for file in (self.tracks, self.signals) if file is not None)


def make_playback(
    tracks: Path | None, background: Background | None, signals: Path | None, props: Sequence[Prop],
    route_files: Sequence[Path],
) -> PlaybackSpec | None:  # fmt: skip
    """Return the spec, with the contents of its files.

    Args:
        tracks: The file of recorded tracks.
        background: What drives recorded BVs from the hand-over on; None leaves it open.
        signals: The file of recorded traffic lights.
        props: The boxes that the scenario places.
        route_files: Route files with the routes of recorded vehicles.

    Returns:
        The spec; None if there is nothing to play back.

    Raises:
        UsageError: A file is missing, damaged or wrong; two objects have one id; or the background is "log" without
            tracks.
    """
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
    """Return the spec with its background decided.

    A given background overrides the spec's own. If neither is set, a ``replayed`` ego gets the log, because it would
    collide with vehicles that deviate from the recording. Any other ego gets SUMO.

    Args:
        spec: The spec; None if nothing is played back.
        background: The background that was asked for.
        replayed: Whether the log moves the ego.

    Returns:
        The spec.

    Raises:
        UsageError: A background was asked for, and there are no tracks.
    """
    if background is None:
        if spec is None or spec.background is not None:
            return spec
        return replace(spec, background="log" if replayed and spec.tracks is not None else "sumo")
    if spec is None or spec.tracks is None:
        raise UsageError(f"--background {background} needs recorded tracks: give a scenario with 'tracks'.")
    return replace(spec, background=background)


def scenario_playback(scenario: Scenario) -> PlaybackSpec | None:
    """Return what a scenario plays back.

    Raises:
        UsageError: As for :func:`make_playback`.
    """
    kinds = {"parked": scenario.parked, "pedestrian": scenario.pedestrians, "cyclist": scenario.cyclists}
    props = [
        Prop(f"{kind}{k}", b.x, b.y, b.heading, b.speed, b.length, b.width, *(b.times or (0.0, math.inf)), kind)
        for kind, boxes in kinds.items() for k, b in enumerate(boxes)
    ]  # fmt: skip
    return make_playback(scenario.tracks, scenario.background, scenario.signals.log, props, scenario.demand.files)
