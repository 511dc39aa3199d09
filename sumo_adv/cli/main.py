"""Run the command line.

An error is one sentence on stderr. Exit status 0: done; 1: the work failed; 2: wrong use. The module of a command is
loaded when that command is called. All of them are loaded for an unknown name.
"""

from __future__ import annotations

import ast
import atexit
import os
import sys
from collections.abc import Callable, Collection
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from sumo_adv.cli.interrupts import Interrupts
from sumo_adv.cli.terminal import cleaned
from sumo_adv.errors import SumoAdvError
from sumo_adv.files import FULL, sweep_scratch

EXIT_INTERRUPTED = 130  # typer's exit status after Ctrl-C

COMMANDS = {
    "run": ("run", "EXAMPLE"),
    "write": ("write", "EXAMPLE"),
    "hunt": ("hunt", "EXAMPLE"),
    "scenarios": ("convert", "SCENARIOS_EXAMPLE"),
    "serve": ("serve", "EXAMPLE"),
    "convert": ("convert", "EXAMPLE"),
    "minimise": ("run", "MINIMISE_EXAMPLE"),
    "judge": ("judge", "EXAMPLE"),
    "keep": ("regress", "KEEP_EXAMPLE"),
    "regress": ("regress", "EXAMPLE"),
    "sweep": ("sweep", "EXAMPLE"),
    "rate": ("rate", "EXAMPLE"),
    "compare": ("judge", "COMPARE_EXAMPLE"),
    "report": ("report", "EXAMPLE"),
    "figure": ("report", "FIGURE_EXAMPLE"),
    "export": ("export", "EXAMPLE"),
    "import": ("convert", "IMPORT_EXAMPLE"),
    "doctor": ("doctor", "EXAMPLE"),
}
"""The module of each command in this package, and the name of the command's example there."""
FUNCTIONS = {"import": "import_fcd"}  # functions whose names differ from their commands
HELP_GROUPS = ("batch", "bench", "memory")  # groups of commands, each in the module of its name


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(import_module("sumo_adv.cli.doctor").version_line())
        raise typer.Exit


def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print versions and the memory bank.")
    ] = False,
) -> None:
    """Finds the dangerous case inside SUMO, online, against your driver."""


def command_line(names: Collection[str]) -> typer.Typer:
    """Build the program with these commands and groups of commands."""
    app = typer.Typer(
        name="sumo-adv", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
        help="Finds the dangerous case inside SUMO, online, against your driver.",
        epilog="Example: sumo-adv run scenarios/motorway_cut_in_left.toml --until valid",
    )  # fmt: skip
    app.callback()(options)
    for name, (file, example) in COMMANDS.items():
        if name in names:
            module = import_module(f"sumo_adv.cli.{file}")
            app.command(name, epilog=getattr(module, example))(getattr(module, FUNCTIONS.get(name, name)))
    for name in HELP_GROUPS:
        if name in names:
            app.add_typer(import_module(f"sumo_adv.cli.{name}").app, name=name)
    return app


def __getattr__(name: str) -> Any:
    """Build ``app``, the program with all commands, when it is first read."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    made = globals()[name] = command_line([*COMMANDS, *HELP_GROUPS])
    return made


def main(loaded: Callable[[], None] = lambda: None) -> None:
    """Run the program with ``sys.argv``, and turn errors into sentences and exit statuses.

    Args:
        loaded: Called when the command's modules are loaded, before the command begins.
    """
    sys.stdout, sys.stderr = cleaned(sys.stdout), cleaned(sys.stderr)
    sweep_scratch()
    try:
        try:
            command = _listing() if sys.argv[1:] in ([], ["--help"]) else command_line(_wanted(sys.argv[1:]))
            loaded()
            command()
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except SumoAdvError as error:
        typer.echo(f"sumo-adv: {error}", err=True)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:  # before a command has begun; commands handle it themselves
        typer.echo("sumo-adv: interrupted.", err=True)
        _leave(1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that nothing is flushed at exit
        sys.exit(1)
    except OSError as error:
        if error.errno not in FULL or error.filename is not None:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        typer.echo("sumo-adv: the output cannot be written, since its disk is full; free some space.", err=True)
        sys.exit(1)
    except SystemExit as end:
        if end.code == EXIT_INTERRUPTED:
            typer.echo("sumo-adv: interrupted.", err=True)
            _leave(1)
        if Interrupts.happened:
            _leave(end.code if isinstance(end.code, int) else 1)
        raise


def _listing() -> typer.Typer:
    """Build the program for its list of commands, with their docstrings but without loading their modules."""
    app, documents = command_line(()), dict[str, dict[str, str]]()
    for name in [*COMMANDS, *HELP_GROUPS]:
        file = COMMANDS.get(name, (name, ""))[0]
        if file not in documents:
            documents[file] = _docstrings(Path(__file__).with_name(f"{file}.py"))
        function = FUNCTIONS.get(name, name)
        app.command(name, help=documents[file][function if name in COMMANDS else "app"])(lambda: None)
    return app


def _docstrings(file: Path) -> dict[str, str]:
    """Read the docstrings of a module's functions and the help of its group ``app``, without importing it."""
    found = dict[str, str]()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            found[node.name] = ast.get_docstring(node) or ""
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            names = [target.id for target in node.targets if isinstance(target, ast.Name)]
            helps = [ast.literal_eval(k.value) for k in node.value.keywords if k.arg == "help"]
            found |= {name: text for name in names for text in helps}
    return found


def _wanted(arguments: list[str]) -> Collection[str]:
    """Return the called command; all commands if the arguments do not begin with one."""
    every = [*COMMANDS, *HELP_GROUPS]
    if arguments[:1] == ["--version"]:
        return ["doctor"]
    return arguments[:1] if arguments and arguments[0] in every else every


def _leave(status: int) -> None:
    """Clean up and exit with a status.

    CPython remembers a KeyboardInterrupt that passed through an ``exec`` of text, even if it was caught. Dataclasses
    use such an ``exec`` on import. CPython would then end the process by SIGINT instead of the status.
    """
    atexit._run_exitfuncs()  # temporary folders, the engine's process
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
