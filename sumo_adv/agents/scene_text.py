"""A situation in words and rounded numbers for prompts, in the ego's frame, with units and road topology.

Vehicles have aliases (EGO, BV1.., V1..), so that a prompt never holds a vehicle's name from a file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Track
from sumo_adv.llm.prompts import sanitize
from sumo_adv.metrics.severity import TENTH_RISK_SPEED_KMH
from sumo_adv.road_users import UNPROTECTED_LIMITS, RoadUser, is_unprotected, road_user
from sumo_adv.simulation.sumo_rules import MINOR_TIME_GAP_S, VISIBILITY_DISTANCE_M
from sumo_adv.situation import ReferencePath, Signal, Situation, Target

MAX_OTHER_VEHICLES = 8  # maximum number of vehicles other than the ego and the possible adversaries, nearest first
HISTORY_TIMES_S = (-1.1, -0.7, -0.3, 0.0)  # for the ego and the possible adversaries
OTHERS_HISTORY_TIMES_S = (-1.1, 0.0)  # for the other vehicles
EARLIEST_ARRIVAL_ACCELERATION_M_S2 = 4.0  # for "at the earliest"
SIGNAL_COLOURS = {"g": "green", "G": "green", "y": "yellow", "Y": "yellow", "r": "red", "R": "red", "u": "red-yellow"}
SIGNAL_COLOURS |= {"o": "blinking", "O": "off", "s": "stop sign"}
DRIVER_DESCRIPTIONS = {
    "krauss": "SUMO's Krauss car-following driver",
    "idm": "an IDM car-following driver",
    "eidm": "an extended IDM car-following driver",
    "careful": "a careful and competent driver (brakes only, reacts within about 1.2 s, up to 7.6 m/s2)",
    "replay": "a recorded motion, played back: EGO does not react to anything",
    "blind": "a driver that keeps its speed and never reacts",
    "lattice": "a planner that looks around, brakes and steers",
}
SUMO_DRIVERS = ("krauss", "idm", "eidm", "careful")  # lane keeping and right of way follow SUMO's rules


@dataclass(frozen=True, slots=True)
class Aliases:
    """Aliases of the vehicles of a situation.

    Attributes:
        bvs: Maps alias to id of the possible adversaries, most dangerous first.
        by_id: Maps id to alias of all vehicles in the prompt.
    """

    bvs: Mapping[str, str]
    by_id: Mapping[str, str]

    @staticmethod
    def of(situation: Situation) -> Aliases:
        """Give aliases: BV1.. for the possible adversaries, V1.. for the nearest other vehicles.

        Args:
            situation: The situation.
        """
        bvs = {f"BV{k + 1}": t.state.id for k, t in enumerate(situation.target_list())}
        by_id = {situation.ego.id: "EGO"} | {i: a for a, i in bvs.items()}
        rest = [t for t in situation.traffic.history if t.id not in by_id]
        rest.sort(key=lambda t: math.hypot(t.x[-1] - situation.ego.x, t.y[-1] - situation.ego.y))
        by_id |= {t.id: f"V{k + 1}" for k, t in enumerate(rest[:MAX_OTHER_VEHICLES])}
        return Aliases(bvs, by_id)


def road_words(situation: Situation, aliases: Aliases) -> str:
    """Describe the lanes beside the ego, the ego's path, and the paths and conflict points of each BV.

    Args:
        situation: The situation.
        aliases: The aliases of its vehicles.
    """
    lines = [f"EGO's lane is {situation.road.lane_width:.1f} m wide; its centre is at about y = 0 where EGO is."]
    for offset, kind in sorted(situation.road.sides, key=lambda side: abs(side[0])):
        side = "left" if offset > 0 else "right"
        direction = "same direction" if kind == "same" else "OPPOSITE direction"
        lines.append(f"To its {side} there is a lane, {direction}, centre {abs(offset):.1f} m to the {side}.")
    if not situation.road.sides:
        lines.append("There is no other lane beside it (or EGO is inside a junction).")
    lines += _signal_lines("EGO", situation.traffic.signals.get(situation.ego.id, ()))
    lines.append(f"EGO's path: {_bends(situation)}.")
    for alias, name in aliases.bvs.items():
        lines += _paths(alias, situation.targets[name], situation)
        lines += _signal_lines(alias, situation.traffic.signals.get(name, ()))
    return "\n".join(lines)


def state_words(situation: Situation, aliases: Aliases) -> str:
    """Describe the rounded history of every vehicle that has an alias.

    Args:
        situation: The situation.
        aliases: The aliases of its vehicles.
    """
    tracks = {t.id: t for t in situation.traffic.history}
    lines = []
    for name, alias in aliases.by_id.items():
        if name not in tracks:
            continue
        times = OTHERS_HISTORY_TIMES_S if alias.startswith("V") else HISTORY_TIMES_S
        lines.append(f"{alias}: {_history(tracks[name], situation, times)}")
    return "\n".join(lines)


def relative_words(situation: Situation, aliases: Aliases, library: Mapping[str, Sequence[str]]) -> str:
    """Describe the position of each BV relative to the ego, and the behaviours that apply.

    Args:
        situation: The situation.
        aliases: The aliases of its vehicles.
        library: The relations that each intent applies to, by label; empty leaves the behaviours out.
    """
    lines = []
    for alias, name in aliases.bvs.items():
        target = situation.targets[name]
        relations = set(target.applies())
        fitting = [sanitize(label) for label, applies in library.items() if relations & set(applies)]
        apply = f" Behaviours that apply: {', '.join(fitting) or 'none of the library'}." if library else ""
        lines.append(f"{alias}: {_relation(target, situation)}{apply}")
    return "\n".join(lines)


def scene_words(situation: Situation, aliases: Aliases, alias: str) -> str:
    """Describe the whole scene for an author of a planner.

    Args:
        situation: The situation.
        aliases: The aliases of its vehicles.
        alias: The alias of the BV that the planner is for.
    """
    return "\n".join(
        (
            f"The bv is {alias}. t in s, x forward and y left of EGO now, hdg in deg, a: acceleration.",
            road_words(situation, aliases), state_words(situation, aliases),
            outlook_words(situation), relative_words(situation, aliases, {}),
        )
    )  # fmt: skip


OUTLOOK_TIMES_S = (2.0, 4.0, 6.0, 8.0)  # from now


def outlook_words(situation: Situation) -> str:
    """Describe where the ego is predicted to be without an attack, and where a recording ends.

    Args:
        situation: The situation.
    """
    path, b = situation.baseline.path, situation.baseline
    parts = []
    for t in OUTLOOK_TIMES_S:
        k = round(t / situation.dt)
        if k >= len(b.s) or k > situation.left:
            break
        x, y, h = (float(v[0]) for v in path.at(b.s[k : k + 1]))
        x, y, h = situation.frame.to_local(x, y, h)
        parts.append(f"t={t:g}: x={x:.1f} y={y + 0.0:.1f} hdg={math.degrees(h):.0f} v={b.v[k]:.1f}")
    end = (
        f"; the recording ends {situation.left * situation.dt:.1f} s from now" if math.isfinite(situation.left) else ""
    )
    return f"EGO without an attack: {'; '.join(parts) or 'not known'}{end}."


def driver_words(situation: Situation) -> str:
    """Describe the driver model of the ego.

    Args:
        situation: The situation.
    """
    model, ego = situation.baseline.model, situation.ego
    kind = DRIVER_DESCRIPTIONS.get(model.kind, "an unknown driver")
    if not model.known:
        kind = f"an unknown driver; predictions take it for {kind} and for others like it"
    size = f"EGO is {ego.length:.1f} m long and {ego.width:.1f} m wide."
    if model.kind in ("replay", "blind"):
        return f"{kind[0].upper()}{kind[1:]}. {size}"
    tendency = "; now braking" if ego.acceleration < -0.3 else ("; now speeding up" if ego.acceleration > 0.3 else "")
    return (
        f"{kind[0].upper()}{kind[1:]}; keeps its lane and route, follows right of way and signals; wants to drive"
        f" {model.speed:.1f} m/s at most, headway {model.tau:.1f} s, comfortable braking"
        f" {model.deceleration:.1f} m/s2{tendency}. {_perception(model.kind)}{_at_junctions(situation)}{size}"
    )


def _perception(kind: str) -> str:
    """Describe what SUMO's drivers react to, which planners have to know."""
    if kind not in SUMO_DRIVERS:
        return ""
    return (
        "It takes a vehicle ahead for its leader as soon as the box of that vehicle comes into its lane, and brakes as"
        " hard as it needs to, up to 9 m/s2. It does not react to a vehicle beside it that has its front behind EGO's,"
        " nor to a vehicle that is still in another lane. "
    )


def _at_junctions(situation: Situation) -> str:
    """Describe what SUMO's drivers react to at junctions, if there is one ahead of the ego or paths meet."""
    meets = any(way.conflict is not None for target in situation.target_list() for way in target.ways)
    if situation.baseline.model.kind not in SUMO_DRIVERS or not (meets or math.isfinite(situation.road.junction)):
        return ""
    return (
        f"At a junction where it must give way it decides {VISIBILITY_DISTANCE_M:g} m before its line:"
        f" it stops for a vehicle that goes first and arrives less than {MINOR_TIME_GAP_S:g} s"
        " after EGO would be across. With priority too it brakes for one across its path as soon as, and not before,"
        " the front of that one is on the junction, unless EGO was on it first. "
    )


def _signal_lines(alias: str, signals: Sequence[Signal]) -> list[str]:
    """Describe the next traffic light of a vehicle."""
    if not signals:
        return []
    _, distance, state = signals[0]
    return [f"{alias} has a signal {distance:.0f} m ahead, now {SIGNAL_COLOURS.get(state, 'unknown')}."]


def _bends(situation: Situation) -> str:
    """Describe how the ego's path bends."""
    path, ahead = situation.baseline.path, (30, 60, 100)
    start = path.project(situation.ego.x, situation.ego.y, near=0.0, reach=25.0)[0]
    first, *later = path.at(start + np.array([0, *ahead]))[2].tolist()
    turned = [math.degrees(math.remainder(heading - first, math.tau)) for heading in later]
    if max(map(abs, turned)) < 8:
        return "straight on for 100 m"
    return ", ".join(f"{t:+.0f} deg after {m} m" for t, m in zip(turned, ahead, strict=True))


MOVEMENT_WORDS = {
    "left": "turning left", "right": "turning right", "across": "going across", "back": "going across and back",
}  # fmt: skip


def _paths(alias: str, target: Target, situation: Situation) -> list[str]:
    """Describe the paths of a BV that meet the ego's path."""
    lines = []
    for path in target.ways:
        if path.conflict is not None:
            movement = MOVEMENT_WORDS.get(path.movement, "going straight on")
            lines.append(f"{alias} {movement}: {_conflict(path, target, situation)}")
    if not lines and any(math.isfinite(path.junction) for path in target.ways):
        lines.append(f"{alias}: none of its ways through the junction ahead of it meets EGO's path.")
    return lines


def _conflict(path: ReferencePath, target: Target, situation: Situation) -> str:
    """Describe where and when a BV's path meets the ego's path, and who has priority."""
    c = path.conflict
    assert c is not None
    x, y, _ = situation.frame.to_local(c.x, c.y, c.heading)
    distance, speed = max(c.bv_s - target.station, 0.0), target.state.speed
    most = EARLIEST_ARRIVAL_ACCELERATION_M_S2
    soonest = (math.sqrt(speed**2 + 2 * most * distance) - speed) / most
    present = f"{distance / speed:.1f} s at its present speed, " if speed > 0.5 else "it stands, "
    arrival = np.flatnonzero(situation.baseline.s >= c.ego_s)
    ego = f"{arrival[0] * situation.dt:.1f} s" if len(arrival) else "not within the time looked at"
    meets = "crosses" if c.kind == "crossing" else "merges into"
    signals = situation.traffic.signals.get(target.state.id, ())
    rule = "it must give way there" if path.gives_way else "it has priority there"
    if path.movement in ("across", "back"):
        rule = "EGO does not expect it there"
    elif signals:
        rule = f"its signal is {SIGNAL_COLOURS.get(signals[0][2], 'unknown')}"
    return (
        f"{meets} EGO's path at ({x:.1f}, {y:.1f}) m at {abs(math.degrees(c.angle)):.0f} deg;"
        f" way to it: {distance:.1f} m ({present}{soonest:.1f} s at the earliest),"
        f" EGO {c.ego_s:.1f} m ({ego} if nothing disturbs it); {rule}."
    )


def _history(track: Track, situation: Situation, times: Sequence[float]) -> str:
    """Describe a track at these times."""
    parts = []
    for t in times:
        i = int(np.argmin(np.abs(track.time - (situation.time + t))))
        if abs(track.time[i] - situation.time - t) > 0.06:
            continue
        x, y, h = situation.frame.to_local(float(track.x[i]), float(track.y[i]), float(track.heading[i]))
        parts.append(f"t={t:.1f}: x={x:.1f} y={y + 0.0:.1f} hdg={math.degrees(h):.0f} v={track.speed[i]:.1f}")
    return "; ".join(parts) + f"; a={track.acceleration[-1]:.1f}; {track.length:.1f} x {track.width:.1f} m"


def _kind_words(target: Target) -> str:
    """Describe what a pedestrian or cyclist can do, and when a collision with it counts as serious."""
    user = road_user(target.state)
    limits, serious = UNPROTECTED_LIMITS[user], TENTH_RISK_SPEED_KMH[user] / 3.6
    turns = "on the spot" if user is RoadUser.PEDESTRIAN else f"with a radius of {1 / limits.curvature:.0f} m"
    return (
        f"It is a {user}: at most {target.fastest:.0f} m/s, braking {limits.braking:g}, acceleration"
        f" {limits.acceleration:g}, lateral {limits.lateral:g} m/s2 (these count, not those of a vehicle). It turns"
        f" {turns} and may be beside the road. A collision is serious where it is hit at {serious:.1f} m/s or more."
        " A careful driver of EGO notices it once it is in sight and moves towards EGO's path. Its ways have the"
        ' movements "along" (straight on, or its lane), "across" (over EGO\'s path) and "back" (over it, a half turn'
        ' between the two distances of "turn", and over it again, where its conflict is).'
    )


def _relation(target: Target, situation: Situation) -> str:
    """Describe the position of a BV relative to the ego."""
    ego, bv = situation.ego, target.state
    x, y, h = situation.frame.to_local(bv.x, bv.y, bv.heading)
    gap = abs(x) - (ego.length + bv.length) / 2
    closing = ego.speed - bv.speed * math.cos(h)
    closing = closing if x > 0 else -closing
    pace = f"{'closing' if closing >= 0 else 'opening'} at {abs(closing):.1f} m/s"
    side = "to the left" if y > 0 else "to the right"
    along = f"{gap:.1f} m {'ahead' if x > 0 else 'behind'} bumper to bumper" if gap > 0 else "overlapping in length"
    lateral = f"centres {abs(y):.1f} m apart sideways"
    hidden = ", hidden from EGO now" if target.hidden else ""
    if is_unprotected(bv):
        place = f"{abs(x):.1f} m {'ahead' if x > 0 else 'behind'}, {abs(y):.1f} m {side}"
        oncoming = ", coming towards EGO" if target.relation == "oncoming" else ""
        return f"{place}{oncoming}{hidden}. {_kind_words(target)}"
    match target.relation:
        case "leader" | "follower":
            return f"in EGO's lane, {along}, {pace}."
        case "neighbour":
            return f"in a lane {side}, same direction, {along}, {lateral}, {pace}."
        case "oncoming":
            return f"oncoming {side}, {along}, {lateral}, {pace}."
        case relation:
            away = f"{math.hypot(x, y):.1f} m away in a straight line"
            return f"{relation}, {away}, from {side.removeprefix('to ')}{hidden}."
