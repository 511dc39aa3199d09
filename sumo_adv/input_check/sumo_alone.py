"""Run the program ``sumo`` without this program, and read the motions that it writes as FCD."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO
from xml.parsers import expat

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.input_check.motions import Motions, State
from sumo_adv.simulation.programs import find_sumo
from sumo_adv.simulation.scan import silent_copies
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_options import FORCED
from sumo_adv.simulation.sumo_states import PERSON
from sumo_adv.simulation.sumocfg import as_sumo_reads_it, is_sumocfg
from sumo_adv.simulation.warnings_log import warnings_in

SUMO_ALONE_TIMEOUT_S = 600.0
READ_AT_ONCE_BYTES = 1 << 16
WITHOUT_STEPS = "--pedestrian.model=nonInteracting"  # such a pedestrian's position is valid when it is read
FCD_DEVICES = ("device.fcd.", "person-device.fcd.")  # options that set for whom and when SUMO writes FCD
# SUMO's option for a file with vehicles and types, whose parameters could make SUMO write files
LOAD_STATE_OPTION = "load-state"


@dataclass(frozen=True, slots=True)
class Alone:
    """The result of a simulation in the program ``sumo``.

    Attributes:
        motions: The motions of the vehicles and persons.
        warnings: SUMO's warnings.
    """

    motions: Motions
    warnings: tuple[str, ...]


def arguments_of(spec: SimulationSpec, path: Path, step: float, folder: Path) -> list[str]:
    """Return the options of ``sumo`` for an input.

    For a .sumocfg, they are the options that it names, as SUMO reads them. For other inputs, they are the options of
    this program. The files are the same as in this program, without outputs.

    Args:
        spec: The simulation.
        path: The input's file.
        step: The step length [s].
        folder: The folder for a copy of a saved state without outputs.

    Raises:
        UsageError: The saved state is missing or damaged.
    """
    spec = replace(
        spec, network=spec.network.absolute(), routes=tuple(file.absolute() for file in spec.routes),
        additional=tuple(file.absolute() for file in spec.additional), step_length=step,
    )  # fmt: skip
    if not is_sumocfg(path):
        return spec.arguments()
    files = {"net-file": (spec.network,), "route-files": spec.routes, "additional-files": spec.additional}
    named = {name: ",".join(map(str, each)) for name, each in files.items() if each}
    options = {**named, **_of_all(as_sumo_reads_it(path)), **FORCED, "step-length": repr(step)}
    if LOAD_STATE_OPTION in options:
        options[LOAD_STATE_OPTION] = str(silent_copies([Path(options[LOAD_STATE_OPTION])], folder)[0])
    return [f"--{name}={value}" for name, value in options.items()]  # a separate value could be read as an option


def _of_all(options: Mapping[str, str]) -> dict[str, str]:
    """Change the options so that SUMO writes FCD of all vehicles and persons at all times.

    A probability becomes 1, because SUMO then draws its random numbers as often as before.
    """
    kept = {name: value for name, value in options.items() if not name.startswith(FCD_DEVICES)}
    drawn = {f"{device}probability" for device in FCD_DEVICES} & options.keys()
    return {**kept, **dict.fromkeys(sorted(drawn), "1")}


def run_alone(spec: SimulationSpec, path: Path, step: float, until: float, folder: Path) -> Alone:
    """Run ``sumo`` on an input.

    The process is killed at the end, because the option for SUMO's own end would change flows.

    Args:
        spec: The simulation.
        path: The input's file.
        step: The step length [s].
        until: The time at which to stop [s].
        folder: The folder for SUMO's messages.

    Raises:
        UsageError: The program is not installed, or refuses the input.
        SimulationError: The program takes longer than ``SUMO_ALONE_TIMEOUT_S``.
    """
    command = [
        str(find_sumo()), *arguments_of(spec, path, step, folder), "--fcd-output", "stdout",
        "--fcd-output.attributes", "x,y,speed,vehicle", "--precision", "6",
    ]  # fmt: skip
    words = folder / "sumo.txt"
    with words.open("wb") as said:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, cwd=folder
        )  # fmt: skip
        patience = threading.Timer(SUMO_ALONE_TIMEOUT_S, process.kill)
        patience.start()
        try:
            assert process.stdout is not None
            walked = 0.0 if WITHOUT_STEPS in command else step
            motions, reached = _read(process.stdout, step, until, walked)
        finally:
            in_time = patience.is_alive()
            patience.cancel()
            process.kill()
            process.wait()
    printed = words.read_text(encoding="utf-8", errors="replace")
    if not in_time:
        raise SimulationError(f"SUMO alone took more than {SUMO_ALONE_TIMEOUT_S:g} s: give fewer --seconds.")
    if not reached:
        errors = [line.removeprefix("Error: ") for line in printed.splitlines() if line.startswith("Error: ")]
        if errors:
            raise UsageError(f"SUMO itself does not run this input ({errors[0].rstrip('.!')}): correct it.")
    return Alone(motions, warnings_in(printed))


def _read(stream: IO[bytes], step: float, until: float, walked: float) -> tuple[Motions, bool]:
    """Read the states of FCD.

    SUMO writes the state after a step with the time before the step. The states here have the time after it.

    Args:
        stream: The FCD output.
        step: The step length [s].
        until: The time up to which to read [s].
        walked: How long a person has walked since the written time [s].

    Returns:
        The motions, and whether the output reaches beyond ``until``.
    """
    motions: dict[str, dict[int, State]] = {}
    time, last = 0, round(1000 * until)

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal time
        if tag == "timestep":
            time = round(1000 * (float(attributes["time"]) + step))
        elif tag in ("vehicle", "person") and not attributes.get("vehicle"):
            name = attributes["id"] if tag == "vehicle" else PERSON + attributes["id"]
            state = (float(attributes["x"]), float(attributes["y"]), float(attributes["speed"]))
            at = time if tag == "vehicle" else time - round(1000 * (step - walked))
            motions.setdefault(name, {})[at] = state

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    while time <= last and (part := stream.read(READ_AT_ONCE_BYTES)):
        parser.Parse(part)
    return motions, time > last
