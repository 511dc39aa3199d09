"""Where the user's own memory bank lives."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from sumo_adv.files import user_folder

FILE_NAME = "memory_bank.sqlite"


def default_bank_path(
    environ: Mapping[str, str] = os.environ, platform: str = sys.platform, home: Path | None = None
) -> Path:
    """The bank in the user's data folder (:func:`~sumo_adv.files.user_folder`); nothing is created."""
    return user_folder("data", environ, platform, home) / FILE_NAME
