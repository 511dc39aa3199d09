"""Convert maps of other formats to SUMO networks: OpenDRIVE and OpenStreetMap, by SUMO's ``netconvert``.

A conversion is kept in the user's cache under the map's content, so that no map is converted twice. A run's folder
holds a copy of the network, as for any other input. ``MapConversion`` says what the network contains and what it lacks.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.files import keep_newest, scratch_prefix, user_folder
from sumo_adv.parsing import read_json
from sumo_adv.simulation import map_content, opendrive, openstreetmap
from sumo_adv.simulation.map_content import MapContent
from sumo_adv.simulation.network_counts import CAR_LANES, count_network
from sumo_adv.simulation.opendrive import TYPE_MAP, read_opendrive
from sumo_adv.simulation.openstreetmap import read_openstreetmap
from sumo_adv.simulation.programs import find_netconvert, find_type_maps
from sumo_adv.simulation.warnings_log import WarningKind, kinds_of, said_of, warnings_in, with_names

OPENDRIVE = (".xodr", ".xodr.gz")
OPENSTREETMAP = (".osm", ".osm.gz", ".osm.xml", ".osm.xml.gz")
MAPS = (*OPENDRIVE, *OPENSTREETMAP)
PACKED = (".osm.pbf", ".osm.bz2", ".pbf")  # formats that netconvert does not read
CONVERSION_TIMEOUT_S = 600.0  # of one conversion; a town takes seconds
MAX_CACHED_MAPS = 100  # conversions in the cache; the oldest are removed first
MAX_NAMED_WAY_KINDS = 6  # maximum number of lost kinds that a sentence names
CONVERSION_FILE = "conversion.json"
# Files that netconvert reads and writes.
MAP_FILE = "map.xml"
OWN_TYPES_FILE = "own.typ.xml"
MADE_NETWORK_FILE = "made.net.xml"

COMMON = (
    "--keep-edges.by-vclass", "passenger", "--ramps.guess", "--junctions.join", "--output.original-names",
    "--xml-validation", "never",
)  # fmt: skip
"""Options for driving: only roads for cars (with their sidewalks and cycle lanes), ramps with acceleration lanes, and
one junction where a map has several nodes.
"""
OF_OPENSTREETMAP = (
    "--osm.sidewalks", "--osm.bike-access", "--osm.lane-access", "--osm.turn-lanes", "--geometry.remove",
    "--roundabouts.guess", "--tls.guess-signals", "--tls.discard-simple", "--tls.join",
)  # fmt: skip
"""Further options for OpenStreetMap, which SUMO's page on importing it also recommends."""
CONNECTED = ("--remove-edges.isolated",)
"""Removes isolated pieces of road at the rim of an OpenStreetMap extract. It is used unless no road for cars would
remain.
"""
TYPE_MAPS = {
    "osm": ("osmNetconvert.typ.xml", "osmNetconvertPedestrians.typ.xml"),
    "opendrive": (
        "opendriveNetconvert.typ.xml", "opendriveNetconvertPedestrians.typ.xml", "opendriveNetconvertBicycle.typ.xml",
    ),
}  # fmt: skip
READERS = {"osm": read_openstreetmap, "opendrive": read_opendrive}


@dataclass(frozen=True, slots=True)
class MapConversion:
    """A converted map.

    Attributes:
        path: The map.
        network: The SUMO network.
        options: The options of netconvert.
        lost: What the network lacks, as a number by kind.
        said: Sentences on what was converted and lost, and on netconvert's warnings.
        warnings: All kinds of netconvert's warnings.
    """

    path: Path
    network: Path
    options: tuple[str, ...]
    lost: Mapping[str, int]
    said: tuple[str, ...]
    warnings: tuple[WarningKind, ...] = ()


def is_map(path: Path) -> bool:
    """Return whether the file's name is that of a map of another format."""
    return path.name.lower().endswith((*MAPS, *PACKED))


def convert_map(path: Path, *, cache: Path | None = None) -> MapConversion:
    """Return a map as a network, from the cache or by converting it now.

    Args:
        path: The map.
        cache: The folder of the cache; None means the user's.

    Returns:
        The conversion.

    Raises:
        UsageError: The map is damaged, of another format, or has no road for cars; netconvert is missing or fails.
    """
    name = path.name.lower()
    if name.endswith(PACKED):
        raise UsageError(f"{path} is packed in a way that netconvert does not read: write it as .osm or .osm.gz first.")
    form = "osm" if name.endswith(OPENSTREETMAP) else "opendrive"
    stem = path.name[: -len(next(ending for ending in sorted(MAPS, key=len, reverse=True) if name.endswith(ending)))]
    place = _cache(cache) / _key(path)
    kept = _kept(path, stem, place)
    if kept is not None:
        return kept
    content = READERS[form](path)
    if content.roads == 0:
        raise UsageError(f"{path} has no road: nothing can be run there; choose another part of the map.")
    options = (*COMMON, *(OF_OPENSTREETMAP if form == "osm" else ()), *(("--lefthand",) if content.left_hand else ()))
    with tempfile.TemporaryDirectory(dir=place.parent, prefix="unfinished-") as scratch:
        folder = Path(scratch)
        (folder / "made").mkdir()
        content.write(folder / MAP_FILE)
        (folder / OWN_TYPES_FILE).write_text(TYPE_MAP, encoding="utf-8")
        report = None
        for chosen in ((*options, *CONNECTED), options) if form == "osm" else (options,):
            warned = _netconvert(form, path, folder, chosen) if report is None else None
            if warned is not None:
                report = _report(path, content, folder / MADE_NETWORK_FILE, chosen, warned)
        if report is None:
            raise UsageError(f"{path} has no road for cars: nothing can be run there; choose another part of the map.")
        (folder / MADE_NETWORK_FILE).rename(folder / "made" / f"{stem}.net.xml")
        (folder / "made" / CONVERSION_FILE).write_text(json.dumps(report, indent=2), encoding="utf-8")
        with contextlib.suppress(OSError):  # another process was faster, and its files are the same
            (folder / "made").rename(place)
    keep_newest((p for p in place.parent.iterdir() if (p / CONVERSION_FILE).is_file()), MAX_CACHED_MAPS)
    whole = _kept(path, stem, place)
    if whole is None:
        raise UsageError(f"The conversion of {path} cannot be kept in {place}: make room there, or set XDG_CACHE_HOME.")
    return whole


def _cache(given: Path | None) -> Path:
    """Return the folder of conversions, or a temporary one if the user's cannot be written."""
    folder = user_folder("cache", os.environ, sys.platform, None) / "maps" if given is None else given
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix=scratch_prefix()))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _key(path: Path) -> str:
    """Return a hash of the file's name and content, SUMO's version and the sources of the conversion."""
    try:
        content = hashlib.sha256(path.read_bytes())
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    sources = [Path(str(module.__file__)).read_bytes() for module in (map_content, opendrive, openstreetmap)]
    content.update(repr((path.name, version("libsumo"), Path(__file__).read_bytes(), sources)).encode())
    return content.hexdigest()[:32]


def _kept(path: Path, stem: str, place: Path) -> MapConversion | None:
    """Return the complete conversion at ``place``, or None."""
    try:
        report = read_json(place / CONVERSION_FILE)
        os.utime(place)
    except (OSError, ValueError):
        return None
    warnings = tuple(WarningKind(each["first"], each["count"]) for each in report["warnings"])
    network = place / f"{stem}.net.xml"
    return MapConversion(path, network, tuple(report["options"]), dict(report["lost"]), tuple(report["said"]), warnings)


def _netconvert(form: str, path: Path, folder: Path, options: Sequence[str]) -> tuple[str, ...] | None:
    """Write ``MADE_NETWORK_FILE`` from ``MAP_FILE``, without the comment that holds paths and the time.

    All file names are relative, because netconvert misreads a comma or colon in a path.

    Returns:
        netconvert's warnings; None if nothing of the map is left.
    """
    program = find_netconvert()
    types = ",".join((*(str(find_type_maps(program) / name) for name in TYPE_MAPS[form]), OWN_TYPES_FILE))
    command = [str(program), f"--{form}-files", MAP_FILE, "--type-files", types, *options, "-o", MADE_NETWORK_FILE]
    target = folder / MADE_NETWORK_FILE
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=CONVERSION_TIMEOUT_S, cwd=folder
        )
    except subprocess.TimeoutExpired as error:
        raise UsageError(
            f"{path} took netconvert more than {CONVERSION_TIMEOUT_S:g} s: "
            "cut out the part that you need, and give that."
        ) from error
    except OSError as error:
        raise UsageError(f"netconvert could not be started ({error}): install it again.") from error
    if done.returncode != 0 or not target.is_file():
        errors = [line.removeprefix("Error: ") for line in done.stderr.splitlines() if line.startswith("Error")]
        if any("No edges loaded" in line or "No nodes loaded" in line for line in errors):
            return None
        reason = errors[0].rstrip(".").replace(MAP_FILE, path.name) if errors else f"exit status {done.returncode}"
        raise UsageError(f"netconvert could not convert {path} ({reason}): correct the map, or convert it by hand.")
    written = target.read_text(encoding="utf-8")
    target.write_text(re.sub(r"<!--.*?-->\s*", "", written, count=1, flags=re.DOTALL), encoding="utf-8")
    return tuple(with_names(each, {MAP_FILE: path.name}) for each in warnings_in(done.stderr))


def _report(
    path: Path, content: MapContent, network: Path, options: Sequence[str], warned: Sequence[str]
) -> dict[str, object] | None:
    """Return the content of ``CONVERSION_FILE``; None if the network has no lane for cars."""
    counts = count_network(network)
    for_cars = counts.lanes[CAR_LANES]
    if not for_cars:
        return None
    missing = Counter(kind for name, kind in content.kinds.items() if name not in counts.original_ids)
    lost = dict(missing.most_common()) | dict(content.lost)
    said = [
        f"Converted {path.name} with netconvert: {counts.edges['normal']} edges with {for_cars} lanes for cars and "
        f"{sum(counts.lanes.values()) - for_cars} others, {sum(counts.junctions.values())} junctions, "
        f"{counts.others['tlLogic']} traffic lights"
        f"{_side(content)}."
    ]
    if lost:
        said.append(f"Left out: {_named(lost)}.")
    kinds = kinds_of(warned)
    return {
        "map": path.name, "options": list(options), "lost": lost, "said": [*said, *said_of(kinds, "netconvert")],
        "warnings": [asdict(kind) for kind in kinds],
    }  # fmt: skip


def _side(content: MapContent) -> str:
    """Return the side of the traffic, for a sentence; empty if the map says that it is the right one."""
    if content.left_hand:
        return ", left-hand traffic"
    return "" if content.says_side else ", right-hand traffic (the map does not say)"


def _named(lost: Mapping[str, int]) -> str:
    """Return the lost kinds with their numbers, for a sentence."""
    kinds = [f"{number} {kind}" for kind, number in lost.items()]
    more = len(kinds) - MAX_NAMED_WAY_KINDS
    return ", ".join(kinds[:MAX_NAMED_WAY_KINDS]) + (
        f", and {more} further kinds ({CONVERSION_FILE})" if more > 0 else ""
    )
