"""Write the files of a run's folder."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import MAX_ADVERSARIES, Attempt, plain_acceleration
from sumo_adv.episode.clock import PartsClock
from sumo_adv.episode.run import EncounterRecord, Run
from sumo_adv.episode.task import Prefix, Task
from sumo_adv.files import json_text
from sumo_adv.metrics.boxes import first_contact, on_grid
from sumo_adv.metrics.criticality import ttc
from sumo_adv.report.outcome import manifest, number, outcome, timing
from sumo_adv.report.staging import RunFolder
from sumo_adv.report.tables import (
    SERIES_HEADER,
    csv_text,
    write_gzip,
    write_inside,
    write_plan,
    write_signals,
    write_states,
)
from sumo_adv.report.verdicts import Findings, findings_on, further_keys
from sumo_adv.scenario_names import columns_of
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.simulation.tracks import tracks_of
from sumo_adv.simulation.warnings_log import WARNINGS_FILE

RUN_FILES = ("outcome.json", "manifest.json", "states.csv.gz", "raw.csv.gz", "criticality.csv.gz", "encounter.png")
FIRST = "first.csv.gz"  # only written if the attempt that counts is not the first one
SIGNALS = "signals.csv.gz"  # only written if traffic lights are near the ego
INSIDE = "driver.jsonl.gz"  # only written if the ego's driver reported its plan or notes
PLAN = "plan.csv.gz"  # only written if the attempt that counts ends with a contact; further files for supports


def write_run(folder: RunFolder, run: Run, *, figure: bool = True) -> dict[str, Any]:
    """Write the files of a run's folder for its best record.

    Args:
        folder: The staged folder.
        run: The run.
        figure: Whether ``encounter.png`` is drawn.

    Returns:
        The content of ``outcome.json``.

    Raises:
        OSError: A file cannot be written.
    """
    return _write(folder, run, run.best, PartsClock(), figure=figure)


def _write(
    folder: RunFolder, run: Run, record: EncounterRecord | None, clock: PartsClock, *, figure: bool
) -> dict[str, Any]:
    """Write the files of a record, and a subfolder for each further kind of attack in it.

    ``outcome.json`` comes last, because it says how long the others took.
    """
    with clock.part("files"):
        result = _write_all_but_outcome(folder, run, record, clock, figure=figure)
    result["timing"] = timing(run, record, clock.seconds)
    (folder.stage / "outcome.json").write_text(json_text(result, 2), encoding="utf-8")
    return result


def _write_all_but_outcome(
    folder: RunFolder, run: Run, record: EncounterRecord | None, clock: PartsClock, *, figure: bool
) -> dict[str, Any]:
    stage = folder.stage
    inputs = _copy_inputs(run.task, stage / "inputs")
    with clock.part("verdict"):
        findings = None if record is None else findings_on(run, record)
    result = full_outcome(run, record, findings)
    (stage / "manifest.json").write_text(json_text(manifest(run, record, inputs), 2), encoding="utf-8")
    _write_attempts(stage / "attempts.csv.gz", run)
    if run.warnings:
        lines = "".join(f"{text}\n" for text in run.warnings)
        (stage / WARNINGS_FILE).write_text(lines, encoding="utf-8", newline="\n")
    if record is not None and record.prefix is not None:
        _write_tables(stage, run, record, record.prefix)
        if findings is not None:
            write_gzip(stage / "criticality.csv.gz", SERIES_HEADER + "".join(findings.rows))
        if record.best is not None and figure:
            picture = stage / "encounter.png"
            try:
                with clock.part("pictures"):
                    _figure(picture, run, record, record.best, record.prefix)
            except OSError:
                raise
            except Exception as error:  # odd values that no plotting library accepts: keep the run without its picture
                why = f"{picture.name} could not be drawn ({type(error).__name__}: {error})."
                result["notes"] = [*result["notes"], why]
    for success in result["successes"]:
        if record is not None and success["folder"] is not None:
            attack_stage = stage / success["folder"]
            attack_stage.mkdir(parents=True)
            inside = RunFolder(folder.target / success["folder"], attack_stage)
            _write(inside, run, record.of_attempt(success["attempt"]), clock, figure=figure)
    return result


def full_outcome(run: Run, record: EncounterRecord | None, findings: Findings | None) -> dict[str, Any]:
    """Assemble the content of ``outcome.json`` without writing anything.

    Args:
        run: The run.
        record: The record that counts; None if no encounter does.
        findings: The findings on the attempt that counts; None if there is none.

    Returns:
        The content of ``outcome.json``.
    """
    raw = None if record is None else raw_figures(record, run.settings)
    return outcome(run, record, raw, further_keys(findings), {} if findings is None else findings.realism)


def _copy_inputs(task: Task, folder: Path) -> dict[Path, str]:
    """Copy network, demand, additional and playback files; a copy's name begins with the hash of its content."""
    spec = task.spec
    folder.mkdir()
    names = {}
    played = () if task.playback is None else task.playback.files
    for file in (spec.network, *spec.routes, *spec.additional, *played):
        data = file.read_bytes()
        content = hashlib.sha256(data).hexdigest()[:12]
        names[file] = f"{content}-{file.name.removeprefix(f'{content}-')}"  # a replay copies copies
        (folder / names[file]).write_bytes(data)
    return names


def _snapshots(record: EncounterRecord, prefix: Prefix) -> list[Snapshot]:
    """Return the states of the attempt that counts (or of the unattacked run without one), since the simulation's
    start."""
    result = record.best_result
    return [*prefix.snapshots, *(record.found.baseline if result is None else result.snapshots)]


def _write_tables(stage: Path, run: Run, record: EncounterRecord, prefix: Prefix) -> None:
    """Write the tables of states and traffic lights, the driver's notes, and the plans after the contact."""
    ego, before, baseline, best = record.found.ego, prefix.snapshots, record.found.baseline, record.best
    sizes, step, roles = all_sizes(record), run.settings.step_length, run.task.roles
    if baseline:
        write_states(stage / "raw.csv.gz", [*before, *baseline], sizes, roles(ego), step)
    bvs = () if best is None else best.proposal.bvs
    snapshots = _snapshots(record, prefix)
    write_states(stage / "states.csv.gz", snapshots, sizes, roles(ego, *bvs), step)
    write_signals(stage / SIGNALS, snapshots)
    if best is None:
        return
    first = record.results[0].snapshots
    if best.index and first:  # begins one step before the trigger
        names = (ego, *record.attempts[0].proposal.bvs)
        write_states(stage / FIRST, [*before[-2:], *first], sizes, roles(*names), step, names)
    if record.best_result is not None:
        write_inside(stage / INSIDE, record.best_result.inside)
        beyond = record.best_result.driven.beyond
        for name, bv in zip(plan_names(), bvs, strict=False):
            if bv in beyond:
                write_plan(stage / name, beyond[bv])


def plan_names() -> tuple[str, ...]:
    """Return the file names of the planned motions: the collider's first, then the supports'."""
    return (PLAN, *(PLAN.replace(".", f"_{number}.", 1) for number in range(2, MAX_ADVERSARIES + 1)))


def all_sizes(record: EncounterRecord) -> dict[str, tuple[float, float]]:
    """Return length and width [m] of all vehicles of an encounter, by id."""
    sizes = {} if record.prefix is None else dict(record.prefix.sizes)
    for result in record.results:
        sizes.update(result.sizes)
    sizes.update(record.found.sizes)
    return sizes


def raw_figures(record: EncounterRecord, settings: Settings) -> dict[str, Any] | None:
    """Measure the unattacked run for the same two vehicles and the same window as the attempt that counts.

    Args:
        record: The record.
        settings: The run's settings.

    Returns:
        ``min_ttc`` [s], null if it is infinite or the window is empty, and ``collided``. None if there is no attempt or
            no unattacked run.
    """
    best, result, encounter = record.best, record.best_result, record.found
    if best is None or result is None or record.prefix is None or not encounter.baseline:
        return None
    after = result.snapshots
    if not after:  # the planner failed before the first step
        return {"min_ttc": None, "collided": False}
    names = (encounter.ego, best.proposal.bv)
    step, snapshots = settings.step_length, [*record.prefix.snapshots[-5:], *encounter.baseline]
    tracks = tracks_of(snapshots, all_sizes(record), {}, step, names)
    low = max([best.trigger_time, *(t.time[0] for t in tracks)])
    high = min([after[-1].time, *(t.time[-1] for t in tracks)])
    if len(tracks) < 2 or high - low < step:
        return {"min_ttc": None, "collided": False}
    by_id = {t.id: t.between(low, high) for t in tracks}
    time = by_id[names[0]].time
    a, b = (on_grid([by_id[name]], time) for name in names)
    least, contact = ttc(a, b), first_contact(a, b, time)
    return {"min_ttc": number(float(np.nanmin(least)) if np.isfinite(least).any() else None),
            "collided": bool(np.isfinite(contact).any())}  # fmt: skip


def _figure(target: Path, run: Run, record: EncounterRecord, best: Attempt, prefix: Prefix) -> None:
    """Draw the picture of the attempt that counts."""
    from sumo_adv.report.encounter_figure import draw_encounter

    encounter = record.found
    names = (encounter.ego, best.proposal.bv)
    roles = run.task.roles(encounter.ego, *best.proposal.bvs)
    sizes, step = all_sizes(record), run.settings.step_length
    history = run.settings.steps(run.settings.history)
    since = _snapshots(record, prefix)[len(prefix.snapshots) - history :]
    attacked = {t.id: t for t in tracks_of(since, sizes, roles, step)}
    raw = {t.id: t for t in tracks_of([*prefix.snapshots[-history:], *encounter.baseline], sizes, roles, step, names)}
    others = [t for n, t in attacked.items() if n not in names]
    p = best.proposal
    draw_encounter(
        target, lanes=record.lanes, ego=attacked[encounter.ego], adversary=attacked[p.bv], others=others,
        raw_ego=raw.get(encounter.ego), raw_adversary=raw.get(p.bv), trigger_time=best.trigger_time,
        verdict=best.verdict,
        title=f"{run.run_input.name}: {' + '.join(p.bvs)} — {p.composition or p.label} "
        f"against {encounter.ego} ({run.task.ego_driver})",
    )  # fmt: skip


def _write_attempts(target: Path, run: Run) -> None:
    """Write a row for each attempt of all encounters, with or without a success. An infinite value is an empty cell.

    Units are s, m and m/s. ``encounter`` is the encounter's time, ``attempt`` its number in the encounter from 1, and
    ``delay`` the time from the encounter to the start of the attack.
    """
    rows = [_row(record.found.time, attempt) for record in run.records for attempt in record.attempts]
    if rows:
        write_gzip(target, csv_text(list(rows[0]), rows))


def _row(encounter: float, a: Attempt) -> dict[str, Any]:
    v, p = a.verdict, a.proposal
    return {
        "encounter": number(encounter), "attempt": a.index + 1, "by": p.by, "phase": a.phase,
        "adversaries": " ".join(p.bvs), "intent": p.composition or p.label, "mode": p.planner.mode,
        "planner": p.planner.hash, "parameters": json.dumps({k: number(q) for k, q in p.parameters.items()}),
        "acceleration": plain_acceleration(p.acceleration), "delay": number(p.delay), "level": str(v.level),
        "min_ttc": number(v.min_ttc), "min_distance": number(v.min_distance), "delta_v": number(v.delta_v),
        "contact_time": number(v.contact_time), "contact_side": v.contact_side,
        "preventable_by": None if v.preventability is None else " ".join(v.preventability.by),
        "failed_gates": " ".join(v.failed_gates), "ending": a.ending, **columns_of(a.scenario),
    }  # fmt: skip
