"""What an attempt showed, in numbers for the modifier: both motions every half second, and the failed gates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from sumo_adv.agents.feedback import AttemptReport, RepairScene, Row
from sumo_adv.agents.scene_text import Aliases, driver_words, scene_words
from sumo_adv.agents.ways import starts_words
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, LibraryEntry, Track
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.geometry import Frame, wrap
from sumo_adv.metrics.gates import explained_gates
from sumo_adv.simulation.recording import tracks_of
from sumo_adv.situation import ReferencePath

EVERY = 0.5  # s between rows
NEAR_WAY = 30.0  # m along a way within which the next position is searched


def report_of(attempt: Attempt, result: AttemptResult, found: FoundEncounter, settings: Settings) -> AttemptReport:
    """The report of an attempt; without rows if ego or adversary left at once."""
    tracks = {t.id: t for t in tracks_of(result.snapshots, result.sizes, {}, settings.step_length)}
    bv, begun = attempt.proposal.bv, attempt.proposal.delay - min(found.situations)
    if found.ego not in tracks or bv not in tracks:
        return AttemptReport(attempt, (), (), begun, 0.0)
    ego, adversary = tracks.pop(found.ego), tracks.pop(bv)
    end = float(min(ego.time[-1], adversary.time[-1]))
    contact = attempt.verdict.contact_time
    gates = explained_gates(
        adversary, list(tracks.values()), attempt.verdict.failed_gates, settings.limits.of(adversary), found.drivable,
        result.start, end if contact is None else contact,
    )  # fmt: skip
    target = found.situations[attempt.proposal.delay].targets.get(bv)
    driven = adversary.between(result.start, end)
    way = way_taken(driven, target.ways) if target is not None and target.ways else None
    rows = _rows(ego.between(result.start, end), driven, result.start, way)
    movement = "none" if way is None else way.movement
    return AttemptReport(attempt, rows, tuple(gates), begun, max(end - result.start, 0.0), movement)


def way_taken(track: Track, ways: Sequence[ReferencePath]) -> ReferencePath:
    """The way that a vehicle followed: the one from which its centre was the least off, in the mean; of equals the
    first."""
    return min(ways, key=lambda way: sum(map(abs, _offsets(track, way, range(len(track.time))))))


def _offsets(track: Track, way: ReferencePath, steps: Iterable[int]) -> list[float]:
    """How far a vehicle's centre was to the left of a way in some steps [m]."""
    offsets, station = list[float](), 0.0
    for k in steps:
        station, offset = way.path.project(float(track.x[k]), float(track.y[k]), near=station, reach=NEAR_WAY)
        offsets.append(offset)
    return offsets


def _rows(ego: Track, bv: Track, start: float, way: ReferencePath | None) -> tuple[Row, ...]:
    count = min(len(ego.time), len(bv.time))
    if count < 2:
        return ()
    every = max(1, round(EVERY / float(np.diff(ego.time).min())))
    steps = sorted({*range(0, count, every), count - 1})
    offsets = [0.0] * len(steps) if way is None else _offsets(bv, way, steps)
    rows = list[Row]()
    for k, offset in zip(steps, offsets, strict=True):
        frame = Frame(float(ego.x[k]), float(ego.y[k]), float(ego.heading[k]))
        ahead, left, _ = frame.to_local(float(bv.x[k]), float(bv.y[k]), 0.0)
        heading = math.degrees(float(wrap(bv.heading[k] - ego.heading[k])))
        rows.append(
            Row(float(ego.time[k]) - start, ahead, left, heading, float(ego.speed[k]), float(bv.speed[k]), offset)
        )
    return tuple(rows)


def scene_of(
    bv: str, entry: LibraryEntry, attempts: Sequence[Attempt], found: FoundEncounter, library: Sequence[LibraryEntry]
) -> RepairScene:
    """What the modifier is told of the encounter."""
    situation = found.first
    aliases = Aliases.of(situation)
    scene = scene_words(situation, aliases, aliases.by_id.get(bv, "BV1"))
    choices: Mapping[str, tuple[LibraryEntry, ...]] = {
        alias: tuple(e for e in library if set(e.applies) & set(situation.targets[name].applies()))
        for alias, name in aliases.bvs.items()
    }
    text = f"{scene}\nEGO's driver: {driver_words(situation)}"
    return RepairScene(entry, text, tuple(attempts), aliases.by_id, choices, starts_words(found.situations))
