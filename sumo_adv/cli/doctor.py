"""Define ``doctor``: check that everything a run needs is here; check a driver (``--ego``) or an input."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv import __version__
from sumo_adv.app import shipped_bank
from sumo_adv.config import Settings, load_settings
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.memory.store import default_bank_path

if TYPE_CHECKING:
    from sumo_adv.cli.doctor_checks import DoctorFinding
    from sumo_adv.driver_check import Checked, DriverCheck
    from sumo_adv.input_check import InputCheck

EXAMPLE = "Example: sumo-adv doctor my.sumocfg"
CHECKED_SIMULATION_S = 100.0  # simulated time of an input


def doctor(
    source: Annotated[
        Path | None,
        typer.Argument(metavar="[INPUT]", help="Check this input instead: a .sumocfg, network, map, record, scenario."),
    ] = None,
    llm: Annotated[str | None, typer.Option(help="The language model to ask one short question, as in run.")] = None,
    memory: Annotated[Path | None, typer.Option(help="The memory bank (default: your own).")] = None,
    ego: Annotated[
        str | None, typer.Option(help="Check this driver instead: drive it unattacked through twelve scenarios.")
    ] = None,
    scenario: Annotated[
        list[Path] | None,
        typer.Option(
            help="With --ego: drive in this scenario, a file or a name of the table, instead of the twelve; repeatable."
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=1.0, help="With INPUT: duration of the comparison, s (default: 100)."),
    ] = None,
    settings_file: Annotated[Path | None, typer.Option("--settings", help="TOML file of settings.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Check libraries, programs, sandbox, model, memory bank and write rights; each line says how to fix it.
    With INPUT: what was read of it, and whether its traffic moves as in SUMO; the exit status is 3 if it does not.

    ok; warn: something that a plain run does not need; fail: a run cannot work, and the exit status is 1.
    With --ego: faults of a driver or its adapter; the exit status is 3 if there are any.
    """
    if source is not None:
        if ego is not None or llm is not None or memory is not None or scenario:
            raise UsageError("doctor checks an INPUT alone: leave out --ego, --scenario, --llm and --memory.")
        tell_input(source, seconds or CHECKED_SIMULATION_S, settings_file, as_json=as_json)
        return
    if seconds is not None:
        raise UsageError("--seconds says how long an INPUT is compared with SUMO: give the INPUT, too.")
    if ego is not None:
        if llm is not None or memory is not None:
            raise UsageError("--ego checks a driver alone: leave out --llm and --memory.")
        check_ego(ego, scenario or (), settings_file, as_json=as_json)
        return
    if scenario:
        raise UsageError("--scenario says where the driver of --ego is checked: give --ego, too.")
    findings = list(_findings(llm, memory, settings_file))
    failed = sum(f.level == "fail" for f in findings)
    if as_json:
        typer.echo(json.dumps({"ok": not failed, "failed": failed, "checks": [asdict(f) for f in findings]}))
    else:
        for finding in findings:
            mend = f". To fix it: {finding.mend}" if finding.mend else ""
            typer.echo(f"{finding.level:<5} {finding.name}: {finding.found.rstrip('.')}{mend}.")
        typer.echo(
            "Everything that a run needs is installed."
            if not failed
            else "A run cannot work: fix the checks that say fail."
        )
    if failed:
        raise typer.Exit(1)


def _findings(llm: str | None, memory: Path | None, settings_file: Path | None) -> Iterator[DoctorFinding]:
    from sumo_adv.cli import doctor_checks as checks
    from sumo_adv.cli.doctor_model import model
    from sumo_adv.simulation.inputs import data_folder

    yield from checks.interpreter()
    yield from checks.libraries()
    try:
        yield from checks.simulator(data_folder("networks") / "straight_2lane.net.xml")
        data_folder("scenarios"), data_folder("prompts"), data_folder("memory_bank.sqlite")
    except SumoAdvError as error:
        yield checks.DoctorFinding("shipped files", checks.FindingLevel.FAIL, str(error), "install the package again")
    yield from checks.programs(developing=find_spec("pytest") is not None)
    yield from checks.extras()
    try:
        settings = load_settings(settings_file, llm=llm, memory=memory)
    except SumoAdvError as error:
        yield checks.DoctorFinding("settings", checks.FindingLevel.FAIL, str(error), "correct the variable or the file")
        settings = None
    yield from checks.variables(Settings.model_fields)
    yield from checks.sandbox(settings is None or settings.bubblewrap)
    if settings is not None:
        yield from model(settings)
    yield from checks.bank(memory if settings is None else settings.memory)
    yield from checks.output(Path.cwd())


def tell_input(source: Path, seconds: float, settings_file: Path | None, *, as_json: bool) -> None:
    """Check an input and print what was found.

    Args:
        source: The input.
        seconds: The simulated time to compare with SUMO [s].
        settings_file: A TOML file of settings; None for no file.
        as_json: Whether the output is JSON.

    Raises:
        typer.Exit: The input's traffic does not move as in SUMO.
    """
    from sumo_adv import app
    from sumo_adv.simulation.inputs import own_simulation

    run_input = app.load(source, None)
    settings = load_settings(settings_file, **own_simulation(run_input))
    done = app.check_input(run_input, settings, seconds)
    typer.echo(json.dumps(_of_input(source, done)) if as_json else "\n".join(_words_of_input(source, done)))
    if not done.same:
        raise typer.Exit(EXIT_FINDINGS)


def _of_input(source: Path, done: InputCheck) -> dict[str, Any]:
    return {
        "input": str(source), "same": done.same, "read": dict(done.contents), "notes": list(done.notes),
        "classes": done.classes, "comparison": None if done.comparison is None else asdict(done.comparison),
        "own_step": None if done.own_step is None else asdict(done.own_step),
        "warnings": [asdict(kind) for kind in done.warnings], "not_inserted": list(done.not_inserted),
    }  # fmt: skip


def _words_of_input(source: Path, done: InputCheck) -> list[str]:
    from sumo_adv.input_check.motions import listed
    from sumo_adv.simulation.warnings_log import said_of

    lines = [f"Read from {source}: {_counted(done.contents)}."]
    if done.classes:
        lines.append(f"Classes: {_counted(done.classes)}.")
    lines += [*done.notes, *said_of(done.warnings)]
    if done.not_inserted:
        lines.append(f"SUMO has not inserted these vehicles, whose departure has passed: {listed(done.not_inserted)}.")
    if done.own_step is not None:
        lines.append(f"With SUMO's own step of {done.own_step.step:g} s: {done.own_step.sentence}")
    if done.comparison is not None:
        start = "As SUMO runs it" if done.comparison.same else "Not as SUMO runs it"
        at_step = f" in steps of {done.comparison.step:g} s" if done.own_step is not None else ""
        lines.append(f"{start}{at_step}: {done.comparison.sentence}")
    return lines


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{number} {kind}" for kind, number in counts.items())


def version_line() -> str:
    """Return the versions of this program and of SUMO, and the memory bank that a run would use.

    If the user has no bank yet, it is the shipped one.
    """
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.migrations import MIGRATIONS

    try:
        sumo = version("libsumo")
    except PackageNotFoundError:
        sumo = "not installed"
    try:
        own = load_settings(None).memory or default_bank_path()
        with MemoryBank.open(own if own.exists() else shipped_bank(), read_only=True) as bank:
            description = f"schema {len(MIGRATIONS)}, content {bank.content_hash()[:12]}"
    except SumoAdvError as error:
        description = str(error).rstrip(".")
    return f"sumo-adv {__version__} (SUMO {sumo}; memory bank: {description})"


EXIT_FINDINGS = 3  # exit status of a check that fails
SCENARIO_NAME_CHARACTERS = 40  # width of a scenario's name


def check_ego(ego: str, scenarios: Sequence[Path], settings_file: Path | None, *, as_json: bool) -> None:
    """Check a driver and print what was found.

    Args:
        ego: The name of the driver.
        scenarios: The scenarios to drive, files or names of the table; empty for the twelve of ``driver_check``.
        settings_file: A TOML file of settings; None for no file.
        as_json: Whether the output is JSON.

    Raises:
        typer.Exit: There is a finding, or Ctrl-C stopped the check.
    """
    from sumo_adv import app
    from sumo_adv.driver_check import DRIVE_DURATION_S, by_name, twelve

    settings = load_settings(settings_file, ego=ego)
    inputs = [by_name(str(source)) or app.load(source, None) for source in scenarios] or twelve()
    if not as_json:
        typer.echo(f"{ego} drives {_many(len(inputs))}: {', '.join(given.name for given in inputs)}.")
        typer.echo(
            f"Each scenario lasts {DRIVE_DURATION_S:.0f} s. idm drives it once, and {ego} twice or, if its drives "
            "differ, more often. After the first, the remaining time is shown. Ctrl-C keeps the finished scenarios."
        )
        typer.echo(f"{'scenario':<{SCENARIO_NAME_CHARACTERS}} {'time':>6} {'ego':>7} {'idm':>7}  findings")
    done = app.check_driver(inputs, settings, (lambda checked: None) if as_json else CheckProgress(len(inputs)).tell)
    if as_json:
        typer.echo(json.dumps(_plain(done)))
    else:
        typer.echo("\n".join(summary(done)))
    if done.kinds or done.stopped:
        raise typer.Exit(EXIT_FINDINGS if done.kinds else 1)


def _many(scenarios: int) -> str:
    return f"{scenarios} scenarios" if scenarios != 1 else "one scenario"


class CheckProgress:
    """Prints a line for each scenario, and after the first one how long the others will take."""

    def __init__(self, scenarios: int) -> None:
        self._left, self._first, self._began = scenarios, True, time.monotonic()

    def tell(self, checked: Checked) -> None:
        _tell(checked)
        self._left -= 1
        if self._first and self._left:
            self._first = False
            from sumo_adv.cli.progress import span

            each = time.monotonic() - self._began
            typer.echo(
                f"The first took {each:.0f} s; the other {self._left} will take about {span(self._left * each)}."
            )


def _tell(checked: Checked) -> None:
    findings = "; ".join(f"{f.kind} at {f.time:.1f} s: {f.words}" for f in checked.findings) or "good"
    drove = f"{checked.seconds:4.0f} s {checked.metres:5.0f} m {checked.idm_metres:5.0f} m"
    typer.echo(f"{checked.scenario:<{SCENARIO_NAME_CHARACTERS}} {drove}  {findings}")


def summary(done: DriverCheck) -> list[str]:
    """Describe the result of a driver's check in lines."""
    from sumo_adv.driver_check import FINDING_MEANINGS

    lines = [f"{kind}: {FINDING_MEANINGS[kind]}" for kind in done.kinds]
    if done.times is not None:
        lines.append(done.times.words)
    if done.stopped:
        lines.append(f"Stopped by Ctrl-C after {_many(len(done.scenarios))}.")
    wrong = sum(bool(checked.findings) for checked in done.scenarios)
    if not wrong:
        every = f"all {len(done.scenarios)} scenarios" if len(done.scenarios) != 1 else "the one scenario"
        lines.append(f"{done.ego} drives well in {every}." if done.scenarios else "")
    else:
        lines.append(f"{done.ego}: something is wrong in {wrong} of {len(done.scenarios)} scenarios.")
    return lines


def _plain(done: DriverCheck) -> dict[str, Any]:
    from sumo_adv.driver_check import FINDING_MEANINGS

    return {
        "ego": done.ego,
        "ok": not done.kinds,
        "findings": {kind: FINDING_MEANINGS[kind] for kind in done.kinds},
        "act_ms": None if done.times is None else asdict(done.times),
        "stopped": done.stopped,
        "scenarios": [asdict(checked) for checked in done.scenarios],
    }
