"""Options of SUMO: what of a user's own simulation is kept, and what this program must set itself.

A network or a scenario alone runs with ``DEFAULTS``. A .sumocfg is a simulation: its options are kept, and those that
it does not name are SUMO's own defaults. Names are SUMO's long ones, without dashes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from sumo_adv.errors import UsageError

DEFAULTS = {
    "time-to-teleport": "-1", "lateral-resolution": "0.8", "default.speeddev": "0", "collision.mingap-factor": "0",
    "collision.check-junctions": "true",
}  # fmt: skip
SUMOS = {
    "time-to-teleport": "300", "lateral-resolution": "-1", "default.speeddev": "-1", "collision.mingap-factor": "-1",
    "collision.check-junctions": "false",
}  # fmt: skip
"""SUMO's own values of ``DEFAULTS``."""
FORCED = {
    "collision.action": "warn", "collision.stoptime": "0", "device.ssm.file": "NUL", "xml-validation": "never",
    "no-step-log": "true", "no-warnings": "true", "duration-log.disable": "true",
}  # fmt: skip
"""With this action and no stop, what SUMO takes for a collision moves no vehicle (measured), and this program finds
collisions by geometry. The other options of collisions change SUMO's own list alone. A vehicle may have an SSM device
of its own, which would write a file in the working folder."""
SHORTEST_STEP, LONGEST_STEP = 0.01, 0.5  # s
SUMO_STEP, FINE_STEP = 1.0, 0.1  # s: SUMO's default, and the longest part of a step that is too long
ELSEWHERE = {
    "net-file": "give the network as the INPUT", "route-files": "name it in a .sumocfg",
    "additional-files": "name it in a .sumocfg", "begin": "use --begin", "end": "use --end", "seed": "use --seed",
    "step-length": "use the setting step_length",
}  # fmt: skip
"""Options of SUMO that have another place, and which."""
_OWN = ("device.ssm.", "gui-", "window-", "save-", "xml-validation", "duration-log", "message-log", "error-log")
_OWN_NAMES = frozenset(
    ("collision.action", "collision.stoptime", "remote-port", "num-clients", "configuration-file", "log", "log-file",
     "verbose", "no-warnings", "no-step-log", "step-log.period", "threads", "load-state", "start", "quit-on-end",
     "delay", "game", "breakpoints", "summary", "tripinfo", "netstate", "netstate-dump", "random", "mesosim",
     "print-options", "help", "version")
)  # fmt: skip


def is_own(name: str) -> bool:
    """Whether this program sets the option itself: effects of collisions, outputs, messages, GUI, threads, port. No
    option that writes a file is left to an input (``device.ssm`` writes files without being told to)."""
    return name in _OWN_NAMES or name.startswith(_OWN) or "output" in name or name.endswith(".file")


def kept(configuration: Path, given: Mapping[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """The options of a .sumocfg that are kept, and ``NAME=VALUE`` of those that are not.

    An option that names a file is not kept: a run copies its network, demand and additional files alone. An option
    that this program sets to the same value is in neither.
    """
    own = {name for name, value in given.items() if is_own(name) or _is_file(configuration, value)}
    left = tuple(f"{name}={given[name]}" for name in given if name in own and FORCED.get(name) != given[name])
    return {name: value for name, value in given.items() if name not in own}, left


def _is_file(configuration: Path, value: str) -> bool:
    return any((configuration.parent / part.strip()).is_file() for part in value.split(",") if part.strip())


def part_of(step: float) -> float | None:
    """The longest step [s] up to ``FINE_STEP`` of which ``step`` is a multiple, so that what SUMO does at the times of
    the long steps is done; None if there is none. SUMO counts in whole ms."""
    whole = round(1000 * step)
    shortest, longest = round(1000 * SHORTEST_STEP), round(1000 * FINE_STEP)
    return next((part / 1000 for part in range(longest, shortest - 1, -1) if whole >= part and whole % part == 0), None)


def differing(options: Mapping[str, str]) -> dict[str, str]:
    """What a scenario needs of its own, beside ``DEFAULTS``, to run with these options."""
    wanted = {name: value for name, value in {**SUMOS, **options}.items() if name not in FORCED}
    return {name: value for name, value in wanted.items() if DEFAULTS.get(name) != value}


def parse(given: Sequence[str]) -> dict[str, str]:
    """``NAME=VALUE`` texts as options. Raises UsageError for another form."""
    parsed: dict[str, str] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not name.strip("- ") or not equals or not value.strip():
            raise UsageError(f"--option takes NAME=VALUE, as in time-to-teleport=300, and not '{text}'.")
        parsed[name.strip().lstrip("-")] = value.strip()
    return parsed


def refuse(options: Mapping[str, str]) -> None:
    """Raises UsageError for an option that has another place, or that this program must set itself."""
    for name in options:
        if name in ELSEWHERE:
            raise UsageError(f"SUMO's option '{name}' cannot be passed through: {ELSEWHERE[name]}.")
        if is_own(name):
            raise UsageError(f"SUMO's option '{name}' is set by this program: leave it out.")
