"""``doctor``: is everything here that a run needs, and what else could be; and the line of ``--version``.

With ``--ego`` it checks a driver instead (``doctor_ego.py``).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sumo_adv import __version__
from sumo_adv.errors import SumoAdvError, UsageError

if TYPE_CHECKING:
    from sumo_adv.cli.doctor_checks import Finding

EXAMPLE = "Example: sumo-adv doctor --llm ollama:llama3"


def doctor(
    llm: Annotated[str | None, typer.Option(help="The language model to look for, as in run.")] = None,
    memory: Annotated[Path | None, typer.Option(help="The memory bank (default: your own).")] = None,
    ego: Annotated[
        str | None, typer.Option(help="Check this driver instead: drive it unattacked through twelve scenarios.")
    ] = None,
    scenario: Annotated[
        list[Path] | None, typer.Option(help="With --ego: drive it here, in place of the twelve (may be repeated).")
    ] = None,
    settings_file: Annotated[Path | None, typer.Option("--settings", help="TOML file of settings.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Check libraries, programs, sandbox, model, memory bank and write rights; each line says how to fix it.

    ok; warn: something that a plain run does not need; fail: a run cannot work, and the exit status is 1.
    With --ego: faults of a driver or its adapter; the exit status is 3 if there are any.
    """
    if ego is not None:
        from sumo_adv.cli.doctor_ego import check

        if llm is not None or memory is not None:
            raise UsageError("--ego checks a driver alone: leave out --llm and --memory.")
        check(ego, scenario or (), settings_file, as_json=as_json)
        return
    if scenario:
        raise UsageError("--scenario says where the driver of --ego is checked: name the driver as well.")
    findings = list(_findings(llm, memory, settings_file))
    failed = sum(f.level == "fail" for f in findings)
    if as_json:
        typer.echo(json.dumps({"ok": not failed, "failed": failed, "checks": [asdict(f) for f in findings]}))
    else:
        for finding in findings:
            mend = f". To fix it: {finding.mend}" if finding.mend else ""
            typer.echo(f"{finding.level:<5} {finding.name}: {finding.found.rstrip('.')}{mend}.")
        typer.echo("All that a run needs is here." if not failed else "A run cannot work: fix what says fail.")
    if failed:
        raise typer.Exit(1)


def _findings(llm: str | None, memory: Path | None, settings_file: Path | None) -> Iterator[Finding]:
    from sumo_adv.cli import doctor_checks as checks
    from sumo_adv.cli import doctor_user as user
    from sumo_adv.config import Settings, load_settings
    from sumo_adv.simulation.inputs import data_folder

    yield from checks.interpreter()
    yield from checks.libraries()
    try:
        yield from checks.simulator(data_folder("networks") / "straight_2lane.net.xml")
        data_folder("scenarios"), data_folder("prompts"), data_folder("memory_bank.sqlite")
    except SumoAdvError as error:
        yield checks.Finding("shipped files", checks.Level.FAIL, str(error), "install the package again")
    yield from checks.programs(developing=find_spec("pytest") is not None)
    yield from checks.extras()
    try:
        settings = load_settings(settings_file, llm=llm, memory=memory)
    except SumoAdvError as error:
        yield checks.Finding("settings", checks.Level.FAIL, str(error), "correct the variable or the file")
        settings = None
    yield from user.variables(Settings.model_fields)
    yield from checks.sandbox(settings is None or settings.bubblewrap)
    if settings is not None:
        yield from user.model(settings)
    yield from user.bank(memory if settings is None else settings.memory)
    yield from user.output(Path.cwd())


def version_line() -> str:
    """This program, SUMO and the memory bank that a run would use (the shipped one where there is none yet)."""
    from sumo_adv.app import shipped_bank
    from sumo_adv.config import load_settings
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.migrations import MIGRATIONS
    from sumo_adv.memory.store import default_bank_path

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
