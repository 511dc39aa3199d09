"""Read SUMO's files as a stream, to find the ids in them.

The files may be gzipped. Expat reads them without building a tree: 5 MB take about 0.1 s.
"""

from __future__ import annotations

import gzip
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from sumo_adv import parsing
from sumo_adv.consistency import MAX_INPUT_COORDINATE_M
from sumo_adv.errors import UsageError
from sumo_adv.simulation.permissions import CAR, classes_of, is_paved
from sumo_adv.simulation.simulation_spec import check_nameable
from sumo_adv.simulation.sumo_options import NO_JUNCTIONS
from sumo_adv.simulation.sumo_states import PERSON

MAX_LANE_NUMBER = 1e6  # upper bound of lengths [m] and speeds [m/s]; beyond any real lane
_Handler = Callable[[str, dict[str, str]], None]
_TextHandler = Callable[[str], None]
ENCODINGS = ("utf-8", "utf-16", "iso-8859-1", "us-ascii", "ascii")  # encodings that expat supports itself
_DRIVING = ("vehicle", "trip", "flow")
READ = {"include": "href", "variableSpeedSign": "file", "calibrator": "file"}
"""Elements that name a file for SUMO to read, and the attribute that holds the name."""


@dataclass(frozen=True, slots=True)
class NetworkScan:
    """Edges of a network.

    Attributes:
        edges: The edges outside junctions.
        drivable: Those of the edges that have a lane for passenger cars.
    """

    edges: frozenset[str]
    drivable: frozenset[str]


@dataclass(frozen=True, slots=True)
class DemandScan:
    """Contents of a route or additional file.

    Attributes:
        edges: The edges, in order of first use.
        vehicles: The ids of vehicles and trips.
        flows: The ids of flows; their vehicles are ``flow.0``, ``flow.1`` and so on.
        persons: ``person:ID`` of each person and each flow of persons.
        files: The other files that the file names.
    """

    edges: tuple[str, ...]
    vehicles: frozenset[str]
    flows: frozenset[str]
    persons: frozenset[str]
    files: tuple[Path, ...] = ()

    def has(self, vehicle: str) -> bool:
        """Return whether a vehicle can come from the file.

        Args:
            vehicle: The id of a vehicle, or ``person:ID`` of a person.

        Returns:
            Whether the file defines the vehicle or person, or a flow that contains it.
        """
        flow = vehicle.rpartition(".")[0]
        return vehicle in self.vehicles | self.persons or flow in self.flows | self.persons


def scan_network(path: Path, shown: Path | None = None, *, cars: bool = True) -> NetworkScan:
    """Return the edges of a SUMO network.

    Args:
        path: The network file.
        shown: The file of the user that messages name, if the network was made from it.
        cars: Whether the network must have a lane for passenger cars. Otherwise, a lane for any road vehicle suffices.

    Returns:
        The edges.

    Raises:
        UsageError: The file is damaged or is not a SUMO network; a lane has an impossible length, width, speed or
            shape; the network has no usable lane, or no lanes on its junctions.
    """
    check_nameable(path)
    named = path if shown is None else shown
    edges: set[str] = set()
    drivable: set[str] = set()
    paved: list[bool] = []
    root: list[str] = []
    current, crossings, across = "", 0, 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal current, crossings, across
        if not root:
            root.append(tag)
            if tag != "net":
                raise UsageError(f"{named} is not a SUMO network: its root element is <{tag}>, not <net>.")
        if tag == "edge":
            current = attributes.get("id", "") if attributes.get("function", "normal") == "normal" else ""
            if current:
                edges.add(current)
        elif tag == "lane":
            _check_lane(named, attributes)
            if current and allows_passenger(attributes):
                drivable.add(current)
            paved.append(bool(current) and is_paved(classes_of(attributes)))
        elif tag == "connection":
            crossings += not attributes.get("from", ":").startswith(":")
            across += "via" in attributes

    parse_xml(path, start)
    if crossings and not across:
        raise UsageError(f"The network {named} has no lanes on its junctions: {NO_JUNCTIONS}.")
    if not (drivable if cars else any(paved)):
        kind = "passenger car" if cars else "vehicle of the road"
        raise UsageError(f"The network {named} has no lane that a {kind} may drive on: nothing can be run there.")
    return NetworkScan(frozenset(edges), frozenset(drivable))


def _check_lane(path: Path, lane: dict[str, str]) -> None:
    """Raise UsageError if no vehicle could be on a lane."""
    shape = lane.get("shape", "")
    try:
        length, width, speed = float(lane["length"]), float(lane.get("width", "3.2")), float(lane["speed"])
        places = [float(number) for number in shape.replace(",", " ").split()]
    except (KeyError, ValueError) as error:
        raise UsageError(_bad_lane(path, lane, f"lacks a number or has a wrong one ({error})")) from error
    if not 0.0 < length < MAX_LANE_NUMBER:
        raise UsageError(_bad_lane(path, lane, f"has a length of {lane['length']} m"))
    if not 0.0 < width < MAX_LANE_NUMBER or not 0.0 <= speed < MAX_LANE_NUMBER:
        raise UsageError(_bad_lane(path, lane, f"has a width of {width:g} m and a speed of {speed:g} m/s"))
    if len(shape.split()) < 2 or not all(abs(place) < MAX_INPUT_COORDINATE_M for place in places):
        raise UsageError(_bad_lane(path, lane, "has no shape of two places or more"))


def _bad_lane(path: Path, lane: dict[str, str], what: str) -> str:
    return f"The lane '{lane.get('id', '')[:80]}' of the network {path} {what}; rebuild the network with netconvert."


def allows_passenger(lane: dict[str, str]) -> bool:
    """Return whether the ``allow`` and ``disallow`` attributes of a lane admit passenger cars."""
    return CAR in classes_of(lane)


def scan_demand(path: Path) -> DemandScan:
    """Return the edges and vehicles of a SUMO route or additional file.

    Raises:
        UsageError: The file is damaged.
    """
    check_nameable(path)
    edges: dict[str, None] = {}
    vehicles: set[str] = set()
    flows: set[str] = set()
    persons: set[str] = set()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "route":
            edges.update(dict.fromkeys(attributes.get("edges", "").split()))
        elif tag in _DRIVING:
            (flows if tag == "flow" else vehicles).add(attributes.get("id", ""))
            for key in ("from", "via", "to"):
                if key in attributes:
                    edges.update(dict.fromkeys(attributes[key].split()))
        elif tag in ("person", "personFlow"):
            persons.add(PERSON + attributes.get("id", ""))

    files = parse_xml(path, start)
    return DemandScan(tuple(edges), frozenset(vehicles), frozenset(flows), frozenset(persons), files)


def scan_routes(files: Sequence[Path]) -> dict[str, tuple[str, ...]]:
    """Return the edges of every named route.

    Args:
        files: Route and additional files.

    Returns:
        The edges by the route's id.

    Raises:
        UsageError: A file is damaged.
    """
    routes: dict[str, tuple[str, ...]] = {}

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "route" and "id" in attributes:
            routes[attributes["id"]] = tuple(attributes.get("edges", "").split())

    for file in files:
        parse_xml(file, start)
    return routes


_FLOWS = ("flow", "personFlow", "containerFlow")
_DEPARTING = ("vehicle", "trip", "person", "container", *_FLOWS)
_LATER = ("triggered", "containerTriggered", "split")  # departures that another departure triggers


def first_departure(files: Sequence[Path], since: float = 0.0) -> float:
    """Return the earliest departure time [s].

    A flow without ``begin`` begins with its ``interval``, or with the simulation if it is in none. SUMO discards
    departures before the simulation begins.

    Args:
        files: Route and additional files.
        since: The begin of the simulation [s].

    Returns:
        The time [s]; ``since`` if no file gives a time from then on.

    Raises:
        UsageError: A file is damaged.
    """
    times: list[float] = []
    interval: dict[str, str] = {}  # the attributes of the open interval

    def see(tag: str, attributes: dict[str, str]) -> None:
        nonlocal interval
        if tag == "interval":
            interval = attributes
        elif tag in _FLOWS:
            begin, end = (attributes.get(key, interval.get(key)) for key in ("begin", "end"))
            if end is None or time_of(end) > since:
                times.append(max(time_of(begin), since))
        elif tag in _DEPARTING:
            text = attributes.get("depart", "0")
            if text not in _LATER and time_of(text) >= since:
                times.append(time_of(text))

    def leave(tag: str) -> None:
        nonlocal interval
        if tag == "interval":
            interval = {}

    def time_of(text: str | None) -> float:
        try:
            return parse_seconds(files[0], "departure", text) or 0.0
        except UsageError:  # a word instead of a time, such as now
            return since

    for file in files:
        parse_xml(file, see, leave)
    return min(times, default=since)


def parse_seconds(path: Path, key: str, value: str | None) -> float | None:
    """Parse a time of SUMO's files.

    Args:
        path: The file that messages name.
        key: What the time is, for messages.
        value: A number of seconds, ``h:m:s`` or ``d:h:m:s``; None if absent.

    Returns:
        The time [s]; None if it is absent or negative.

    Raises:
        UsageError: The value is not a time.
    """
    if value is None:
        return None
    try:
        total = 0.0
        for part, factor in zip(reversed(value.split(":")), (1.0, 60.0, 3600.0, 86400.0), strict=False):
            total += float(part) * factor
    except ValueError as error:
        raise UsageError(f"{path} has a bad {key} time '{value}': give seconds.") from error
    return total if total >= 0.0 else None


def parse_xml(
    path: Path, start: _Handler, end: _TextHandler | None = None, text: _TextHandler | None = None
) -> tuple[Path, ...]:
    """Pass the start and end of every element, and the text between, to handlers.

    Files that SUMO would read because this file names them (``READ``) are read too. The elements below their roots are
    passed at the place where the file is named.

    Args:
        path: The file.
        start: Receives the tag and attributes of an element that starts.
        end: Receives the tag of an element that ends.
        text: Receives pieces of text, only from the file itself.

    Returns:
        The other files that were read.

    Raises:
        UsageError: A file is damaged or missing, or includes itself.
    """
    others: dict[Path, None] = {}
    _parse(path, start, end, (), others, text)
    return tuple(others)


def _parse(
    path: Path, start: _Handler, end: _TextHandler | None, within: tuple[Path, ...], others: dict[Path, None],
    text: _TextHandler | None = None,
) -> None:  # fmt: skip
    """Read a file and the files that it names, as ``parse_xml`` does; ``within`` are the files that name this one."""
    outside = bool(within)  # an included file in which no element below the root has begun
    shown: list[bool] = []  # for each open element, whether it was passed to ``start``

    def started(tag: str, attributes: dict[str, str]) -> None:
        nonlocal outside
        name = attributes.get(READ[tag], "") if tag in READ else ""
        hidden = outside or (tag == "include" and bool(name))
        outside = False
        if end is not None:
            shown.append(not hidden)
        if not hidden:
            start(tag, attributes)
        if name:
            named(name)

    def ended(tag: str) -> None:
        if end is not None and shown.pop():
            end(tag)

    def named(name: str) -> None:
        file = path.parent / name
        if not file.is_file():
            raise UsageError(f"{path} names the file {file}, which is missing.")
        if file.resolve() in within:
            raise UsageError(f"{path} names the file {file}, which includes it: remove one of the two.")
        others[file] = None
        _parse(file, start, end, (*within, path.resolve()), others)

    _read(path, started, None if end is None else ended, text)


def _read(path: Path, start: _Handler, end: _TextHandler | None, text: _TextHandler | None) -> None:
    """Pass the elements of this file alone to the handlers."""

    def known_encoding(version: str, encoding: str | None, standalone: int) -> None:
        if encoding is not None and encoding.lower() not in ENCODINGS:
            raise UsageError(f"{path} says that it is written in {encoding[:40]!r}: write it in UTF-8.")

    def no_declarations(name: str, system: str | None, public: str | None, inside: int) -> None:
        if system is not None or public is not None or inside:  # SUMO's reader would take elements from it
            raise UsageError(f"{path} has a document type with declarations, which no file of SUMO needs: remove it.")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = no_declarations
    parser.StartElementHandler = start
    if end is not None:
        parser.EndElementHandler = end
    if text is not None:
        parser.CharacterDataHandler = text
    parser.XmlDeclHandler = known_encoding
    try:
        with _open(path) as file:
            parser.ParseFile(_Bounded(path, file))
    except parsing.BAD_GZIP as error:
        raise UsageError(f"{path} is a damaged or truncated gzip file: fetch or write it again.") from error
    except expat.ExpatError as error:
        raise UsageError(f"{path} is not valid XML (damaged or cut short): {error}.") from error
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error


def read_sumo_text(path: Path, what: str) -> str:
    """Return the text of a UTF-8 file, gzipped or not, without its byte order mark.

    Args:
        path: The file.
        what: The file in words, for messages.

    Returns:
        The text.

    Raises:
        UsageError: The file cannot be read, is not in UTF-8, or is damaged or too large.
    """
    try:
        return parsing.read_text(path, parsing.MAX_UNPACKED_BYTES).removeprefix("\ufeff")
    except OSError as error:
        raise UsageError(f"{what} {path} cannot be read: {error.strerror or error}.") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{what} {path} are not text in UTF-8: write them as CSV in UTF-8.") from error
    except ValueError as error:
        raise UsageError(f"{what} {path} cannot be used ({error}): write them again.") from error


class _Bounded:
    """A file for expat with at most ``parsing.MAX_SUMO_FILE_BYTES`` unpacked bytes."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file, self._left = path, file, parsing.MAX_SUMO_FILE_BYTES

    def read(self, size: int = -1, /) -> bytes:
        part = self._file.read(size)
        self._left -= len(part)
        if self._left < 0:
            raise UsageError(f"{self._path} has more than {parsing.MAX_SUMO_FILE_BYTES // 2**30} GiB: cut it smaller.")
        return part


def _open(path: Path) -> BinaryIO:
    """Open the file for reading, and unpack it if its name ends in .gz."""
    if path.name.lower().endswith(".gz"):
        return cast(BinaryIO, gzip.open(path, "rb"))
    return path.open("rb")


# -- copies from which SUMO writes nothing --------------------------------------------------------------------------

NO_FILE = "NUL"
WRITTEN = ("file", "output", "dest")
"""Attributes that name a file to write, unless the element uses them for a file to read (``scan.READ``)."""
WRITTEN_PARAMETER = re.compile(r"(.*[^a-z])?(files?|outputs?|log|logfile|dump|swarmlog)", re.IGNORECASE | re.DOTALL)
"""Pattern for keys of ``<param>`` that name a file to write. It tests the last word of the key, so it also covers
devices that SUMO adds in the future. Known keys are ``device.ssm.file``, ``device.toc.file``, ``file`` (of actuated
lights) and ``SWARMLOG`` (of swarm lights).
"""
FROM_HERE = "edgesFile"
"""An attribute of ``<edgeData>`` that restricts what is written. SUMO looks for the file in the working folder."""


def silent_copies(additional: Sequence[Path], folder: Path) -> tuple[Path, ...]:
    """Return files from which SUMO writes nothing.

    A file that names no other file is returned itself. Any other file is copied into a new folder without those names.
    Additional files, demand and networks are treated alike.

    Args:
        additional: The files.
        folder: Where the new folders are created.

    Returns:
        The files or their copies, in the same order.

    Raises:
        UsageError: A file is damaged or missing, or SUMO's options cannot hold its name.
    """
    for file in additional:
        check_nameable(file)
    return tuple(_copy(file, folder) if _names_files(file) else file for file in additional)


def _names_files(file: Path) -> bool:
    """Return whether a file names other files to read or write."""
    changed = False

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal changed
        changed = changed or _silent(tag, attributes) != attributes

    return bool(parse_xml(file, start)) or changed


def _copy(file: Path, folder: Path) -> Path:
    """Write a copy that names no files, and return its path."""
    name = file.name[:-3] if file.name.lower().endswith(".gz") else file.name
    target = Path(tempfile.mkdtemp(prefix="silent-", dir=folder)) / name
    with target.open("w", encoding="utf-8", newline="\n") as out:

        def start(tag: str, attributes: dict[str, str]) -> None:
            given = "".join(f" {key}={quoteattr(value)}" for key, value in _silent(tag, attributes).items())
            out.write(f"<{tag}{given}>\n")

        def end(tag: str) -> None:
            out.write(f"</{tag}>\n")

        out.write('<?xml version="1.0" encoding="UTF-8"?>\n')
        parse_xml(file, start, end)
    return target


def _silent(tag: str, attributes: dict[str, str]) -> dict[str, str]:
    """Return the attributes of an element, changed so that it reads and writes no file."""
    if tag == "param":
        written = WRITTEN_PARAMETER.fullmatch(attributes.get("key", "")) is not None
        return {**attributes, "value": NO_FILE} if written else attributes
    read = READ.get(tag)
    kept = {key: value for key, value in attributes.items() if key not in (read, FROM_HERE)}
    return {key: NO_FILE if key in WRITTEN else value for key, value in kept.items()}
