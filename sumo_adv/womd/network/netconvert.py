"""Runs netconvert."""

from __future__ import annotations

import subprocess
from pathlib import Path

from sumo_adv.errors import UsageError

OPTIONS = (
    "--offset.disable-normalization", "--no-turnarounds", "--junctions.join", "false",
    "--geometry.avoid-overlap", "false", "--default.junctions.radius", "0", "--precision", "3",
    "--geometry.max-angle", "-1", "--geometry.min-radius", "-1", "--no-warnings", "--xml-validation", "never",
)  # fmt: skip
TIMEOUT = 120.0  # s


def run_netconvert(program: Path, folder: Path, target: Path) -> None:
    """From ``plain.*.xml`` in ``folder`` to ``target``. Raises UsageError with netconvert's last error."""
    command = [str(program), *OPTIONS, "-o", str(target)]
    for option, kind in (("-n", "nod"), ("-e", "edg"), ("-x", "con")):
        command += [option, str(folder / f"plain.{kind}.xml")]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UsageError(f"netconvert could not build the network: {error}.") from error
    if done.returncode != 0 or not target.is_file():
        errors = [line for line in done.stderr.splitlines() if line.startswith("Error")]
        last = errors[-1].removeprefix("Error: ").rstrip(".") if errors else f"exit status {done.returncode}"
        raise UsageError(f"netconvert could not build the network: {last}.")
