"""Read SUMO's floating car data (``--fcd-output``) as arrays in the coordinates of its network.

``x`` and ``y`` are front bumpers, and ``angle`` is in degrees clockwise from north. The place of a ``person`` is its
middle. A person in a vehicle has the vehicle's place, and is left out while it rides. Times are seconds, or ``h:m:s``
with ``--human-readable-time``. Places may come from ``--fcd-output.geo`` or ``--fcd-output.utm``. The ego shows which
it is, because it must be near the lane that the recording names.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sumo_adv.consistency import SUMO_DEGREES, GivenMotion, find_fault, unordered
from sumo_adv.datatypes import Floats
from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.programs import load_libsumo
from sumo_adv.simulation.scan import parse_seconds, parse_xml, silent_copies
from sumo_adv.simulation.sumo_states import PERSON

MAX_RECORDING_TIME_S = 1e7  # maximum time in a recording: about four months
NEEDED_ATTRIBUTES = ("x", "y", "angle", "speed")
MUST_NAME = "--fcd-output.attributes must name x,y,angle,speed,type,lane"
MAX_LANE_OFFSET_M = 20.0  # from a vehicle's front to the middle of its lane; a vehicle that overtakes is within 10
MAX_COMPARED_STATES = 200  # maximum number of the ego's states that are compared with its lanes
States = dict[float, dict[str, str]]  # attributes by time [s]


@dataclass(frozen=True, slots=True)
class RecordedObject:
    """One vehicle or person. Arrays have shape ``(n,)``, in order of time.

    Attributes:
        name: The name of the object.
        person: Whether it is a person.
        kind: Its vType; empty if unknown.
        time: Times [s].
        x: x of the front bumper, or of a person's middle [m].
        y: y of the same point [m].
        angle: Angles clockwise from north [degrees].
        speed: Speeds [m/s].
        lanes: Lane ids; an empty string off all lanes.
    """

    name: str
    person: bool
    kind: str
    time: Floats
    x: Floats
    y: Floats
    angle: Floats
    speed: Floats
    lanes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class FcdRecording:
    """All objects of a recording.

    Attributes:
        objects: The objects by name.
        notes: Sentences on what was converted or left out.
    """

    objects: Mapping[str, RecordedObject]
    notes: tuple[str, ...] = ()


def read_recording(path: Path) -> FcdRecording:
    """Read the objects of a recording, in the coordinates of the file.

    Args:
        path: The file.

    Returns:
        The recording.

    Raises:
        UsageError: The file is damaged or is no FCD, lacks an attribute, or has times out of order.
    """
    vehicles: dict[str, States] = {}
    persons: dict[str, States] = {}
    riding: set[str] = set()
    containers: set[str] = set()
    places: set[tuple[str | None, str | None]] = set()  # places of the vehicles in the present timestep
    times: list[float] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "timestep":
            times.append(_time(path, attributes))
            if wrong := unordered(np.array(times[-2:])):
                raise _no_fcd(path, f"the timestep {wrong[1]}")
            places.clear()
        elif tag == "container":
            containers.add(attributes.get("id", ""))
        elif tag in ("vehicle", "person"):
            if not times or "id" not in attributes:
                raise _no_fcd(path, f"a {tag} is in no timestep" if not times else f"a {tag} has no id")
            place, name = (attributes.get("x"), attributes.get("y")), attributes["id"]
            if tag == "vehicle":
                places.add(place)
            elif attributes.get("vehicle") or place in places:
                riding.add(name)
                return
            states = (vehicles if tag == "vehicle" else persons).setdefault(name, {})
            if times[-1] in states:
                raise _no_fcd(path, f"the {tag} '{name}' comes twice at {times[-1]:g} s")
            states[times[-1]] = attributes

    if path.name.lower().endswith((".csv", ".parquet", ".csv.gz")):
        raise UsageError(f"{path} is not XML: let SUMO write the FCD into a file whose name ends in .xml or .xml.gz.")
    parse_xml(path, start)
    if not vehicles:
        raise UsageError(f"{path} has no vehicle in a timestep; write it with sumo --fcd-output.")
    objects = {name: _object(path, name, states, person=False) for name, states in vehicles.items()}
    for name, states in persons.items():
        own = PERSON + name if name in objects else name
        objects[own] = _object(path, own, states, person=True)
    left_out = (("Persons are left out while they are in a vehicle", riding), ("Containers are left out", containers))
    return FcdRecording(objects, tuple(f"{what}: {some(sorted(names))}." for what, names in left_out if names))


def some(names: Sequence[str]) -> str:
    """Return the first five names, for a sentence."""
    return f"{', '.join(names[:5])}{' ..' if len(names) > 5 else ''}"


def _no_fcd(path: Path, why: str) -> UsageError:
    """Return the error that the file is no FCD."""
    return UsageError(f"{path} is not SUMO's FCD ({why}); write it with sumo --fcd-output.")


def _time(path: Path, attributes: Mapping[str, str]) -> float:
    """Return the time of a timestep [s]."""
    if "time" not in attributes:
        raise _no_fcd(path, "a timestep has no time")
    time = parse_seconds(path, "timestep", attributes["time"])
    if time is None or not time < MAX_RECORDING_TIME_S:
        raise _no_fcd(path, f"a timestep at {attributes['time'][:40]}")
    return time


def _object(path: Path, name: str, states: States, *, person: bool) -> RecordedObject:
    """Return the states of one object as arrays."""
    columns: dict[str, Floats] = {}
    for key in NEEDED_ATTRIBUTES:
        try:
            columns[key] = np.array([float(state[key]) for state in states.values()])
        except KeyError:
            time = next(t for t, state in states.items() if key not in state)
            raise _no_fcd(path, f"'{name}' has no {key} at {time:g} s; {MUST_NAME}") from None
        except ValueError as error:
            raise _no_fcd(path, f"the {key} of '{name}': {error}") from error
    kind = next(iter(states.values())).get("type", "")
    lanes = tuple(state.get("lane", "") for state in states.values())
    return RecordedObject(name, person, kind, np.array(list(states)), **columns, lanes=lanes)


def check_recording(path: Path, recording: FcdRecording, sizes: Mapping[str, tuple[float, float]]) -> None:
    """Refuse a recording with impossible motion (``consistency.py``).

    Args:
        path: The file, for messages.
        recording: The recording.
        sizes: Length and width by name [m].

    Raises:
        UsageError: Some motion is impossible.
    """
    motions = (
        GivenMotion(o.name, "pedestrian" if o.person else "vehicle", o.time, o.x, o.y, o.angle, o.speed, *sizes[o.name],
               SUMO_DEGREES)
        for o in recording.objects.values()
    )  # fmt: skip
    if fault := find_fault(list(motions), noisy=True):
        raise UsageError(f"{path} cannot be right: the timestep {fault.time:g} {fault.says}.")


# -- coordinates ----------------------------------------------------------------------------------------------------


def in_network(path: Path, recording: FcdRecording, network: Path, road: RoadMap, ego: str) -> FcdRecording:
    """Convert a recording to the coordinates of a network.

    Args:
        path: The file of the recording, for messages.
        recording: The recording.
        network: The network file.
        road: The network.
        ego: The name of the ego.

    Returns:
        The recording, with a note on the conversion if there was one.

    Raises:
        UsageError: The ego is on no lane of the network, or far from its recorded lanes in all supported coordinates.
    """
    me = recording.objects[ego]
    if not any(me.lanes):
        raise _no_fcd(path, f"'{ego}' has no lane; {MUST_NAME}")
    if not any(lane in road.lanes for lane in me.lanes):
        raise UsageError(
            f"The vehicle '{ego}' is on no lane of {network.name} in {path}; check that it is that network's."
        )
    far = _from_lanes(me, road)
    if far <= MAX_LANE_OFFSET_M or not math.isfinite(far):
        return recording
    offset, projection = _location(network)
    lon_lat = _places(recording)
    unshifted = _moved(recording, lon_lat + offset)
    if _from_lanes(unshifted.objects[ego], road) <= MAX_LANE_OFFSET_M:
        note = "Places of --fcd-output.utm are moved by the network's offset."
        moved = dict(unshifted.objects)
        for name, o in recording.objects.items():  # SUMO 1.28 always writes persons in the network's coordinates
            if o.person and _apart(o, moved[ego]) < _apart(moved[name], moved[ego]):
                moved[name] = o
        return FcdRecording(moved, (*recording.notes, note))
    if (np.abs(lon_lat) <= (180.0, 90.0)).all():
        if projection == "!":
            raise UsageError(
                f"{path} has longitudes and latitudes, and {network.name} has no projection to convert them with: "
                "record it without --fcd-output.geo."
            )
        projected = _moved(recording, _projected(network, lon_lat))
        if _from_lanes(projected.objects[ego], road) <= MAX_LANE_OFFSET_M:
            note = "Longitudes and latitudes are converted with the network's projection."
            return replace(projected, notes=(*recording.notes, note))
    raise UsageError(
        f"The vehicle '{ego}' is {far:.4g} m from the lanes of {network.name} that it is on in {path}; "
        "is it that network's?"
    )


def _apart(a: RecordedObject, b: RecordedObject) -> float:
    """Return the distance between the first places of two objects [m]."""
    return math.hypot(float(a.x[0] - b.x[0]), float(a.y[0] - b.y[0]))


def _from_lanes(o: RecordedObject, road: RoadMap) -> float:
    """Return the median distance to the lanes that the recording names [m]."""
    from shapely import LineString, Point

    on = [k for k, lane in enumerate(o.lanes) if lane in road.lanes]
    lines = {lane: LineString(road.lanes[lane].shape) for lane in {o.lanes[k] for k in on}}
    some = on[:: max(1, len(on) // MAX_COMPARED_STATES)]
    return float(np.median([lines[o.lanes[k]].distance(Point(o.x[k], o.y[k])) for k in some]))


def _places(recording: FcdRecording) -> Floats:
    """Return all places ``(n, 2)``, object by object."""
    return np.concatenate([np.column_stack([o.x, o.y]) for o in recording.objects.values()])


def _moved(recording: FcdRecording, places: Floats) -> FcdRecording:
    """Return the recording with other places, in the order of :func:`_places`."""
    ends = np.cumsum([len(o.time) for o in recording.objects.values()])[:-1]
    parts = np.split(places, ends)
    moved = {
        name: replace(o, x=part[:, 0], y=part[:, 1])
        for (name, o), part in zip(recording.objects.items(), parts, strict=True)
    }
    return replace(recording, objects=moved)


def _location(network: Path) -> tuple[Floats, str]:
    """Return a network's offset ``(2,)`` [m] and its projection, ``!`` without one."""
    found: list[tuple[Floats, str]] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "location":
            x, y = attributes.get("netOffset", "0,0").split(",")
            found.append((np.array([float(x), float(y)]), attributes.get("projParameter", "!")))

    parse_xml(network, start)
    return found[0] if found else (np.zeros(2), "!")


def _projected(network: Path, lon_lat: Floats) -> Floats:
    """Convert longitudes and latitudes to places in the network ``(n, 2)`` [m], as SUMO does.

    Raises:
        SimulationError: SUMO does not load the network, or already runs in this process.
    """
    libsumo = load_libsumo()
    try:
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
            (silent,) = silent_copies((network,), Path(scratch))
            libsumo.start(["sumo", "-n", str(silent), "--no-step-log", "--no-warnings", "--xml-validation", "never"])
            try:
                return np.array([libsumo.simulation.convertGeo(x, y, True) for x, y in lon_lat.tolist()])
            finally:
                libsumo.close()
    except libsumo.TraCIException as error:
        raise SimulationError(f"SUMO cannot convert places with the projection of {network}: {error}.") from error
