"""Names of others reach a terminal and a spreadsheet as text; a full disk behind stdout is a sentence."""

from __future__ import annotations

import os
import pty
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from cli_samples import Program
from regression_samples import attacked

from sumo_adv.cli.terminal import clean
from sumo_adv.files import cell_text, plain_cell


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("plain\ttext\n", "plain\ttext\n"), ("\x1b[1;31mred\x1b[0m", "\x1b[1;31mred\x1b[0m"),
        ("a\x1b[2Jb\x1b[Hc", "abc"), ("a\x1b]0;title\x07b", "ab"), ("a\x1b]52;c;aGk=\x1b\\b", "ab"),
        ("a\x1bPq\x1b\\b", "ab"), ("a\x9b2Jb", "a2Jb"), ("a\rb\x08c\x7f", "abc"), ("a\u202eb", "ab"), ("ä\x1b", "ä"),
    ],
)  # fmt: skip
def test_only_colours_are_left_of_orders_to_a_terminal(given: str, shown: str) -> None:
    assert clean(given) == shown


@pytest.mark.parametrize("text", ["=1+1", "+a", "-E0_0", "@sum", "\tx"])
def test_a_formula_is_a_text_and_comes_back(text: str) -> None:
    assert plain_cell(text) == f"'{text}"
    assert cell_text(f"'{text}") == text


@pytest.mark.parametrize("value", ["-1.5", "+3", "a=b", "'quoted", "", 3.0, None])
def test_numbers_and_other_texts_stay(value: object) -> None:
    assert plain_cell(value) == value
    if isinstance(value, str):
        assert cell_text(value) == value


@pytest.fixture
def on_a_terminal(program: Program) -> Callable[..., str]:
    """What a command writes to a terminal."""
    if not hasattr(os, "fork"):
        pytest.skip("needs a pseudo-terminal")

    def run(*words: str) -> str:
        main, end = pty.openpty()
        environment = {key: value for key, value in program.environment().items() if key != "CI"}  # which has no bars
        command = [sys.executable, "-m", "sumo_adv", *words]
        try:
            with subprocess.Popen(command, cwd=program.folder, env=environment, stdout=end, stderr=end):
                os.close(end)
                parts = list[bytes]()
                with suppress(OSError):  # the end on Linux
                    while part := os.read(main, 4096):
                        parts.append(part)
                return b"".join(parts).decode()
        finally:
            os.close(main)

    return run


def test_a_key_of_a_file_steers_no_terminal(program: Program, on_a_terminal: Callable[..., str]) -> None:
    (program.folder / "s.toml").write_text('"a\\u001b]0;owned\\u0007b" = 1\n', encoding="utf-8")
    said = on_a_terminal("run", "motorway", "--settings", "s.toml")
    assert "There is no setting 'ab'" in said
    assert "owned" not in said


def test_an_episode_that_fails_beside_the_bar_steers_no_terminal(
    program: Program, on_a_terminal: Callable[..., str]
) -> None:
    text = 'schema = 1\nnetwork = "motorway"\n"a\\u001b]0;owned\\u0007b" = 1\n'
    (program.folder / "s.toml").write_text(text, encoding="utf-8")
    said = on_a_terminal("batch", "run", "s.toml", "--workers", "1", "--out", "out")
    assert "has an unknown key 'ab'" in " ".join(said.split())
    assert "owned" not in said


def test_the_program_itself_writes_its_line_anew(program: Program, on_a_terminal: Callable[..., str]) -> None:
    for name in ("a", "b"):
        shutil.copytree(attacked(), program.folder / "runs" / name)
    said = on_a_terminal("report", "runs", "--workers", "1")
    assert "\r1 of 2 pages \r2 of 2 pages " in said


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_a_sentence(program: Program) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "sumo_adv", "scenarios"], cwd=program.folder, env=program.environment(), stdout=full,
            stderr=subprocess.PIPE, text=True, timeout=60,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == "sumo-adv: the output cannot be written, since its disk is full; free some space.\n"


def test_an_empty_variable_is_none(program: Program) -> None:
    program.variables = {"SUMO_ADV_MEMORY": "", "SUMO_ADV_LLM_BASE_URL": ""}
    done = program.here("run", "motorway", "--total-seconds", "0", "--attempts", "1", "--learn", "off", "--out", "out")
    assert "is a folder" not in done.err
    assert done.outcome["ending"]
