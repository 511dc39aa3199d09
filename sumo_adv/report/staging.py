"""Folders that are there whole, or not at all: written beside their place and then moved there; and scratch folders."""

from __future__ import annotations

import errno
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sumo_adv.errors import SumoAdvError, UsageError


class RunFolder:
    """Where a run's files go. Use :func:`staged`."""

    def __init__(self, target: Path, stage: Path) -> None:
        self.target, self.stage = target, stage

    def keep(self, *, force: bool) -> None:
        """Put the staged folder in its place."""
        if self.target.exists() and force:
            shutil.rmtree(self.target)
        self.stage.replace(self.target)


@contextmanager
def staged(target: Path, *, force: bool, marker: str = "manifest.json") -> Iterator[RunFolder]:
    """A folder to write into; removed again unless it was kept. ``force`` replaces a folder that holds the file
    ``marker``.

    Raises UsageError: the place is taken (without ``force``), or cannot be written.
    """
    if target.exists() and not force:
        raise UsageError(f"The output folder {target} is there already; give another --out, or --force to replace it.")
    if target.exists() and not (target.is_dir() and (not any(target.iterdir()) or (target / marker).exists())):
        fault = f"{target} is not the folder of a run or a conversion"
        raise UsageError(f"{fault}, so --force does not replace it; give another --out.")
    made = [p for p in (target.parent, *target.parent.parents) if not p.exists()]
    stage = target.parent / f".{target.name}.{secrets.token_hex(4)}"  # known before it is there, in case of a Ctrl-C
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stage.mkdir()
        stage.chmod(0o755)
        yield RunFolder(target, stage)
    except BrokenPipeError:  # whoever read our output has gone: not the folder's fault
        raise
    except OSError as error:
        raise _sentence(error, target) from error
    finally:
        if stage.exists():
            shutil.rmtree(stage, ignore_errors=True)
        if not target.exists():
            for parent in made:
                if parent.exists() and not any(parent.iterdir()):
                    parent.rmdir()


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder for files that are only needed meanwhile. Its name is known before it is there, in case of a Ctrl-C."""
    folder = Path(tempfile.gettempdir()) / f"sumo_adv-{secrets.token_hex(4)}"
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sentence(error: OSError, target: Path) -> SumoAdvError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return SumoAdvError(f"There is no space left to write {target}; free some or give another --out.")
    return UsageError(f"The output folder {target} cannot be written ({error.strerror or error}); give another --out.")
