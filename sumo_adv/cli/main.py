"""The command line: one sentence on stderr for what is wrong, exit status 0 done, 1 the work failed, 2 wrong use."""

from __future__ import annotations

import atexit
import os
import sys
from typing import Annotated

import typer

from sumo_adv.cli import (
    batch,
    bench,
    convert,
    doctor,
    export,
    hunt,
    judge,
    memory,
    rate,
    regress,
    report,
    run,
    serve,
    transformer,
    write,
)
from sumo_adv.cli.terminal import cleaned
from sumo_adv.errors import SumoAdvError
from sumo_adv.files import FULL, sweep_scratch

INTERRUPTED = 130  # what typer makes of Ctrl-C

app = typer.Typer(
    name="sumo-adv", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Finds the dangerous case inside SUMO, online, against your driver.",
    epilog="Example: sumo-adv run scenarios/motorway_cut_in_left.toml --until valid",
)  # fmt: skip
for name, command, example in (
    ("run", run.run, run.EXAMPLE),
    ("write", write.write, write.EXAMPLE),
    ("hunt", hunt.hunt, hunt.EXAMPLE),
    ("scenarios", convert.scenarios, convert.SCENARIOS_EXAMPLE),
    ("serve", serve.serve, serve.EXAMPLE),
    ("convert", convert.convert, convert.EXAMPLE),
    ("minimise", run.minimise, run.MINIMISE_EXAMPLE),
    ("judge", judge.judge, judge.EXAMPLE),
    ("keep", regress.keep, regress.KEEP_EXAMPLE),
    ("regress", regress.regress, regress.EXAMPLE),
    ("rate", rate.rate, rate.EXAMPLE),
    ("compare", judge.compare, judge.COMPARE_EXAMPLE),
    ("report", report.report, report.EXAMPLE),
    ("figure", report.figure, report.FIGURE_EXAMPLE),
    ("export", export.export, export.EXAMPLE),
    ("import", convert.import_fcd, convert.IMPORT_EXAMPLE),
    ("doctor", doctor.doctor, doctor.EXAMPLE),
):
    app.command(name, epilog=example)(command)
app.add_typer(batch.app, name="batch")
app.add_typer(bench.app, name="bench")
app.add_typer(memory.app, name="memory")
app.add_typer(transformer.app, name="transformer")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(doctor.version_line())
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print versions and the memory bank.")
    ] = False,
) -> None:
    """Finds the dangerous case inside SUMO, online, against your driver."""


def main() -> None:
    sys.stdout, sys.stderr = cleaned(sys.stdout), cleaned(sys.stderr)
    sweep_scratch()
    try:
        try:
            app()
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except SumoAdvError as error:
        typer.echo(f"sumo-adv: {error}", err=True)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:  # before a command has begun; commands see to it themselves
        typer.echo("sumo-adv: interrupted.", err=True)
        _leave(1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more is flushed at exit
        sys.exit(1)
    except OSError as error:
        if error.errno not in FULL or error.filename is not None:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        typer.echo("sumo-adv: the output cannot be written, since its disk is full; free some space.", err=True)
        sys.exit(1)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            typer.echo("sumo-adv: interrupted.", err=True)
            _leave(1)
        if run.Interrupts.happened:
            _leave(end.code if isinstance(end.code, int) else 1)
        raise


def _leave(status: int) -> None:
    """Clean up and exit with a status.

    CPython remembers a KeyboardInterrupt that passed through an ``exec`` of text (dataclasses do that on import), even
    an interrupt that was caught, and would end the process by SIGINT in place of the status.
    """
    atexit._run_exitfuncs()  # temporary folders, the engine's process
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
