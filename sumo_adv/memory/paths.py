"""Where the user's own memory bank lives."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

FILE_NAME = "memory_bank.sqlite"


def default_bank_path(
    environ: Mapping[str, str] = os.environ, platform: str = sys.platform, home: Path | None = None
) -> Path:
    """The bank in the user's data folder; nothing is created.

    Linux and the rest: ``$XDG_DATA_HOME`` (absolute, as the XDG base directory specification asks) or
    ``~/.local/share``; macOS: ``~/Library/Application Support``; Windows: ``%LOCALAPPDATA%`` or ``~/AppData/Local``.
    """
    home = Path.home() if home is None else home
    if platform == "win32":
        named = environ.get("LOCALAPPDATA", "")
        data = Path(named) if named else home / "AppData" / "Local"
    elif platform == "darwin":
        data = home / "Library" / "Application Support"
    else:
        named = environ.get("XDG_DATA_HOME", "")
        data = Path(named) if named and Path(named).is_absolute() else home / ".local" / "share"
    return data / "sumo_adv" / FILE_NAME
