"""What happens in the OpenSCENARIO file: the positions at its start, and the timed trajectories from then on.

Time 0 of the file is the piece's begin.  A vehicle that comes later is added by an action; it is deleted when it
leaves.
"""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.report.export.entities import metres, reference_points
from sumo_adv.report.export.piece import Piece

SLACK = 0.5  # s: how much before its time a free ego's nearness may start the attack
Names = dict[str, str]


def add_replay(parent: Element, piece: Piece, names: Names) -> None:
    """All vehicles as recorded."""
    act = _add_story(parent, piece, names)
    for track in piece.tracks:
        _add_recorded(act, piece, track, names)
    _finish(parent, act, piece)


def add_free_ego(parent: Element, piece: Piece, names: Names) -> None:
    """The ego starts as recorded and is then the player's; adversaries attack when triggered; others as recorded.

    An adversary follows its recording to the takeover.  From the takeover's time on it attacks, or up to ``SLACK``
    earlier if the ego is as near to the collider by then as it was at the recorded takeover: all begin together.
    """
    act = _add_story(parent, piece, names)
    for track in piece.tracks:
        if track.role is Role.ADVERSARY:
            _add_attacker(act, piece, track, names)
        elif track.id != piece.ego:
            _add_recorded(act, piece, track, names)
    _finish(parent, act, piece)


def _add_story(parent: Element, piece: Piece, names: Names) -> Element:
    """Storyboard, Init and an Act to fill."""
    storyboard = SubElement(parent, "Storyboard")
    actions = SubElement(SubElement(storyboard, "Init"), "Actions")
    for track in piece.tracks:
        if _is_late(track, piece):
            continue
        private = SubElement(actions, "Private", entityRef=names[track.id])
        _add_position(SubElement(SubElement(private, "PrivateAction"), "TeleportAction"), track, 0)
        speed = SubElement(
            SubElement(SubElement(private, "PrivateAction"), "LongitudinalAction"), "SpeedAction"
        )  # fmt: skip
        SubElement(speed, "SpeedActionDynamics", dynamicsShape="step", dynamicsDimension="time", value="0.0")
        target = SubElement(speed, "SpeedActionTarget")
        SubElement(target, "AbsoluteTargetSpeed", value=metres(float(track.speed[0])))
    return SubElement(SubElement(storyboard, "Story", name="recording"), "Act", name="act")


def _finish(parent: Element, act: Element, piece: Piece) -> None:
    _add_time_trigger(act, "StartTrigger", 0.0, "start")
    storyboard = parent.find("Storyboard")
    assert storyboard is not None
    _add_time_trigger(storyboard, "StopTrigger", piece.end - piece.begin, "end")


def _add_recorded(act: Element, piece: Piece, track: Track, names: Names) -> None:
    """Come, follow the recording, go."""
    name = names[track.id]
    begin, end = float(track.time[0]) - piece.begin, float(track.time[-1]) - piece.begin
    maneuver = _add_maneuver(act, name)
    if _is_late(track, piece):
        event = _add_event(maneuver, f"{name} comes")
        entity = SubElement(_add_action(event, f"{name} is added", "GlobalAction"), "EntityAction", entityRef=name)
        _add_position(SubElement(entity, "AddEntityAction"), track, 0)
        _add_time_trigger(event, "StartTrigger", begin, f"{name} comes")
    if len(track.time) > 1:
        event = _add_event(maneuver, f"{name} drives")
        _add_following(event, f"{name} follows", track, track.time - piece.begin, absolute=True)
        _add_time_trigger(event, "StartTrigger", begin, f"{name} drives")
    if track.time[-1] < piece.end - piece.step / 2:
        event = _add_event(maneuver, f"{name} goes")
        entity = SubElement(_add_action(event, f"{name} is deleted", "GlobalAction"), "EntityAction", entityRef=name)
        SubElement(entity, "DeleteEntityAction")
        _add_time_trigger(event, "StartTrigger", end + piece.step, f"{name} goes")


def _add_attacker(act: Element, piece: Piece, track: Track, names: Names) -> None:
    """The recording up to the takeover, then the attack on a clock of its own."""
    assert piece.takeover is not None and piece.adversary is not None
    name, collider = names[track.id], piece.track(piece.adversary)
    maneuver = _add_maneuver(act, name)
    lead, attack = track.between(track.time[0], piece.takeover), track.between(piece.takeover, piece.end)
    if len(lead.time) > 1:
        event = _add_event(maneuver, f"{name} approaches")
        _add_following(event, f"{name} follows its recording", lead, lead.time - piece.begin, absolute=True)
        _add_time_trigger(event, "StartTrigger", 0.0, f"{name} approaches")
    event = _add_event(maneuver, f"{name} attacks")
    _add_following(event, f"{name} follows its attack", attack, attack.time - attack.time[0], absolute=False)
    trigger = SubElement(event, "StartTrigger")
    takeover = piece.takeover - piece.begin
    _add_time(SubElement(trigger, "ConditionGroup"), takeover, "time of the takeover")
    group = SubElement(trigger, "ConditionGroup")
    _add_time(group, max(0.0, takeover - SLACK), "shortly before the takeover")
    _add_nearness(group, names[collider.id], names[piece.ego], _distance(piece, collider))


def _distance(piece: Piece, track: Track) -> float:
    """m between the reference points of adversary and ego at the takeover."""
    assert piece.takeover is not None
    (x, y), (ego_x, ego_y) = (_reference_point(each, piece.takeover) for each in (track, piece.track(piece.ego)))
    return math.hypot(x - ego_x, y - ego_y)


def _reference_point(track: Track, time: float) -> tuple[float, float]:
    x, y, _ = reference_points(track)
    return float(np.interp(time, track.time, x)), float(np.interp(time, track.time, y))


def _is_late(track: Track, piece: Piece) -> bool:
    return bool(track.time[0] > piece.begin + piece.step / 2)


def _add_maneuver(act: Element, name: str) -> Element:
    group = SubElement(act, "ManeuverGroup", name=f"group of {name}", maximumExecutionCount="1")
    actors = SubElement(group, "Actors", selectTriggeringEntities="false")
    SubElement(actors, "EntityRef", entityRef=name)
    return SubElement(group, "Maneuver", name=f"maneuver of {name}")


def _add_event(maneuver: Element, name: str) -> Element:
    return SubElement(maneuver, "Event", name=name, priority="override", maximumExecutionCount="1")


def _add_action(event: Element, name: str, sort: str) -> Element:
    return SubElement(SubElement(event, "Action", name=name), sort)


def _add_following(event: Element, name: str, track: Track, time: Floats, *, absolute: bool) -> None:
    """FollowTrajectoryAction with a vertex a state; ``time`` [s] on the file's clock, or from the action's start on."""
    action = SubElement(
        SubElement(_add_action(event, name, "PrivateAction"), "RoutingAction"), "FollowTrajectoryAction"
    )
    reference = SubElement(action, "TimeReference")
    domain = "absolute" if absolute else "relative"
    SubElement(reference, "Timing", domainAbsoluteRelative=domain, offset="0.0", scale="1.0")
    SubElement(action, "TrajectoryFollowingMode", followingMode="position" if absolute else "follow")
    trajectory = SubElement(
        SubElement(action, "TrajectoryRef"), "Trajectory", name=f"{name}: trajectory", closed="false"
    )
    line = SubElement(SubElement(trajectory, "Shape"), "Polyline")
    for k, t in enumerate(time.tolist()):
        _add_position(SubElement(line, "Vertex", time=_seconds(t)), track, k)


def _add_position(parent: Element, track: Track, k: int) -> None:
    x, y, heading = reference_points(track)
    SubElement(
        SubElement(parent, "Position"), "WorldPosition",
        x=metres(float(x[k])), y=metres(float(y[k])), h=f"{heading[k] + 0.0:.6f}",
    )  # fmt: skip


def _add_time_trigger(parent: Element, tag: str, time: float, name: str) -> None:
    _add_time(SubElement(SubElement(parent, tag), "ConditionGroup"), time, name)


def _add_time(group: Element, time: float, name: str) -> None:
    condition = SubElement(group, "Condition", name=name, delay="0.0", conditionEdge="none")
    SubElement(
        SubElement(condition, "ByValueCondition"),
        "SimulationTimeCondition",
        value=_seconds(time),
        rule="greaterOrEqual",
    )


def _add_nearness(group: Element, name: str, ego: str, distance: float) -> None:
    condition = SubElement(group, "Condition", name=f"{name} is near", delay="0.0", conditionEdge="none")
    by_entity = SubElement(condition, "ByEntityCondition")
    triggering = SubElement(by_entity, "TriggeringEntities", triggeringEntitiesRule="any")
    SubElement(triggering, "EntityRef", entityRef=name)
    SubElement(
        SubElement(by_entity, "EntityCondition"), "RelativeDistanceCondition", entityRef=ego, freespace="false",
        relativeDistanceType="euclidianDistance", coordinateSystem="entity", rule="lessOrEqual", value=metres(distance),
    )  # fmt: skip


def _seconds(value: float) -> str:
    """Milliseconds."""
    return f"{value + 0.0:.3f}"
