"""The files of a run's folder."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from sumo_adv.datatypes import MAX_ADVERSARIES, Attempt, plain_acceleration
from sumo_adv.episode.episode import Episode
from sumo_adv.files import json_text
from sumo_adv.metrics.boxes import first_contact, on_grid
from sumo_adv.metrics.criticality import ttc
from sumo_adv.report.outcome import manifest, number, outcome
from sumo_adv.report.staging import RunFolder
from sumo_adv.report.tables import SERIES_HEADER, csv_text, write_gzip, write_plan, write_signals, write_states
from sumo_adv.report.verdicts import findings_on, further_keys
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.simulation.tracks import tracks_of
from sumo_adv.simulation.warnings_log import WARNINGS_FILE

RUN_FILES = ("outcome.json", "manifest.json", "states.csv.gz", "raw.csv.gz", "criticality.csv.gz", "encounter.png")
FIRST = "first.csv.gz"  # written if another attempt than the first counts
SIGNALS = "signals.csv.gz"  # there is one where traffic lights are near the ego
PLAN = "plan.csv.gz"  # there is one where the attempt that counts ends with a contact, and one for each support


def write_run(folder: RunFolder, episode: Episode, *, figure: bool = True) -> dict[str, Any]:
    """All files of the contract, the picture only with ``figure``; gives back what ``outcome.json`` holds."""
    stage = folder.stage
    inputs = _copy_inputs(episode, stage / "inputs")
    began = perf_counter()
    found = findings_on(episode)
    episode.timing["verdict"] = perf_counter() - began
    realism = found.realism if found is not None else {}
    result = outcome(episode, raw_figures(episode), further_keys(found), realism)
    (stage / "manifest.json").write_text(json_text(manifest(episode, inputs), 2), encoding="utf-8")
    _write_attempts(stage / "attempts.csv.gz", episode)
    if episode.warnings:
        lines = "".join(f"{text}\n" for text in episode.warnings)
        (stage / WARNINGS_FILE).write_text(lines, encoding="utf-8", newline="\n")
    if episode.found is not None and episode.prefix is not None:
        _write_tables(stage, episode)
        if found is not None:
            write_gzip(stage / "criticality.csv.gz", SERIES_HEADER + "".join(found.rows))
        if episode.best is not None and figure:
            picture = stage / "encounter.png"
            try:
                _figure(picture, episode)
            except OSError:
                raise
            except Exception as error:  # odd values that no plotting library takes: the run is kept without it
                why = f"{picture.name} could not be drawn ({type(error).__name__}: {error})."
                result["notes"] = [*result["notes"], why]
    (stage / "outcome.json").write_text(json_text(result, 2), encoding="utf-8")
    for success in result["successes"]:
        if success["folder"] is not None:
            attack_stage = stage / success["folder"]
            attack_stage.mkdir(parents=True)
            inside = RunFolder(folder.target / success["folder"], attack_stage)
            write_run(inside, episode.of_attempt(success["attempt"]), figure=figure)
    return result


def _copy_inputs(episode: Episode, folder: Path) -> dict[Path, str]:
    """Content-addressed copies of network, demand, additional files and what is played back."""
    spec = episode.task.spec
    folder.mkdir()
    names = {}
    played = () if episode.task.playback is None else episode.task.playback.files
    for file in (spec.network, *spec.routes, *spec.additional, *played):
        data = file.read_bytes()
        content = hashlib.sha256(data).hexdigest()[:12]
        names[file] = f"{content}-{file.name.removeprefix(f'{content}-')}"  # a replay copies copies
        (folder / names[file]).write_bytes(data)
    return names


def _attempt_snapshots(episode: Episode) -> list[Snapshot]:
    assert episode.prefix is not None
    best, encounter = episode.refinement.best, episode.found
    after = encounter.baseline if best is None and encounter else episode.refinement.results[best or 0].snapshots
    return [*episode.prefix.snapshots, *after]


def _write_tables(stage: Path, episode: Episode) -> None:
    """States, lights, and what the adversaries were to do after the contact."""
    assert episode.found is not None and episode.prefix is not None
    ego, before, baseline = episode.found.ego, episode.prefix.snapshots, episode.found.baseline
    sizes, step, roles, done = all_sizes(episode), episode.settings.step_length, episode.task.roles, episode.refinement
    if baseline:
        write_states(stage / "raw.csv.gz", [*before, *baseline], sizes, roles(ego), step)
    bvs = () if episode.best is None else episode.best.proposal.bvs
    write_states(stage / "states.csv.gz", _attempt_snapshots(episode), sizes, roles(ego, *bvs), step)
    write_signals(stage / SIGNALS, _attempt_snapshots(episode))
    if done.best and done.results[0].snapshots:  # of the first attempt, from the step before the trigger on
        names = (ego, *done.attempts[0].proposal.bvs)
        write_states(stage / FIRST, [*before[-2:], *done.results[0].snapshots], sizes, roles(*names), step, names)
    if episode.best is not None:
        beyond = done.results[done.best or 0].driven.beyond
        for name, bv in zip(plan_names(), bvs, strict=False):
            if bv in beyond:
                write_plan(stage / name, beyond[bv])


def plan_names() -> tuple[str, ...]:
    """The files of the planned motions: the collider's, then the supports'."""
    return (PLAN, *(PLAN.replace(".", f"_{number}.", 1) for number in range(2, MAX_ADVERSARIES + 1)))


def all_sizes(episode: Episode) -> dict[str, tuple[float, float]]:
    assert episode.prefix is not None
    sizes = dict(episode.prefix.sizes)
    for result in episode.refinement.results:
        sizes.update(result.sizes)
    if episode.found is not None:
        sizes.update(episode.found.sizes)
    return sizes


def raw_figures(episode: Episode) -> dict[str, Any] | None:
    """The unattacked run over the same pair and window as the attempt that counts; None if there was none."""
    best, encounter = episode.best, episode.found
    if best is None or encounter is None or episode.prefix is None or not encounter.baseline:
        return None
    after = episode.refinement.results[episode.refinement.best or 0].snapshots
    if not after:  # its planner failed before the first step
        return {"min_ttc": None, "collided": False}
    names = (encounter.ego, best.proposal.bv)
    step, snapshots = episode.settings.step_length, [*episode.prefix.snapshots[-5:], *encounter.baseline]
    tracks = tracks_of(snapshots, all_sizes(episode), {}, step, names)
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


def _figure(target: Path, episode: Episode) -> None:
    from sumo_adv.report.encounter_figure import draw_encounter

    best, encounter, prefix = episode.best, episode.found, episode.prefix
    assert best is not None and encounter is not None and prefix is not None
    names = (encounter.ego, best.proposal.bv)
    roles = episode.task.roles(encounter.ego, *best.proposal.bvs)
    sizes, step = all_sizes(episode), episode.settings.step_length
    history = episode.settings.steps(episode.settings.history)
    since = _attempt_snapshots(episode)[len(prefix.snapshots) - history :]
    attacked = {t.id: t for t in tracks_of(since, sizes, roles, step)}
    raw = {t.id: t for t in tracks_of([*prefix.snapshots[-history:], *encounter.baseline], sizes, roles, step, names)}
    others = [t for n, t in attacked.items() if n not in names]
    p = best.proposal
    draw_encounter(
        target, lanes=episode.lanes, ego=attacked[encounter.ego], adversary=attacked[p.bv], others=others,
        raw_ego=raw.get(encounter.ego), raw_adversary=raw.get(p.bv), trigger_time=best.trigger_time,
        verdict=best.verdict,
        title=f"{episode.source.name}: {' + '.join(p.bvs)} — {p.composition or p.label} "
        f"against {encounter.ego} ({episode.task.ego_driver})",
    )  # fmt: skip


def _write_attempts(target: Path, episode: Episode) -> None:
    """A row for each attempt, of encounters that gave nothing, too. Times s, distances m, speeds m/s; never = empty.

    encounter: its time; attempt: its number there, from 1; delay: from the encounter to the start.
    """
    encounters = {t.time: t.made for t in episode.tried}
    if episode.found is not None:
        encounters[episode.found.time] = episode.refinement.attempts
    rows = [_row(time, attempt) for time, made in sorted(encounters.items()) for attempt in made]
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
        "failed_gates": " ".join(v.failed_gates), "ending": a.ending,
    }  # fmt: skip
