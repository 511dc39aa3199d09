"""Read a .sumocfg as SUMO reads it: its files, its times, and its options with SUMO's defaults.

Measured with SUMO 1.28:

- Each element with a ``value`` (or ``v``) is an option, in any section. The text of an element without children counts
  as its value, too.
- Commas separate the files of a list.
- ``%20`` in a file's name is a space, and so on. A name with a ``%`` that two hexadecimal digits do not follow is taken
  as it is.
- ``${NAME}`` is an environment variable; it is empty if the variable is not set.
- ``~`` at the start of a file is the home folder.
- An option that is named twice, even by two of its names, ends SUMO.
- An unknown attribute is ignored.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from sumo_adv.errors import UsageError
from sumo_adv.simulation.scan import parse_seconds, parse_xml
from sumo_adv.simulation.sumo_options import (
    MAX_STEP_LENGTH_S,
    MIN_STEP_LENGTH_S,
    SUMO_STEP_LENGTH_S,
    SUMOS_SEED,
    kept,
    only_shows,
    part_of,
)

_SYNONYMS = """
c configuration configuration-file|n net net-file|r routes route-files|a additional additional-files|
w weights weight-files|b begin|e end|s route-steps|H human-readable-time|v verbose|X xml-validation|l log-file log|
t duration-log.statistics|no-duration-log duration-log.disable|summary summary-output|tripinfo tripinfo-output|
personinfo personinfo-output|vehroutes vehroute-output|person-fcd person-fcd-output|
ndump netstate netstate-output netstate-dump|statistics-output statistic-output|personroutes personroute-output|
carfollow.model default.carfollowmodel|routing-threads device.rerouting.threads|taxi.vclasses device.taxi.vclasses|
railsignal.moving-block railsignal-moving-block|meso.ignore-lanes.by-vclass meso-ignore-lanes-by-vclass|
g gui-settings-file|Q quit-on-end|G game|S start|d delay|B breakpoints|D demo|T disable-textures|
data-files m edgedata-files|N alternative-net-file|device.fcd-replay.file device.fcd-replay.files
"""
SYNONYMS: Mapping[str, str] = {
    name: group.split()[-1] for group in _SYNONYMS.split("|") for name in group.split()
}  # fmt: skip
"""All names of SUMO's options that have several (``sumo --save-template``), with the name that SUMO uses itself."""
_KNOWN_ATTRIBUTES = frozenset(("value", "v", "type", "help", "synonymes"))
_ENVIRONMENT_VARIABLE = re.compile(r"\$\{(.+?)\}")
_NO_ESCAPE = re.compile(r"%(?![0-9A-Fa-f]{2})")  # a percent sign that stands for itself
_SECRET = re.compile(
    r"KEY|TOKEN|SECRET|PASSW|CREDENTIAL|SUMO_ADV_", re.IGNORECASE
)  # parts of variable names that suggest a secret
_OF_SUMO = ("LOCALTIME", "UTC", "PID")  # variables that SUMO sets itself, for names of outputs
_FILES = ("net-file", "route-files", "additional-files")
_OWN_OPTIONS = (*_FILES, "begin", "end", "seed", "step-length")


@dataclass(frozen=True, slots=True)
class Configuration:
    """The content of a .sumocfg.

    Attributes:
        networks: Its net-file; there should be one.
        routes: Its route files, in order.
        additional: Its additional files, in order.
        begin: When the simulation begins [s].
        end: When the simulation ends [s]; None if it has no end.
        seed: The seed; SUMO's default if the file names none.
        step: The step length for this program [s]; None means this program's default.
        sumo_step: The step length that SUMO uses [s].
        options: All other options that are kept, by SUMO's long names.
        notes: Sentences about what is not kept, and what SUMO ignores.
    """

    networks: tuple[Path, ...]
    routes: tuple[Path, ...]
    additional: tuple[Path, ...]
    begin: float
    end: float | None
    seed: int
    step: float | None
    sumo_step: float
    options: Mapping[str, str]
    notes: tuple[str, ...]


def is_sumocfg(path: Path) -> bool:
    """Return whether the file's name is that of a .sumocfg."""
    return path.name.lower().endswith((".sumocfg", ".sumo.cfg"))


def read_sumocfg(path: Path, environ: Mapping[str, str] = os.environ) -> Configuration:
    """Read the simulation that a .sumocfg describes.

    Args:
        path: The file.
        environ: The environment variables.

    Returns:
        The configuration.

    Raises:
        UsageError: The file is damaged, names an option twice, has a bad time, or cannot be run.
    """
    given, notes = _options(path, environ)
    begin, end = (parse_seconds(path, key, given.get(key)) for key in ("begin", "end"))
    if begin is None and "begin" in given:
        raise UsageError(f"{path} begins at {given['begin']} s: SUMO takes no negative begin, so correct it.")
    begin = begin or 0.0
    if end is not None and end <= begin:
        raise UsageError(f"{path} ends at {end:g} s, which is not after its begin: correct one of the two.")
    sumo_step = parse_seconds(path, "step-length", given.get("step-length", str(SUMO_STEP_LENGTH_S)))
    if not sumo_step:
        raise UsageError(f"{path} has steps of {given['step-length'][:40]} s: give a step-length above 0.")
    step, said = _step(path, sumo_step, named="step-length" in given)
    options, left = kept(path, {name: value for name, value in given.items() if name not in _OWN_OPTIONS})
    if end is not None:
        options["end"] = given["end"]  # flows without their own end use this one
    networks, routes, additional = (_files(path, given.get(name, "")) for name in _FILES)
    return Configuration(
        networks, routes, additional, begin, end, _seed(path, given), step, sumo_step, options,
        (*said, *left, *notes),
    )  # fmt: skip


def as_sumo_reads_it(path: Path) -> dict[str, str]:
    """Return the options of a .sumocfg, without its files and without options that write, report or show something.

    File names are resolved against the configuration's folder.

    Raises:
        UsageError: The file is damaged, or names an option twice.
    """
    given, _ = _options(path, os.environ)
    return {
        name: str(file.absolute()) if (file := path.parent / _decoded(value)).is_file() else value
        for name, value in given.items()
        if name not in _FILES and not only_shows(name)
    }


def _options(path: Path, environ: Mapping[str, str]) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the options by SUMO's long names, and sentences about ignored attributes and unset variables."""
    options: dict[str, str] = {}
    notes: list[str] = []
    text: list[str] | None = None  # the text of the open element; None after a child of it

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal text
        text = []
        values = [attributes[name] for name in ("value", "v") if name in attributes]
        if values:
            give(tag, attributes, values)

    def read(part: str) -> None:
        if text is not None:
            text.append(part)

    def end(tag: str) -> None:
        nonlocal text
        if text is not None and (value := "".join(text).strip()):
            give(tag, {}, [value])
        text = None

    def give(tag: str, attributes: Mapping[str, str], values: Sequence[str]) -> None:
        name = SYNONYMS.get(tag, tag)
        if name in options or len(values) > 1:
            raise UsageError(f"{path} names the option '{name}' twice, which SUMO refuses: remove one of the two.")
        unknown = [key for key in attributes if key not in _KNOWN_ATTRIBUTES]
        if unknown:
            notes.append(f"SUMO passes over the attribute '{unknown[0]}' of the option '{tag}' in {path.name}.")
        value, unset = _expanded(values[0].strip(), environ)
        secret = next(
            (each for each in _ENVIRONMENT_VARIABLE.findall(f"{values[0]} {value}") if _SECRET.search(each)), None
        )
        if secret is not None:  # values of options appear in messages and in a run's files
            raise UsageError(f"{path} names the variable {secret!r}, which may hold a secret: remove it or rename it.")
        if unset and name in _FILES:
            raise UsageError(f"{path} names its {name} by the variable {unset[0]}, which is not set: set it.")
        notes.extend(f"The variable {each} of {path.name} is not set, so it is empty, as in SUMO." for each in unset)
        if value:
            options[name] = value

    parse_xml(path, start, end, read)
    return options, tuple(notes)


def _expanded(text: str, environ: Mapping[str, str]) -> tuple[str, list[str]]:
    """Return a value with its variables replaced, and the names of unset variables."""
    names = [name for name in _ENVIRONMENT_VARIABLE.findall(text) if name not in _OF_SUMO]
    unset = [name for name in names if name not in environ]
    whole = _ENVIRONMENT_VARIABLE.sub(lambda m: m[0] if m[1] in _OF_SUMO else environ.get(m[1], ""), text)
    home = environ.get("HOME", "")
    if whole.startswith("~"):
        whole = f"{home}{whole[1:]}"
    return whole.replace(",~", f",{home}"), unset


def _seed(path: Path, given: Mapping[str, str]) -> int:
    """Return the seed, or SUMO's default if none is named; refuse one below 0, which only SUMO accepts."""
    try:
        seed = int(given.get("seed", SUMOS_SEED))
    except ValueError:
        seed = -1
    if seed < 0:
        raise UsageError(f"{path} has the seed {given['seed'][:40]}: give a whole number from 0 on.")
    return seed


def _step(path: Path, step: float, *, named: bool) -> tuple[float | None, tuple[str, ...]]:
    """Return the step length for this program [s] and notes.

    The step is kept without a note if it is possible. Otherwise it is a part of the step, or None for this program's
    default, with a note.
    """
    if MIN_STEP_LENGTH_S <= step <= MAX_STEP_LENGTH_S:
        return step, ()
    taken = part_of(step)
    said = f"{step:g} s" if named else "SUMO's default of 1 s"
    why = f"this program takes steps of {MIN_STEP_LENGTH_S:g} to {MAX_STEP_LENGTH_S:g} s"
    but = "Drivers then decide at other times, so motions differ from those of SUMO alone."
    if taken is None:
        return None, (f"The step-length of {path.name}, {said}, is not kept: {why}, here of its own. {but}",)
    whole = round(step / taken)
    return taken, (
        f"The step-length of {path.name}, {said}, is not kept: {why}, here of {taken:g} s, of which {whole} make one. "
        f"{but}",
    )


def _files(configuration: Path, value: str) -> tuple[Path, ...]:
    """Return the files of SUMO's comma-separated list, resolved against the configuration's folder."""
    return tuple(configuration.parent / _decoded(name.strip()) for name in value.split(",") if name.strip())


def _decoded(name: str) -> str:
    """Return a file's name with its percent escapes replaced, which SUMO writes for spaces and other characters."""
    return name if _NO_ESCAPE.search(name) else unquote(name)
