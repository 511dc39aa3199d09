"""Turn a draft into files: the scenario (TOML) and, under the same name, its demand, network and signals.

Vehicles that are to meet the ego start at a place from which, at constant speed, they arrive when the draft says.
Pedestrians, cyclists and parked vehicles are placed along the ego's way, or straight on from its start. At traffic
lights, the ego has green, or the lights follow the phases of the draft.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_adv.asked import RequestOrigin
from sumo_adv.datatypes import MAX_ADVERSARIES
from sumo_adv.errors import UsageError
from sumo_adv.files import toml_lines, toml_text
from sumo_adv.planners.script_checks import Walker, check_walker_script
from sumo_adv.road_users import UNPROTECTED_SPEEDS_M_S, RoadUser
from sumo_adv.script import Script
from sumo_adv.words.draft import AttackDraft, EgoDraft, LightsPhase, SceneDraft, VehicleDraft, WalkerDraft
from sumo_adv.words.ego_way import come_after, time_to, way_tables
from sumo_adv.words.roads import Net, VehicleRoute, make_network, meeting
from sumo_adv.words.scripts import check_script, script_tables

MEETING_TIME_S = 9.0  # after the start; the ego then reaches the place where it meets others
MIN_TIME_TO_MEETING_S = 5.5  # minimum time from the ego's start to the meeting
TRIGGER_BEFORE_MEETING_S = 5.0  # how long before the meeting an attack begins, at most
MIN_TRIGGER_TIME_S = 2.0  # after the start; no attack on a meeting begins earlier
FREE_TRIGGER_TIME_S = 3.0  # after the start; when an attack without a meeting begins
ROAD_BEHIND_EGO_M = 60.0  # length of road behind the ego if nothing else determines its start
MIN_FRONT_DISTANCE_M = 4.0  # minimum distance of the fronts of vehicles in one lane, in addition to their length
PLACED_HEADWAY_RANGE_S = (0.2, 1.0)  # bounds of the headway to the vehicle ahead, which is as placed
MIN_GAP_M = 2.5  # SUMO's minGap
DRAFT_HORIZON_S = 10.0
DEMAND_DURATION_S = 40.0
ALWAYS_S = 3600.0  # duration of the only phase of lights that do not change
ACTOR_SIZES_M = {
    "car": (4.8, 1.8), "van": (5.5, 2.0), "truck": (12.0, 2.5), "bus": (12.0, 2.55), "motorcycle": (2.2, 0.8),
    "bicycle": (1.8, 0.6),
}  # fmt: skip
"""The length and width of each type [m]."""
PEDESTRIAN_SIZE_M = (0.5, 0.5)
MEETING_STEP_S = 0.1  # step of the search for the time at which the ego is nearest to a walker


@dataclass(frozen=True, slots=True)
class Placed:
    """A vehicle at its start.

    Attributes:
        draft: The vehicle as drafted.
        drive: Its way.
        position: The place of its front on the first edge [m].
        meets: The time at which the ego is where the two meet [s]; None without such a place.
    """

    draft: VehicleDraft
    drive: VehicleRoute
    position: float
    meets: float | None


def build_scenario(scene: SceneDraft, target: Path, written: RequestOrigin, given: Path | None = None) -> Path:
    """Write a scenario and the files beside it.

    Args:
        scene: The scene of a draft.
        target: The path of the scenario (.toml).
        written: The words, the model and the date, which the scenario records.
        given: The user's network; None if there is none.

    Returns:
        The path of the scenario.

    Raises:
        UsageError: The draft has a fault. The message is one sentence, for people and for the model.
    """
    _check_names(scene)
    stem = target.with_suffix("")
    network = make_network(scene.road, stem.with_suffix(".net.xml"), given)
    net = Net(network)
    ego_drive = net.drive(scene.ego.route, scene.ego.lane, "passenger", "the ego")
    drives = {v.id: net.drive(v.route, v.lane, _vclass(v.type), f"'{v.id}'") for v in scene.vehicles}
    start = _ego_start(scene, ego_drive, drives)
    _check_speed(scene.ego.speed, ego_drive, "The ego")
    tables = way_tables(scene.ego)
    placed = [_place(v, drives[v.id], scene.ego, ego_drive, start) for v in scene.vehicles]
    _check_room(placed, scene.ego, ego_drive, start)
    _check_script(scene, drives, net)
    stem.with_suffix(".rou.xml").write_text(_demand(scene.ego, ego_drive, start, placed), encoding="utf-8")
    phases = scene.road.lights or [LightsPhase(shows="ego_green", seconds=ALWAYS_S)]
    states = [net.light_states(ego_drive.edges, phase.shows) for phase in phases]
    if states[0]:
        text = _signals(phases, states, scene.road.lights_offset)
        stem.with_suffix(".add.xml").write_text(text, encoding="utf-8")
    elif scene.road.lights:
        raise UsageError(
            "The road has phases of lights and no traffic lights on the ego's way: give a crossing control = signals."
        )
    text = _scenario(scene, stem.name, network, written, ego_drive, start, placed, tables, lights=bool(states[0]))
    target.write_text(text, encoding="utf-8")
    return target


def _vclass(kind: str) -> str:
    """Return SUMO's vehicle class of a type."""
    return "bicycle" if kind == "bicycle" else "passenger"


def _check_names(scene: SceneDraft) -> None:
    """Check that ids are used once, and that the attack names vehicles or walkers that exist."""
    names = [v.id for v in scene.vehicles] + [w.id for w in scene.walkers]
    twice = next((name for name in names if names.count(name) > 1 or name == "ego"), None)
    if twice is not None:
        raise UsageError(f"The id '{twice}' is used twice: each vehicle and walker needs its own, and none is 'ego'.")
    adversaries = [*scene.attack.attackers, *scene.attack.supports]
    for name in adversaries:
        if name not in names:
            raise UsageError(f"The attack names '{name}', which is no vehicle or walker; there are {', '.join(names)}.")
    if len(set(adversaries)) < len(adversaries) or len(adversaries) > MAX_ADVERSARIES:
        raise UsageError(f"The adversary, the others and the supports are at most {MAX_ADVERSARIES}, each named once.")
    if any(getattr(other.asked, key) is not None for other in scene.attack.others for key in OF_ALL):
        raise UsageError("level and within hold for all attackers: give them in asked of the adversary, not of others.")
    if scene.attack.asked.within is not None and not scene.attack.others:
        raise UsageError("within bounds the time between several attackers: leave it out, or give others.")


def _check_speed(kmh: float, drive: VehicleRoute, who: str) -> None:
    """Check that a speed is within the limit of the first edge."""
    if kmh / 3.6 > drive.limit + 0.05:
        raise UsageError(
            f"{who} drives {kmh:g} km/h on edge '{drive.edges[0]}', where the limit is {drive.limit * 3.6:.0f} km/h."
        )


def _ego_start(scene: SceneDraft, ego: VehicleRoute, drives: dict[str, VehicleRoute]) -> float:
    """Return where the ego's front starts on its first edge [m]."""
    length = ACTOR_SIZES_M[scene.ego.type][0]
    if scene.ego.position is not None:
        if scene.ego.position > ego.first:
            raise UsageError(f"The ego's position is beyond its first edge, which is {ego.first:.0f} m long.")
        return max(scene.ego.position, length + 0.5)
    order = sorted(scene.vehicles, key=lambda v: v.id != scene.attack.adversary)
    for vehicle in order:
        met = meeting(ego, drives[vehicle.id]) if vehicle.arrives is not None or vehicle.stands else None
        if met is not None:
            (before,) = come_after(scene.ego, _seconds(vehicle, drives[vehicle.id], met[1]))
            start = max(met[0] - before, length + 1.0)
            if time_to(scene.ego, met[0] - start) < MIN_TIME_TO_MEETING_S:
                raise UsageError(
                    f"The ego's way to where it meets '{vehicle.id}' is {met[0]:.0f} m, which is less than "
                    f"{MIN_TIME_TO_MEETING_S:g} s at its speed: give a longer road, or a lower speed."
                )
            return min(start, ego.first - 1.0)
    behind = max((-v.gap for v in scene.vehicles if v.gap is not None), default=0.0)
    return min(max(ROAD_BEHIND_EGO_M, behind + ROAD_BEHIND_EGO_M / 2), ego.first / 2)


def _seconds(v: VehicleDraft, drive: VehicleRoute, station: float) -> float:
    """Return the time to the meeting at which the vehicle can start on its first edge [s]."""
    if v.stands or v.speed == 0:
        return MEETING_TIME_S
    return max(MEETING_TIME_S, (station - drive.first + MIN_FRONT_DISTANCE_M) / (v.speed / 3.6) - (v.arrives or 0.0))


def _place(v: VehicleDraft, drive: VehicleRoute, ego: EgoDraft, ego_drive: VehicleRoute, start: float) -> Placed:
    """Place a vehicle by its gap, by its arrival, or at the end of its first edge if it stands."""
    _check_speed(v.speed, drive, f"'{v.id}'")
    met = meeting(ego_drive, drive)
    meets = None if met is None else time_to(ego, met[0] - start)
    if v.gap is not None:
        if drive.edges[0] != ego_drive.edges[0]:
            raise UsageError(
                f"'{v.id}' has a gap but begins on edge '{drive.edges[0]}' and the ego on '{ego_drive.edges[0]}': let "
                "it begin there, or give arrives."
            )
        return Placed(v, drive, _within(v, drive, start + v.gap), None)
    if v.stands:
        return Placed(v, drive, drive.first - 1.0, meets)
    if v.arrives is None:
        raise UsageError(f"'{v.id}' needs a gap or arrives, or stands.")
    if drive.edges[0] == ego_drive.edges[0]:
        raise UsageError(f"'{v.id}' begins on the ego's edge, so it needs a gap, not arrives.")
    if met is None or meets is None:
        meets = MEETING_TIME_S
        (come,) = come_after(ego, meets)
        x, y, _ = ego_drive.at(start + come)
        station = drive.nearest(x, y)
    else:
        station = met[1]
    return Placed(v, drive, _within(v, drive, station - (meets + v.arrives) * v.speed / 3.6), meets)


def _within(v: VehicleDraft, drive: VehicleRoute, position: float) -> float:
    """Return the position if it is on the first edge; otherwise raise UsageError."""
    if not ACTOR_SIZES_M[v.type][0] <= position <= drive.first:
        way = "Its speed, arrives or gap must be less, or the road longer" if position < 0 else "Choose other numbers"
        raise UsageError(
            f"'{v.id}' would have to start at {position:.0f} m on edge '{drive.edges[0]}', which has room from "
            f"{ACTOR_SIZES_M[v.type][0]:.0f} to {drive.first:.0f} m. {way}."
        )
    return position


def _check_room(placed: list[Placed], ego: EgoDraft, ego_drive: VehicleRoute, start: float) -> None:
    """Check that no two vehicles start on top of one another."""
    fronts = [("the ego", ego_drive.edges[0], ego_drive.lane, start, ACTOR_SIZES_M[ego.type][0])]
    fronts += [
        (f"'{p.draft.id}'", p.drive.edges[0], p.drive.lane, p.position, ACTOR_SIZES_M[p.draft.type][0]) for p in placed
    ]
    for k, (one, *lane, front, length) in enumerate(fronts):
        for other, *beside, place, size in fronts[k + 1 :]:
            if lane == beside and abs(front - place) < (size if place > front else length) + MIN_FRONT_DISTANCE_M:
                raise UsageError(
                    f"{one[:1].upper()}{one[1:]} and {other} would start on top of one another in lane {lane[1]} of "
                    f"'{lane[0]}' (fronts at {front:.0f} and {place:.0f} m)."
                )


def _check_script(scene: SceneDraft, drives: Mapping[str, VehicleRoute], net: Net) -> None:
    """Check that those that have a script can play it, and that different scripts have different labels."""
    labels: dict[str, Script] = {}
    for name, script in scene.attack.scripts.items():
        if labels.setdefault(script.label, script) != script:
            raise UsageError(f"Two scripts have the label '{script.label}': give each a name of its own.")
        actor = next((v for v in scene.vehicles if v.id == name), None)
        if actor is None or actor.type == "bicycle":
            check_walker_script(script, f"'{name}'", _walker(scene, name, actor), DRAFT_HORIZON_S)
        else:
            speed = 0.0 if actor.stands else actor.speed / 3.6
            check_script(script, f"'{name}'", speed, ACTOR_SIZES_M[actor.type], drives[name], net, DRAFT_HORIZON_S)


def _walker(scene: SceneDraft, name: str, rider: VehicleDraft | None) -> Walker:
    """Return an adversary at the beginning of its attack: a rider on the road, or one of the walkers."""
    if rider is not None:
        return Walker(RoadUser.CYCLIST, 0.0 if rider.stands else rider.speed / 3.6, None, False)
    walker = next(w for w in scene.walkers if w.id == name)
    crosses = walker.heading == "across" or walker.speed == 0
    moved = walker.speed > 0 and walker.heading == "across"  # it may have come over the ego's way by then
    return Walker(RoadUser(walker.kind), walker.speed / 3.6, None if moved else walker.offset, crosses)


def _demand(ego: EgoDraft, ego_drive: VehicleRoute, start: float, placed: list[Placed]) -> str:
    """Return SUMO's demand: types, vehicles and routes."""
    rows: list[tuple[str, str, float, VehicleRoute, float, bool]]
    rows = [("ego", ego.type, ego.speed, ego_drive, start, False)]
    rows += [(p.draft.id, p.draft.type, p.draft.speed, p.drive, p.position, p.draft.stands) for p in placed]
    types, vehicles = [], []
    backs = [(drive.edges[0], drive.lane, position - ACTOR_SIZES_M[kind][0]) for _, kind, _, drive, position, _ in rows]
    for name, kind, kmh, drive, position, stands in sorted(rows, key=lambda row: -row[4]):
        length, width = ACTOR_SIZES_M[kind]
        speed = min(kmh / 3.6, drive.limit)  # 70 km/h is slightly more than the 19.4 m/s of a network
        lanes = "" if len(drive.edges) > 1 else ' lcStrategic="-1" lcCooperative="0"'  # keeps its lane
        types.append(
            f'    <vType id="type_{name}" vClass="{_vclass(kind)}" carFollowModel="Krauss" sigma="0" '
            f'tau="{_headway(backs, drive, position, speed):.2g}" speedDev="0" maxSpeed="{max(speed, 3.0):.2f}" '
            f'length="{length:g}" width="{width:g}" lcKeepRight="0" lcSpeedGain="0"{lanes}/>\n'
        )
        stop, depart = "", drive.line.position_of(position)
        if stands:
            lane = f"{drive.edges[0]}_{drive.lane}"
            stop = f'        <stop lane={quoteattr(lane)} endPos="{depart:.2f}" duration="{DEMAND_DURATION_S:g}"/>\n'
        vehicles.append(
            f'    <vehicle id="{name}" type="type_{name}" depart="0" departLane="{drive.lane}" '
            f'departPos="{depart:.2f}" departSpeed="{0.0 if stands else speed:.2f}" insertionChecks="none">\n'
            f"        <route edges={quoteattr(' '.join(drive.edges))}/>\n{stop}    </vehicle>\n"
        )
    return f'<?xml version="1.0" encoding="UTF-8"?>\n\n<routes>\n{"".join(types)}{"".join(vehicles)}</routes>\n'


def _headway(backs: list[tuple[str, int, float]], drive: VehicleRoute, position: float, speed: float) -> float:
    """Return the headway [s] at which a vehicle placed behind another one in its lane keeps that gap, within bounds."""
    ahead = [b - position for edge, lane, b in backs if (edge, lane) == (drive.edges[0], drive.lane) and b > position]
    least, most = PLACED_HEADWAY_RANGE_S
    return min(max((min(ahead, default=math.inf) - MIN_GAP_M) / max(speed, 1.0), least), most)


def _signals(phases: Sequence[LightsPhase], states: Sequence[Mapping[str, str]], offset: float) -> str:
    """Return SUMO's programs of the traffic lights; ``states`` has the states of all lights, by phase."""
    rows = []
    for name in sorted(states[0]):
        rows.append(f'    <tlLogic id={quoteattr(name)} type="static" programID="asked" offset="{offset:g}">\n')
        rows += [
            f'        <phase duration="{phase.seconds:g}" state="{state[name]}"/>\n'
            for phase, state in zip(phases, states, strict=True)
        ]
        rows.append("    </tlLogic>\n")
    return f"<additional>\n{''.join(rows)}</additional>\n"


def _scenario(
    scene: SceneDraft, stem: str, network: Path, written: RequestOrigin, ego: VehicleRoute, start: float,
    placed: list[Placed], way: Sequence[str], *, lights: bool,
) -> str:  # fmt: skip
    """Return the text of the scenario."""
    attack = scene.attack
    walkers, tables = _boxes(scene, ego, start)
    meets = {p.draft.id: p.meets for p in placed} | {
        w.id: _nearest_time(w, scene.ego, ego, start) for w in scene.walkers
    }
    met = min((time for name in attack.attackers if (time := meets.get(name)) is not None), default=None)
    trigger = FREE_TRIGGER_TIME_S if met is None else max(round(met - TRIGGER_BEFORE_MEETING_S, 1), MIN_TRIGGER_TIME_S)
    name = scene.road.name if scene.road.kind == "shipped" else network.name
    if scene.road.kind == "given":
        name = str(network.resolve())
    lines = [
        "# Made from words by sumo-adv write; [written] holds them.\n"
        f"schema = 1\nnetwork = {toml_text(name)}\n\n[demand]\nfiles = [{toml_text(f'{stem}.rou.xml')}]\nbegin = 0.0\n"
        f"end = {DEMAND_DURATION_S}\n\n[ego]\nid = \"ego\"\n\n[window]\n"
        f"warm_up = {min(trigger, MIN_TRIGGER_TIME_S)}\ntrigger = {trigger}\n"
        f"horizon = {DRAFT_HORIZON_S}\n",
        _table("adversary", _adversary(attack, walkers)),
        f"\n[signals]\nfiles = [{toml_text(f'{stem}.add.xml')}]\n" if lights else "",
        *tables, *way,
        *map(script_tables, {script.label: script for script in attack.scripts.values()}.values()),
        _table("written", {"words": written.words, "model": written.model, "date": written.date}),
        _table("asked", _asked_of_all(attack)),
        *_attackers(attack, walkers),
    ]  # fmt: skip
    return "".join(lines)


def _adversary(attack: AttackDraft, walkers: Mapping[str, str]) -> dict[str, Any]:
    """Return the table of the only adversary and its supports; that of several attackers has the supports only."""
    supports = {"supports": attack.supports or None}
    if attack.others:
        return supports
    name = walkers.get(attack.adversary, attack.adversary)
    return {"candidates": [name], **supports, "intents": attack.labels or None}


OF_ALL = ("level", "within")  # keys of what is asked of several attackers together


def _asked_of_all(attack: AttackDraft) -> dict[str, Any]:
    """Return the table of what is asked of the only adversary, or of several attackers together."""
    table = attack.asked.model_dump(mode="json", exclude_defaults=True)
    return {key: value for key, value in table.items() if key in OF_ALL} if attack.others else table


def _attackers(attack: AttackDraft, walkers: Mapping[str, str]) -> list[str]:
    """Return the tables of several attackers; none for one."""
    if not attack.others:
        return []
    each = [(attack.adversary, attack.labels, True, attack.asked)]
    each += [(other.adversary, other.labels, other.attacks, other.asked) for other in attack.others]
    tables = []
    for name, labels, attacks, asked in each:
        own = asked.model_dump(mode="json", exclude_defaults=True, exclude=set(OF_ALL))
        of_it = {"id": walkers.get(name, name), "intents": labels or None, "attacks": None if attacks else False}
        head = toml_lines(of_it)
        tables.append("\n".join(["", "[[attackers]]", *head, ""]) + _table("attackers.asked", own))
    return tables


def _boxes(scene: SceneDraft, ego: VehicleRoute, start: float) -> tuple[dict[str, str], list[str]]:
    """Return the ids that a run gives to the walkers, and the tables of walkers and parked vehicles."""
    ids: dict[str, str] = {}
    tables = []
    counts = {"pedestrian": 0, "cyclist": 0}
    for parked in scene.parked:
        x, y, heading = _beside(ego, start + parked.at, parked.offset)
        tables.append(_box("parked", x, y, heading, *ACTOR_SIZES_M[parked.type]))
    for walker in scene.walkers:
        x, y, heading = _walker_start(walker, ego, start)
        ids[walker.id] = f"{walker.kind}{counts[walker.kind]}"
        counts[walker.kind] += 1
        size = PEDESTRIAN_SIZE_M if walker.kind == "pedestrian" else ACTOR_SIZES_M["bicycle"]
        tables.append(_box(f"{walker.kind}s", x, y, heading, *size, walker.speed / 3.6))
    return ids, tables


def _walker_start(walker: WalkerDraft, ego: VehicleRoute, start: float) -> tuple[float, float, float]:
    """Return x, y [m] and heading [rad] of a pedestrian or cyclist at the start; check its speed."""
    fastest = UNPROTECTED_SPEEDS_M_S[RoadUser(walker.kind)] * 3.6
    if walker.speed > fastest:
        raise UsageError(f"'{walker.id}' goes {walker.speed:g} km/h, and a {walker.kind} at most {fastest:.0f}.")
    if walker.straight_on:
        x, y, heading = ego.at(start)
        x, y = x + walker.at * math.cos(heading), y + walker.at * math.sin(heading)
        x, y = x - walker.offset * math.sin(heading), y + walker.offset * math.cos(heading)
    else:
        x, y, heading = _beside(ego, start + walker.at, walker.offset)
    turns = {"across": -math.copysign(math.pi / 2, walker.offset), "along": 0.0, "against": math.pi}
    return x, y, heading + turns[walker.heading]


def _nearest_time(walker: WalkerDraft, moves: EgoDraft, ego: VehicleRoute, start: float) -> float:
    """Return when the ego is nearest to a pedestrian or cyclist who stands, or goes straight on [s]."""
    if walker.speed == 0 and not walker.straight_on:
        return time_to(moves, walker.at)
    x, y, heading = _walker_start(walker, ego, start)
    pace, times = walker.speed / 3.6, MEETING_STEP_S * np.arange(round(DEMAND_DURATION_S / MEETING_STEP_S))
    places = np.array([ego.at(start + come)[:2] for come in come_after(moves, *times)])
    there = np.column_stack([x + pace * times * math.cos(heading), y + pace * times * math.sin(heading)])
    return float(times[np.argmin(np.hypot(*(places - there).T))])


def _beside(ego: VehicleRoute, station: float, offset: float) -> tuple[float, float, float]:
    """Return x, y [m] and heading [rad] at an offset [m] to the left of the ego's way."""
    x, y, heading = ego.at(station)
    return x - offset * math.sin(heading), y + offset * math.cos(heading), heading


def _table(name: str, table: Mapping[str, Any]) -> str:
    """Return a TOML table."""
    return "\n".join(["", f"[{name}]", *toml_lines(table), ""])


def _box(table: str, x: float, y: float, heading: float, length: float, width: float, speed: float = 0.0) -> str:
    """Return a TOML table of a box that stands, or goes straight on."""
    turned = math.remainder(heading, math.tau)
    moves = f"speed = {speed:.2f}\n" if speed else ""
    place = f"x = {x:.2f}\ny = {y:.2f}\nheading = {turned:.4f}\n"
    return f"\n[[{table}]]\n{place}length = {length}\nwidth = {width}\n{moves}"
