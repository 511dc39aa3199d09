"""``doctor``: is everything here that a run needs?"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import typer

EXAMPLE = "Example: sumo-adv doctor"
SYSTEM_LIBRARIES = "libx11-6 libxext6 libxrender1 libgl1 libexpat1 libatomic1"


def doctor() -> None:
    """Check libraries, sandbox, bank and write rights; each line says how to mend it. Exit 1 if a run cannot work."""
    checks: list[tuple[str, Callable[[], str], bool]] = [
        ("libsumo", _libsumo, True), ("sandbox", _sandbox, True), ("memory bank", _bank, True),
        ("output folder", _write, True), ("netconvert", _netconvert, False),
        ("Waymo records", _protobuf, False),
    ]  # fmt: skip
    failed = False
    for name, check, needed in checks:
        try:
            typer.echo(f"ok    {name}: {check()}")
        except Exception as error:  # whatever is wrong is what doctor is to report
            failed |= needed
            typer.echo(f"{'FAIL ' if needed else 'note '} {name}: {error}")
    if failed:
        raise typer.Exit(1)


def _libsumo() -> str:
    try:
        import libsumo
    except ImportError as error:
        raise RuntimeError(f"{error}; on Debian: apt-get install {SYSTEM_LIBRARIES}") from error
    return str(libsumo.getVersion()[1])


def _sandbox() -> str:
    from sumo_adv.planning.sandbox import Sandbox

    with Sandbox() as sandbox:
        return sandbox.note


def _bank() -> str:
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.paths import default_bank_path
    from sumo_adv.world.inputs import data_folder

    with MemoryBank.open(default_bank_path(), seed_from=data_folder("memory_bank.sqlite")) as bank:
        return f"{bank.path}, {len(bank.intents())} intents{'' if bank.writable else ' (read-only: nothing is learnt)'}"


def _write() -> str:
    with tempfile.NamedTemporaryFile(dir=Path.cwd()):
        return "can be written"


def _netconvert() -> str:
    from sumo_adv.womd.network.netconvert import find_netconvert

    return f"{find_netconvert().name} found"


def _protobuf() -> str:
    try:
        import google.protobuf
    except ImportError as error:
        raise RuntimeError("protobuf is not installed: pip install 'sumo-adv[womd]'") from error
    return f"protobuf {google.protobuf.__version__}"
