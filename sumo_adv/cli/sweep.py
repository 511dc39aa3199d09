"""Define ``sweep``: vary the numbers of one attack over ranges, and find the border between pass and fail."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.cli.options import words
from sumo_adv.config import Until
from sumo_adv.errors import UsageError
from sumo_adv.files import scratch_prefix, sentences, write_text

if TYPE_CHECKING:
    from sumo_adv.regression.case import KeptCase
    from sumo_adv.regression.sweep import Axis, Index, Point, Points, Sweep

EXAMPLE = "Example: sumo-adv sweep regression/motorway-3 --over gap=2:8 --over ego.speed=15:30 --ego my_driver:MyDriver"
MAX_AXES, MAX_POINTS, MAX_DRIVERS = 2, 129, 4
CASE_FILE, OUTCOME_FILE = "case.toml", "outcome.json"


def sweep(
    given: Annotated[
        Path, typer.Argument(metavar="CASE | RUN | SCENARIO", help="A kept case, a run's folder, or an input of run.")
    ],
    over: Annotated[
        list[str],
        typer.Option(metavar="NAME=LOW:HIGH", help="A number of the attack or the scenario to vary; twice for two."),
    ],
    ego: Annotated[str, typer.Option(help="The driver under test, or up to three with commas between.")],
    points: Annotated[
        int, typer.Option(min=2, max=MAX_POINTS, help="Points along each number; 17, 33 and 65 refine well.")
    ] = 17,
    grid: Annotated[bool, typer.Option("--grid", help="Measure each point, not only those near the border.")] = False,
    avoid: Annotated[Until, typer.Option(help="The level that the attack must stay below.")] = Until.COLLISION,
    no_reference: Annotated[bool, typer.Option("--no-reference", help="Leave out the border of cc_human.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of results (default: runs/sweep-NAME).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the results of another sweep.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Attack drivers over ranges of an attack's numbers, and draw where they pass and fail.

    The border of the reference driver cc_human (the driver careful) is in the picture. Of a scenario, an attack that
    hits the first driver is looked for first.
    """
    from sumo_adv.regression.sweep import REFERENCE, Sweep, axis_of, numbers_of

    drivers = words(ego)
    drivers += [REFERENCE] if REFERENCE not in drivers and not no_reference else []
    if not 1 <= len(over) <= MAX_AXES:
        raise UsageError(f"A sweep has one number or two, and {len(over)} were given.")
    if not 1 <= len(drivers) <= MAX_DRIVERS:
        raise UsageError(
            f"A picture has at most {MAX_DRIVERS} drivers, with the reference driver; {len(drivers)} were given."
        )
    target = out or Path("runs") / f"sweep-{given.resolve().name.partition('.')[0]}"
    if (target / "sweep.json").exists() and not force:
        raise UsageError(f"{target} holds a sweep already; give another --out, or --force to replace it.")
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        case = _case(given, drivers[0], Path(scratch), quiet=as_json)
        axes, names = tuple(axis_of(case, each) for each in over), numbers_of(case)
        if len({axis.name for axis in axes}) < len(axes):
            raise UsageError(f"--over names '{axes[0].name}' twice; give two numbers.")
        found = {driver: _swept(case, axes, driver, avoid, points, whole=grid, quiet=as_json) for driver in drivers}
        done = Sweep(case.name, axes, points, found)
    with sentences(target):
        _write(done, target)
    document = done.document()
    if as_json:
        typer.echo(json.dumps({**document, "folder": str(target)}))
        return
    typer.echo("\n".join(done.lines(names)))
    typer.echo(f"Picture: {target / 'sweep.png'}\nFiles: {target}")


def _case(given: Path, ego: str, scratch: Path, *, quiet: bool) -> KeptCase:
    """Read a kept case, or make one of a run or of an attack that is searched for in a scenario.

    Raises:
        UsageError: No attack was found, or the run cannot be kept.
    """
    from sumo_adv.regression.case import Expectation, read_case
    from sumo_adv.regression.keep import keep_run

    if (given / CASE_FILE).is_file():
        return read_case(given)
    run = given
    if not (given / OUTCOME_FILE).is_file():
        from sumo_adv.api import run as attacked

        if not quiet:
            typer.echo(f"Looking for an attack on {ego} in {given}.", err=True)
        run = attacked(given, ego=ego, out=scratch / "run", until="collision", learn="off").folder
    try:
        folder, _ = keep_run(run, scratch / "suite", Expectation(avoid="collision"))
    except UsageError as error:
        if run is given:
            raise
        raise UsageError(
            f"No attack on {ego} was found in {given}; give a kept case or the folder of a run."
        ) from error
    return read_case(folder)


def _swept(
    case: KeptCase, axes: Sequence[Axis], driver: str, avoid: Until, points: int, *, whole: bool, quiet: bool
) -> Points:
    """Measure the points of one driver."""
    from sumo_adv.cli.progress import Counter
    from sumo_adv.regression.case import Expectation
    from sumo_adv.regression.sweep import Sweep, SweepRunner, swept

    place = Sweep(case.name, tuple(axes), points, {})
    expect = Expectation.model_validate({"avoid": str(avoid.level)})
    counter, made, of = Counter(f"points of {driver}", quiet=quiet, at_most=not whole), count(1), points ** len(axes)
    counter.begin(of)
    with SweepRunner() as runner:

        def measure(some: Sequence[Index]) -> list[Point]:
            numbers = [place.numbers(index) for index in some]
            return runner.measure(case, driver, expect, numbers, lambda: counter.tell(next(made), of))

        found = swept(measure, len(axes), points, whole=whole)
    counter.close()
    return found


def _write(done: Sweep, target: Path) -> None:
    """Write the table, the JSON and the pictures.

    Raises:
        OSError: A file cannot be written.
    """
    import numpy as np

    from sumo_adv.regression.sweep import REFERENCE, PointResult
    from sumo_adv.report.figures import save
    from sumo_adv.report.sweep_figure import FAILS, PASSES, UNKNOWN, draw_sweep
    from sumo_adv.report.tables import csv_text, plain_row

    target.mkdir(parents=True, exist_ok=True)
    rows = done.rows()
    write_text(target / "sweep.json", json.dumps(done.document(), indent=1) + "\n")
    write_text(target / "sweep.csv", csv_text(list(rows[0]), map(plain_row, rows)))
    numbers = {PointResult.PASS: PASSES, PointResult.FAIL: FAILS}
    drivers: dict[str, Any] = {}
    for driver, points in done.drivers.items():
        results = np.array([numbers.get(point.result, UNKNOWN) for point in points.values()])
        name = f"{driver} (cc_human)" if driver == REFERENCE else driver
        drivers[name] = results.reshape((done.count,) * len(done.axes))
    labels = [f"{axis.name} [{axis.unit}]" if axis.unit else axis.name for axis in done.axes]
    picture = draw_sweep(done.name, labels, [axis.values(done.count) for axis in done.axes], drivers)
    for kind in ("png", "svg"):
        save(picture, target / f"sweep.{kind}", kind)
