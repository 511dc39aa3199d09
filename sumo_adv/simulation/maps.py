"""Maps of other formats as SUMO networks: OpenDRIVE and OpenStreetMap, converted by SUMO's ``netconvert``.

A conversion is kept in the user's cache under the map's content, so that nothing is converted twice; a run's folder
holds a copy of the network like that of any other input. ``Conversion`` counts what the network has, and names what it
lacks.
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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.files import scratch_prefix, user_folder
from sumo_adv.parsing import read_json
from sumo_adv.simulation.programs import find_netconvert, find_type_maps
from sumo_adv.simulation.scan import allows_passenger, parse

OPENDRIVE = (".xodr", ".xodr.gz")
OPENSTREETMAP = (".osm", ".osm.gz", ".osm.xml", ".osm.xml.gz")
MAPS = (*OPENDRIVE, *OPENSTREETMAP)
PACKED = (".osm.pbf", ".osm.bz2", ".pbf")  # that netconvert does not read
PATIENCE = 600.0  # s, of one conversion: a town takes seconds
MOST_KEPT = 100  # conversions in the cache; the oldest go first
MOST_KINDS = 6  # of lost ways that a line names
REPORT = "conversion.json"

COMMON = (
    "--keep-edges.by-vclass", "passenger", "--remove-edges.isolated", "--ramps.guess", "--junctions.join",
    "--output.original-names", "--flatten", "--xml-validation", "never",
)  # fmt: skip
"""For driving: only roads for cars (with their sidewalks and cycle lanes), ramps with acceleration lanes, one junction
where a map has several nodes, no heights."""
OF_OPENSTREETMAP = (
    "--osm.sidewalks", "--geometry.remove", "--roundabouts.guess", "--tls.guess-signals", "--tls.discard-simple",
    "--tls.join",
)  # fmt: skip
"""Also the recommendation of SUMO's page on importing OpenStreetMap."""
TYPES = {
    "osm": ("osmNetconvert.typ.xml", "osmNetconvertPedestrians.typ.xml"),
    "opendrive": ("opendriveNetconvert.typ.xml", "opendriveNetconvertPedestrians.typ.xml"),
}


@dataclass(frozen=True, slots=True)
class Conversion:
    """A converted map. network: the SUMO network. options: netconvert's. lost: what the network lacks, by kind. said:
    one to three sentences on what was converted and lost."""

    source: Path
    network: Path
    options: tuple[str, ...]
    lost: Mapping[str, int]
    said: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Content:
    """What a map holds: the kind of each road (or of each lane ``ROAD_LANE`` of OpenDRIVE), the number of roads, and
    whether it has heights and left-hand traffic."""

    kinds: Mapping[str, str]
    roads: int
    heights: bool
    left_hand: bool


def is_map(path: Path) -> bool:
    """Whether the file's name is that of a map of another format."""
    return path.name.lower().endswith((*MAPS, *PACKED))


def convert_map(path: Path, *, cache: Path | None = None) -> Conversion:
    """The map at ``path`` as a network, from the cache (default: the user's) or made now. Raises UsageError: the file
    is damaged, of another format, or has no road for cars; netconvert is missing or fails."""
    name = path.name.lower()
    if name.endswith(PACKED):
        raise UsageError(f"{path} is packed in a way that netconvert does not read: write it as .osm or .osm.gz first.")
    form = "osm" if name.endswith(OPENSTREETMAP) else "opendrive"
    stem = path.name[: -len(next(ending for ending in sorted(MAPS, key=len, reverse=True) if name.endswith(ending)))]
    content = _read_osm(path) if form == "osm" else _read_opendrive(path)
    if content.roads == 0:
        raise UsageError(f"{path} has no road: nothing can be run there; choose another part of the map.")
    program = find_netconvert()
    options = [*COMMON, *(OF_OPENSTREETMAP if form == "osm" else ()), *(("--lefthand",) if content.left_hand else ())]
    place = _cache(cache) / _key(path, options)
    kept = _kept(path, stem, place)
    if kept is not None:
        return kept
    with tempfile.TemporaryDirectory(dir=place.parent, prefix="unfinished-") as scratch:
        made = Path(scratch) / "made"
        made.mkdir()
        _netconvert(program, form, path, made / f"{stem}.net.xml", options)
        report = _report(path, content, made / f"{stem}.net.xml", options)
        (made / REPORT).write_text(json.dumps(report, indent=2), encoding="utf-8")
        with contextlib.suppress(OSError):  # another process was faster: its files are the same
            made.rename(place)
    _trim(place.parent)
    whole = _kept(path, stem, place)
    if whole is None:
        raise UsageError(f"The conversion of {path} cannot be kept in {place}: make room there, or set XDG_CACHE_HOME.")
    return whole


def _cache(given: Path | None) -> Path:
    """The folder of conversions; a temporary one where the user's cannot be written."""
    folder = user_folder("cache", os.environ, sys.platform, None) / "maps" if given is None else given
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix=scratch_prefix()))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _key(path: Path, options: Sequence[str]) -> str:
    try:
        content = hashlib.sha256(path.read_bytes())
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    content.update(repr((path.name, options, version("libsumo"), Path(__file__).read_bytes())).encode())
    return content.hexdigest()[:32]


def _kept(path: Path, stem: str, place: Path) -> Conversion | None:
    """The whole conversion at ``place``, or None."""
    try:
        report = read_json(place / REPORT)
        os.utime(place)
    except (OSError, ValueError):
        return None
    return Conversion(
        path, place / f"{stem}.net.xml", tuple(report["options"]), dict(report["lost"]), tuple(report["said"])
    )


def _trim(cache: Path) -> None:
    """Remove the oldest conversions beyond ``MOST_KEPT``."""
    with contextlib.suppress(OSError):
        kept = sorted((p for p in cache.iterdir() if (p / REPORT).is_file()), key=lambda p: p.stat().st_mtime)
        for old in kept[:-MOST_KEPT]:
            shutil.rmtree(old, ignore_errors=True)


def _parse_map(path: Path, start: Callable[[str, dict[str, str]], None], root: str) -> None:
    """``parse`` of a file that must begin with the element ``root``."""
    seen = False

    def checked(tag: str, attributes: dict[str, str]) -> None:
        nonlocal seen
        if not seen and tag != root:
            raise UsageError(f"{path} is no map of its ending: its root element is <{tag[:40]}>, not <{root}>.")
        seen = True
        start(tag, attributes)

    parse(path, checked)


def _read_osm(path: Path) -> _Content:
    kinds: dict[str, str] = {}
    way, left = "", False

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal way, left
        if tag in ("way", "node", "relation"):
            way = attributes.get("id", "") if tag == "way" else ""
        elif tag == "tag" and way:
            key, value = attributes.get("k", ""), attributes.get("v", "")
            if key == "highway":
                kinds[way] = value
            elif key == "railway":
                kinds.setdefault(way, f"railway {value}")
            left = left or (key == "driving_side" and value == "left")

    _parse_map(path, start, "osm")
    roads = sum(not kind.startswith("railway") for kind in kinds.values())
    return _Content(kinds, roads, False, left)


def _read_opendrive(path: Path) -> _Content:
    kinds: dict[str, str] = {}
    roads, left = 0, 0
    road, heights = "", False

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal roads, left, road, heights
        if tag == "road":
            road, roads = attributes.get("id", ""), roads + 1
            left += attributes.get("rule") == "LHT"
        elif tag == "elevation":
            heights = heights or any(attributes.get(k, "0").strip("-+0.eE") for k in "abcd")
        elif tag == "lane" and attributes.get("type", "none") != "none":
            kinds[f"{road}_{attributes.get('id', '')}"] = f"lane {attributes['type']}"

    _parse_map(path, start, "OpenDRIVE")
    return _Content(kinds, roads, heights, 2 * left > roads)


def _netconvert(program: Path, form: str, path: Path, target: Path, options: Sequence[str]) -> None:
    """Write the network, without the comment that holds paths and the time."""
    folder = find_type_maps(program)
    types = ",".join(str(folder / name) for name in TYPES[form])
    command = [str(program), f"--{form}-files", str(path.resolve()), "--type-files", types, *options]
    try:
        done = subprocess.run(
            [*command, "-o", str(target)], capture_output=True, text=True, check=False, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired as error:
        raise UsageError(
            f"{path} took netconvert more than {PATIENCE:g} s: cut out the part that you need, and give that."
        ) from error
    except OSError as error:
        raise UsageError(f"netconvert could not be started ({error}): install it again.") from error
    if done.returncode != 0 or not target.is_file():
        errors = [line.removeprefix("Error: ") for line in done.stderr.splitlines() if line.startswith("Error")]
        if any("No edges loaded" in line or "No nodes loaded" in line for line in errors):
            raise UsageError(f"{path} has no road for cars: nothing can be run there; choose another part of the map.")
        reason = errors[0].rstrip(".") if errors else f"exit status {done.returncode}"
        raise UsageError(f"netconvert could not convert {path} ({reason}): correct the map, or convert it by hand.")
    text = target.read_text(encoding="utf-8")
    target.write_text(re.sub(r"<!--.*?-->\s*", "", text, count=1, flags=re.DOTALL), encoding="utf-8")


def _report(path: Path, content: _Content, network: Path, options: Sequence[str]) -> dict[str, object]:
    """What ``REPORT`` holds."""
    counts: Counter[str] = Counter()
    kept: set[str] = set()
    function = ""

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal function
        if tag == "edge":
            function = attributes.get("function", "normal")
            counts["edges"] += function == "normal"
        elif tag == "lane" and function == "normal":
            counts["lanes" if allows_passenger(attributes) else "other lanes"] += 1
        elif tag == "junction":
            counts["junctions"] += attributes.get("type") not in ("internal", "dead_end")
        elif tag == "tlLogic":
            counts["lights"] += 1
        elif tag == "param" and attributes.get("key") == "origId":
            kept.update(attributes.get("value", "").split())

    parse(network, start)
    missing = Counter(kind for name, kind in content.kinds.items() if name not in kept)
    lost = dict(missing.most_common()) | ({"heights": 1} if content.heights else {})
    said = [
        f"Converted {path.name} with netconvert: {counts['edges']} edges with {counts['lanes']} lanes for cars and "
        f"{counts['other lanes']} others, {counts['junctions']} junctions, {counts['lights']} traffic lights"
        f"{', left-hand traffic' if content.left_hand else ''}."
    ]
    if lost:
        said.append(f"Left out: {_named(lost)}.")
    return {"map": path.name, "options": list(options), "lost": lost, "said": said}


def _named(lost: Mapping[str, int]) -> str:
    kinds = [f"{number} {kind}" if kind != "heights" else "heights" for kind, number in lost.items()]
    more = len(kinds) - MOST_KINDS
    return ", ".join(kinds[:MOST_KINDS]) + (f", and {more} further kinds ({REPORT})" if more > 0 else "")
