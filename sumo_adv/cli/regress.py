"""``regress``: the cases of a suite against a driver, each attacked again reactively."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from sumo_adv.regression.runner import Judged

EXAMPLE = "Example: sumo-adv regress regression --ego my_package.driver:MyDriver --junit regression.xml"
NOT_PASSED = 3  # exit status


def regress(
    suite: Annotated[Path, typer.Argument(metavar="SUITE", help="Folder that sumo-adv keep has made, or one case.")],
    ego: Annotated[str, typer.Option(help="The driver under test: krauss, idm, careful, module:Class ...")],
    baseline: Annotated[
        Path | None, typer.Option(metavar="FILE", help="regress.json of another driver or revision, to compare with.")
    ] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="JUnit XML to write, for build servers.")] = None,
    allow_untested: Annotated[
        bool, typer.Option("--allow-untested", help="Do not fail for cases without an encounter or a fair attack.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of results (default: runs/regress-SUITE).")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes (default: one a core).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the folder of other results.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Run each case of a suite once against a driver, and say whether it does what the case expects.

    The adversary is not replayed: it plans again against what this driver does, with the kept planner, parameters and
    trigger. Exit status 0: all cases pass; 3: a case does not; 2: bad input.
    """
    from sumo_adv.regression.case import read_suite
    from sumo_adv.regression.suite import lines, read_baseline, run_suite, write_junit

    cases = read_suite(suite)
    before = None if baseline is None else read_baseline(baseline)
    for note in (note for case in cases for note in case.notes):
        typer.echo(f"sumo-adv: {note}", err=True)
    name = suite.resolve().name
    target = out or Path("runs") / f"regress-{name}"
    counter = _Counter(len(cases), shown=not as_json and sys.stderr.isatty())
    run = run_suite(
        cases, name, ego, target, workers=workers or os.cpu_count() or 1, force=force, baseline=before,
        tell=counter.tell,
    )  # fmt: skip
    counter.close()
    if junit is not None:
        write_junit(junit, run, allow_untested=allow_untested)
    if as_json:
        typer.echo(json.dumps({**run.document(), "folder": str(target)}))
    else:
        typer.echo("\n".join(lines(run)))
        typer.echo(f"Files: {target}")
    if not run.passed(allow_untested=allow_untested):
        raise typer.Exit(NOT_PASSED)


class _Counter:
    """How far it is, on a terminal alone."""

    def __init__(self, of: int, *, shown: bool) -> None:
        self._of, self._shown, self._done = of, shown, 0

    def tell(self, case: Judged) -> None:
        """One more case."""
        self._done += 1
        if self._shown:
            typer.echo(f"\r{self._done} of {self._of} cases", nl=False, err=True)

    def close(self) -> None:
        """End the line."""
        if self._shown:
            typer.echo(err=True)
