"""What ``doctor`` looks at of the user's: variables, models, memory bank, where results go."""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit
from urllib.request import getproxies

from sumo_adv.cli.doctor_checks import Finding, Level, reason
from sumo_adv.errors import SumoAdvError

if TYPE_CHECKING:
    from sumo_adv.config import Settings
    from sumo_adv.llm.client import Server

PREFIX = "SUMO_ADV_"
REACHED = 3.0  # s for a server to take a connection
LITTLE_SPACE = 500e6  # bytes


def variables(known: Collection[str], environment: Mapping[str, str] = os.environ) -> Iterator[Finding]:
    """Variables that look like settings and are none; ``known``: the names of settings. Values are never shown."""
    given = [name for name in environment if name.upper().startswith(PREFIX)]
    unknown = sorted(n for n in given if n.upper().removeprefix(PREFIX).split("__")[0].lower() not in known)
    if unknown:
        state = f"{', '.join(unknown)}: no setting has that name, so it does nothing"
        yield Finding("variables", Level.WARN, state, "see docs/settings.md for the names")


def model(settings: Settings, environment: Mapping[str, str] = os.environ) -> Iterator[Finding]:
    """The servers of the models that the settings name. Nothing is asked of them, and no key is sent or shown."""
    from sumo_adv.agents.agents import ROLES
    from sumo_adv.llm.client import REPLAY, find_server

    names = sorted({name for role in ROLES if (name := settings.player(role)) is not None})
    level = Level.WARN if settings.fallback == "builtin" else Level.FAIL
    if not names:
        yield Finding("model", Level.OK, "none is set: the built-in expert plays all parts (--llm NAME names one)")
    for name in names:
        if name.startswith(REPLAY):
            there = Path(name.removeprefix(REPLAY)).is_file()
            state = "a recording, asked instead of a model" if there else "a recording that is not there"
            yield Finding(f"model {name}", Level.OK if there else level, state, "" if there else "give its path")
            continue
        try:
            server = find_server(name, settings, environment)
        except SumoAdvError as error:
            yield Finding(f"model {name}", level, reason(error), "see docs/models.md")
            continue
        yield _reached(name, server, level)


def _reached(name: str, server: Server, level: Level) -> Finding:
    parts = urlsplit(server.base_url)
    host, port = parts.hostname or "", parts.port or (443 if parts.scheme == "https" else 80)
    key = "with a key" if server.key is not None else "without a key"
    proxy = None if host in ("localhost", "127.0.0.1", "::1") else getproxies().get(parts.scheme)
    way = urlsplit(proxy) if proxy else None
    try:
        with socket.create_connection((way.hostname or "", way.port or 80) if way else (host, port), timeout=REACHED):
            pass
    except OSError as error:
        mend = "start the server, or correct SUMO_ADV_LLM_BASE_URL"
        through = "the proxy on the way to " if way else ""
        return Finding(f"model {name}", level, f"{through}{host}:{port} cannot be reached ({reason(error)})", mend)
    done = "the proxy on the way to it takes connections" if way else "takes connections"
    return Finding(f"model {name}", Level.OK, f"{host}:{port} {done}; {key}. It was asked nothing")


def bank(path: Path | None) -> Iterator[Finding]:
    """The bank that a run would use; none is made."""
    from sumo_adv.app import shipped_bank
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.migrations import MIGRATIONS
    from sumo_adv.memory.store import default_bank_path

    used = path or default_bank_path()
    try:
        if not used.exists():
            with MemoryBank.open(shipped_bank(), read_only=True) as shipped:
                says = (
                    f"{len(shipped.intents())} intents, schema {len(MIGRATIONS)}, content {shipped.content_hash()[:12]}"
                )
            yield _made_later(used, says)
            return
        with MemoryBank.open(used) as bank:
            says = (
                f"{used}: {len(bank.intents())} intents, schema {len(MIGRATIONS)}, content {bank.content_hash()[:12]}"
            )
            writable = bank.writable
    except SumoAdvError as error:
        yield Finding("memory bank", Level.FAIL, reason(error), "give another --memory, or move the file away")
        return
    if writable:
        yield Finding("memory bank", Level.OK, says)
    else:
        yield Finding(
            "memory bank",
            Level.WARN,
            f"{says}; read-only, so nothing is learnt",
            "make the file and its folder writable",
        )


def _made_later(path: Path, says: str) -> Finding:
    """The nearest folder above that is there must be writable."""
    above = next(folder for folder in path.absolute().parents if folder.is_dir())
    wrong = not_writable(above)
    if wrong is None:
        return Finding("memory bank", Level.OK, f"none yet; the first run copies the shipped one ({says}) to {path}")
    mend = "set --memory, SUMO_ADV_MEMORY or XDG_DATA_HOME to where you may write"
    return Finding("memory bank", Level.FAIL, f"none yet, and {above} cannot be written ({wrong})", mend)


def output(folder: Path) -> Iterator[Finding]:
    """Whether ``runs/`` in ``folder`` can be written, and how much room there is."""
    runs = folder / "runs"
    place = runs if runs.is_dir() else folder
    wrong = not_writable(place)
    if wrong is not None:
        yield Finding("output", Level.FAIL, f"{place} cannot be written ({wrong})", "run elsewhere, or give --out")
        return
    free = shutil.disk_usage(place).free
    if free < LITTLE_SPACE:
        shortage = f"{place} can be written, but only {free / 1e6:.0f} MB are free"
        yield Finding("output", Level.WARN, shortage, "free some space: a run takes 0.1 MB, a campaign gigabytes")
    else:
        yield Finding("output", Level.OK, f"{place} can be written; {free / 1e9:.0f} GB are free")


def not_writable(folder: Path) -> str | None:
    """Why no file can be made there; None if one can."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return None
    except OSError as error:
        return (error.strerror or str(error)).lower()
