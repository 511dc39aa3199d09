"""Options of SUMO: what of a user's own simulation is kept, and what this program must set itself.

A network or a scenario alone runs with ``DEFAULTS``. A .sumocfg is a simulation: its options are kept, and those that
it does not name are SUMO's own defaults. Names are SUMO's long ones, without dashes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sumo_adv.errors import UsageError
from sumo_adv.simulation.given_options import KINDS, check

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


def is_own(name: str) -> bool:
    """Whether this program sets the option itself, or leaves it alone: effects of collisions, outputs, messages, GUI,
    threads, port; and whatever is not in the list of those that may be given."""
    return name in FORCED or name not in KINDS


def kept(given: Mapping[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """The options of a .sumocfg that are kept, and ``NAME=VALUE`` of those that are not.

    An option that this program sets to the same value is in neither. Raises UsageError for a value that is not of the
    type of its option.
    """
    left = tuple(f"{name}={given[name]}" for name in given if is_own(name) and FORCED.get(name) != given[name])
    chosen = {name: value for name, value in given.items() if not is_own(name)}
    check(chosen)
    return chosen, left


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
    """Raises UsageError for an option that has another place, that this program must set itself, or that may not be
    given; and for a value that is not of the option's type."""
    for name in options:
        if name in ELSEWHERE:
            raise UsageError(f"SUMO's option '{name}' cannot be passed through: {ELSEWHERE[name]}.")
        if name in FORCED:
            raise UsageError(f"SUMO's option '{name}' is set by this program: leave it out.")
    check(options)
