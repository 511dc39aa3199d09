"""Random traffic as a trial of a network: does it run without collisions and teleports? In a process of its own."""

from __future__ import annotations

import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.simulation.demand import generate
from sumo_adv.simulation.programs import find_netconvert

DURATION = 120.0  # s
PATIENCE = 60.0  # s without a move after which SUMO teleports a vehicle
TIME_LIMIT = 120.0  # s of wall time
_TELEPORT = re.compile(r"Teleporting vehicle '[^']*'; ([^,]*), lane='([^']*)', time=([0-9.]+)\.")


def random_traffic(network: Path, *, seed: int = 0, duration: float = DURATION) -> dict[str, Any]:
    """Runs generated traffic of the default density for ``duration`` s: vehicles, collisions, teleports, and the place
    and time of each of those (``events``).

    A network without any route has no traffic: ``note`` says so. Raises SimulationError if SUMO fails,
    UsageError if it is not installed.
    """
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
        folder = Path(scratch)
        try:
            demand = generate(network, folder / "demand.rou.xml", seed=seed, end=duration)
        except UsageError as error:
            return {"vehicles": 0, "collisions": 0, "teleports": 0, "events": [], "note": str(error)}
        warnings = _sumo(network, demand, folder, seed, duration)
        root = ElementTree.parse(folder / "statistics.xml").getroot()
        events = ElementTree.parse(folder / "collisions.xml").getroot()
        teleports, vehicles = root.find("teleports"), root.find("vehicles")
        assert teleports is not None and vehicles is not None
        pairs: dict[frozenset[str], str] = {}
        for c in events.iter("collision"):
            event = f"collision ({c.attrib['type']}) on {c.attrib['lane']} at {float(c.attrib['time']):.1f} s"
            pairs.setdefault(frozenset((c.attrib["collider"], c.attrib["victim"])), event)
        return {
            "vehicles": int(vehicles.attrib["inserted"]), "collisions": len(pairs),
            "teleports": int(teleports.attrib["total"]), "events": [*pairs.values(), *_teleports(warnings)],
        }  # fmt: skip


def _teleports(warnings: str) -> list[str]:
    """SUMO's warnings of teleports, shortened: it has no other output for them."""
    return [f"teleport ({why}) from {lane} at {float(time):.1f} s" for why, lane, time in _TELEPORT.findall(warnings)]


def _sumo(network: Path, demand: Path, folder: Path, seed: int, duration: float) -> str:
    """Run SUMO; its warnings."""
    netconvert = find_netconvert()
    sumo = netconvert.with_name(netconvert.name.replace("netconvert", "sumo"))  # they are installed together
    command = [
        str(sumo), "-n", str(network), "-r", str(demand), "--end", str(duration), "--seed", str(seed),
        "--step-length", "0.1", "--collision.action", "warn", "--collision.mingap-factor", "0",
        "--collision.check-junctions", "true", "--lanechange.duration", "3", "--time-to-teleport", str(PATIENCE),
        "--statistic-output", str(folder / "statistics.xml"), "--collision-output", str(folder / "collisions.xml"),
        "--xml-validation", "never", "--no-step-log", "true",
    ]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIME_LIMIT, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SimulationError(f"Random traffic could not be tried on {network}: {error}.") from error
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[0]
        raise SimulationError(f"Random traffic could not be tried on {network}: SUMO says '{reason}'.")
    return done.stderr
