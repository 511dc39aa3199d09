"""Folders that are there whole, or not at all: written beside their place and then moved there; and scratch folders."""

from __future__ import annotations

import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import FULL, json_text, refuse_links, scratch_prefix
from sumo_adv.parsing import read_json

PROGRAM = "sumo_adv"
RESULTS_FILE, PLAN_FILE = "results.csv", "plan.json"
"""In the folder of a batch: the table of its episodes, and what it runs."""
LISTING = "files.json"
"""In each folder that this program wrote: its name, and the entries that it wrote, all that --force may delete."""
LATER_FILES = ("report.html", "figure.png", "report")  # what commands add to a folder that was written


class RunFolder:
    """Where a run's files go. Use :func:`staged`."""

    def __init__(self, target: Path, stage: Path, *, inside: bool = False) -> None:
        """``inside``: it lies in a folder of ours, and so needs no list of its files."""
        self.target, self.stage, self.inside = target, stage, inside

    def keep(self, *, force: bool) -> None:
        """Put the staged folder in its place."""
        if not self.inside:
            files = [path.relative_to(self.stage).as_posix() for path in sorted(self.stage.rglob("*"))]
            (self.stage / LISTING).write_text(json_text({"program": PROGRAM, "files": files}), encoding="utf-8")
        if self.target.exists() and force:
            shutil.rmtree(self.target)
        self.stage.replace(self.target)


def check_replaceable(target: Path) -> None:
    """Raises UsageError for a folder that --force does not replace: it is a link, this program did not write it, or it
    holds something else."""
    advice = "so --force does not replace it; give another --out"
    if target.is_symlink():
        raise UsageError(f"{target} is a link, {advice}.")
    if target.is_dir() and not any(target.iterdir()):
        return
    try:
        listing = read_json(target / LISTING)
        known = {LISTING, *listing["files"]} if listing["program"] == PROGRAM else set()
    except (OSError, ValueError, KeyError, TypeError):
        known = set()
    if not known:
        raise UsageError(f"{target} is not the folder of a run or a conversion, {advice}.")
    refuse_links(target)
    for path in sorted(target.rglob("*")):
        inside = path.relative_to(target)
        if inside.as_posix() not in known and inside.parts[0] not in LATER_FILES:
            raise UsageError(f"{target} holds {path.name}, which this program did not write, {advice}.")


@contextmanager
def staged(target: Path, *, force: bool, inside: bool = False) -> Iterator[RunFolder]:
    """A folder to write into; removed again unless it was kept. ``force`` replaces a folder that this program wrote.

    inside: the target lies in a folder of ours (a campaign's, a server's), which is ours with all that is in it.

    Raises UsageError: the place is taken (without ``force``), or cannot be written.
    """
    if target.exists() and not force:
        raise UsageError(f"The output folder {target} is there already; give another --out, or --force to replace it.")
    if (target.exists() or target.is_symlink()) and not inside:
        check_replaceable(target)
    made = [p for p in (target.parent, *target.parent.parents) if not p.exists()]
    stage = target.parent / f".{target.name}.{secrets.token_hex(4)}"  # known before it is there, in case of a Ctrl-C
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stage.mkdir()
        stage.chmod(0o755)
        yield RunFolder(target, stage, inside=inside)
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
    folder = Path(tempfile.gettempdir()) / f"{scratch_prefix()}{secrets.token_hex(4)}"
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sentence(error: OSError, target: Path) -> SumoAdvError:
    if error.errno in FULL:
        return SumoAdvError(f"There is no space left to write {target}; free some or give another --out.")
    return UsageError(f"The output folder {target} cannot be written ({error.strerror or error}); give another --out.")
