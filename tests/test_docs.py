"""What README and docs say can be typed: every command line is parsed by the real program, every block has a mark that
says whether it is run (``test_docs_run.py`` does it), links and files exist, and the site builds without a warning."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT
from docs_blocks import Block, blocks, inline_commands, pages, words
from typer.main import get_command

from sumo_adv.campaigns.plan import read_plan
from sumo_adv.cli.main import app
from sumo_adv.config import Settings
from sumo_adv.config_odd import Odd, read_odd
from sumo_adv.datatypes import Ending
from sumo_adv.regression.waivers import read_waivers
from sumo_adv.simulation.scenario import load_scenario

PAGES = pages()
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]
PLACEHOLDER = re.compile(r"\.\.+|\[.*\]|\||…")
TARGETS = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


class Refused(Exception):
    """A command line that the program would not take."""


def parse(command: list[str]) -> None:
    """Let the real program read a command line, and do nothing. Raises Refused."""
    command = command[1:] if command[0] == "sumo-adv" else command[3:]
    group, context, done = get_command(app), None, []
    while True:
        try:
            context = group.make_context(done[-1] if done else "sumo-adv", command, parent=context)
        except Exception as error:  # click's own, by whatever name typer has it
            if type(error).__name__ in ("Exit", "NoArgsIsHelpError"):  # --help, --version
                return
            raise Refused(f"{' '.join(done)}: {getattr(error, 'message', error)}") from error
        if not hasattr(group, "commands"):
            return
        rest: list[str] = (
            [*context._protected_args, *context.args] if hasattr(context, "_protected_args") else context.args
        )
        if not rest:
            return
        if rest[0] not in group.commands:
            raise Refused(f"no command {rest[0]}")
        group, command, done = group.commands[rest[0]], rest[1:], [*done, rest[0]]


def known_options(command: list[str]) -> None:
    """Of a command with placeholders: the command is there, and so are the options named. Raises Refused."""
    group: Any = get_command(app)
    if len(command) > 1 and command[0] == "sumo-adv" and command[1] not in group.commands and command[1] != "--version":
        raise Refused(f"no command {command[1]}")
    for word in command[1:] if command[0] == "sumo-adv" else command[3:]:
        if word.startswith("--"):
            options = {each for p in group.params for each in (*p.opts, *getattr(p, "secondary_opts", ()))}
            options |= {"--help"}
            if hasattr(group, "commands") and "run" in group.commands:  # batch
                options |= {each for p in group.commands["run"].params for each in p.opts}
            if word.split("=")[0] not in options:
                raise Refused(f"no option {word}")
        elif hasattr(group, "commands") and word in group.commands:
            group = group.commands[word]


def check(command: str, *, whole: bool = True) -> None:
    """Raises Refused for a line that could not be typed; what is not ``whole`` may lack arguments."""
    split = words(command)
    if split[0] == "sumo-adv" or split[1:3] == ["-m", "sumo_adv"]:
        open_ended = not whole or any(PLACEHOLDER.search(word) for word in split)
        (known_options if open_ended else parse)(split)
    elif split[0] == "make":
        if missing := {w for w in split[1:] if re.fullmatch(r"\w+", w)} - TARGETS:
            raise Refused(f"no target {missing}")
    elif split[0] in ("python", "python3") and len(split) > 1 and split[1].endswith(".py"):
        ours = split[1].split("/")[0] in ("examples", "benchmarks", "tests")
        if ours and not (ROOT / split[1]).is_file():
            raise Refused(f"no file {split[1]}")
    elif split[0] == "pip":
        for extras in re.findall(r"(?:sumo-adv|\.)\[([\w,]+)\]", command):
            if unknown := set(extras.split(",")) - set(PROJECT["optional-dependencies"]):
                raise Refused(f"no extra {unknown}")
    elif split[0] == "export":
        for name in re.findall(r"SUMO_ADV_(\w+?)=", command):
            if name.lower() not in Settings.model_fields:
                raise Refused(f"no setting {name}")


def refusals(commands: Iterator[tuple[str, str]], *, whole: bool = True) -> list[str]:
    """Where a command is that would be refused, and why."""
    refused = []
    for place, command in commands:
        try:
            check(command, whole=whole)
        except Refused as error:
            refused.append(f"{place}: {command}: {error}")
    return refused


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_command_lines_can_be_typed(page: Path) -> None:
    assert refusals((b.location, command) for b in blocks(page) for command in b.commands) == []
    assert refusals(((page.name, command) for command in inline_commands(page)), whole=False) == []


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_every_block_says_whether_it_is_run(page: Path) -> None:
    held = list(blocks(page))
    assert [b.location for b in held if (b.commands or b.is_python) and not b.mark] == []
    assert [b.location for b in held if b.mark in ("not run", "file") and len(b.detail) < 3] == []


@pytest.mark.parametrize(
    "command",
    [
        "sumo-adv walk", "sumo-adv run motorway --speed 3", "sumo-adv run motorway --until never",
        "sumo-adv memory find", "sumo-adv batch a.toml --egoes idm", "sumo-adv memory ... --mode3", "make coffee",
        "python benchmarks/nothing.py", "pip install 'sumo-adv[everything]'", "export SUMO_ADV_ATTEMPT=3",
    ],
)  # fmt: skip
def test_a_wrong_command_line_would_be_found(command: str) -> None:
    with pytest.raises(Refused):
        check(command)


@pytest.mark.parametrize(
    "command",
    [
        "sumo-adv --version", "sumo-adv run motorway --until valid --seed 3   # said", "sumo-adv batch pack OUT",
        "sumo-adv batch scenarios --seeds 2 | head", "make run", "sumo-adv run .. --seed 3", "cd examples",
    ],
)  # fmt: skip
def test_a_right_one_is_let_through(command: str) -> None:
    check(command)


def test_blocks_are_found_however_they_are_written(tmp_path: Path) -> None:
    page = ROOT / "docs" / "unwritten.md"
    written = tmp_path / "page.md"
    indented = "Words\n\n<!-- run -->\n\n    make run\n\n    make test\n\n- item\n  more\n"
    written.write_text(f"{indented}\n<!-- file: a.py -->\n```python\nx = 1\n```\n")
    run_block, file_block = (Block(page, b.line, b.language, b.text, b.mark, b.detail) for b in blocks(written))
    assert (run_block.mark, run_block.commands, run_block.is_python) == ("run", ["make run", "make test"], False)
    assert (file_block.mark, file_block.detail) == ("file", "a.py")
    assert (file_block.text, file_block.is_python) == ("x = 1\n", True)


def test_scenarios_and_plans_in_the_docs_are_read(tmp_path: Path) -> None:
    tables = [b for page in PAGES for b in blocks(page) if b.language == "toml"]
    assert len(tables) >= 3
    for block in tables:
        file = tmp_path / "given.toml"
        file.write_text(block.text, encoding="utf-8")
        keys = set(tomllib.loads(block.text))
        if "inputs" in keys:
            read_plan(file)
        elif keys <= set(Odd.model_fields):
            read_odd(file)
        elif keys == {"waive"}:
            read_waivers(file, (), ())
        else:
            load_scenario(file)


LINK = re.compile(r"(?<!!)\[[^\]\n]*\]\(([^)\s]+)\)")


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    for target in LINK.findall(re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)):
        if target.startswith(("http://", "https://", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        file = page if not name else page.parent / name
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            lost.append(target)
    assert lost == []


def anchors(page: Path) -> set[str]:
    """The headings of a page as a browser's address has them."""
    heads = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


PATHS = re.compile(r"`((?:sumo_adv|tests|examples|benchmarks|scenarios|networks|prompts|memory_bank|docs)/[\w./*-]+)")
ENVIRONMENTS = {"sumo_adv/Ego-v0", "sumo_adv/Adversary-v0"}  # ids of gymnasium, no files


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_files_that_are_named_exist(page: Path) -> None:
    named = {path.rstrip(".") for path in PATHS.findall(page.read_text(encoding="utf-8"))} - ENVIRONMENTS
    assert sorted(name for name in named if not list(ROOT.glob(name.rstrip("/")))) == []


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    if find_spec("properdocs") is None:
        pytest.skip("the extra docs is not installed (pip install '.[docs]')")
    done = subprocess.run(
        [sys.executable, "-m", "properdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    front = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert '<iframe src="replay.html"' in front and (tmp_path / "site" / "replay.html").stat().st_size > 50_000
    made = {page.stem for page in (tmp_path / "site").rglob("*.html")} | {
        p.parent.name for p in (tmp_path / "site").rglob("index.html")
    }
    assert {page.stem for page in (ROOT / "docs").glob("*.md")} <= made


SENTENCE = re.compile(r"^\| `([^`]+)`[^|]*\|", re.MULTILINE)
ELSEWHERE = {"Connection closed by SUMO"}  # the words of traci


def texts_of_the_program() -> str:
    """All texts in the program's sources, constants and the constant parts of f-strings, a line each."""
    texts = []
    for file in (ROOT / "sumo_adv").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    return "\n".join(texts)


def test_troubleshooting_quotes_what_the_program_says() -> None:
    page, texts = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8"), texts_of_the_program()
    quoted = SENTENCE.findall(page.split("## Endings")[0])
    assert len(quoted) > 30
    parts = {q: [p.strip() for p in q.split("…")] for q in quoted if q not in ELSEWHERE}
    assert [q for q, held in parts.items() if max(map(len, held)) < 10 or not all(p in texts for p in held)] == []


def test_every_ending_has_its_line() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8").split("## Endings")[1]
    first = "".join(line.split("|")[1] for line in page.splitlines() if line.startswith("| `"))
    assert set(re.findall(r"`(\w+)`", first)) == {*Ending, "ending"}
