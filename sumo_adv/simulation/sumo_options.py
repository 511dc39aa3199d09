"""Options of SUMO: what of a user's own simulation is kept, and what this program must set itself.

A network or a scenario alone runs with ``DEFAULTS``. A .sumocfg is a simulation: its options are kept, and those that
it does not name are SUMO's own defaults. Names are SUMO's long ones, without dashes.
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
"""SUMO's own values of ``DEFAULTS``."""
SUMOS_SEED = 23423
FORCED = {
    "device.ssm.file": "NUL", "xml-validation": "never", "no-step-log": "true", "duration-log.disable": "true",
}  # fmt: skip
"""None of these changes a motion. A vehicle may have an SSM device of its own, which would write a file in the working
folder."""
MIN_STEP_LENGTH_S, MAX_STEP_LENGTH_S = 0.01, 0.5  # s
SUMO_STEP_LENGTH_S, FINE_STEP_LENGTH_S = 1.0, 0.1  # s: SUMO's default, and the longest part of a step that is too long
OPTIONS_SET_ELSEWHERE = {
    "net-file": "give the network as the INPUT", "route-files": "name it in a .sumocfg",
    "additional-files": "name it in a .sumocfg", "begin": "use --begin", "end": "use --end", "seed": "use --seed",
    "step-length": "use the setting step_length",
}  # fmt: skip
"""Options of SUMO that have another place, and which."""


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
"""Options that write, report or show, by the beginnings of their names and by their names."""
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
"""SUMO 1.28's other options that may not be given: they change motions, or have a place of their own."""


def is_own(name: str) -> bool:
    """Whether this program sets the option itself, or leaves it alone: effects of collisions, outputs, messages, GUI,
    threads, port; and whatever is not in the list of those that may be given."""
    return name in FORCED or name not in OPTION_TYPES


def only_shows(name: str) -> bool:
    """Whether an option writes, reports or shows, and so changes no motion."""
    shows = name in SHOWING_NAMES or name.startswith(SHOWING) or "output" in name or name.endswith(".file")
    return is_own(name) and shows


def kept(configuration: Path, given: Mapping[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """The options of a .sumocfg that are kept, with what becomes of collisions, and a sentence for each kind of those
    that are not.

    An option that names a file is not kept: a run copies its network, demand and additional files alone. An option
    that this program sets to the same value is in no sentence.

    Raises UsageError: the options let no vehicle be moved, or a value is not of the type of its option.
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
            f"Not kept of {configuration.name}, so traffic moves otherwise than in SUMO: {', '.join(moving)}.",
            *said,
        )
    if silent:
        said = (f"Not kept of {configuration.name}, as this program sets them itself: {', '.join(silent)}.", *said)
    options = {name: value for name, value in given.items() if name not in own and name not in DECIDED}
    check(options)
    return {**options, **collisions}, said


COLLISIONS = ("collision.action", "collision.stoptime")
DECIDED = frozenset((*COLLISIONS, "no-internal-links"))
"""Options of a .sumocfg whose value decides whether they are kept."""
NO_JUNCTIONS = (
    "SUMO dies when a vehicle is moved across a junction without lanes of its own; use a network that netconvert made "
    "without --no-internal-links, and leave that option out"
)


def is_on(value: str | None) -> bool:
    """Whether a value of an option means yes, as SUMO reads it."""
    return value is not None and value.lower() in ("true", "1", "on", "yes", "x", "t")


def _collisions(file_name: str, given: Mapping[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """What SUMO does with vehicles that collide, and what differs from ``file_name`` in a sentence.

    With the action ``teleport``, SUMO passes over collisions of a vehicle that is moved, or was in the last 10 s, but
    those on junctions (``MSLane::detectCollisionBetween``; measured). So a user's collisions happen as they are
    configured, and an attack's contact stays. With ``warn`` and ``none`` and no stop, no vehicle is moved by a
    collision.
    """
    action, stop = (given.get(name, SUMOS[name]) for name in COLLISIONS)
    on_junctions = is_on(given.get("collision.check-junctions"))
    if action == "teleport" and not on_junctions:
        return {name: given[name] for name in COLLISIONS if name in given}, ()
    if action not in ("teleport", "remove") and not stop.strip("0.:"):
        return {"collision.action": action}, ()
    why = ", as SUMO looks for collisions on junctions" if on_junctions else ""
    return {"collision.action": "warn", "collision.stoptime": "0"}, (
        f"What {file_name} says of collisions is not kept{why} (collision.action={action}, "
        f"collision.stoptime={stop}): vehicles that collide drive on, so what comes after a collision of your own "
        "traffic may differ.",
    )


def part_of(step: float) -> float | None:
    """The longest step [s] up to ``FINE_STEP_LENGTH_S`` of which ``step`` is a multiple, so that what SUMO does at the
    times of the long steps is done; None if there is none. SUMO counts in whole ms."""
    whole = round(1000 * step)
    shortest, longest = round(1000 * MIN_STEP_LENGTH_S), round(1000 * FINE_STEP_LENGTH_S)
    return next((part / 1000 for part in range(longest, shortest - 1, -1) if whole >= part and whole % part == 0), None)


def differing(options: Mapping[str, str]) -> dict[str, str]:
    """What a scenario needs of its own, beside ``DEFAULTS``, to run with these options."""
    wanted = {
        name: value for name, value in {**SUMOS, **options}.items() if name not in (*FORCED, *OPTIONS_SET_ELSEWHERE)
    }
    return {
        name: value for name, value in wanted.items()
        if DEFAULTS.get(name) != value and (name in COLLISIONS or not is_own(name))
    }  # fmt: skip


def parse_options(given: Sequence[str]) -> dict[str, str]:
    """``NAME=VALUE`` texts as options. Raises UsageError for another form."""
    parsed: dict[str, str] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not name.strip("- ") or not equals or not value.strip():
            raise UsageError(f"--option takes NAME=VALUE, as in time-to-teleport=300, and not '{text}'.")
        parsed[name.strip().lstrip("-")] = value.strip()
    return parsed


def refuse(options: Mapping[str, str]) -> None:
    """Raises UsageError for an option that has another place, that this program must set itself, or that may not be
    given; and for a value that is not of the option's type."""
    for name in options:
        if name in OPTIONS_SET_ELSEWHERE:
            raise UsageError(f"SUMO's option '{name}' cannot be passed through: {OPTIONS_SET_ELSEWHERE[name]}.")
        if name == "no-internal-links":
            raise UsageError(f"SUMO's option '{name}' cannot be passed through: {NO_JUNCTIONS}.")
        if name in FORCED or (name in COLLISIONS and _collisions("--option", {**DEFAULTS, **options})[1]):
            raise UsageError(f"SUMO's option '{name}' is set by this program: leave it out.")
    check(options)
