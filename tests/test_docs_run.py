"""The pages as stories: blocks marked ``file`` are saved and those marked ``run`` are run, in their order, in a folder
that holds what a checkout holds. What a reader types is what runs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from cli_samples import PATIENCE, ROOT, Program
from docs_blocks import Block, blocks, pages

STORIES = {str(page.relative_to(ROOT)): page for page in pages() if any(b.mark == "run" for b in blocks(page))}
Played = Callable[[str], tuple[Path, list[str]]]
LATER = (
    "campaigns",
    "choose",
    "first_week",
    "gym",
    "memory",
    "rate",
    "several",
    "vulnerable",
)  # only in make soak, as other tests run their commands
SAID = "said.txt"  # in a story's folder: what its blocks printed
AT_HAND = ("scenarios", "networks", "memory_bank", "prompts")  # of the checkout, which no block writes to


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Played:
    """The folder of a story, and what went wrong in it; each is played once."""

    @cache
    def play(name: str) -> tuple[Path, list[str]]:
        folder = tmp_path_factory.mktemp(STORIES[name].stem)
        return folder, tell(STORIES[name], folder, caches)

    return play


def tell(page: Path, folder: Path, caches: Path) -> list[str]:
    """Play a page; a sentence for the first block that fails."""
    program = Program(folder, caches)
    for name in AT_HAND:
        (folder / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "examples", folder / "examples", ignore=shutil.ignore_patterns("__pycache__"))
    environment = program.environment()
    environment["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), environment["PATH"]))
    for block in blocks(page):
        if block.mark == "file":
            (folder / block.detail).write_text(block.text, encoding="utf-8")
        elif block.mark == "run" and (wrong := run(block, folder, environment)) is not None:
            return [wrong]
    return []


def run(block: Block, folder: Path, environment: dict[str, str]) -> str | None:
    """None if the block ends well."""
    command = [sys.executable, "-"] if block.is_python else ["sh", "-eu"]
    done = subprocess.run(
        command, input=block.text, cwd=folder, env=environment, capture_output=True, text=True, check=False,
        timeout=PATIENCE,
    )  # fmt: skip
    with (folder / SAID).open("a", encoding="utf-8") as log:
        log.write(done.stdout)
    return None if done.returncode == 0 else f"{block.location}: status {done.returncode}: {done.stderr[-600:]}"


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.soak if page.stem in LATER else []) for n, page in STORIES.items()]
)
def test_what_a_page_says_works(name: str, played: Played) -> None:
    assert played(name)[1] == []


@pytest.mark.parametrize(
    ("page", "run_folder"), [("docs/first_hour.md", "runs/first"), ("docs/planner.md", "runs/squeeze")]
)
def test_what_newcomers_try_first_succeeds(page: str, run_folder: str, played: Played) -> None:
    folder, wrong = played(page)
    assert wrong == []
    outcome = json.loads((folder / run_folder / "outcome.json").read_text(encoding="utf-8"))
    assert (outcome["ending"], outcome["outcome"]["valid"]) == ("critical", True)


@pytest.mark.soak
def test_the_second_version_passes_what_the_first_one_fails(played: Played) -> None:
    folder, wrong = played("docs/first_week.md")
    assert wrong == []
    counts = {}
    for version in ("First", "Second"):
        file = folder / "runs" / f"two_versions:{version}" / "regress.json"
        counts[version] = json.loads(file.read_text(encoding="utf-8"))["counts"]
    assert counts["First"]["pass"] == 0 and counts["Second"]["pass"] == counts["First"]["fail"] >= 2
    assert (folder / "runs" / "compared" / "compare.html").is_file()


@pytest.mark.parametrize("page", ["README.md", "docs/first_hour.md"])
def test_the_output_shown_is_the_output(page: str, played: Played) -> None:
    folder, wrong = played("docs/first_hour.md")
    assert wrong == []
    printed = (folder / SAID).read_text(encoding="utf-8")
    shown = next(b.text for b in blocks(ROOT / page) if b.text.startswith("Encounter at"))
    lines = [line.split(" (risk")[0] for line in shown.splitlines() if not line.startswith("Files:")]
    assert len(lines) >= 4  # the predictor's own figures may change
    assert [line for line in lines if line not in printed] == []


def test_a_block_that_fails_is_told(tmp_path: Path) -> None:
    page = ROOT / "README.md"
    shell = Block(page, 7, "sh", "sumo-adv run nowhere\ntrue\n", "run", "")
    python = Block(page, 9, "python", "raise ValueError('no')\n", "run", "")
    environment = Program(tmp_path, tmp_path).environment()
    environment["PATH"] = os.pathsep.join((str(Path(sys.executable).parent), environment["PATH"]))
    assert "README.md:7: status 2: sumo-adv: There is no file nowhere" in (run(shell, tmp_path, environment) or "")
    assert "ValueError: no" in (run(python, tmp_path, environment) or "")


def test_the_stories_are_those_that_newcomers_need() -> None:
    needed = {"first_hour", "ego", "planner", "memory", "campaigns", "api", "settings", "first_week"}
    assert needed <= {page.stem for page in STORIES.values()}
