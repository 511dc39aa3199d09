"""The second wall: monty's worker inside bubblewrap (Linux), or as a plain process.

The worker sees its own file and the few libraries it is linked with, read-only. It has no network, /proc, /dev, home,
environment or capabilities. Its user is 65534, and its session and name spaces are its own. Most containers refuse
bubblewrap. Then the container is the second wall, and ``Jail.note`` says so.
Measured on two slow cores: the probe takes 60 ms once, the first session 8 ms (plain 5 ms), all else is equal.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from sumo_adv.errors import SandboxError

SWITCH = "SUMO_ADV_BUBBLEWRAP"
ADDRESS_SPACE = 1 << 30  # bytes, beside the memory limit: what the worker needs itself, with its type checker
_PROBE_SECONDS = 10.0


@dataclass(frozen=True, slots=True)
class Jail:
    """How the worker is started: ``command`` (argv), ``isolation`` (bubblewrap | process), ``note`` (a sentence)."""

    command: tuple[str, ...]
    isolation: str
    note: str


def make_jail(bubblewrap: bool = True) -> Jail:
    """Find the worker and the strongest way to start it here.

    Args:
        bubblewrap: False turns it off, and so does ``off`` in the variable ``SUMO_ADV_BUBBLEWRAP``.

    Raises:
        SandboxError: monty's worker is not installed.
    """
    worker = _find_worker()
    if not bubblewrap or os.environ.get(SWITCH, "on").strip().lower() in ("off", "0", "false", "no"):
        return _plain(worker, "bubblewrap is turned off")
    if not sys.platform.startswith("linux"):
        return _plain(worker, "bubblewrap exists on Linux alone")
    program = shutil.which("bwrap")
    if program is None:
        return _plain(worker, "bwrap is not installed")
    try:
        command = (
            *_bubblewrap(program, _libraries(worker)),
            "--ro-bind",
            worker,
            "/monty",
            "--remount-ro",
            "/",
            "/monty",
        )
        failure = _probe(command)
    except (OSError, subprocess.SubprocessError) as error:
        failure = str(error)
    if failure is not None:
        return _plain(worker, f"bubblewrap is refused here ({failure})")
    return Jail(
        command, "bubblewrap", "Planners run in a separate interpreter inside bubblewrap: no network, no files."
    )


def wrapper_script(jail: Jail, memory: int) -> str:
    """A POSIX ``sh`` script that starts the worker with an address-space limit, no core file and no messages.

    ``memory``: of the planner's heap [bytes].
    """
    kilobytes = (ADDRESS_SPACE + memory) // 1024
    return (
        "#!/bin/sh\n"
        "ulimit -c 0 2>/dev/null\n"
        f"ulimit -v {kilobytes} 2>/dev/null\n"
        f'exec {shlex.join(jail.command)} "$@" 2>/dev/null\n'
    )


def _find_worker() -> str:
    from pydantic_monty._binary import find_monty_binary

    try:
        return str(Path(find_monty_binary()).resolve())
    except FileNotFoundError:
        raise SandboxError("The sandbox's worker is not installed: install pydantic-monty again.") from None


def _plain(worker: str, reason: str) -> Jail:
    note = f"Planners run in a separate interpreter in a plain process, because {reason}; a container is a second wall."
    return Jail((worker,), "process", note)


def _bubblewrap(program: str, libraries: list[str]) -> list[str]:
    command = [program, "--unshare-all", "--die-with-parent", "--new-session", "--cap-drop", "ALL", "--clearenv"]
    command += ["--uid", "65534", "--gid", "65534", "--chdir", "/"]
    for library in libraries:
        command += ["--ro-bind", library, library]
    return command


def _libraries(worker: str) -> list[str]:
    """Absolute paths of the worker's shared libraries and loader; empty if it is linked statically."""
    done = subprocess.run(["ldd", worker], capture_output=True, text=True, timeout=_PROBE_SECONDS, check=False)
    return re.findall(r"(/\S+) \(0x[0-9a-f]+\)", done.stdout)


def _probe(command: tuple[str, ...]) -> str | None:
    """None if the worker starts and prints its version, else the reason."""
    done = subprocess.run(
        [*command, "--version"],
        capture_output=True,
        text=True,
        timeout=_PROBE_SECONDS,
        check=False,
        stdin=subprocess.DEVNULL,
    )
    if done.returncode == 0 and done.stdout.startswith("monty"):
        return None
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return lines[0][:160] if lines else f"exit status {done.returncode}"
