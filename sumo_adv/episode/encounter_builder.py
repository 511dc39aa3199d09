"""Describe the encounter that begins now, for ``run`` and for ``serve``.

The two differ in the baseline: ``run`` simulates it in a fork, and ``serve`` predicts it (``traffic_forecast``).

The encounter of a recording may be attacked from its beginning to shortly before its end, or to shortly before the log
itself becomes dangerous. Any vehicle that could begin an attack at that moment may attack.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.encounter_detector import RankedVehicle, vehicles_of
from sumo_adv.episode.road_place import place_of
from sumo_adv.episode.situation_builder import MAX_START_SHIFT_S, build_situations, recorded_situations, trigger_state
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.geometry import Frame
from sumo_adv.metrics.boxes import first_contact, on_grid, overlaps
from sumo_adv.metrics.case import closest
from sumo_adv.metrics.criticality import ttc
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.permissions import OFF_ROAD_CLASSES
from sumo_adv.simulation.sumo_states import Snapshot, heading_of
from sumo_adv.situation import fastest_of

# -- dangerous without an attack ------------------------------------------------------------------------------------

ENDANGERS = "could endanger the ego"  # the end of a reason if no vehicle near the ego could
MIN_EGO_STAY_S = 2.0  # s after the trigger for which the ego must stay in the network
ENCOUNTER_REACH_M = 30.0  # m between centres; only vehicles that come nearer to the ego are checked
MAX_NAMED_VEHICLES, NAMED_WITHIN_M = 4, 200.0  # maximum number of vehicles in a reason, and their distance [m]
AS_LOGGED_DISTANCE_M = 0.1  # m; maximum sum of the distances of ego and vehicle from their logged positions


class Danger(NamedTuple):
    """Whether an encounter is dangerous without an attack.

    Attributes:
        why: Why the encounter is passed over; empty if it is not.
        critical: The vehicles that are critical without an attack.
        since: The time from which a vehicle is critical or collides [s].
    """

    why: str
    critical: frozenset[str]
    since: float = math.inf


def danger(tracks: Mapping[str, Track], drive: Drive, time: float, limit: float, candidates: Collection[str]) -> Danger:
    """Check whether an encounter is dangerous without an attack.

    An encounter is passed over if the ego leaves, if it collides, or if a vehicle is critical. A recording has few
    encounters. There, a critical vehicle is only excluded as a candidate, and the encounter is passed over if no
    candidate is left.

    Boxes that overlap at their logged positions are an error of the log. They are no collision, and the vehicle is no
    candidate. For objects that are no vehicles, only a contact counts.

    Args:
        tracks: The baseline by id.
        drive: The simulation with the ego.
        time: The time of the encounter [s].
        limit: The minimum TTC up to which a vehicle is critical [s].
        candidates: The ranked vehicles.
    """
    ego = tracks[str(drive.ego)]
    if ego.time[-1] < time + MIN_EGO_STAY_S:
        return Danger("the ego leaves the network at once", frozenset())
    grid = ego.time[ego.time >= time - 1e-6]
    near = [
        t for n, t in tracks.items() if n != ego.id and len(t.time) > 1 and closest(ego, t, time) < ENCOUNTER_REACH_M
    ]
    overlapping = _overlapping(drive, tracks, ego, grid)
    others = [t for t in near if t.id not in overlapping]
    if overlapping and overlapping.issuperset(candidates):
        return Danger("in the log itself it overlaps the ego", overlapping)
    if not others:
        return Danger("", overlapping)
    me = on_grid([ego], grid)
    contact = float(np.nanmin(first_contact(me, on_grid(others, grid), grid), initial=math.inf))
    vehicles = [t for t in others if t.role is not Role.OBSTACLE]
    by_step = ttc(me, on_grid(vehicles, grid)) if vehicles else np.full((0, len(grid)), np.inf)
    least = np.nanmin(by_step, axis=-1, initial=math.inf)
    critical = overlapping | frozenset(t.id for t, value in zip(vehicles, least, strict=True) if value <= limit)
    close = np.flatnonzero((by_step <= limit).any(axis=0))
    since = min(contact, float(grid[close[0]]) if len(close) else math.inf)
    if math.isfinite(contact):
        return Danger("the ego collides unattacked", critical, since)
    if critical and (not drive.recorded() or critical.issuperset(candidates)):
        return Danger(f"critical unattacked: min TTC {float(least.min(initial=math.inf)):.2f} s", critical, since)
    return Danger("", critical)


def _overlapping(drive: Drive, tracks: Mapping[str, Track], ego: Track, grid: Floats) -> frozenset[str]:
    """Return vehicles that overlap the ego at the first step, or later while both are at their logged positions."""
    others = [t for t in tracks.values() if t.id != ego.id]
    logged = {} if drive.playback is None else {t.id: t for t in drive.playback.logged()}
    if not others or ego.id not in logged:
        return frozenset()
    me, them = on_grid([ego], grid), on_grid(others, grid)
    their = on_grid([logged.get(t.id, t) for t in others], grid)
    ego_logged = on_grid([logged[ego.id]], grid)
    ego_off = np.hypot(me.x - ego_logged.x, me.y - ego_logged.y)
    as_logged = ego_off + np.hypot(them.x - their.x, them.y - their.y) < AS_LOGGED_DISTANCE_M
    touching = np.asarray(overlaps(me, them))
    fault = touching & as_logged
    fault[:, 0] = touching[:, 0]
    return frozenset(t.id for t, row in zip(others, fault, strict=True) if row.any())


# -- out of reach ---------------------------------------------------------------------------------------------------

SET_OUT_INTERVAL_S = 0.5  # s between the moments at which a vehicle may leave its own motion


class Reach(NamedTuple):
    """How near a vehicle could come to the ego.

    Attributes:
        vehicle: The vehicle that comes nearest.
        short: The distance that it is short by [m]; 0 or less if it reaches the ego.
        time: When it comes nearest [s].
    """

    vehicle: str
    short: float
    time: float


def nearest_reach(tracks: Mapping[str, Track], ego: str, time: float, acceleration: float) -> Reach | None:
    """Find the vehicle that could come nearest to the ego's unattacked motion.

    A vehicle leaves its own motion at any moment, accelerates up to its highest speed and heads straight for the place
    where the ego will be. It touches the ego where their centres are half of both lengths apart. On any road it needs
    to drive farther than that.

    Args:
        tracks: The baseline by id.
        ego: The ego's id.
        time: The time from which vehicles may leave their own motion [s].
        acceleration: Their acceleration [m/s2].

    Returns:
        The vehicle; None if there is no other vehicle.
    """
    me = tracks[ego].between(time, math.inf)
    best: Reach | None = None
    for name, track in tracks.items():
        own = track.between(time, math.inf)
        if name == ego or track.role is Role.OBSTACLE or len(own.time) < 1:
            continue
        steps = np.unique(np.searchsorted(own.time, np.arange(own.time[0], own.time[-1] + 1e-6, SET_OUT_INTERVAL_S)))
        starts = steps[steps < len(own.time)]
        left = me.time[None, :] - own.time[starts][:, None]
        v = own.speed[starts][:, None]
        top = np.array([[fastest_of(float(each))] for each in v[:, 0]])
        rises = np.minimum(left, (top - v) / acceleration)
        reached = v * left + acceleration * rises * (left - rises / 2)
        away = np.hypot(me.x[None, :] - own.x[starts][:, None], me.y[None, :] - own.y[starts][:, None])
        short = np.where(left > 0.0, away - (me.length + own.length) / 2 - reached, math.inf)
        k = int(np.argmin(short))
        least = float(short.flat[k])
        if math.isfinite(least) and (best is None or least < best.short):
            best = Reach(name, least, float(me.time[k % len(me.time)]))
    return best


def why_nobody(tracks: Mapping[str, Track], ego: str, time: float, acceleration: float) -> str:
    """Return why no vehicle of a recording can attack, in words.

    Args:
        tracks: The baseline by id.
        ego: The ego's id.
        time: The time from which vehicles may attack [s].
        acceleration: The acceleration of a vehicle that heads for the ego [m/s2].
    """
    nearest = nearest_reach(tracks, ego, time, acceleration)
    if nearest is None:
        return "no other vehicle is there"
    if nearest.short <= 0.0:
        return "no vehicle near is on a way that meets the ego's path in time"
    return (
        f"no vehicle can reach the ego: '{nearest.vehicle}' comes nearest, and is {nearest.short:.1f} m short at "
        f"{nearest.time:.1f} s even if it accelerates at {acceleration:g} m/s2 all the time"
    )


# -- the encounter --------------------------------------------------------------------------------------------------

LOG_DANGER_MARGIN_S = 0.3  # attempts end this time [s] before a log itself becomes dangerous
MAX_RECORDED_ADVERSARIES = 12  # maximum number of vehicles of a recording that may attack
ROAD_MARGIN_M = 150.0  # m around the unattacked ego's path within which the drivable area is known


@dataclass(frozen=True, slots=True)
class UnattackedMotion:
    """The motion without an attack, simulated or predicted.

    Attributes:
        tracks: The motion by id, from the history before the trigger to the end.
        snapshots: The simulated states from the trigger on; empty if the motion is predicted.
        sizes: The length and width by id [m].
        looks: In a recording, the vehicles that could attack, by time after the trigger [s]; otherwise empty.
    """

    tracks: Mapping[str, Track]
    snapshots: Sequence[Snapshot]
    sizes: Mapping[str, tuple[float, float]]
    looks: Mapping[float, Sequence[RankedVehicle]] = field(default_factory=dict)


def build_encounter(
    drive: Drive, road: RoadMap, settings: Settings, ranking: Sequence[RankedVehicle],
    baseline_for: Callable[[float], UnattackedMotion], *, checked: float = math.inf, passed_over: Sequence[str] = (),
    delay: float | None = None,
) -> tuple[FoundEncounter, UnattackedMotion] | str:  # fmt: skip
    """Build the encounter that begins now.

    If the log of a recording becomes dangerous by itself later on, ``drive.until`` is set, so that attempts end before.

    Args:
        drive: The simulation with the ego, at the trigger.
        road: The map.
        settings: The run's settings.
        ranking: The vehicles that could attack, highest risk first.
        baseline_for: Takes a duration from now [s] and returns the baseline until then.
        checked: The time from now within which the baseline must not be dangerous itself [s].
        passed_over: Why earlier encounters were passed over.
        delay: The only delay after the trigger at which an attack may begin [s]; None allows those of ``delays``.

    Returns:
        The encounter and its baseline, or why the encounter is passed over.
    """
    nobody = f"no {vehicles_of(settings.kind)} near {ENDANGERS}"
    nobody += " within the ODD" if settings.odd is not None else ""
    if drive.ego is None or not (ranking or drive.recorded()):
        return nobody
    place, late = place_of(road, drive), MAX_START_SHIFT_S if all(c.meets_ahead for c in ranking) else 0.0
    baseline = baseline_for(settings.duration + max(max(settings.delays) + late, delay or 0.0))
    looks = dict(baseline.looks)
    if looks:
        ranking = _most_dangerous(looks)
    if not ranking and drive.recorded():
        return why_nobody(baseline.tracks, drive.ego, drive.now, settings.limits.limits().acceleration)
    names, limit = [c.id for c in ranking], settings.harmless_ttc
    tracks = {name: t.between(-math.inf, drive.now + checked) for name, t in baseline.tracks.items()}
    found = danger(tracks, drive, drive.now, limit, names)
    if drive.recorded() and found.why and found.since - LOG_DANGER_MARGIN_S >= drive.now + MIN_EGO_STAY_S:
        drive.until = found.since - LOG_DANGER_MARGIN_S
        tracks = {name: t.between(-math.inf, drive.until) for name, t in tracks.items()}
        snapshots = [s for s in baseline.snapshots if s.time <= drive.until + 1e-6]
        baseline = replace(baseline, tracks=tracks, snapshots=snapshots)
        found = danger(tracks, drive, drive.now, limit, names)
    if found.why:
        return found.why
    ranking = [c for c in ranking if c.id not in found.critical]
    trigger = trigger_state(road, drive, ranking)
    if looks:
        those = {c.id for c in ranking}
        looks = {d: [c for c in seen if c.id in those] for d, seen in looks.items()}
        situations = recorded_situations(road, baseline.tracks, trigger, looks, settings, delay)
    else:
        situations = build_situations(road, baseline.tracks, trigger, ranking, settings, delay)
    if not situations:
        return "the vehicles near it leave at once"
    order = tuple((c.id, c.relation, round(c.risk, 4)) for c in ranking)
    area = _area_around(baseline.tracks[trigger.ego].between(trigger.time, math.inf))
    encounter = FoundEncounter(
        trigger.ego, trigger.time, order, situations, baseline.snapshots, tuple(passed_over), road.drivable(*area),
        baseline.sizes, area, place=place,
    )  # fmt: skip
    return encounter, baseline


def nearest_ones(drive: Drive) -> str:
    """Describe where the nearest vehicles are, from the ego's front to theirs.

    The text follows the reason why no vehicle attacks. It names at most ``MAX_NAMED_VEHICLES`` within
    ``NAMED_WITHIN_M``.

    Args:
        drive: The simulation with the ego.

    Returns:
        The text; empty without an ego or near vehicles.
    """
    if drive.ego is None or drive.ego not in drive.snapshot.raw:
        return ""
    places = []
    for name in drive.snapshot.raw:
        distance, place = place_in_words(drive.snapshot, drive.ego, name)
        if name != drive.ego and distance < NAMED_WITHIN_M:
            place += f" (a {kind}, which cannot attack)" if (kind := drive.kind(name)) in OFF_ROAD_CLASSES else ""
            places.append((distance, place))
    return f": {'; '.join(place for _, place in sorted(places)[:MAX_NAMED_VEHICLES])}" if places else ""


def place_in_words(snapshot: Snapshot, ego: str, name: str) -> tuple[float, str]:
    """Say where a vehicle is, from the ego's front to its front, and how fast it is.

    Args:
        snapshot: The states of all vehicles.
        ego: The ego's id.
        name: The vehicle's id.

    Returns:
        The distance between the two fronts [m], and the place in words.
    """
    x, y, angle = snapshot.raw[ego][:3]
    other_x, other_y, other_angle, speed = snapshot.raw[name][:4]
    ahead, left, _ = Frame(x, y, heading_of(angle)).to_local(other_x, other_y, heading_of(other_angle))
    side = "" if abs(left) < 1.0 else f" and {abs(left):.0f} m to the {'left' if left > 0 else 'right'}"
    place = f"{name} {abs(ahead):.0f} m {'ahead' if ahead >= 0 else 'behind'}{side}, at {speed:.0f} m/s"
    return math.hypot(ahead, left), place


def _most_dangerous(looks: Mapping[float, Sequence[RankedVehicle]]) -> list[RankedVehicle]:
    """Return each vehicle at its most dangerous moment, highest risk first, at most ``MAX_RECORDED_ADVERSARIES``."""
    best: dict[str, RankedVehicle] = {}
    for ranked in (c for delay in sorted(looks) for c in looks[delay]):
        if ranked.id not in best or ranked.risk > best[ranked.id].risk:
            best[ranked.id] = ranked
    return sorted(best.values(), key=lambda c: (-c.risk, c.id))[:MAX_RECORDED_ADVERSARIES]


def _area_around(ego: Track) -> tuple[float, float, float]:
    """Return a circle (x, y, radius) around the unattacked ego's path, with a margin [m]."""
    x, y = float(ego.x.min() + ego.x.max()) / 2, float(ego.y.min() + ego.y.max()) / 2
    return x, y, float(np.hypot(ego.x - x, ego.y - y).max()) + ROAD_MARGIN_M
