"""Crash rates from Python: ``found = sumo_adv.crash_rate("straight_2lane", ego="idm", out="runs/rate-idm")``."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from sumo_adv.rate.estimate import Estimate

Progress = Callable[[str, int, int], None]


def crash_rate(
    source: str | Path,
    *,
    ego: str | None = None,
    runs: int = 1000,
    pilot: int = 200,
    plain: bool = False,
    seed: int = 0,
    duration: float = 60.0,
    warm_up: float = 20.0,
    density: float | None = None,
    errors: float = 1.0,
    out: str | Path | None = None,
    workers: int | None = None,
    ray: str | None = None,
    ego_parameters: Mapping[str, Any] | None = None,
    tell: Progress | None = None,
) -> Estimate | None:
    """Estimate how often the ego crashes in normal traffic, as ``sumo-adv rate``; None if Ctrl-C stopped it.

    source: a net.xml, a .sumocfg, a scenario or a shipped name; not a recording. ego: the name of a driver
    (``module:Class`` for a driver of yours), None = as the input says, else idm. runs: that are estimated from; pilot:
    those before, from which the proposal learns; plain: draw all runs from the model. duration, warm_up [s]: of a run.
    density: departures a minute of generated traffic. errors: factor on the rates of all human errors. out: the folder
    of runs, where the same call again goes on; None = a temporary one. ray: address of a Ray cluster. tell: called with
    the phase (``pilot``, ``runs``, ``plain``), and how many of how many blocks of 20 runs are finished.

    The result: ``found.per_hour["collision"].value``, ``.low``, ``.high``, ``.half_width``; so too ``per_km``, and the
    levels ``contact``, ``valid``, ``strict``, ``serious``. ``found.document()`` is what ``rate.json`` holds.

    Raises:
        UsageError: bad input, or ``out`` holds runs of another estimate. SimulationError: a run failed twice.
    """
    from sumo_adv.app import estimate_rate
    from sumo_adv.rate.blocks import RatePlan

    if ego is not None and not isinstance(ego, str):
        raise UsageError("Give the ego of a crash rate as a name (module:Class): its workers import it.")
    if min(runs, pilot) < 1:
        raise UsageError("A crash rate needs at least one run and one pilot run.")
    plan = RatePlan(
        Path(source), ego, dict(ego_parameters or {}), density, warm_up, duration, errors, pilot, plain, seed
    )  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="sumo_adv-result-") as scratch:
        folder = Path(scratch) if out is None else Path(out)
        return estimate_rate(plan, folder, runs, workers or os.cpu_count() or 1, _Teller(tell), ray)


class _Teller:
    """Passes on how far a phase is."""

    def __init__(self, tell: Progress | None) -> None:
        self._tell, self._of, self._done = tell, 0, 0

    def begin(self, total: int, before: Sequence[Any]) -> None:
        """A phase of ``total`` blocks."""
        self._of, self._done = total, len(before)

    def finished(self, job: Any, row: Any) -> None:
        """One more block."""
        self._done += 1
        if self._tell is not None:
            self._tell(job.phase, self._done, self._of)

    def stopping(self, now: bool) -> None:
        """Nothing is said: the caller sees it by the result None."""
