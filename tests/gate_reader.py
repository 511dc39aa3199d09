"""A client that asks stock ``traci`` for nearly everything, and prints what it heard: ``gate_reader.py PORT``."""

from __future__ import annotations

import inspect
import json
import re
import struct
import sys
from collections.abc import Callable
from typing import Any

import traci
from traci import constants as tc

client = traci.connect(int(sys.argv[1]), host="127.0.0.1")
client.setOrder(2)
answers: list[tuple[str, str]] = []


def say(label: str, call: Callable[..., Any], *given: Any, **named: Any) -> None:
    """Ask, and note the answer or the error."""
    try:
        answer = repr(call(*given, **named))
    except traci.FatalTraCIError:
        raise
    except Exception as error:  # also traci's own, where it cannot read what SUMO says
        answer = f"{type(error).__name__}: {error}"
    answers.append((label, re.sub(" at 0x[0-9a-f]+", "", answer)))


def read(domain: Any) -> None:
    """Every getter of a domain that needs at most an object, for two objects and a missing one."""
    name = domain._name
    say(name, domain.getIDList)
    try:
        ids = [*domain.getIDList()[:2], "nobody"]
    except traci.TraCIException:
        ids = ["nobody"]
    for method in sorted(dir(domain)):
        if not re.match("get|is", method) or method in ("getIDList", "getHelpers"):
            continue
        call = getattr(domain, method)
        try:
            signature = inspect.signature(call)
            needed = [p for p in signature.parameters.values() if p.default is p.empty]
        except (TypeError, ValueError):
            continue
        if any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in signature.parameters.values()):
            needed = needed[:1]
        for object_id in ids:
            if len(needed) <= 1:
                say(f"{name}.{method}({object_id})", call, *([object_id] if needed else []))


def read_with_parameters() -> None:
    """Getters that take more."""
    v, s, lane, edge = client.vehicle, client.simulation, client.lane, client.edge
    for call, *given in (
        (v.getLeader, "other", 50.0),
        (v.getFollower, "ego", 50.0),
        (v.getNeighbors, "ego", 1),
        (v.getLaneChangeState, "ego", 1),
        (v.getDrivingDistance, "ego", "west_out", 20.0),
        (v.getDrivingDistance2D, "ego", -100.0, 4.8),
        (v.getFollowSpeed, "ego", 10.0, 20.0, 8.0, 4.5),
        (v.getSecureGap, "ego", 10.0, 8.0, 4.5),
        (v.getStopSpeed, "ego", 8.0, 20.0),
        (v.getParameter, "ego", "device.tripinfo.waitingTime"),
        (v.getParameterWithKey, "ego", "none"),
        (v.getNextStops, "ego"),
        (v.getStops, "ego", 3),
        (v.getStopParameter, "ego", 0, "duration"),
        (v.getAdaptedTraveltime, "ego", 1.0, "east_in"),
        (v.getEffort, "ego", 1.0, "east_in"),
        (v.getJunctionFoes, "ego", 100.0),
        (v.getTaxiFleet, 0),
        (v.couldChangeLane, "ego", 1),
        (v.wantsAndCouldChangeLane, "ego", 1),
        (v.getLeftFollowers, "ego"),
        (v.getRightLeaders, "ego"),
        (s.convert2D, "east_in", 10.0),
        (s.convert3D, "east_in", 10.0),
        (s.convertRoad, 50.0, 4.8),
        (s.convertRoad, 50.0, 4.8, False, "passenger"),
        (s.convertGeo, 1.0, 2.0),
        (s.getDistance2D, 0.0, 0.0, 3.0, 4.0),
        (s.getDistance2D, 50.0, 4.8, -50.0, 4.8, False, True),
        (s.getDistanceRoad, "east_in", 1.0, "west_out", 1.0, True),
        (s.getDistanceRoad, "nowhere", 1.0, "west_out", 1.0, True),
        (s.findRoute, "east_in", "west_out"),
        (s.findRoute, "east_in", "nowhere"),
        (s.findIntermodalRoute, "east_in", "west_out", "car"),
        (s.getParameter, "", "none"),
        (s.getOption, "seed"),
        (lane.getAngle, "east_in_0", 5.0),
        (lane.getFoes, "east_in_0", "west_out_0"),
        (lane.getChangePermissions, "east_in_0", 1),
        (edge.getAngle, "east_in", 5.0),
        (edge.getAdaptedTraveltime, "east_in", 1.0),
        (edge.getEffort, "east_in", 1.0),
        (client.trafficlight.getBlockingVehicles, "centre", 0),
        (client.trafficlight.getServedPersonCount, "centre", 0),
        (client.person.getTaxiReservations, 0),
        (client.person.getStage, "walker", 0),
    ):
        say(f"{call.__self__._name}.{call.__name__}{given}", call, *given)


def subscribe() -> None:
    """Subscriptions, contexts, filters."""
    say("subscribe", client.vehicle.subscribe, "ego")
    say("subscribe", client.vehicle.subscribe, "other", [tc.VAR_SPEED, tc.VAR_LANE_ID])
    say("leader", client.vehicle.subscribeLeader, "other", 60.0)
    say("parameter", client.vehicle.subscribeParameterWithKey, "ego", "device.tripinfo.waitingTime")
    say("nobody", client.vehicle.subscribe, "nobody", [tc.VAR_SPEED])
    say("simulation", client.simulation.subscribe, [tc.VAR_DEPARTED_VEHICLES_IDS, tc.VAR_TIME])
    say("loop", client.inductionloop.subscribe, "loop", [tc.LAST_STEP_VEHICLE_NUMBER])
    say("light", client.trafficlight.subscribe, "centre", [tc.TL_CURRENT_PHASE])
    say(
        "edge",
        client.edge.subscribe,
        "east_in",
        [tc.VAR_EDGE_TRAVELTIME],
        parameters={tc.VAR_EDGE_TRAVELTIME: ("d", 1.0)},
    )
    say("context", client.vehicle.subscribeContext, "ego", tc.CMD_GET_VEHICLE_VARIABLE, 80.0, [tc.VAR_SPEED])
    say(
        "filter",
        client.vehicle.addSubscriptionFilterLanes,
        [-1, 0, 1],
        noOpposite=True,
        downstreamDist=50.0,
        upstreamDist=60.0,
    )
    say("filter", client.vehicle.addSubscriptionFilterVClass, ["passenger"])
    say("filter", client.vehicle.addSubscriptionFilterVType, ["car"])
    say("junction", client.junction.subscribeContext, "centre", tc.CMD_GET_VEHICLE_VARIABLE, 60.0, [tc.VAR_POSITION])
    say("lanes", client.junction.subscribeContext, "centre", tc.CMD_GET_LANE_VARIABLE, 20.0, [tc.VAR_MAXSPEED])


def results() -> None:
    """What the subscriptions brought."""
    for domain in (client.vehicle, client.simulation, client.inductionloop, client.trafficlight, client.edge):
        say(f"{domain._name} results", domain.getAllSubscriptionResults)
    for domain in (client.vehicle, client.junction):
        say(f"{domain._name} contexts", domain.getAllContextSubscriptionResults)


def act() -> None:
    """Setters of its own vehicle and of what it adds."""
    v = client.vehicle
    for call, *given in (
        (client.route.add, "mine", ["south_in", "north_out"]),
        (client.vehicletype.copy, "car", "mine"),
        (client.vehicletype.setLength, "mine", 4.0),
        (client.vehicletype.setColor, "mine", (1, 2, 3, 4)),
        (v.add, "friend", "mine", "mine", "now", "best", "10", "5"),
        (v.add, "friend", "mine"),
        (v.add, "lost", "nowhere"),
        (v.setSpeed, "ego", 7.0),
        (v.setSpeedMode, "ego", 31),
        (v.setLaneChangeMode, "ego", 512),
        (v.changeLane, "ego", 1, 2.0),
        (v.changeLaneRelative, "ego", 1, 2.0),
        (v.changeSublane, "ego", 0.1),
        (v.slowDown, "ego", 6.0, 1.0),
        (v.setAcceleration, "ego", 0.5, 1.0),
        (v.setMaxSpeed, "ego", 20.0),
        (v.setTau, "ego", 1.2),
        (v.setColor, "ego", (255, 0, 0)),
        (v.setSignals, "ego", 1),
        (v.setType, "ego", "mine"),
        (v.setParameter, "ego", "note", "x"),
        (v.setRoute, "ego", ["east_in", "north_out"]),
        (v.setRouteID, "ego", "through"),
        (v.changeTarget, "ego", "south_out"),
        (v.setVia, "ego", []),
        (v.rerouteTraveltime, "ego"),
        (v.rerouteEffort, "ego"),
        (v.setStop, "ego", "east_in", 190.0, 0, 1.0),
        (v.setStopParameter, "ego", 0, "duration", "2"),
        (v.getStops, "ego"),
        (v.resume, "ego"),
        (v.replaceStop, "ego", 0, ""),
        (v.insertStop, "ego", 0, "east_in", 195.0),
        (v.setAdaptedTraveltime, "ego", "east_in", 20.0, 0.0, 100.0),
        (v.setEffort, "ego", "east_in", 3.0),
        (v.setRoutingMode, "ego", 1),
        (v.setPreviousSpeed, "ego", 7.0),
        (v.openGap, "ego", 2.0, 10.0, 5.0, 1.0),
        (v.deactivateGapControl, "ego"),
        (v.highlight, "ego"),
        (v.setLine, "ego", "x"),
        (v.setLateralLanePosition, "ego", 0.2),
        (v.updateBestLanes, "ego"),
        (v.moveTo, "friend", "south_in_0", 30.0),
        (v.moveToXY, "ego", "", -1, 100.0, 4.8, 270.0, 2),
        (v.rerouteParkingArea, "ego", "park"),
        (v.dispatchTaxi, "ego", []),
        (client.poi.add, "mine", 1.0, 2.0, (1, 2, 3, 4)),
        (client.poi.setPosition, "mine", 3.0, 4.0),
        (client.polygon.add, "mine", [(0, 0), (1, 0), (1, 1)], (1, 2, 3, 4)),
        (client.polygon.setShape, "mine", [(0, 0), (2, 0), (2, 2)]),
        (client.poi.getPosition, "mine"),
        (client.polygon.getShape, "mine"),
        (client.poi.remove, "mine"),
        (client.polygon.remove, "mine"),
        (client.person.add, "walker", "west_in", 5.0),
        (client.person.appendWaitingStage, "walker", 3.0),
        (client.person.appendWalkingStage, "walker", ["west_in"], 20.0),
        (client.person.getRemainingStages, "walker"),
        (client.person.setSpeed, "walker", 1.0),
    ):
        say(f"{call.__self__._name}.{call.__name__}{given}", call, *given)


def several_in_one() -> None:
    """Two getters, a setter and a command that does not exist, in one message."""
    name = struct.pack("!i", 3) + b"ego"
    parts = (
        b"\x0a\xa4\x40" + name,
        b"\x0a\xa4\x42" + name,
        b"\x13\xc4\x40" + name + b"\x0b" + struct.pack("!d", 6.5),
        b"\x03\x99x",
    )
    body = b"".join(parts)
    client._socket.sendall(struct.pack("!i", 4 + len(body)) + body)
    (length,) = struct.unpack("!i", client._socket.recv(4))
    answer = b""
    while len(answer) < length - 4:
        answer += client._socket.recv(length - 4 - len(answer))
    answers.append(("several", answer.hex()))


def main() -> None:
    """The whole conversation."""
    say("version", client.getVersion)
    client.simulationStep()
    subscribe()
    client.simulationStep()
    results()
    for domain in traci.domain.DOMAINS:
        bound = getattr(client, domain._name)
        read(bound)
    read_with_parameters()
    act()
    client.simulationStep()
    results()
    several_in_one()
    client.simulationStep()
    for name in ("ego", "friend"):
        for method in (
            "getPosition",
            "getSpeed",
            "getTypeID",
            "getRoute",
            "getLaneID",
            "getSignals",
            "getColor",
            "getLength",
        ):
            say(f"{method}({name})", getattr(client.vehicle, method), name)
    say("unsubscribe", client.vehicle.unsubscribe, "ego")
    say("unsubscribe", client.vehicle.unsubscribeContext, "ego", tc.CMD_GET_VEHICLE_VARIABLE, 80.0)
    say("remove", client.vehicle.remove, "friend")
    client.simulationStep(client.simulation.getTime() + 0.3)
    say("time", client.simulation.getTime)
    client.simulationStep(0.1)
    say("time", client.simulation.getTime)
    results()
    say("all", client.vehicle.getIDList)
    client.simulationStep()
    client.close()
    print(json.dumps(answers))


if __name__ == "__main__":
    main()
