"""The program ``sumo`` alone on a simulation, without this program: what it writes as FCD."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.input_check.motions import Motions, State
from sumo_adv.simulation.programs import find_sumo
from sumo_adv.simulation.scan import parse
from sumo_adv.simulation.simulation import PERSON, SimulationSpec
from sumo_adv.simulation.sumo_options import FORCED
from sumo_adv.simulation.sumocfg import as_sumo_reads_it, is_sumocfg
from sumo_adv.simulation.warnings_log import warnings_in

PATIENCE = 600.0  # s


@dataclass(frozen=True, slots=True)
class Alone:
    """The motions of a simulation in the program ``sumo``, and its warnings."""

    motions: Motions
    warnings: tuple[str, ...]


def arguments_of(spec: SimulationSpec, source: Path, step: float) -> list[str]:
    """The options of ``sumo`` for an input in steps of ``step`` [s], but for the end.

    Of a .sumocfg they are those that it names, as SUMO reads them; of other inputs those of this program. The files are
    the same ones, without outputs.
    """
    spec = replace(
        spec, network=spec.network.absolute(), routes=tuple(file.absolute() for file in spec.routes),
        additional=tuple(file.absolute() for file in spec.additional), step_length=step,
    )  # fmt: skip
    if not is_sumocfg(source):
        return spec.arguments()
    files = (("-n", (spec.network,)), ("-r", spec.routes), ("-a", spec.additional))
    args = [part for flag, each in files if each for part in (flag, ",".join(map(str, each)))]
    left_out = ("step-length", "end", "begin")
    options = {name: value for name, value in as_sumo_reads_it(source).items() if name not in left_out}
    options |= {**FORCED, "begin": repr(spec.begin), "step-length": repr(step)}
    return [*args, *(part for name, value in options.items() for part in (f"--{name}", value))]


def run_alone(spec: SimulationSpec, source: Path, step: float, until: float, folder: Path) -> Alone:
    """Run ``sumo`` on an input in steps of ``step`` [s] until ``until`` [s]; ``folder``: for its file.

    Raises:
        UsageError: The program is not installed, or refuses the input.
        SimulationError: It fails.
    """
    target = folder / f"fcd-{step:g}.xml"
    command = [
        str(find_sumo()), *arguments_of(spec, source, step), "--end", repr(until), "--fcd-output", str(target),
        "--fcd-output.attributes", "x,y,speed,vehicle", "--precision", "6",
    ]  # fmt: skip
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=PATIENCE, stdin=subprocess.DEVNULL, cwd=folder
        )
    except subprocess.TimeoutExpired as error:
        raise SimulationError(f"SUMO alone took more than {PATIENCE:g} s: give fewer --seconds.") from error
    if done.returncode != 0:
        errors = [line.removeprefix("Error: ") for line in done.stderr.splitlines() if line.startswith("Error: ")]
        why = errors[0].rstrip(".!") if errors else f"exit status {done.returncode}"
        raise UsageError(f"SUMO itself does not run this input ({why}): correct it.")
    return Alone(_read(target, step), warnings_in(done.stderr))


def _read(file: Path, step: float) -> Motions:
    """The states of an FCD file at the times after its steps: SUMO writes the state after a step with the time before
    it."""
    motions: dict[str, dict[int, State]] = {}
    time = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal time
        if tag == "timestep":
            time = round(1000 * (float(attributes["time"]) + step))
        elif tag in ("vehicle", "person") and not attributes.get("vehicle"):
            name = attributes["id"] if tag == "vehicle" else PERSON + attributes["id"]
            state = (float(attributes["x"]), float(attributes["y"]), float(attributes["speed"]))
            motions.setdefault(name, {})[time] = state

    parse(file, start)
    return motions
