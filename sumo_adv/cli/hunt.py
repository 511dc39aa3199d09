"""Define ``hunt``: find the worst distinct failures of a driver in a given time."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sumo_adv.cli import options as opt
from sumo_adv.cli.groups import grouped, named_settings
from sumo_adv.cli.options import ATTACK_PANEL, INPUT_PANEL, OUTPUT_PANEL, RUNNING_PANEL, SEARCH_PANEL, option
from sumo_adv.cli.terminal import counted
from sumo_adv.datatypes import Level
from sumo_adv.simulation.warnings_log import kinds_below, said_of

if TYPE_CHECKING:
    from sumo_adv.hunting.hunt import Found, HuntProgress

EXAMPLE = "Example: sumo-adv hunt motorway priority_crossing --ego my_package.driver:MyDriver --minutes 30"
MAX_FAILURES_SHOWN = 20  # largest number of failures on the screen
SCREEN_COLUMNS: dict[str, Literal["left", "right"]] = {
    "rank": "right", "level": "left", "delta-v": "right", "hit on": "left", "times": "right", "attack and cause": "left"
}  # fmt: skip
SCENARIO_NAME_WIDTH = 54  # characters of a scenario's name on the screen
FIRST_LINE_S = 20.0  # after which a line says that the first encounter is still attacked
MAX_NEVER_MET_SHOWN = 8  # names of scenarios of a list that were never met
PARTS_SHOWN = 4  # parts of a hunt's time that are named
RULE_BREAKERS = ("adversary", "ego", "both")
DIFFERING_COLUMNS = ("intent", "speed_band", "cause", "seed", "adversary")
"""Columns that are shown if rows that read the same differ in them."""

Given = Annotated[
    list[str],
    typer.Argument(metavar="INPUT...", help="Networks, maps, .sumocfg files, scenarios, records, folders, names."),
]
Ego = Annotated[str | None, option(INPUT_PANEL, "Driver under test: idm, module:Class ...", default="the inputs'")]
Memory = Annotated[Path | None, option(SEARCH_PANEL, "Memory bank; it is only read.", default="your own")]


@dataclass(frozen=True)
class AttackOptions:
    """Options that say which failures are wanted, and how long they are searched for."""

    minutes: Annotated[
        float, option(ATTACK_PANEL, "Minutes of the whole hunt, all calls together.", default="30", min=0.1)
    ] = 30.0
    distinct: Annotated[int | None, option(ATTACK_PANEL, "End sooner, at this many distinct failures.", min=1)] = None
    until: Annotated[
        opt.Until | None,
        option(
            ATTACK_PANEL,
            "Level of a failure, at which an encounter ends: valid, strict or serious.",
            metavar="LEVEL",
            default="serious; valid for the ego careful",
        ),
    ] = None
    seconds: Annotated[
        float | None,
        option(ATTACK_PANEL, "Maximum seconds of attempts per encounter.", default="20", min=3.0),
    ] = None
    min_delta_v: opt.MinDeltaV = None
    intents: opt.Intents = None
    exclude: opt.Exclude = None
    kind: opt.Kind = None
    scenario: opt.Scenario = None
    adversaries: opt.Adversaries = None


@dataclass(frozen=True)
class SearchOptions:
    """Options of the search: its first seed, its bank, and what the time is given to."""

    seed: Annotated[int, option(SEARCH_PANEL, "The first seed of traffic and search.", default="0", min=0)] = 0
    memory: Memory = None
    cover: Annotated[
        bool,
        option(
            SEARCH_PANEL, "Give time to the named scenarios that were met least often, not to new failures.", "--cover"
        ),
    ] = False


@dataclass(frozen=True)
class RunningOptions:
    """Options that say how the encounters are run."""

    workers: opt.Workers = None
    deadline: Annotated[
        float, option(RUNNING_PANEL, "Seconds after which an episode is stuck.", default="600", min=1)
    ] = 600.0
    ray: opt.RayCluster = None


@dataclass(frozen=True)
class OutputOptions:
    """Options that say what is written and printed."""

    out: Annotated[
        Path | None, option(OUTPUT_PANEL, "Folder of results; the same folder continues a hunt.", default="runs/hunt")
    ] = None
    no_pages: Annotated[bool, option(OUTPUT_PANEL, "Make no index page and no replays.", "--no-pages")] = False
    as_json: opt.AsJson = False


@grouped
def hunt(
    given: Given, *, ego: Ego = None, settings_file: opt.SettingsFile = None, attack: AttackOptions,
    search: SearchOptions, running: RunningOptions, output: OutputOptions,
) -> None:  # fmt: skip
    """Find the worst distinct failures of a driver in a given time. Rerun the same command to continue.

    Ctrl-C finishes what runs, and keeps the results. Keep all failures with: sumo-adv keep OUT/failures --suite DIR
    """
    from sumo_adv.api_batch import hunt as hunted

    quiet = output.as_json
    lines = _Lines()

    def begun() -> None:
        typer.echo(f"Hunting for {attack.minutes:g} min; a line follows as episodes end.")
        lines.begin()

    try:
        found = hunted(
            given, ego=ego, minutes=attack.minutes, distinct=attack.distinct, out=output.out or Path("runs") / "hunt",
            **asdict(search), **asdict(running), settings_file=settings_file, pages=not output.no_pages,
            tell=None if quiet else lines.tell, stopping=_stopping, note=None if quiet else typer.echo,
            begun=None if quiet else begun,
            **named_settings(attack),
        )  # fmt: skip
    finally:
        lines.end()
    if quiet:
        typer.echo(json.dumps(_document(found.found, found.rows)))
    else:
        _show(found.found, found.rows, found.index)
    if found.found.ended == "stopped":
        raise typer.Exit(1)


def _document(found: Found, rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "folder": str(found.folder), "ended": found.ended, "seconds": round(found.seconds, 1),
        "episodes": found.episodes, "attempts": found.attempts, "lost": list(found.lost), "failures": rows,
        "driver_time": {**found.driver_time.as_data(), "of": round(found.episode_seconds, 1)},
        "spent": {part: round(seconds, 1) for part, seconds in found.spent.items()},
        "left": found.left.as_data(), "scenarios": [row.cells() for row in found.scenarios],
    }  # fmt: skip


def _stopping(now: bool) -> None:
    from sumo_adv.cli.progress import stopping_words

    typer.echo(stopping_words(now), err=True)


class _Lines:
    """Prints the progress of a hunt. The first line comes after ``FIRST_LINE_S`` even if no encounter has ended."""

    def __init__(self) -> None:
        self._timer = threading.Timer(FIRST_LINE_S, self._nothing_yet)
        self._timer.daemon = True

    def begin(self) -> None:
        self._timer.start()

    def _nothing_yet(self) -> None:
        typer.echo(f"After {FIRST_LINE_S:g} s the first episodes are still running.")

    def tell(self, progress: HuntProgress) -> None:
        self.end()
        typer.echo(progress_line(progress))
        if progress.driver_time.calls:
            typer.echo(f"          {progress.driver_time.words(progress.episode_seconds)}")

    def end(self) -> None:
        self._timer.cancel()


def progress_line(progress: HuntProgress) -> str:
    """Return the line that says how far a hunt is."""
    levels = ", ".join(f"{progress.count(level)} {level}" for level in (Level.SERIOUS, Level.STRICT, Level.VALID))
    newest = ""
    if progress.newest is not None:
        touch = " (a near-touch, not counted)" if progress.newest.near_touch else ""
        newest = f" Newest{touch}: {progress.newest.words}."
    lost = f", {progress.lost} lost" if progress.lost else ""
    return (
        f"{progress.seconds_left / 60:5.1f} min left: {counted(progress.episodes, 'episode')}, "
        f"{counted(progress.attempts, 'attempt')} ({progress.attempts_per_second:.2g} a second{lost}), "
        f"distinct failures (this level or worse): {levels}; "
        f"{progress.left.words}.{newest}"
    )


def _show(found: Found, rows: list[dict[str, Any]], index: Path | None) -> None:
    """Print the ranked table and what to do next."""
    from rich.console import Console
    from rich.table import Table

    from sumo_adv.metrics.severity import NEAR_TOUCH_DELTA_V_M_S

    ends = {
        "time": "The time is used up", "distinct": "Enough distinct failures were found", "stopped": "Stopped by Ctrl-C"
    }  # fmt: skip
    failures, touches = ([row for row in rows if row["near_touch"] is touch] for touch in (False, True))
    for some in (failures, touches):
        if not some:
            continue
        if some is touches:
            typer.echo(f"Near-touches, with a delta-v below {NEAR_TOUCH_DELTA_V_M_S:g} m/s:")
        shown = Table(box=None, pad_edge=False)
        for name, justify in SCREEN_COLUMNS.items():
            shown.add_column(name, justify=justify, vertical="top", overflow="fold")
        for row in some[:MAX_FAILURES_SHOWN]:
            words = "\n".join(filter(None, (_what(row), _facts(row), row["cause_sentence"], _differing(row, rows))))
            shown.add_row(
                str(row["rank"]), row["level"], _hard(row), row["side"], str(row["count"]), words
            )  # fmt: skip
        Console(highlight=False, markup=False).print(shown)
    more = f" The table shows the first {MAX_FAILURES_SHOWN}." if len(failures) > MAX_FAILURES_SHOWN else ""
    near = f" and {len(touches)} near-touch{'es' * (len(touches) > 1)}" if touches else ""
    typer.echo(
        f"{ends[found.ended]}: {counted(len(failures), 'distinct failure')}{near} in "
        f"{counted(found.episodes, 'episode')}, {counted(found.attempts, 'attempt')}, "
        f"{found.seconds / 60:.1f} min.{more}"
    )
    typer.echo(f"Estimate of what is left: {found.left.words}.")
    if found.driver_time.calls:
        typer.echo(found.driver_time.words(found.episode_seconds))
    if spent := sorted(found.spent.items(), key=lambda part: -part[1]):
        total = sum(found.spent.values())
        most = ", ".join(f"{part} {100 * seconds / total:.0f} %" for part, seconds in spent[:PARTS_SHOWN])
        typer.echo(f"The workers' {total:.0f} s: {most}.")
    _show_scenarios(found)
    for sentence in said_of(kinds_below(found.folder)):
        typer.echo(sentence)
    typer.echo(f"Table: {found.folder / 'results.csv'}")
    if index is not None:
        typer.echo(f"Pages: {index}")
    if found.lost:
        many = f"{len(found.lost)} attempts or episodes were" if len(found.lost) > 1 else "One attempt or episode was"
        typer.echo(f"{many} lost: {found.lost[0]}")
    if rows:
        typer.echo(f"Keep them as a regression suite: sumo-adv keep {found.folder / 'failures'} --suite regression")
    if found.ended == "stopped":
        typer.echo("Rerun the same command to continue.")


def _show_scenarios(found: Found) -> None:
    """Print the named scenarios that were met, and the names of the others."""
    from sumo_adv.report.scenario_table import LEVELS, never_met
    from sumo_adv.scenario_names import LISTS

    met = [row for row in found.scenarios if row.encounters]
    if not met:
        return
    typer.echo(
        "Named scenarios: encounters and attempts that show each, and encounters that reached at least each level:"
    )
    typer.echo(f"{'':54}  enc.   att.  " + "  ".join(f"{level!s:>9}" for level in LEVELS))
    for row in met:
        name = f"{row.name.list}: {row.name.name}"
        name = name if len(name) <= SCENARIO_NAME_WIDTH else f"{name[: SCENARIO_NAME_WIDTH - 3]}..."
        reached = "  ".join(f"{row.reached[level]:9}" for level in LEVELS)
        typer.echo(f"{name:{SCENARIO_NAME_WIDTH}}  {row.encounters:4}  {row.attempts:5}  {reached}")
    for name in LISTS:
        names = never_met(found.scenarios, name)
        typer.echo(f"{name}, never met ({len(names)}): {never_met_words(names)}")


def never_met_words(names: Sequence[str]) -> str:
    """Return the first names of scenarios that were never met, and how many more there are.

    Args:
        names: The names.
    """
    more = len(names) - MAX_NEVER_MET_SHOWN
    rest = f" and {more} more (scenarios.csv)" if more > 0 else ""
    return f"{'; '.join(names[:MAX_NEVER_MET_SHOWN]) or 'none'}{rest}"


def _hard(row: Mapping[str, Any]) -> str:
    """Say how hard the contact is: the delta-v, or the speed at which a pedestrian or a cyclist is hit."""
    if row["impact_speed"] is not None:
        return f"hit at {row['impact_speed']:.1f} m/s"
    return f"{row['delta_v']:.1f} m/s"


def _what(row: Mapping[str, Any]) -> str:
    """Say what the adversary does and where, with the names of the scenario."""
    names = [row["euro_ncap"], row["nhtsa"] and f"NHTSA {row['nhtsa']}"]
    named = f", {'; '.join(filter(None, names))}" if any(names) else ""
    return f"{row['motion'] or row['intent']} ({row['relation']}, {row['road']}), {row['network']}{named}"


def _facts(row: Mapping[str, Any]) -> str:
    """Say whether the attack is robust and human-like, and who broke which rule."""
    holds = [
        word if row[key] else f"not {word}" for key, word in (("robust", "robust"), ("humanlike", "humanlike"))
        if row[key] is not None
    ]  # fmt: skip
    broken = [
        f"{key.replace('_', ' ')}: {row[key]}" for key in ("red_light", "right_of_way") if row[key] in RULE_BREAKERS
    ]
    fault = [] if row["fault"] is None else [f"fault: {row['fault']}"]
    warning = [] if row["warning"] is None else [f"warning {row['warning']:.1f} s"]
    overlap = [] if row["overlap"] is None else [f"overlap {100 * row['overlap']:.0f} %"]
    return ", ".join([*holds, *fault, *broken, *warning, *overlap])


def _differing(row: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    """Name the features that set a row apart from rows that read the same; '' if there are none."""

    def read(each: Mapping[str, Any]) -> tuple[Any, ...]:
        return _what(each), each["cause_sentence"], each["level"], each["side"]

    alike = [each for each in rows if read(each) == read(row)]
    names = [name for name in DIFFERING_COLUMNS if len({each[name] for each in alike}) > 1]
    return ", ".join(f"{name.replace('_', ' ')} {row[name] if row[name] is not None else '-'}" for name in names)
