"""Define ``keep`` and ``regress``.

``keep`` turns found attacks into the cases of a suite. ``regress`` runs the cases against a driver, each with a new
attack.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence, Set
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sumo_adv.cli.options import words
from sumo_adv.cli.terminal import counted
from sumo_adv.config import Until
from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from sumo_adv.regression.case import Expectation
    from sumo_adv.regression.reference import Reference
    from sumo_adv.regression.waivers import Waivers
    from sumo_adv.scenario_names import ScenarioName

KEEP_EXAMPLE = "Example: sumo-adv keep runs/priority_crossing-3 --suite regression"


def keep(
    given: Annotated[
        list[Path], typer.Argument(metavar="RUN...", help="Folders of runs or of hunts, or that hold runs.")
    ],
    suite: Annotated[Path, typer.Option(help="Folder of the suite; made if it does not exist.")],
    level: Annotated[
        Until, typer.Option(help="From a folder that holds runs, keep only attacks that reach this level.")
    ] = Until.COLLISION,
    scenario: Annotated[
        str | None,
        typer.Option(metavar="A,B", help="From such a folder, keep only attacks that show one of these scenarios."),
    ] = None,
    avoid: Annotated[
        Until | None,
        typer.Option(
            help="Expect that the attack stays below this level (default: the level with a reference driver)."
        ),
    ] = None,
    min_ttc: Annotated[float | None, typer.Option(min=0, help="Expect a min TTC above this, s.")] = None,
    no_worse: Annotated[
        bool, typer.Option("--no-worse", help="Expect the ego to be no worse than in a baseline.")
    ] = False,
    name: Annotated[str | None, typer.Option(help="Name of the case, for one RUN (default: input and seed).")] = None,
    every: Annotated[bool, typer.Option("--all", help="Keep cases that no reference driver passes, too.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes (default: one per core).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Keep found attacks in a suite: scenario, planner, parameters and trigger, in a folder a case.

    The driver careful drives each of them first. An attack that no reference driver passes is left out.
    The files are text, and stand on their own: put them under version control, and edit what is expected in case.toml.
    """
    from sumo_adv.cli.progress import Counter
    from sumo_adv.hunting.hunt import FAILURES_FOLDER
    from sumo_adv.regression.keep import keep_run
    from sumo_adv.regression.reference import references
    from sumo_adv.report.index import HUNT
    from sumo_adv.report.judging import run_folders
    from sumo_adv.report.read import reading

    expect = _expected(avoid, min_ttc, no_worse=no_worse)
    given = [folder / FAILURES_FOLDER if (folder / HUNT).is_file() else folder for folder in given]
    runs = run_folders(given)
    if name is not None and len(runs) != 1:
        raise UsageError(f"--name is for one run, and {len(runs)} were given.")
    done, fresh = _sorted(runs, set(given), suite, level, _scenarios(scenario), name)
    counter, number = Counter("attacks", quiet=as_json), count(1)
    counter.begin(len(fresh))
    answers = references(fresh, expect, workers or os.cpu_count() or 1, lambda: counter.tell(next(number), len(fresh)))
    counter.close()
    for run, answer in zip(fresh, answers, strict=True):
        if not answer.passed_by and not every:
            done.not_passed[run] = answer.why
            continue
        with reading(run):
            folder, new = keep_run(run, suite, answer.expect, name, answer.passed_by)
        if new:
            done.kept[folder] = run
            done.notes[folder] = _note(run, answer)
        else:
            done.there_already.append(folder)
    _say(done, suite, level, ", or another scenario" if scenario else "", as_json=as_json)


@dataclass(frozen=True)
class _Keeping:
    """What ``keep`` did with each run.

    Attributes:
        kept: The run of each new case.
        notes: What to know of each new case; empty if there is nothing.
        there_already: The cases that were in the suite already.
        left_out: Runs with another level or scenario.
        not_passed: Why no reference driver passes the attack of a run.
    """

    kept: dict[Path, Path] = field(default_factory=dict)
    notes: dict[Path, str] = field(default_factory=dict)
    there_already: list[Path] = field(default_factory=list)
    left_out: list[Path] = field(default_factory=list)
    not_passed: dict[Path, str] = field(default_factory=dict)


def _sorted(
    runs: Sequence[Path], given: Set[Path], suite: Path, level: Until, only: Sequence[ScenarioName], name: str | None
) -> tuple[_Keeping, list[Path]]:
    """Separate the runs that are settled at once from those that reference drivers must drive first."""
    from sumo_adv.regression.keep import held_in
    from sumo_adv.report.read import read_outcome, reading
    from sumo_adv.report.run_outcome import level_named
    from sumo_adv.scenario_names import is_one_of

    done, fresh = _Keeping(), list[Path]()
    for run in runs:
        with reading(run):
            outcome = read_outcome(run)
            below = level_named((outcome.get("outcome") or {}).get("level")) < level.level
            other = bool(only) and not is_one_of(outcome.get("named_scenario") or {}, only)
            if run not in given and (below or other):
                done.left_out.append(run)
            elif (folder := held_in(run, suite, name)) is not None:
                done.there_already.append(folder)
            else:
                fresh.append(run)
    return done, fresh


def _expected(avoid: Until | None, min_ttc: float | None, *, no_worse: bool) -> Expectation | None:
    """Return what the options expect of the ego; None if none of them was given."""
    from sumo_adv.regression.case import Expectation

    if avoid is None and min_ttc is None and not no_worse:
        return None
    return Expectation.model_validate(
        {"avoid": None if avoid is None else str(avoid.level), "min_ttc": min_ttc, "no_worse": no_worse}
    )


def _note(run: Path, answer: Reference) -> str:
    """Say that ``careful`` does not pass a case that is kept, and that the attack found a near-touch only."""
    from sumo_adv.metrics.severity import is_near_touch
    from sumo_adv.report.read import read_outcome

    notes, why = [], answer.why.replace("Your driver", "It")
    if answer.why and answer.passed_by:
        notes.append(f"passed by {', '.join(answer.passed_by)}, and not by careful: {why.rstrip('.')}")
    outcome = read_outcome(run).get("outcome") or {}
    delta_v = outcome.get("delta_v")
    if delta_v is not None and is_near_touch(delta_v, outcome.get("impact_speed")):
        notes.append(f"the attack that was found is a near-touch, with a delta-v of {delta_v:.2f} m/s")
    return f" ({'; '.join(notes)})" if notes else ""


def _say(done: _Keeping, suite: Path, level: Until, other: str, *, as_json: bool) -> None:
    """Print what was kept, and why the rest was not."""
    kept, again, left, failed = done.kept, done.there_already, done.left_out, done.not_passed
    if as_json:
        names = {"kept": list(kept), "there_already": again, "left_out": left, "not_passed": list(failed)}
        typer.echo(json.dumps({"suite": str(suite)} | {key: [str(p) for p in value] for key, value in names.items()}))
        return
    for folder, run in kept.items():
        typer.echo(f"Kept {folder} from {run.name}{done.notes[folder]}")
    for run, why in failed.items():
        typer.echo(f"Left out {run}: no reference driver passes it (careful: {why})")
    more = [f"{len(again)} already there"] if again else []
    more += [f"{len(left)} left out (below {level}{other})"] if left else []
    more += [f"{len(failed)} left out (no reference driver passes; --all keeps them)"] if failed else []
    typer.echo(f"{counted(len(kept), 'case')} into {suite}{''.join(', ' + each for each in more)}.")


def _scenarios(given: str | None) -> tuple[ScenarioName, ...]:
    """Find the named scenarios of a filter.

    Raises:
        UsageError: A scenario is unknown.
    """
    from sumo_adv.scenario_names import wanted

    try:
        return wanted(words(given or ""))
    except ValueError as error:
        raise UsageError(f"--scenario cannot be used: {error}.") from error


EXAMPLE = "Example: sumo-adv regress regression --ego my_package.driver:MyDriver --junit regression.xml"
EXIT_NOT_PASSED = 3  # exit status


def regress(
    suite: Annotated[Path, typer.Argument(metavar="SUITE", help="Folder that sumo-adv keep has made, or one case.")],
    ego: Annotated[str, typer.Option(help="The driver under test: krauss, idm, careful, module:Class ...")],
    baseline: Annotated[
        Path | None, typer.Option(metavar="FILE", help="regress.json of another driver or revision, to compare with.")
    ] = None,
    attempts: Annotated[
        int,
        typer.Option(
            min=1,
            help="Maximum number of attempts per case; more than one also tries nearby parameter values (default: 1).",
        ),
    ] = 1,
    waive: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Cases that need not pass until a date (default: waive.toml in SUITE)."),
    ] = None,
    junit: Annotated[Path | None, typer.Option(metavar="FILE", help="JUnit XML to write, for build servers.")] = None,
    allow_untested: Annotated[
        bool, typer.Option("--allow-untested", help="Do not fail for cases without an encounter or a fair attack.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of results (default: runs/regress-SUITE).")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes (default: one per core).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the folder of other results.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Run each case of a suite against a driver, and say whether it does what the case expects.

    The adversary is not replayed: it plans again against what this driver does, with the kept planner, parameters and
    trigger. Where the driver arrives otherwise than the one that the case was found with, near numbers are tried, too.
    Exit status 0: all cases pass; 3: a case does not; 2: bad input.
    """
    from sumo_adv.cli.progress import Counter
    from sumo_adv.regression.case import read_suite
    from sumo_adv.regression.suite import lines, read_baseline, run_suite, write_junit

    cases = read_suite(suite)
    before = None if baseline is None else read_baseline(baseline)
    waivers = _waivers(suite, waive, [case.name for case in cases])
    for note in (*(note for case in cases for note in case.notes), *waivers.notes):
        typer.echo(f"sumo-adv: {note}", err=True)
    name = suite.resolve().name
    target = out or Path("runs") / f"regress-{name}"
    counter, done = Counter("cases", quiet=as_json), count(1)
    counter.begin(len(cases))
    run = run_suite(
        cases, name, ego, target, workers=workers or os.cpu_count() or 1, force=force, attempts=attempts,
        baseline=before, waived=waivers.by_case, tell=lambda _: counter.tell(next(done), len(cases)),
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
        raise typer.Exit(EXIT_NOT_PASSED)


def _waivers(suite: Path, given: Path | None, cases: list[str]) -> Waivers:
    """Read the waivers for the cases that run, from the given file or otherwise from the suite.

    Raises:
        UsageError: The waivers are bad.
    """
    from sumo_adv.regression.case import CASE_FILE
    from sumo_adv.regression.waivers import WAIVERS, Waivers, read_waivers

    whole = suite.resolve().parent if (suite / CASE_FILE).is_file() else suite
    file = given or whole / WAIVERS
    if given is None and not file.is_file():
        return Waivers()
    return read_waivers(file, cases, {p.parent.name for p in whole.glob(f"*/{CASE_FILE}")})
