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
    compare,
    convert,
    doctor,
    export,
    figure,
    hunt,
    import_fcd,
    judge,
    keep,
    memory,
    minimise,
    rate,
    regress,
    report,
    run,
    scenarios,
    serve,
    transformer,
    write,
)
from sumo_adv.cli.interrupts import Interrupts
from sumo_adv.errors import SumoAdvError

INTERRUPTED = 130  # what typer makes of Ctrl-C

app = typer.Typer(
    name="sumo-adv", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Finds the dangerous case inside SUMO, online, against your driver.",
    epilog="Example: sumo-adv run scenarios/motorway_cut_in_left.toml --until valid",
)  # fmt: skip
app.command("run", epilog=run.EXAMPLE)(run.run)
app.command("write", epilog=write.EXAMPLE)(write.write)
app.command("hunt", epilog=hunt.EXAMPLE)(hunt.hunt)
app.command("scenarios", epilog=scenarios.EXAMPLE)(scenarios.scenarios)
app.command("serve", epilog=serve.EXAMPLE)(serve.serve)
app.command("convert", epilog=convert.EXAMPLE)(convert.convert)
app.command("minimise", epilog=minimise.EXAMPLE)(minimise.minimise)
app.command("judge", epilog=judge.EXAMPLE)(judge.judge)
app.command("keep", epilog=keep.EXAMPLE)(keep.keep)
app.command("regress", epilog=regress.EXAMPLE)(regress.regress)
app.command("rate", epilog=rate.EXAMPLE)(rate.rate)
app.command("compare", epilog=compare.EXAMPLE)(compare.compare)
app.command("report", epilog=report.EXAMPLE)(report.report)
app.command("figure", epilog=figure.EXAMPLE)(figure.figure)
app.command("export", epilog=export.EXAMPLE)(export.export)
app.command("import", epilog=import_fcd.EXAMPLE)(import_fcd.import_fcd)
app.command("doctor", epilog=doctor.EXAMPLE)(doctor.doctor)
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
    """The program."""
    try:
        app()
    except SumoAdvError as error:
        typer.echo(f"sumo-adv: {error}", err=True)
        sys.exit(error.exit_status)
    except KeyboardInterrupt:  # before a command has begun; commands see to it themselves
        typer.echo("sumo-adv: interrupted.", err=True)
        _leave(1)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more is flushed at exit
        sys.exit(1)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            typer.echo("sumo-adv: interrupted.", err=True)
            _leave(1)
        if Interrupts.happened:
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
