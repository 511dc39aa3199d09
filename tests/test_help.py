"""What the help shows: options in panels, with their defaults; and the list of what is shipped."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
from cli_samples import ROOT, Program
from typer.main import get_command

from sumo_adv.cli.main import app
from sumo_adv.config import Settings

PANELS = {"Input", "Ego", "Attack", "Search", "Language model", "Output"}


def options_of(command: str) -> dict[str, tuple[str, str]]:
    """Of each option of ``run`` its panel and its help."""
    entry = get_command(app).commands[command]  # type: ignore[attr-defined]
    return {
        p.opts[0]: (str(p.rich_help_panel), str(p.help))
        for p in entry.params
        if p.opts[0].startswith("--") and p.name != "help"
    }


def test_every_option_of_run_is_in_a_panel() -> None:
    assert {panel for panel, _ in options_of("run").values()} == PANELS


def test_every_option_of_run_that_takes_a_value_tells_its_default() -> None:
    flags = {"--no-fork", "--show-prompts", "--force", "--json"}
    without = {name for name, (_, text) in options_of("run").items() if "(default: " not in text}
    assert without == flags


@pytest.mark.parametrize("name", ["attempts", "seed", "diverse", "critical_ttc", "samples", "tuner"])
def test_the_default_is_that_of_the_settings(name: str) -> None:
    _, text = options_of("run")[f"--{name.replace('_', '-')}"]
    default = Settings.model_fields[name].default
    assert f"(default: {default:g})" in text if isinstance(default, float) else f"(default: {default})" in text


def test_the_help_fits_a_terminal(program: Program) -> None:
    program.variables["COLUMNS"] = "100"
    done = program("run", "--help")
    assert done.status == 0 and max(map(len, done.out.splitlines())) <= 100
    assert [p for p in PANELS if not re.search(rf"─ {p} ─", done.out)] == []


def test_the_shipped_scenarios_are_listed(program: Program) -> None:
    listing = json.loads(program.here("scenarios", "--json").out)
    names = {p.stem for p in (ROOT / "scenarios").glob("*.toml")}
    assert {s["name"] for s in listing["scenarios"]} == names and "motorway" in listing["networks"]
    assert all(s["description"] and s["road"] in listing["networks"] and s["intents"] for s in listing["scenarios"])
    text = program.here("scenarios").out
    assert all(name in text for name in names)


VAGUE = re.compile(r"\b(so many|nobody|somebody|everybody|whoever|mend|came of|came off|to be had)\b", re.IGNORECASE)


def helps(command: Any, name: str = "sumo-adv") -> Iterator[tuple[str, str]]:
    """Every text of the help of a command and those below it."""
    yield name, str(command.help)
    yield from ((f"{name} {p.opts[0]}", str(getattr(p, "help", ""))) for p in command.params)
    for below, each in getattr(command, "commands", {}).items():
        yield from helps(each, f"{name} {below}")


def test_the_help_says_quantities_and_names_things() -> None:
    assert {name: text for name, text in helps(get_command(app)) if VAGUE.search(text)} == {}


def test_the_list_of_commands_is_that_of_the_whole_program(program: Program) -> None:
    """It is made without loading them."""
    program.variables["COLUMNS"] = "100"
    whole = program.here("--help").out
    assert "regress" in whole and "memory" in whole
    assert program("--help").out.split("\n", 2)[2] == whole.split("\n", 2)[2]  # below how it was called
