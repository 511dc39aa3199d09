"""What is exported of a run: a stretch of the attempt that counts, or of the unattacked run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Role, Track
from sumo_adv.errors import UsageError
from sumo_adv.metrics.boxes import first_contact, row_of
from sumo_adv.report.manifest import waymo_source
from sumo_adv.report.page.read import MANIFEST, RunRead, read_run
from sumo_adv.simulation.inputs import WaymoSource
from sumo_adv.simulation.signals import SignalLog


@dataclass(frozen=True, slots=True)
class Piece:
    """Tracks between ``begin`` and ``end`` [s, simulation time], in order of first appearance.

    network: the net.xml they drive on. step [s]. adversary: the collider; supports: the other adversaries. takeover:
    when they begin to be driven [s], None if unattacked. written: when the run was made. level: what the attempt came
    to, empty if unattacked. lights: what the traffic lights near the ego showed, empty if unattacked. waymo: the record
    that the run's input was converted from.
    """

    name: str
    network: Path
    tracks: tuple[Track, ...]
    begin: float
    end: float
    step: float
    ego: str
    adversary: str | None
    takeover: float | None
    written: datetime
    supports: tuple[str, ...] = ()
    level: str = ""
    lights: SignalLog = SignalLog({})  # noqa: RUF009 - frozen
    waymo: WaymoSource | None = None

    def track(self, vehicle: str) -> Track:
        """The track of that id, which is there."""
        return next(t for t in self.tracks if t.id == vehicle)

    def contact(self) -> float | None:
        """When the boxes of ego and collider first touch [s]; None if they do not."""
        if self.adversary is None:
            return None
        ego, other = self.track(self.ego), self.track(self.adversary)
        start, end = max(ego.time[0], other.time[0]), min(ego.time[-1], other.time[-1])
        if end < start:
            return None
        ego, other = ego.between(start, end), other.between(start, end)
        time = float(first_contact(row_of(ego), row_of(other), ego.time)[0])
        return time if math.isfinite(time) else None


def read_piece(folder: Path, *, unattacked: bool = False, before: float | None = None, whole: bool = False) -> Piece:
    """The stretch of a run to export, from ``before`` seconds before the takeover on (None = the run's own history).

    ``unattacked``: of the run without an attack. ``whole``: from the start of the simulation on.

    Raises:
        UsageError: no run's folder, nothing in it to export, or a damaged file.
    """
    run = read_run(folder)
    tracks = run.raw if unattacked else run.best
    if not tracks:
        fault = "no states of the unattacked run" if unattacked else "no states: it met no encounter"
        raise UsageError(f"The run in {folder} has {fault}, so there is nothing to export.")
    try:
        return _piece(run, tracks, unattacked, before, whole)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UsageError(
            f"The run in {folder} is not as this program writes it ({type(error).__name__}: {error}); run it again."
        ) from error


def _piece(run: RunRead, tracks: Sequence[Track], unattacked: bool, before: float | None, whole: bool) -> Piece:
    settings: Mapping[str, Any] = run.manifest["settings"]
    network = run.folder / "inputs" / Path(run.manifest["network"]).name
    if not network.is_file():
        raise UsageError(f"{network} is missing, so the run in {run.folder} cannot be exported.")
    takeover = run.outcome["trigger_time"]
    moment = run.outcome["encounter"]["time"] if takeover is None else takeover
    first, end = min(t.time[0] for t in tracks), max(t.time[-1] for t in tracks)
    lead = settings["history"] if before is None else before
    begin = first if whole else max(first, float(moment) - lead)
    shown = [part for t in tracks if (part := t.between(begin, end)).time.size]
    ego = run.outcome["ego"]["id"]
    adversaries = run.outcome.get("adversaries") or []
    driven = {t.id for t in shown if t.role is Role.ADVERSARY}
    colliders = driven & {str(a["id"]) for a in adversaries[:1]}
    attacked = None if unattacked or not colliders else colliders.pop()
    supports = [name for a in adversaries[1:] if (name := str(a["id"])) in driven and attacked is not None]
    if ego not in {t.id for t in shown}:
        raise UsageError(f"The ego is not in the exported part of the run in {run.folder}; give --whole.")
    return Piece(
        str(run.manifest["name"]), network, tuple(shown), float(min(t.time[0] for t in shown)), float(end),
        float(settings["step_length"]), ego, attacked, float(takeover) if attacked is not None else None,
        datetime.fromtimestamp((run.folder / MANIFEST).stat().st_mtime, UTC).replace(microsecond=0),
        tuple(supports), _level(run, attacked), SignalLog({}) if unattacked else run.lights,
        waymo_source(run.manifest),
    )  # fmt: skip


def _level(run: RunRead, attacked: str | None) -> str:
    """The level of the attempt that counts."""
    best = run.outcome.get("best")
    return "" if attacked is None or best is None else str(run.outcome["attempts"][best]["level"] or "")
