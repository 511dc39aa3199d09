"""``doctor --ego``: the check of a driver as a table and one sentence for each kind of finding."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from sumo_adv.driver_check import Checked, DriverCheck

FOUND = 3  # exit status of a check that fails
WIDTH = 40  # columns for a scenario's name


def check(ego: str, scenarios: Sequence[Path], settings_file: Path | None, *, as_json: bool) -> None:
    """Check a driver and print what was found. Raises typer.Exit if there is a finding."""
    from sumo_adv import app
    from sumo_adv.config import load_settings

    settings = load_settings(settings_file, ego=ego)
    inputs = [app.load(source, None) for source in scenarios] or None
    if not as_json:
        typer.echo(f"{'scenario':<{WIDTH}} {'time':>6} {'ego':>7} {'idm':>7}  findings")
    done = app.check_driver(inputs, settings, (lambda checked: None) if as_json else _tell)
    if as_json:
        typer.echo(json.dumps(_plain(done)))
    else:
        typer.echo("\n".join(summary(done)))
    if done.kinds:
        raise typer.Exit(FOUND)


def _tell(checked: Checked) -> None:
    findings = "; ".join(f"{f.kind} at {f.time:.1f} s: {f.words}" for f in checked.findings) or "good"
    drove = f"{checked.seconds:4.0f} s {checked.metres:5.0f} m {checked.idm_metres:5.0f} m"
    typer.echo(f"{checked.scenario:<{WIDTH}} {drove}  {findings}")


def summary(done: DriverCheck) -> list[str]:
    """The lines below the table."""
    from sumo_adv.driver_check import MEANING

    lines = [f"{kind}: {MEANING[kind]}" for kind in done.kinds]
    if done.act_ms is not None:
        lines.append("An answer takes {:.1f} ms (median; 99 % within {:.1f} ms).".format(*done.act_ms))
    wrong = sum(bool(checked.findings) for checked in done.scenarios)
    if not wrong:
        lines.append(f"{done.ego} drives well in all {len(done.scenarios)} scenarios.")
    else:
        lines.append(f"{done.ego}: something is wrong in {wrong} of {len(done.scenarios)} scenarios.")
    return lines


def _plain(done: DriverCheck) -> dict[str, Any]:
    from sumo_adv.driver_check import MEANING

    return {
        "ego": done.ego,
        "ok": not done.kinds,
        "findings": {kind: MEANING[kind] for kind in done.kinds},
        "act_ms": None if done.act_ms is None else {"median": done.act_ms[0], "p99": done.act_ms[1]},
        "scenarios": [asdict(checked) for checked in done.scenarios],
    }
