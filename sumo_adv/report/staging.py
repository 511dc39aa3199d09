"""Write folders whole or not at all, beside their place before they are moved there; make scratch folders."""

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
"""The files of a batch's folder: the table of its episodes, and the plan of what it runs."""
LISTING = "files.json"
"""The file in each folder of this program that lists what the program wrote; --force may delete nothing else."""
LATER_FILES = ("report.html", "figure.png", "report")  # commands add these to a folder that was written


class RunFolder:
    """The folder that a run's files are written into. Use :func:`staged` to get one."""

    def __init__(self, target: Path, stage: Path, *, inside: bool = False) -> None:
        """Describe a folder that exists at ``stage``.

        Args:
            target: Where the folder is moved in the end.
            stage: Where it is written.
            inside: Whether it lies in a folder of this program, in which case it needs no list of its files.
        """
        self.target, self.stage, self.inside = target, stage, inside

    def keep(self, *, force: bool) -> None:
        """Move the staged folder to its place.

        Args:
            force: Whether an existing folder is replaced.
        """
        if not self.inside:
            files = [path.relative_to(self.stage).as_posix() for path in sorted(self.stage.rglob("*"))]
            (self.stage / LISTING).write_text(json_text({"program": PROGRAM, "files": files}), encoding="utf-8")
        if self.target.exists() and force:
            shutil.rmtree(self.target)
        self.stage.replace(self.target)


def check_replaceable(target: Path) -> None:
    """Check that --force may replace a folder.

    Args:
        target: The folder.

    Raises:
        UsageError: The folder is a link, this program did not write it, or it holds something else.
    """
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
    """Yield a folder to write into. It is removed again unless ``keep`` was called.

    Args:
        target: Where the folder is moved in the end.
        force: Whether an existing folder that this program wrote may be replaced.
        inside: Whether the target lies in a folder of this program (a campaign's or a server's), whose content all
            belongs to the program.

    Raises:
        UsageError: The target exists and ``force`` is not set, --force may not replace it, or it cannot be written.
        SumoAdvError: There is no space left.
    """
    if target.exists() and not force:
        raise UsageError(f"The output folder {target} already exists; give another --out, or --force to replace it.")
    if (target.exists() or target.is_symlink()) and not inside:
        check_replaceable(target)
    made = [p for p in (target.parent, *target.parent.parents) if not p.exists()]
    stage = target.parent / f".{target.name}.{secrets.token_hex(4)}"  # fixed before mkdir, in case of Ctrl-C
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        stage.mkdir()
        stage.chmod(0o755)
        yield RunFolder(target, stage, inside=inside)
    except BrokenPipeError:  # the reader of our output is gone; the folder is fine
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
    """Yield a temporary folder; its name is fixed before it is created, so that Ctrl-C leaves nothing behind."""
    folder = Path(tempfile.gettempdir()) / f"{scratch_prefix()}{secrets.token_hex(4)}"
    try:
        folder.mkdir(mode=0o700)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _sentence(error: OSError, target: Path) -> SumoAdvError:
    """Convert an OSError to an error of this program."""
    if error.errno in FULL:
        return SumoAdvError(f"There is no space left to write {target}; free some space, or give another --out.")
    return UsageError(f"The output folder {target} cannot be written ({error.strerror or error}); give another --out.")
