"""An ego for ``sumo-adv serve``: the IDM (Treiber, Hennecke and Helbing 2000) keeps the distance, over stock TraCI.

usage: python idm_ego.py [port] [host]     SUMO keeps the lane and the rules at junctions (speed mode 30).
"""

import math
import sys
import time

import traci

EGO = "ego"
ACCELERATION, BRAKING, HEADWAY, MIN_GAP = 2.6, 4.5, 1.0, 2.5  # m/s2, m/s2, s, m


def idm(speed: float, wished: float, gap: float, closing: float) -> float:
    """Acceleration [m/s2] at a bumper gap [m] that closes by ``closing`` [m/s]; never below -9."""
    room = MIN_GAP + max(0.0, speed * HEADWAY + speed * closing / (2 * math.sqrt(ACCELERATION * BRAKING)))
    return max(-9.0, ACCELERATION * (1 - (speed / wished) ** 4 - (room / max(gap, 0.1)) ** 2))


def drive(sumo: traci.connection.Connection) -> None:
    """Drive until the server ends this simulation."""
    step, vehicle = sumo.simulation.getDeltaT(), sumo.vehicle
    while True:
        sumo.simulationStep()
        if EGO in vehicle.getIDList():
            speed, leader = vehicle.getSpeed(EGO), vehicle.getLeader(EGO, 150.0)
            there = leader is not None and leader[0] != ""
            gap = leader[1] + vehicle.getMinGap(EGO) if there else math.inf
            closing = speed - vehicle.getSpeed(leader[0]) if there else 0.0
            acceleration = idm(speed, vehicle.getAllowedSpeed(EGO), gap, closing)
            vehicle.setSpeedMode(EGO, 30)
            vehicle.setSpeed(EGO, max(0.0, speed + acceleration * step))


def main(port: int = 8813, host: str = "127.0.0.1") -> None:
    """Connect, and connect again whenever the server begins a new simulation; end when it has gone."""
    last = time.monotonic()
    while time.monotonic() - last < 10.0:
        try:
            sumo = traci.connect(port, numRetries=0, host=host)
            sumo.setOrder(2)
            last = math.inf
            drive(sumo)
        except (traci.FatalTraCIError, OSError):  # no server yet, or it has closed this simulation
            last = min(last, time.monotonic())
            time.sleep(0.1)


if __name__ == "__main__":
    main(*(kind(text) for kind, text in zip((int, str), sys.argv[1:], strict=False)))
