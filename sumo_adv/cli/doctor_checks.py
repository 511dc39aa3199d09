"""Check the machine and the user's files for ``doctor``. Each check tries the real thing and says how to fix it."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from sumo_adv import __version__
from sumo_adv.app import shipped_bank
from sumo_adv.config import SETTING_PREFIX
from sumo_adv.errors import SumoAdvError
from sumo_adv.memory.store import default_bank_path
from sumo_adv.planners.text import make_planner
from sumo_adv.simulation.programs import SYSTEM_LIBRARIES

LIBRARIES = ("numpy", "scipy", "shapely", "httpx", "pydantic", "pydantic_settings", "typer", "rich", "matplotlib")
EXTRAS = (
    ("sumo", "sumo", "serve, Waymo records, OpenSCENARIO"), ("google.protobuf", "womd", "Waymo records"),
    ("qc_openscenario", "export", "OpenSCENARIO"), ("pyarrow", "batch", "results.parquet"),
    ("ray", "ray", "batches and crash rates on several machines"),
    ("fiss_planner", "planners", "the ego fiss_plus"),
    ("commonroad", "commonroad", "CommonRoad planners"), ("gymnasium", "gym", "the environments"),
    ("optax", "train", "training the row transformer"),
)  # fmt: skip
PROGRAM_TIMEOUT_S = 30.0  # longest time for a program to answer
CONTAINERS = ("/.dockerenv", "/run/.containerenv")
ONE_STEP = """\
import sys
import libsumo
libsumo.start(["sumo", "-n", sys.argv[1], "--no-step-log", "--no-warnings", "--xml-validation", "never"])
libsumo.simulationStep()
said = libsumo.getVersion()[1]
libsumo.close()
print(said.split()[-1])
"""
TRIED = """\
PARAMETERS = {}


def endpoint(bv, ego, road, parameters, acc, horizon):
    pose = at(ego["path"], 3.0)
    x, y = offset(pose, bv["ahead"], bv["left"])
    return {"x": x, "y": y, "heading": pose[2], "speed": pose[3], "time": 3.0}
"""


class FindingLevel(StrEnum):
    """The level of a finding. ``FAIL``: a run cannot work. ``WARN``: something else cannot, or a wall is missing."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True)
class DoctorFinding:
    """One line of the report.

    Attributes:
        name: The thing that was checked.
        level: The level of the finding.
        found: The finding.
        mend: How to fix it; empty if nothing is wrong.
    """

    name: str
    level: FindingLevel
    found: str
    mend: str = ""


def reason(error: Exception) -> str:
    """Return an error's message in one line, with the error's type if it is not one of this program's."""
    text = " ".join(str(error).split()).rstrip(".")
    return text if isinstance(error, SumoAdvError) else f"{type(error).__name__}: {text}"


def interpreter() -> Iterator[DoctorFinding]:
    """Report the versions, and whether the system can fork attempts."""
    here = f"sumo_adv {__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    if hasattr(os, "fork") and sys.platform != "darwin":
        yield DoctorFinding("program", FindingLevel.OK, here)
    else:
        yield DoctorFinding(
            "program", FindingLevel.WARN,
            f"{here}; attempts are not forked here but loaded and repeated, which is slower",
            "run on Linux (a container will do)",
        )  # fmt: skip


def libraries(names: tuple[str, ...] = LIBRARIES) -> Iterator[DoctorFinding]:
    """Import each library and report its version."""
    present, missing = [], []
    for name in names:
        try:
            importlib.import_module(name)
            present.append(f"{name} {version(name.replace('_', '-'))}")
        except Exception as error:  # a broken binary may raise anything
            missing.append(f"{name} ({reason(error)})")
    if missing:
        mend = "install the package again: pip install --force-reinstall sumo-adv"
        yield DoctorFinding("libraries", FindingLevel.FAIL, f"cannot be imported: {', '.join(missing)}", mend)
    else:
        yield DoctorFinding("libraries", FindingLevel.OK, ", ".join(present))


def _installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ImportError:  # the package above the module is missing
        return False


def extras(there: Callable[[str], bool] = _installed) -> Iterator[DoctorFinding]:
    """Report the optional packages. ``there`` says whether a module is installed."""
    missing = [(extra, use) for module, extra, use in EXTRAS if not there(module)]
    names = ", ".join(extra for _, extra, _ in EXTRAS if extra not in {e for e, _ in missing})
    if not missing:
        yield DoctorFinding("extras", FindingLevel.OK, names)
    for extra, use in missing:
        yield DoctorFinding(
            f"extra {extra}",
            FindingLevel.WARN,
            f"not installed; it is only for {use}",
            f"pip install 'sumo-adv[{extra}]'",
        )


def simulator(network: Path) -> Iterator[DoctorFinding]:
    """Run one step of SUMO on ``network``, in a process that it may crash."""
    try:
        done = _said(sys.executable, "-c", ONE_STEP, str(network))
    except (OSError, subprocess.TimeoutExpired) as error:
        yield DoctorFinding(
            "simulator", FindingLevel.FAIL, f"SUMO did not run ({reason(error)})", "try again on an idle machine"
        )
        return
    if done.returncode == 0:
        yield DoctorFinding(
            "simulator", FindingLevel.OK, f"SUMO {done.stdout.strip()}, as the library libsumo; one step was run"
        )
        return
    last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    mend = (
        f"on Debian: apt-get install {SYSTEM_LIBRARIES}" if ".so" in last else "pip install --force-reinstall libsumo"
    )
    yield DoctorFinding("simulator", FindingLevel.FAIL, f"libsumo does not run ({last})", mend)


def programs(which: Callable[[str], str | None] = shutil.which, *, developing: bool = False) -> Iterator[DoctorFinding]:
    """Look for the programs that some commands start.

    Args:
        which: Finds a program by its name.
        developing: Whether the programs that only the tests need are checked as well.
    """
    from sumo_adv.simulation.programs import find_netconvert, find_sumo

    for name, find, use in (("sumo", find_sumo, "serve"), ("netconvert", find_netconvert, "Waymo and OpenSCENARIO")):
        try:
            yield _program(name, find(), use)
        except SumoAdvError:
            yield DoctorFinding(
                name, FindingLevel.WARN, f"not found; it is only for {use}", "pip install 'sumo-adv[sumo]'"
            )
    optional: list[tuple[str, tuple[str, ...], str]]
    optional = [("ffmpeg", ("ffmpeg",), "figure --out FILE.mp4 (a .gif does not need it)")]
    if developing:
        optional.append(("chromium", ("chromium", "chromium-browser", "google-chrome"), "some of the tests"))
    for name, spellings, use in optional:
        if any(which(spelling) for spelling in spellings):
            yield DoctorFinding(name, FindingLevel.OK, "found")
        else:
            yield DoctorFinding(
                name, FindingLevel.WARN, f"not found; it is only for {use}", f"on Debian: apt-get install {name}"
            )


def _program(name: str, path: Path, use: str) -> DoctorFinding:
    """Check that a program of SUMO runs and has the library's version."""
    try:
        match = re.search(r"SUMO \w+ v?(\d[.\d]*)", _said(str(path), "--version").stdout)
    except (OSError, subprocess.TimeoutExpired) as error:
        return DoctorFinding(
            name, FindingLevel.WARN, f"does not run ({reason(error)}); it is only for {use}", "install it again"
        )
    library = _version("libsumo")
    if match is None:
        mend = f"on Debian: apt-get install {SYSTEM_LIBRARIES}"
        return DoctorFinding(name, FindingLevel.WARN, f"does not report its version; it is only for {use}", mend)
    if match[1] != library:
        return DoctorFinding(
            name, FindingLevel.WARN, f"{match[1]}, but the library is {library}: both may drive differently",
            "pip install 'sumo-adv[sumo]', and unset SUMO_HOME",
        )  # fmt: skip
    return DoctorFinding(name, FindingLevel.OK, match[1])


def _said(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command, capture_output=True, text=True, timeout=PROGRAM_TIMEOUT_S, check=False, stdin=subprocess.DEVNULL
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def sandbox(bubblewrap: bool, contained: bool | None = None) -> Iterator[DoctorFinding]:
    """Try a planner in the sandbox, and report how many walls the sandbox has.

    Args:
        bubblewrap: Whether bubblewrap is used if it is available.
        contained: Whether the program runs in a container; None to detect it.
    """
    from sumo_adv.planners.sandbox import Sandbox
    from sumo_adv.planners.trial import trial

    try:
        with Sandbox(bubblewrap=bubblewrap) as box:
            wrong = trial(box, make_planner("Trial", "trial", TRIED, "person"), ("neighbour",))
            isolation, note = box.isolation, box.note
    except SumoAdvError as error:
        yield DoctorFinding("sandbox", FindingLevel.FAIL, reason(error), "pip install --force-reinstall pydantic-monty")
        return
    if wrong is not None:
        yield DoctorFinding("sandbox", FindingLevel.FAIL, wrong, "pip install --force-reinstall pydantic-monty")
    elif isolation == "bubblewrap":
        yield DoctorFinding("sandbox", FindingLevel.OK, note)
    elif in_container() if contained is None else contained:
        yield DoctorFinding(
            "sandbox", FindingLevel.OK, "Planners run in a separate interpreter; bubblewrap is not available here, so "
            "this container is the second wall: give the container no network and no files that matter",
        )  # fmt: skip
    else:
        yield DoctorFinding(
            "sandbox", FindingLevel.WARN, f"{note.rstrip('.')}. The interpreter's own wall stands; if a planner broke "
            "through it, it could do what you can do", _more_walls(note),
        )  # fmt: skip


def _more_walls(note: str) -> str:
    if "turned off" in note:
        return "leave SUMO_ADV_BUBBLEWRAP unset"
    if "not installed" in note:
        return "on Debian: apt-get install bubblewrap"
    return "run in a container, or allow user name spaces (sysctl kernel.unprivileged_userns_clone=1)"


def in_container(files: tuple[str, ...] = CONTAINERS, environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether the program runs in a container, judging by the usual marks."""
    return bool(environment.get("container")) or any(Path(file).exists() for file in files)


LOW_DISK_SPACE_BYTES = 500e6


def variables(known: Collection[str], environment: Mapping[str, str] = os.environ) -> Iterator[DoctorFinding]:
    """Report variables that look like settings but are not. Their values are never shown.

    Args:
        known: The names of the settings.
        environment: The environment variables.
    """
    given = [name for name in environment if name.upper().startswith(SETTING_PREFIX)]
    unknown = sorted(n for n in given if n.upper().removeprefix(SETTING_PREFIX).split("__")[0].lower() not in known)
    if unknown:
        state = f"{', '.join(unknown)}: no setting has that name, so the variable has no effect"
        yield DoctorFinding("variables", FindingLevel.WARN, state, "see docs/settings.md for the names")


def bank(path: Path | None) -> Iterator[DoctorFinding]:
    """Open the bank that a run would use; do not make one."""
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.migrations import MIGRATIONS

    used = path or default_bank_path()
    there = used.exists()
    try:
        with MemoryBank.open(used if there else shipped_bank(), read_only=not there) as bank:
            says = f"{len(bank.intents())} intents, schema {len(MIGRATIONS)}, content {bank.content_hash()[:12]}"
            writable = bank.writable
    except SumoAdvError as error:
        yield DoctorFinding(
            "memory bank", FindingLevel.FAIL, reason(error), "give another --memory, or move the file away"
        )
        return
    if not there:
        yield _made_later(used, says)
    elif writable:
        yield DoctorFinding("memory bank", FindingLevel.OK, f"{used}: {says}")
    else:
        says = f"{used}: {says}; read-only, so nothing is learnt"
        yield DoctorFinding("memory bank", FindingLevel.WARN, says, "make the file and its folder writable")


def _made_later(path: Path, says: str) -> DoctorFinding:
    """Check that the nearest existing folder above a missing bank is writable."""
    above = next(folder for folder in path.absolute().parents if folder.is_dir())
    wrong = not_writable(above)
    if wrong is None:
        return DoctorFinding(
            "memory bank", FindingLevel.OK, f"none yet; the first run copies the shipped one ({says}) to {path}"
        )
    mend = "set --memory, SUMO_ADV_MEMORY or XDG_DATA_HOME to a place where you may write"
    return DoctorFinding("memory bank", FindingLevel.FAIL, f"none yet, and {above} cannot be written ({wrong})", mend)


def output(folder: Path) -> Iterator[DoctorFinding]:
    """Check that ``runs/`` in ``folder`` can be written, and report the free space."""
    runs = folder / "runs"
    place = runs if runs.is_dir() else folder
    wrong = not_writable(place)
    if wrong is not None:
        yield DoctorFinding(
            "output", FindingLevel.FAIL, f"{place} cannot be written ({wrong})", "run elsewhere, or give --out"
        )
        return
    free = shutil.disk_usage(place).free
    if free < LOW_DISK_SPACE_BYTES:
        shortage = f"{place} can be written, but only {free / 1e6:.0f} MB are free"
        yield DoctorFinding(
            "output", FindingLevel.WARN, shortage, "free some space: a run takes 0.1 MB, a campaign gigabytes"
        )
    else:
        yield DoctorFinding("output", FindingLevel.OK, f"{place} can be written; {free / 1e9:.0f} GB are free")


def not_writable(folder: Path) -> str | None:
    """Return why no file can be made in a folder; None if one can."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return None
    except OSError as error:
        return (error.strerror or str(error)).lower()
