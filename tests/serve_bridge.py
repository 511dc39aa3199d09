"""A client as CARLA's bridge is one: it adds a vehicle of its own, moves it with ``moveToXY`` alone, and subscribes to
all vehicles. ``serve_bridge.py PORT``; on ``straight_3lane``, at 14 m/s along y = -3.2 m, from the start again at the
end.
"""

from __future__ import annotations

import contextlib
import sys
import time

import traci
from traci import constants

ME, SPEED, START, END = "carla0", 14.0, 60.0, 900.0


def drive(sumo: traci.connection.Connection) -> None:
    """As the bridge does it, step for step."""
    sumo.vehicletype.copy("DEFAULT_VEHTYPE", "vehicle.tesla.model3")
    sumo.vehicletype.setLength("vehicle.tesla.model3", 4.7)
    sumo.route.add("carla_route", [sumo.edge.getIDList()[0]])
    sumo.vehicle.add(ME, "carla_route", typeID="vehicle.tesla.model3")
    x = START
    while True:
        sumo.simulationStep()
        for name in sumo.simulation.getDepartedIDList():
            sumo.vehicle.subscribe(name, [constants.VAR_POSITION3D, constants.VAR_ANGLE, constants.VAR_SPEED])
        x = START if x > END else x + SPEED * 0.1
        sumo.vehicle.moveToXY(ME, "", 0, x, -3.2, 90.0, keepRoute=2)


def main(port: int) -> None:
    """Until the server has gone."""
    with contextlib.suppress(traci.FatalTraCIError):
        for _ in range(100):
            try:
                connection = traci.connect(port, numRetries=0, host="127.0.0.1")
                break
            except traci.FatalTraCIError:
                time.sleep(0.1)
        drive(connection)


if __name__ == "__main__":
    main(int(sys.argv[1]))
