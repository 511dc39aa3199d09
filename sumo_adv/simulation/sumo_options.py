"""Decide which options of the user's own simulation are kept, and which this program must set itself.

A network or a scenario alone runs with ``DEFAULTS``. A .sumocfg is a simulation: its options are kept, and those that
it does not name have SUMO's defaults. Names are SUMO's long ones, without dashes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.simulation.given_options import OPTION_TYPES, check

DEFAULTS = {
    "time-to-teleport": "-1", "lateral-resolution": "0.8", "default.speeddev": "0", "collision.mingap-factor": "0",
    "collision.check-junctions": "true", "collision.action": "warn", "collision.stoptime": "0",
}  # fmt: skip
SUMOS = {
    "time-to-teleport": "300", "lateral-resolution": "-1", "default.speeddev": "-1", "collision.mingap-factor": "-1",
    "collision.check-junctions": "false", "collision.action": "teleport", "collision.stoptime": "0",
}  # fmt: skip
"""SUMO's own defaults for the options in ``DEFAULTS``."""
SUMOS_SEED = 23423
FORCED = {
    "device.ssm.file": "NUL", "xml-validation": "never", "no-step-log": "true", "duration-log.disable": "true",
}  # fmt: skip
"""Options that this program always sets. None of them changes a motion. The first prevents a vehicle's own SSM device
from writing a file into the working folder.
"""
MIN_STEP_LENGTH_S, MAX_STEP_LENGTH_S = 0.01, 0.5
# SUMO's default, and the longest step into which a longer one is divided.
SUMO_STEP_LENGTH_S, FINE_STEP_LENGTH_S = 1.0, 0.1
OPTIONS_SET_ELSEWHERE = {
    "net-file": "give the network as the INPUT", "route-files": "name it in a .sumocfg",
    "additional-files": "name it in a .sumocfg", "begin": "use --begin", "end": "use --end", "seed": "use --seed",
    "step-length": "use the setting step_length",
}  # fmt: skip
"""Options of SUMO that are given in another way, and how."""


SHOWING = (
    "gui-", "window-", "save-", "write-", "device.ssm.", "device.fcd.", "person-device.fcd.", "device.tripinfo.",
    "device.vehroute.", "netstate-dump.", "log.", "xml-validation", "duration-log", "message-log", "error-log",
)  # fmt: skip
SHOWING_NAMES = frozenset(
    ("remote-port", "num-clients", "configuration-file", "log", "log-file", "verbose", "no-warnings", "no-step-log",
     "step-log.period", "start", "quit-on-end", "delay", "game", "breakpoints", "summary", "tripinfo", "netstate",
     "netstate-dump", "print-options", "help", "version", "precision", "precision.geo", "human-readable-time",
     "aggregate-warnings", "language", "demo", "disable-textures", "registry-viewport", "tracker-interval",
     "edgedata-files", "alternative-net-file", "selection-file", "game.mode", "tls.actuated.show-detectors",
     "pedestrian.jupedsim.wkt", "pedestrian.jupedsim.wkt.geo", "pedestrian.jupedsim.py")
)  # fmt: skip
"""Options that write, report or show something, by the beginnings of their names (``SHOWING``) and by their names."""
_OTHERS = """
    net-file route-files additional-files weight-files load-state load-state.offset load-state.remove-vehicles
    begin step-length threads
    no-internal-links astar.all-distances astar.landmark-distances device.rerouting.threads phemlight-path
    device.example.probability device.example.explicit device.example.deterministic device.example.parameter
    device.taxi.dispatch-algorithm.params device.fcd-replay.probability device.fcd-replay.explicit
    device.fcd-replay.deterministic device.fcd-replay.files device.fcd-replay.consistency mesosim meso-ltm
    meso-edgelength meso-tauff meso-taufj meso-taujf meso-taujj meso-jam-threshold meso-multi-queue meso-lane-queue
    meso-ignore-lanes-by-vclass meso-junction-control meso-junction-control.limited meso-tls-penalty
    meso-tls-flow-penalty meso-minor-penalty meso-overtaking meso-recheck meso-interpolate-pos random seed thread-rngs
"""
OTHERS = frozenset(_OTHERS.split())
"""Other options of SUMO 1.28 that may not be given: they change motions, or are given in another way."""


def is_own(name: str) -> bool:
    """Return whether this program sets an option itself or does not let it be given.

    These options concern effects of collisions, outputs, messages, the GUI, threads and the port, and everything that
    is missing from the list of options that may be given.
    """
    return name in FORCED or name not in OPTION_TYPES


def only_shows(name: str) -> bool:
    """Return whether an option only writes, reports or shows something, and so changes no motion."""
    shows = name in SHOWING_NAMES or name.startswith(SHOWING) or "output" in name or name.endswith(".file")
    return is_own(name) and shows


def kept(configuration: Path, given: Mapping[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the options of a .sumocfg that are kept.

    An option that names a file is not kept, because a run copies only its network, demand and additional files. There
    is no sentence on an option that this program sets to the same value.

    Args:
        configuration: The .sumocfg, for messages.
        given: Its options.

    Returns:
        The options, with those on collisions, and a sentence for each kind of option that is not kept.

    Raises:
        UsageError: The options let no vehicle be moved, an option is unknown, or a value has the wrong type.
    """
    if is_on(given.get("no-internal-links")):
        raise UsageError(f"{configuration} sets no-internal-links: {NO_JUNCTIONS}.")
    collisions, said = _collisions(configuration.name, given)
    own = {name for name in given if name not in DECIDED and is_own(name)}
    for name in sorted(own):
        if name not in FORCED and name not in OTHERS and not only_shows(name):
            raise UsageError(f"{configuration}: SUMO has no option '{name}': correct its name or leave it out.")
    left = [f"{name}={given[name]}" for name in given if name in own and FORCED.get(name) != given[name]]
    moving = [text for text in left if not only_shows(text.partition("=")[0])]
    silent = [text for text in left if text not in moving]
    if moving:
        said = (
            f"Not kept of {configuration.name}, so traffic moves differently than in SUMO: {', '.join(moving)}.",
            *said,
        )
    if silent:
        said = (f"Not kept of {configuration.name}, because this program sets them itself: {', '.join(silent)}.", *said)
    options = {name: value for name, value in given.items() if name not in own and name not in DECIDED}
    check(options)
    return {**options, **collisions}, said


COLLISIONS = ("collision.action", "collision.stoptime")
DECIDED = frozenset((*COLLISIONS, "no-internal-links"))
"""Options of a .sumocfg whose value decides whether they are kept."""
NO_JUNCTIONS = (
    "SUMO crashes if a vehicle is moved across a junction without lanes of its own; use a network that netconvert made "
    "without --no-internal-links, and leave that option out"
)


def is_on(value: str | None) -> bool:
    """Return whether SUMO reads the value of an option as yes."""
    return value is not None and value.lower() in ("true", "1", "on", "yes", "x", "t")


def _collisions(file_name: str, given: Mapping[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return what SUMO does with vehicles that collide, and a sentence on what differs from ``file_name``.

    With the action ``teleport``, SUMO ignores collisions of a vehicle that is moved, or was moved in the last 10 s,
    except on junctions (``MSLane::detectCollisionBetween``; measured). Collisions of the user's traffic thus happen as
    configured, and an attack's contact stays. With ``warn`` and ``none`` and no stop, a collision moves no vehicle.
    """
    action, stop = (given.get(name, SUMOS[name]) for name in COLLISIONS)
    on_junctions = is_on(given.get("collision.check-junctions"))
    if action == "teleport" and not on_junctions:
        return {name: given[name] for name in COLLISIONS if name in given}, ()
    if action not in ("teleport", "remove") and not stop.strip("0.:"):
        return {"collision.action": action}, ()
    why = ", because SUMO looks for collisions on junctions" if on_junctions else ""
    return {"collision.action": "warn", "collision.stoptime": "0"}, (
        f"What {file_name} sets for collisions is not kept{why} (collision.action={action}, "
        f"collision.stoptime={stop}): vehicles that collide drive on, so what follows a collision of your own "
        "traffic may differ.",
    )


def part_of(step: float) -> float | None:
    """Return the longest step up to ``FINE_STEP_LENGTH_S`` of which ``step`` is a multiple [s].

    What SUMO does at the times of the long steps thus still happens. SUMO counts in whole ms.

    Args:
        step: The long step [s].

    Returns:
        The step [s]; None if there is none.
    """
    whole = round(1000 * step)
    shortest, longest = round(1000 * MIN_STEP_LENGTH_S), round(1000 * FINE_STEP_LENGTH_S)
    return next((part / 1000 for part in range(longest, shortest - 1, -1) if whole >= part and whole % part == 0), None)


def differing(options: Mapping[str, str]) -> dict[str, str]:
    """Return the options that a scenario must set, beside ``DEFAULTS``, to run with these options."""
    wanted = {
        name: value for name, value in {**SUMOS, **options}.items() if name not in (*FORCED, *OPTIONS_SET_ELSEWHERE)
    }
    return {
        name: value for name, value in wanted.items()
        if DEFAULTS.get(name) != value and (name in COLLISIONS or not is_own(name))
    }  # fmt: skip


def parse_options(given: Sequence[str]) -> dict[str, str]:
    """Parse ``NAME=VALUE`` texts.

    Returns:
        The values by name.

    Raises:
        UsageError: A text has another form.
    """
    parsed: dict[str, str] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not name.strip("- ") or not equals or not value.strip():
            raise UsageError(f"--option takes NAME=VALUE, such as time-to-teleport=300, not '{text}'.")
        parsed[name.strip().lstrip("-")] = value.strip()
    return parsed


def refuse(options: Mapping[str, str]) -> None:
    """Refuse options that cannot be passed through.

    Raises:
        UsageError: An option is given in another way, is set by this program, or may not be given; or its value has the
            wrong type.
    """
    for name in options:
        if name in OPTIONS_SET_ELSEWHERE:
            raise UsageError(f"SUMO's option '{name}' cannot be passed through: {OPTIONS_SET_ELSEWHERE[name]}.")
        if name == "no-internal-links":
            raise UsageError(f"SUMO's option '{name}' cannot be passed through: {NO_JUNCTIONS}.")
        if name in FORCED or (name in COLLISIONS and _collisions("--option", {**DEFAULTS, **options})[1]):
            raise UsageError(f"SUMO's option '{name}' is set by this program: leave it out.")
    check(options)
