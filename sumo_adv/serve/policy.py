"""What an ego's client may do: read anything, set its own vehicle and what it added, and nothing that ends SUMO.

A refusal is a sentence. The gate answers it as a TraCI error, and SUMO never sees the call.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from sumo_adv.errors import UsageError
from sumo_adv.serve import framing, shapes
from sumo_adv.serve.framing import TraciCommand
from sumo_adv.serve.shapes import Misfit
from sumo_adv.simulation.scan import WRITTEN_PARAMETER

MAX_STEP_S = 3600.0  # longest time that one simulationStep may cover
_DOMAINS = (
    (0xA0, "inductionloop multientryexit trafficlight lane vehicle vehicletype route poi polygon junction edge "
           "simulation gui lanearea person busstop"),
    (0x24, "parkingarea chargingstation routeprobe calibrator rerouter variablespeedsign meandata overheadwire"),
)  # fmt: skip
GETTERS = {first + k: name for first, names in _DOMAINS for k, name in enumerate(names.split())}
"""Maps the number of a getter to its domain, as in ``traci``. Other commands of a domain have fixed distances to it."""
SETTERS = {number + 0x20: name for number, name in GETTERS.items()}
GETTER_TO_SUBSCRIPTION = 0x30
SUBSCRIPTIONS = {number + GETTER_TO_SUBSCRIPTION: name for number, name in GETTERS.items()}
CONTEXTS = {number - 0x20: name for number, name in GETTERS.items()}
ADDED = frozenset({"vehicle", "vehicletype", "route", "person", "poi", "polygon"})
"""Domains in which a client may add objects, and set those that it added."""
NEVER_SET = frozenset({"simulation", "gui"})
_ADD, _REMOVE, _ADD_FULL, _COPY = 0x80, 0x81, 0x85, 0x88
_GUI = 0xAC
_CALIBRATOR = 0x07  # a context around one ends SUMO
_ACTING = {(0xA2, 0x32): "trafficlight", (0xAE, 0xC7): "person"}  # getters that change something
_TOO_LONG = "A name this long is not passed on: it could crash SUMO."
_NOT_A_CLIENTS = "This object is sumo_adv's own."
_KEPT = "sumo_adv adds and removes the ego: its client can do neither."
_WRITES = "A client cannot set this parameter: it could make SUMO write a file."
_ODD_NAME = "An object that is added needs a name of printable characters in UTF-8."
_DEVICES = "battery bluelight btreceiver btsender driverstate elechybrid emissions friction glosa rerouting taxi toc"
_MODELS = ("carFollowModel", "laneChangeModel", "junctionModel", "parking")
SET_PARAMETERS = re.compile(
    rf"[^.]*|({'|'.join(_MODELS)})\..*|has\.({'|'.join(_DEVICES.split())})\.device"
    rf"|(person-)?device\.({'|'.join(_DEVICES.split())})\..*",
    re.DOTALL,
)
"""Keys that ``setParameter`` may set if they name no file.

They are the object's own, and those of models and devices that write no files.
"""
OUR_PREFIX = "sumo_adv."
"""The prefix of the names of objects that the server adds. A client can set none of them."""


@dataclass(frozen=True, slots=True)
class Rules:
    """What the client may set.

    Attributes:
        also: Domains, named as in ``traci``, in which the client may set every object.
    """

    also: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Refuse names that are no domains, and domains that are never allowed.

        Raises:
            UsageError: A domain cannot be allowed. The message names those that can.
        """
        if wrong := sorted(self.also - (frozenset(GETTERS.values()) - NEVER_SET)):
            allowed = ", ".join(sorted(frozenset(GETTERS.values()) - NEVER_SET))
            raise UsageError(f"The ego's client cannot be allowed to set {wrong[0]}; what can be allowed: {allowed}.")


class Policy:
    """The rules in one simulation. It records the objects that the client added."""

    def __init__(self, rules: Rules, own: Iterable[str], kept: Collection[str] = ()) -> None:
        """Start with the client's vehicles.

        Args:
            rules: What the client may set.
            own: The vehicles that the client may set.
            kept: Those of them that it neither adds nor removes.
        """
        self._rules = rules
        self._own: dict[str, set[bytes]] = {domain: set() for domain in ADDED}
        self._own["vehicle"] |= {name.encode() for name in own}
        self._kept = frozenset(name.encode() for name in kept)

    @property
    def own(self) -> frozenset[str]:
        """The vehicles that the client may set."""
        return frozenset(name.decode(errors="replace") for name in list(self._own["vehicle"]))

    def refusal(self, command: TraciCommand) -> str | None:
        """Say why SUMO must not see a command. Step, order, version and close are not checked here.

        Args:
            command: The command.

        Returns:
            The reason; None if SUMO may see the command.
        """
        number, payload = command.number, command.payload
        try:
            if number in GETTERS:
                return self._getter(number, payload)
            if number in SETTERS:
                return self._setter(number, payload)
            if number in SUBSCRIPTIONS or number in CONTEXTS:
                return self._subscription(number, payload)
            if number == framing.FILTER:
                return None if _filter_fits(payload) else _misfit(number)
        except Misfit:
            return _misfit(number)
        if number == framing.LOAD:
            return "The simulation belongs to sumo_adv: a client cannot load another one."
        if number == framing.EXECUTEMOVE:
            return "A client of sumo_adv cannot make half steps: use simulationStep."
        return None

    def _getter(self, number: int, payload: bytes) -> str | None:
        """Say why a getter is refused."""
        if number == _GUI:
            return None
        end = shapes.name_end(payload, 1)
        if end - 5 > (shapes.MAX_OBJECT_NAME_BYTES if end == len(payload) else shapes.MAX_NAME_BYTES):
            return _TOO_LONG
        if not shapes.fits(payload, end, shapes.get_shapes(number, payload[0])):
            return _misfit(number)
        acting = _ACTING.get((number, payload[0]))
        if acting and acting not in self._rules.also:
            return f"This getter changes a {acting}, which is not the client's."
        return None

    def _setter(self, number: int, payload: bytes) -> str | None:
        """Say why a setter is refused."""
        domain = SETTERS[number]
        end = shapes.name_end(payload, 1)
        variable, name = payload[0], payload[5:end]
        expected = shapes.set_shapes(number, variable)
        if len(name) > shapes.MAX_NAME_BYTES:
            return _TOO_LONG
        if domain in NEVER_SET:
            return f"A client of sumo_adv cannot set the {domain}."
        if name.startswith(OUR_PREFIX.encode()):
            return _NOT_A_CLIENTS
        if domain == "vehicle" and name in self._kept and variable in (_ADD, _ADD_FULL, _REMOVE):
            return _KEPT
        if variable in (_ADD, _ADD_FULL) and domain in ADDED and not _is_printable(name):
            return _ODD_NAME
        if not (domain in self._rules.also or self._may(domain, variable, name)):
            said = name[:60].decode(errors="replace")
            return f"{domain} {said!r} is not the client's: a client may set its own vehicle and what it added."
        if expected is None or not shapes.fits(payload, end, expected):
            return _misfit(number)
        if any(not _may_be_set(key) for key in shapes.keys_set(payload, end, variable)):
            return _WRITES
        if variable == _COPY and domain == "vehicletype":
            name = payload[end + 5 :]
            return (
                _NOT_A_CLIENTS if name.startswith(OUR_PREFIX.encode()) else None if _is_printable(name) else _ODD_NAME
            )
        return None

    def _may(self, domain: str, variable: int, name: bytes) -> bool:
        """Return whether the client added the object, or adds it now."""
        if domain not in ADDED:
            return False
        if domain == "vehicletype":
            return variable == _COPY or name in self._own[domain]
        adding = variable == _ADD or (variable == _ADD_FULL and domain == "vehicle")
        return adding or name in self._own[domain]

    def _subscription(self, number: int, payload: bytes) -> str | None:
        """Say why a subscription is refused."""
        end = shapes.name_end(payload, 16)
        name = payload[20:end]
        if len(name) > shapes.MAX_OBJECT_NAME_BYTES:
            return _TOO_LONG
        if not all(map(math.isfinite, struct.unpack_from("!2d", payload))):
            raise Misfit
        if number not in CONTEXTS:
            shapes.subscribed(payload, end, number - GETTER_TO_SUBSCRIPTION)
            return None
        if len(payload) < end + 10 or not abs(struct.unpack_from("!d", payload, end + 1)[0]) <= shapes.MAX_NUMBER:
            raise Misfit
        if number == _CALIBRATOR or not shapes.context_fits(payload, end + 9, payload[end]):
            return "A context subscription cannot have this domain or these variables."
        return None

    def took(self, command: TraciCommand) -> None:
        """Record what a setter that SUMO accepted added or removed.

        Args:
            command: The setter.
        """
        domain = SETTERS[command.number]
        if domain not in ADDED:
            return
        variable, end = command.payload[0], shapes.name_end(command.payload, 1)
        name = command.payload[5:end]
        if variable == _COPY and domain == "vehicletype":
            self._own[domain].add(command.payload[end + 5 :])
        elif variable == _ADD or (variable == _ADD_FULL and domain == "vehicle"):
            self._own[domain].add(name)
        elif variable == _REMOVE:
            self._own[domain].discard(name)


def removed(command: TraciCommand) -> tuple[str, bytes] | None:
    """Return domain and name of the object that a command removes.

    Args:
        command: The command.

    Returns:
        Domain and name; None if the command removes nothing.
    """
    domain = SETTERS.get(command.number)
    if domain is None or not command.payload or command.payload[0] != _REMOVE:
        return None
    return domain, command.payload[5 : shapes.name_end(command.payload, 1)]


def step_until(payload: bytes) -> float:
    """Return the time that a SIMSTEP asks for [s]; 0 means one step.

    Args:
        payload: The payload of the command.

    Raises:
        Misfit: The payload is no time.
    """
    if len(payload) != 8:
        raise Misfit
    until: float = struct.unpack("!d", payload)[0]
    if not math.isfinite(until):
        raise Misfit
    return until


def _filter_fits(payload: bytes) -> bool:
    """Return whether the payload is that of a context filter."""
    if not payload:
        return False
    kind = payload[0]
    if kind == 0x01:  # lanes: a count and that many bytes
        return len(payload) >= 2 and payload[1] < 128 and len(payload) == 2 + payload[1]
    shape = {0x03: "d", 0x04: "d", 0x07: "d", 0x08: "v", 0x09: "l", 0x0A: "d", 0x0B: "d"}.get(kind, "")
    return shapes.fits(payload, 1, (shape,))


def _may_be_set(key: bytes) -> bool:
    """Return whether a client may set this parameter."""
    text = key.decode(errors="replace")
    return SET_PARAMETERS.fullmatch(text) is not None and not WRITTEN_PARAMETER.fullmatch(text)


def _misfit(number: int) -> str:
    """Return the refusal of a payload that does not fit."""
    return f"The content of command 0x{number:02x} is not what SUMO 1.28 reads; it was not passed on."


def _is_printable(name: bytes) -> bool:
    """Return whether a name is printable UTF-8."""
    try:
        return name.decode().isprintable()
    except UnicodeDecodeError:
        return False
