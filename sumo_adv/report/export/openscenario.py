"""Export a run as ASAM OpenSCENARIO 1.2 with its road as OpenDRIVE: a folder of two files.

World x, y and h are the network's coordinates in SUMO. Time 0 is the beginning of the exported part. The reference
point of an OpenSCENARIO vehicle is the middle of its rear axle, on the ground. SUMO's vehicle types have no axles, so
all vehicles use one convention: the wheelbase is 0.6 of the length and both overhangs are equal, hence the box's centre
is 0.3 of the length ahead of the rear axle. The reference point of other objects is their box's centre. A vehicle that
appears later is added by an action. A vehicle that leaves is deleted.
"""

from __future__ import annotations

import gzip
import math
import re
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from sumo_adv import __version__
from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.report.export import Variant
from sumo_adv.report.export.piece import (
    DEFAULT_STEERING_RAD,
    HEIGHT_M,
    WHEELBASE_SHARE,
    ExportedRun,
    height_of,
    kind,
    metres,
    printable,
    stretches,
)
from sumo_adv.report.page_road import network
from sumo_adv.simulation.network import is_left_hand

OPENSCENARIO_FILE, OPENDRIVE_FILE = "scenario.xosc", "road.xodr"
OPENSCENARIO_VERSION = "1.2.0"  # version of the schema
CENTRE_SHARE = 0.3  # share of the length from the rear axle to the box's centre
TRACK_WIDTH_SHARE = 0.85  # share of the width
WHEEL_DIAMETER_M = 0.65
MASS_KG = {"car": 1500, "truck": 12000, "bicycle": 90, "pedestrian": 75, "obstacle": 500}
PERFORMANCE_SPEED_M_S, PERFORMANCE_ACCELERATION_M_S2, PERFORMANCE_DECELERATION_M_S2 = (
    70.0,
    4.0,
    9.0,
)  # wide enough for every trajectory
START_SLACK_S = 0.5  # a free ego's nearness may start the attack this much earlier
OPENDRIVE_EXPORT_TIMEOUT_S = 600.0  # for netconvert; a town takes seconds
Names = Mapping[str, str]


def write_openscenario(folder: Path, piece: ExportedRun, netconvert: Path, variant: Variant = Variant.REPLAY) -> None:
    """Write ``scenario.xosc``, checked against ASAM's schema, and ``road.xodr`` into a folder.

    Args:
        folder: The folder.
        piece: What is exported.
        netconvert: The program ``netconvert``.
        variant: The vehicles that the file drives.

    Raises:
        UsageError: A free ego is wanted and there is no adversary.
        SumoAdvError: netconvert failed, or the document is not valid.
    """
    text = openscenario(piece, variant)
    check_openscenario(text)
    write_opendrive(netconvert, piece.network, folder / OPENDRIVE_FILE, piece.written)
    (folder / OPENSCENARIO_FILE).write_text(text, encoding="utf-8")


def openscenario(piece: ExportedRun, variant: Variant = Variant.REPLAY) -> str:
    """Make the document.

    With a free ego, the file drives all vehicles but the ego, which starts as recorded and is then the player's. The
    file begins when the ego and all adversaries exist. Adversaries follow their recording up to the takeover, and
    attack from then on, up to ``START_SLACK_S`` earlier if the ego is as near to the collider as at the recorded
    takeover. All adversaries begin together.

    Args:
        piece: What is exported.
        variant: The vehicles that the file drives.

    Returns:
        The XML.

    Raises:
        UsageError: A free ego is wanted and there is no adversary.
    """
    if variant is Variant.FREE_EGO and (piece.adversary is None or piece.takeover is None):
        raise UsageError("A free ego needs an adversary: export a run that was attacked, without --unattacked.")
    if variant is Variant.FREE_EGO:
        piece = _from_all_there(piece)
    heights = network(piece.network).heights
    if heights is not None and heights.inferred:  # netconvert's OpenDRIVE lacks inferred heights
        piece = replace(piece, tracks=tuple(replace(track, z=0.0) for track in piece.tracks))
    names = entity_names(piece.tracks)
    root = Element("OpenSCENARIO")
    header = SubElement(
        root, "FileHeader", revMajor="1", revMinor="2", date=piece.written.strftime("%Y-%m-%dT%H:%M:%S"),
        author=f"sumo_adv {__version__}",
        description=printable(f"{piece.name}, {variant}; time 0 is {piece.begin:.3f} s of the simulation"),
    )  # fmt: skip
    known = {"begin": f"{piece.begin:.3f}", "end": f"{piece.end:.3f}", "ego": names[piece.ego]}
    if piece.adversary is not None:
        known |= {"adversary": names[piece.adversary], "takeover": f"{piece.takeover:.3f}"}
    known |= {f"support_{k}": names[support] for k, support in enumerate(piece.supports, 1)}
    properties = SubElement(header, "Properties")
    for name, value in known.items():  # a reader needs these to find the run
        SubElement(properties, "Property", name=f"sumo_adv_{name}", value=value)
    SubElement(root, "CatalogLocations")
    SubElement(SubElement(root, "RoadNetwork"), "LogicFile", filepath=OPENDRIVE_FILE)
    _add_entities(root, piece.tracks, names)
    _add_storyboard(root, piece, variant, names)
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _from_all_there(piece: ExportedRun) -> ExportedRun:
    """Cut a piece so that it begins when the ego and all adversaries exist, since a free ego is only placed at 0."""
    begin = max(float(t.time[0]) for t in piece.tracks if t.id == piece.ego or t.role is Role.ADVERSARY)
    parts = (track.between(begin, piece.end) for track in piece.tracks)
    return replace(piece, begin=begin, tracks=tuple(part for part in parts if len(part.time)))


# -- entities ---------------------------------------------------------------------------------------------------------


def entity_names(tracks: Sequence[Track]) -> dict[str, str]:
    """Give each id a unique name that OpenSCENARIO accepts: no control characters, no ``$`` (a parameter), no ``:``."""
    names: dict[str, str] = {}
    for track in tracks:
        name = "".join(c if c.isprintable() and c not in "$:" else "_" for c in track.id).strip() or "_"
        while name in names.values():
            name += "_"
        names[track.id] = name
    return names


def _centre_ahead(track: Track) -> float:
    """Return how far the box's centre is ahead of the reference point [m]."""
    return 0.0 if kind(track) in ("pedestrian", "obstacle") else CENTRE_SHARE * track.length


def reference_points(track: Track) -> tuple[Floats, Floats, Floats]:
    """Return x [m], y [m] of the reference point and the unwrapped heading [rad], at the track's times."""
    ahead = _centre_ahead(track)
    x, y = track.x - ahead * np.cos(track.heading), track.y - ahead * np.sin(track.heading)
    return x, y, np.unwrap(track.heading)


def _add_entities(parent: Element, tracks: Sequence[Track], names: Names) -> None:
    entities = SubElement(parent, "Entities")
    for track in tracks:
        scenario_object = SubElement(entities, "ScenarioObject", name=names[track.id])
        category = kind(track)
        if category == "pedestrian":
            thing = SubElement(scenario_object, "Pedestrian", pedestrianCategory="pedestrian")
        elif category == "obstacle":
            thing = SubElement(scenario_object, "MiscObject", miscObjectCategory="obstacle")
        else:
            thing = SubElement(scenario_object, "Vehicle", vehicleCategory=category)
        thing.set("name", f"{category}_{track.length:.2f}x{track.width:.2f}")
        thing.set("mass", str(MASS_KG[category]))
        box, height = SubElement(thing, "BoundingBox"), HEIGHT_M[category]
        SubElement(box, "Center", x=metres(_centre_ahead(track)), y="0.0", z=metres(height / 2))
        size = {"length": metres(track.length), "width": metres(track.width), "height": metres(height)}
        SubElement(box, "Dimensions", size)
        if thing.tag == "Vehicle":
            _add_vehicle_parts(thing, track)
        properties = SubElement(thing, "Properties")
        SubElement(properties, "Property", name="sumo_adv_id", value=printable(track.id))
        SubElement(properties, "Property", name="sumo_adv_role", value=str(track.role))


def _add_vehicle_parts(thing: Element, track: Track) -> None:
    SubElement(
        thing,
        "Performance",
        maxSpeed=f"{PERFORMANCE_SPEED_M_S}",
        maxAcceleration=f"{PERFORMANCE_ACCELERATION_M_S2}",
        maxDeceleration=f"{PERFORMANCE_DECELERATION_M_S2}",
    )
    axles = SubElement(thing, "Axles")
    for name, at, steer in (
        ("FrontAxle", WHEELBASE_SHARE * track.length, DEFAULT_STEERING_RAD),
        ("RearAxle", 0.0, 0.0),
    ):
        SubElement(
            axles, name, maxSteering=f"{steer}", wheelDiameter=f"{WHEEL_DIAMETER_M}",
            trackWidth=metres(TRACK_WIDTH_SHARE * track.width),
            positionX=metres(at), positionZ=metres(WHEEL_DIAMETER_M / 2),
        )  # fmt: skip


# -- what happens -----------------------------------------------------------------------------------------------------


def _add_storyboard(parent: Element, piece: ExportedRun, variant: Variant, names: Names) -> None:
    """Add the positions at the start, and the timed trajectories from then on."""
    storyboard = SubElement(parent, "Storyboard")
    actions = SubElement(SubElement(storyboard, "Init"), "Actions")
    for track in piece.tracks:
        if _is_late(track, piece):
            continue
        private = SubElement(actions, "Private", entityRef=names[track.id])
        _add_position(_nested(private, "PrivateAction", "TeleportAction"), track, 0)
        speed = _nested(private, "PrivateAction", "LongitudinalAction", "SpeedAction")
        SubElement(speed, "SpeedActionDynamics", dynamicsShape="step", dynamicsDimension="time", value="0.0")
        target = SubElement(speed, "SpeedActionTarget")
        SubElement(target, "AbsoluteTargetSpeed", value=metres(float(track.speed[0])))
    act = SubElement(SubElement(storyboard, "Story", name="recording"), "Act", name="act")
    for track in piece.tracks:
        if variant is Variant.FREE_EGO and track.role is Role.ADVERSARY:
            _add_attacker(act, piece, track, names)
        elif variant is Variant.REPLAY or track.id != piece.ego:
            _add_recorded(act, piece, track, names[track.id])
    _add_time_trigger(act, "StartTrigger", 0.0, "start")
    _add_time_trigger(storyboard, "StopTrigger", piece.end - piece.begin, "end")


def _add_recorded(act: Element, piece: ExportedRun, track: Track, name: str) -> None:
    """Add a vehicle's recording: it appears, follows its trajectory and disappears, once for each stretch."""
    maneuver = _add_maneuver(act, name)
    for number, part in enumerate(stretches(track, piece.step), 1):
        again = f" ({number})" if number > 1 else ""
        begin, end = float(part.time[0]) - piece.begin, float(part.time[-1]) - piece.begin
        if _is_late(part, piece):
            event = _add_event(maneuver, f"{name} comes{again}")
            added = _add_action(event, f"{name} is added{again}", "GlobalAction")
            entity = SubElement(added, "EntityAction", entityRef=name)
            _add_position(SubElement(entity, "AddEntityAction"), part, 0)
            _add_time_trigger(event, "StartTrigger", begin, f"{name} comes{again}")
        if len(part.time) > 1:
            event = _add_event(maneuver, f"{name} drives{again}")
            _add_following(event, f"{name} follows{again}", part, part.time - piece.begin, absolute=True)
            _add_time_trigger(event, "StartTrigger", begin, f"{name} drives{again}")
        if part.time[-1] < piece.end - piece.step / 2:
            event = _add_event(maneuver, f"{name} goes{again}")
            deleted = _add_action(event, f"{name} is deleted{again}", "GlobalAction")
            SubElement(SubElement(deleted, "EntityAction", entityRef=name), "DeleteEntityAction")
            _add_time_trigger(event, "StartTrigger", end + piece.step, f"{name} goes{again}")


def _add_attacker(act: Element, piece: ExportedRun, track: Track, names: Names) -> None:
    """Add an adversary: the recording up to the takeover, then the attack with relative times."""
    assert piece.takeover is not None and piece.adversary is not None
    name, takeover = names[track.id], piece.takeover - piece.begin
    maneuver = _add_maneuver(act, name)
    lead, attack = track.between(track.time[0], piece.takeover), track.between(piece.takeover, piece.end)
    if len(lead.time) > 1:
        event = _add_event(maneuver, f"{name} approaches")
        _add_following(event, f"{name} follows its recording", lead, lead.time - piece.begin, absolute=True)
        _add_time_trigger(event, "StartTrigger", 0.0, f"{name} approaches")
    event = _add_event(maneuver, f"{name} attacks")
    _add_following(event, f"{name} follows its attack", attack, attack.time - attack.time[0], absolute=False)
    trigger = SubElement(event, "StartTrigger")
    _add_time(SubElement(trigger, "ConditionGroup"), takeover, "time of the takeover")
    group = SubElement(trigger, "ConditionGroup")
    _add_time(group, max(0.0, takeover - START_SLACK_S), "shortly before the takeover")
    (x, y), (ego_x, ego_y) = (
        [float(np.interp(piece.takeover, each.time, values)) for values in reference_points(each)[:2]]
        for each in (piece.track(piece.adversary), piece.track(piece.ego))
    )
    _add_nearness(group, names[piece.adversary], names[piece.ego], math.hypot(x - ego_x, y - ego_y))


def _is_late(track: Track, piece: ExportedRun) -> bool:
    """Return whether a vehicle appears after the beginning."""
    return bool(track.time[0] > piece.begin + piece.step / 2)


def _nested(parent: Element, *tags: str) -> Element:
    """Create nested elements and return the innermost one."""
    for tag in tags:
        parent = SubElement(parent, tag)
    return parent


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
    """Add a FollowTrajectoryAction with a vertex for each state; ``time`` [s] is the file's or the action's own."""
    action = _nested(_add_action(event, name, "PrivateAction"), "RoutingAction", "FollowTrajectoryAction")
    reference = SubElement(action, "TimeReference")
    domain = "absolute" if absolute else "relative"
    SubElement(reference, "Timing", domainAbsoluteRelative=domain, offset="0.0", scale="1.0")
    SubElement(action, "TrajectoryFollowingMode", followingMode="position" if absolute else "follow")
    trajectory = SubElement(
        SubElement(action, "TrajectoryRef"), "Trajectory", name=f"{name}: trajectory", closed="false"
    )
    line = _nested(trajectory, "Shape", "Polyline")
    for k, t in enumerate(time.tolist()):
        _add_position(SubElement(line, "Vertex", time=_seconds(t)), track, k)


def _add_position(parent: Element, track: Track, k: int) -> None:
    x, y, heading = reference_points(track)
    place = {"x": metres(float(x[k])), "y": metres(float(y[k])), "h": f"{heading[k] + 0.0:.6f}"}
    if np.ndim(track.z):
        place["z"] = metres(height_of(track, k))
    SubElement(SubElement(parent, "Position"), "WorldPosition", place)


def _add_time_trigger(parent: Element, tag: str, time: float, name: str) -> None:
    _add_time(_nested(parent, tag, "ConditionGroup"), time, name)


def _add_time(group: Element, time: float, name: str) -> None:
    condition = SubElement(group, "Condition", name=name, delay="0.0", conditionEdge="none")
    by_value = SubElement(condition, "ByValueCondition")
    SubElement(by_value, "SimulationTimeCondition", value=_seconds(time), rule="greaterOrEqual")


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
    return f"{value + 0.0:.3f}"


# -- the road ---------------------------------------------------------------------------------------------------------


def write_opendrive(netconvert: Path, network: Path, target: Path, written: datetime) -> None:
    """Write a network as OpenDRIVE. Its world x and y are those of the net.xml.

    netconvert's comment (its command line and the time) is left out. An ``offset`` in the header is left out, too,
    because some players would add it to every position; the network's offset is kept as ``userData``. Left-hand roads
    have the attribute ``rule``, which OpenDRIVE has since 1.5, and their lanes, to the left, have positive numbers.

    Args:
        netconvert: The program ``netconvert``.
        network: The network.
        target: The file.
        written: The date in the header.

    Raises:
        SumoAdvError: netconvert failed.
    """
    left_hand = is_left_hand(network)
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        made = Path(scratch) / "network.xodr"
        command = [str(netconvert), "-s", str(network.resolve()), "--opendrive-output", str(made)]
        command += ["--precision", "4", "--xml-validation", "never"]
        command += ["--opendrive-output.lefthand-left"] if left_hand else []
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=OPENDRIVE_EXPORT_TIMEOUT_S, check=False, cwd=scratch
        )
        if done.returncode or not made.is_file():
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[0].removeprefix("Error: ")
            raise SumoAdvError(
                f"netconvert made no OpenDRIVE of {network.name} ({reason.rstrip('.')}); check the network."
            )
        tree = ElementTree.parse(made)
    header = tree.getroot().find("header")
    assert header is not None
    header.set("date", written.strftime("%Y-%m-%dT%H:%M:%S"))
    header.set("name", network.name)
    for offset in header.findall("offset"):
        header.remove(offset)
    SubElement(header, "userData", code="sumoNetOffset", value=_net_offset(network))
    if left_hand:
        header.set("revMinor", "5")
        for road in tree.iter("road"):
            road.set("rule", "LHT")
    tree.write(target, encoding="UTF-8", xml_declaration=True)


def _net_offset(network: Path) -> str:
    """Read ``netOffset`` of a net.xml(.gz) as "x,y" [m]."""
    opened = gzip.open if network.suffix == ".gz" else open
    with opened(network, "rt", encoding="utf-8") as file:
        for line in file:
            if match := re.search(r'netOffset="([^"]*)"', line):
                return match.group(1)
    return "0.00,0.00"


# -- the schema -------------------------------------------------------------------------------------------------------


def check_openscenario(text: str) -> None:
    """Check a document against ASAM OpenSCENARIO 1.2.

    Args:
        text: The document.

    Raises:
        SumoAdvError: The document is not valid, which is a fault of this program.
    """
    from lxml import etree

    schema = _schema()
    if not schema.validate(etree.fromstring(text.encode())):
        first = schema.error_log[0]
        raise SumoAdvError(
            f"The OpenSCENARIO made from this run is not valid (line {first.line}: {first.message}); please report it."
        )


@cache
def _schema() -> Any:
    """Load ASAM's schema, which the package ``asam-qc-openscenarioxml`` contains."""
    from importlib.resources import files

    from lxml import etree

    file = files("qc_openscenario") / "schema" / OPENSCENARIO_VERSION / "OpenSCENARIO.xsd"
    return etree.XMLSchema(etree.fromstring(file.read_bytes()))
