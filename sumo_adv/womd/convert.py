"""Convert a record to a folder that ``run`` accepts, and keep the folder in the user's cache.

The cache key is the SHA-256 of the record's bytes with the program's version and the sources of this package, so that a
changed converter converts again. A folder is written elsewhere in the cache, and moved to its place when it is
complete.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from time import perf_counter
from typing import Any
from xml.etree import ElementTree

from sumo_adv import __version__
from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.files import keep_newest, scratch_prefix, user_folder, write_text
from sumo_adv.parsing import read_json
from sumo_adv.simulation.demand import generate_demand
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.simulation.scenario import NETWORK_FILE, SCENARIO_FILE
from sumo_adv.womd.record import Record, evenly_sampled
from sumo_adv.womd.scene import write_scene

FIDELITY_FILE, FIDELITY_PICTURE = "fidelity.json", "fidelity.png"
MAX_CACHED_RECORDS = 300  # conversions in the cache; the oldest are removed first
TRAFFIC_TRIAL_DURATION_S = 120.0
TELEPORT_TIME_S = 60.0  # SUMO teleports a vehicle that has stood still for this long
TRAFFIC_TRIAL_TIMEOUT_S = 120.0  # wall time
_TELEPORT = re.compile(r"Teleporting vehicle '[^']*'; ([^,]*), lane='([^']*)', time=([0-9.]+)\.")


@dataclass(frozen=True, slots=True)
class RecordConversion:
    """A converted record.

    Attributes:
        folder: The folder with its files.
        report: Its fidelity report.
        cached: Whether it had been converted before.
    """

    folder: Path
    report: Mapping[str, Any]
    cached: bool

    @property
    def scenario(self) -> Path:
        """The scenario file."""
        return self.folder / SCENARIO_FILE


def convert_record(record: Record, folder: Path, *, traffic: bool) -> dict[str, Any]:
    """Write the network, scenario, tracks, routes and fidelity report of a record.

    Args:
        record: The record.
        folder: Where the files are written.
        traffic: Whether to also try random traffic.

    Returns:
        The report.

    Raises:
        SumoAdvError: The record cannot be converted.
    """
    from sumo_adv.womd.fidelity import draw_fidelity, measure_fidelity
    from sumo_adv.womd.matching import read_net
    from sumo_adv.womd.network import convert_network

    began, cpu = perf_counter(), sum(os.times()[:4])  # CPU time of this process and its children, such as netconvert
    record, sampling = evenly_sampled(record)
    converted = convert_network(record, folder)
    seconds = {"network": converted.seconds, "network_cpu": round(sum(os.times()[:4]) - cpu, 3)}
    net = read_net(converted.path)
    fidelity = measure_fidelity(record, net, converted)
    write_scene(record, net, fidelity.matched, folder)
    draw_fidelity(folder / FIDELITY_PICTURE, record, net, fidelity)
    seconds["all"] = perf_counter() - began
    scenario = {
        "ego": record.tracks[record.sdc].id, "objects_of_interest": list(record.objects_of_interest),
        "to_predict": [record.tracks[i].id for i in record.to_predict],
    }  # fmt: skip
    report = {
        **fidelity.report, "scenario": scenario, "sampling": {**asdict(sampling), "note": sampling.sentence},
        "traffic": None, "seconds": seconds,
    }  # fmt: skip
    return _written(folder, report, traffic=traffic)


def _written(folder: Path, report: dict[str, Any], *, traffic: bool) -> dict[str, Any]:
    """Write the report, after a trial of random traffic if ``traffic`` is set."""
    if traffic:
        report = {**report, "traffic": random_traffic(folder / NETWORK_FILE)}
    write_text(folder / FIDELITY_FILE, json.dumps(report, indent=2, allow_nan=False) + "\n")
    return report


@contextlib.contextmanager
def conversion(record: Record, *, traffic: bool, cache: Path | None = None) -> Iterator[RecordConversion]:
    """Provide the conversion of a record, from the cache or by converting it now.

    If the cache cannot be written, the folder exists only within the context.

    Args:
        record: The record.
        traffic: Whether the report must include a trial of random traffic.
        cache: The folder of the cache; None means the user's.

    Yields:
        The conversion.

    Raises:
        SumoAdvError: As for :func:`convert_record`.
    """
    key = hashlib.sha256(f"{record.content} {__version__} {_package_hash()}".encode()).hexdigest()
    place = (cache or cache_folder()) / key[:32] / record.scenario_id
    report = _known(place)
    if report is not None:
        if traffic and report.get("traffic") is None:
            report = _written(place, report, traffic=True)
        with contextlib.suppress(OSError):
            os.utime(place.parent)
        yield RecordConversion(place, report, cached=True)
        return
    with contextlib.ExitStack() as stack:
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            kept, stage = True, Path(stack.enter_context(tempfile.TemporaryDirectory(dir=place.parent)))
        except OSError:
            kept, stage = False, Path(stack.enter_context(tempfile.TemporaryDirectory(prefix=scratch_prefix())))
        made = stage / record.scenario_id
        made.mkdir()
        report = convert_record(record, made, traffic=traffic)
        if kept:
            with contextlib.suppress(OSError):  # another process was faster, and its files are the same
                made.rename(place)
            made = place
            keep_newest((p for p in place.parent.parent.iterdir() if p.is_dir()), MAX_CACHED_RECORDS)
        yield RecordConversion(made, report, cached=False)


def _known(place: Path) -> dict[str, Any] | None:
    """Return the report of a complete conversion at ``place``, or None."""
    try:
        return dict(read_json(place / FIDELITY_FILE))
    except (OSError, ValueError, TypeError):
        return None


@lru_cache(maxsize=1)
def _package_hash() -> str:
    """Return a hash of this package's sources."""
    content = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py")))
    return hashlib.sha256(content).hexdigest()


def cache_folder(
    environ: Mapping[str, str] = os.environ, platform: str = sys.platform, home: Path | None = None
) -> Path:
    """Return where conversions are kept, in the user's cache folder (:func:`~sumo_adv.files.user_folder`)."""
    return user_folder("cache", environ, platform, home) / "womd"


def random_traffic(network: Path, *, seed: int = 0, duration: float = TRAFFIC_TRIAL_DURATION_S) -> dict[str, Any]:
    """Run SUMO with generated traffic of the default density.

    Args:
        network: The network file.
        seed: The seed of the traffic and of SUMO.
        duration: The simulated time [s].

    Returns:
        The numbers of ``vehicles``, ``collisions`` and ``teleports``, and in ``events`` the place and time of each
        collision and teleport. If the network has no route, the numbers are 0 and ``note`` gives the reason.

    Raises:
        SimulationError: SUMO fails.
        UsageError: SUMO is not installed.
    """
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        folder = Path(scratch)
        try:
            demand = generate_demand(network, folder / "demand.rou.xml", seed=seed, end=duration)
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
    """Return SUMO's warnings of teleports in short form; SUMO has no other output for teleports."""
    return [f"teleport ({why}) from {lane} at {float(time):.1f} s" for why, lane, time in _TELEPORT.findall(warnings)]


def _sumo(network: Path, demand: Path, folder: Path, seed: int, duration: float) -> str:
    """Run SUMO, and return its warnings."""
    netconvert = find_netconvert()
    sumo = netconvert.with_name(netconvert.name.replace("netconvert", "sumo"))  # SUMO's programs are installed together
    command = [
        str(sumo), "-n", str(network), "-r", str(demand), "--end", str(duration), "--seed", str(seed),
        "--step-length", "0.1", "--collision.action", "warn", "--collision.mingap-factor", "0",
        "--collision.check-junctions", "true", "--lanechange.duration", "3", "--time-to-teleport", str(TELEPORT_TIME_S),
        "--statistic-output", str(folder / "statistics.xml"), "--collision-output", str(folder / "collisions.xml"),
        "--xml-validation", "never", "--no-step-log", "true",
    ]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TRAFFIC_TRIAL_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise SimulationError(f"Random traffic could not be tried on {network}: {error}.") from error
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[0]
        raise SimulationError(f"Random traffic could not be tried on {network}: SUMO says '{reason}'.")
    return done.stderr
