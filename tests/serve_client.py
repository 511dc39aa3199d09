"""A client that lets SUMO drive its ego and counts: ``serve_client.py PORT [FILE [FLAG]]``.

FILE gets a line a simulation: its steps, and the times [s] it saw first and last. It hangs once the file FLAG exists.
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import traci


def main(port: int, file: str = "", flag: str = "") -> None:
    """Step until the server has gone for three seconds."""
    last = time.monotonic()
    while time.monotonic() - last < 3.0:
        times: list[float] = []
        try:
            sumo = traci.connect(port, numRetries=0, host="127.0.0.1")
            last = math.inf
            while True:
                sumo.simulationStep()
                times.append(sumo.simulation.getTime())
                if flag and Path(flag).exists():
                    time.sleep(3600.0)
        except (traci.FatalTraCIError, OSError):
            last = min(last, time.monotonic())
            if times and file:
                with Path(file).open("a", encoding="utf-8") as kept:
                    kept.write(json.dumps({"steps": len(times), "first": times[0], "last": times[-1]}) + "\n")
            time.sleep(0.1)


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
