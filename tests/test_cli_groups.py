"""Groups of options: what typer reads of a command that takes them, and what the command gets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer
from typer.testing import CliRunner

from sumo_adv.cli.groups import grouped, named_settings

Attempts = Annotated[int | None, typer.Option(help="How many.")]


@dataclass(frozen=True)
class SearchOptions:
    seed: Annotated[int, typer.Option(help="Of all draws.")]
    attempts: Attempts = None
    quiet: Annotated[bool, typer.Option("--quiet")] = False


def screen_of(*words: str) -> str:
    app = typer.Typer()

    @app.command()
    @grouped
    def look(where: str, search: SearchOptions, *, deep: Annotated[bool, typer.Option("--deep")] = False) -> None:
        typer.echo(f"{where} {deep} {search} {named_settings(search)}")

    return CliRunner().invoke(app, list(words)).output


def test_a_command_gets_its_groups_beside_its_own_parameters() -> None:
    told = "SearchOptions(seed=3, attempts=None, quiet=True)"
    assert screen_of("here", "--seed", "3", "--quiet") == f"here False {told} {{'seed': 3}}\n"
    told = "SearchOptions(seed=3, attempts=5, quiet=False)"
    assert screen_of("here", "--seed", "3", "--attempts", "5", "--deep") == (
        f"here True {told} {{'seed': 3, 'attempts': 5}}\n"
    )


def test_a_field_without_a_default_is_an_option_that_must_be_given() -> None:
    assert "Missing option '--seed'" in screen_of("here")


def test_the_help_lists_the_options_in_the_order_of_parameters_and_fields() -> None:
    text = screen_of("--help")
    places = [text.index(flag) for flag in ("--seed", "--attempts", "--quiet", "--deep")]
    assert places == sorted(places)
