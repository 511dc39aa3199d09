"""One run: traffic, the ego for some time, errors of the drivers near it, and the verdict on a contact."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Ints, Level, Limits, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.verdict import own_reference
from sumo_adv.metrics.boxes import first_contact
from sumo_adv.metrics.case import make_case
from sumo_adv.metrics.verdict import judge_attempt
from sumo_adv.rate.proposal import (
    DANGER_LEVEL_COUNT,
    DECISION_INTERVAL_S,
    ERRING_DISTANCE_M,
    ERROR_KINDS,
    Counts,
    Decisions,
    ErrorProposal,
    danger_levels,
)
from sumo_adv.simulation.human_errors import HumanErrors
from sumo_adv.simulation.sumo_states import RawState, heading_of

SECONDS_PER_HOUR = 3600.0
DRIVEN_AFTER_CONTACT_S = 4.0  # after a contact, to show what the other vehicle would have done
JUDGED_BEFORE_CONTACT_S = 4.0  # the judged time before a contact if the other vehicle made no error
MAX_ERROR_AGE_S = 10.0  # before a contact; earlier errors have nothing to do with it
JUDGED_HISTORY_S = 2.0  # before the judged time, as history
UNLIMITED = Limits(*[1e9] * 5)  # the limits of an adversary do not apply to normal traffic
BOX_FIELDS = ("x", "y", "heading", "speed", "length", "width")
CLEAR_DISTANCE_M = 0.2  # margin between two boxes, in addition to their motion in a step


@dataclass(frozen=True, slots=True)
class RateRecord:
    """The record of one run.

    Attributes:
        seed: The seed of the run.
        hours: How long the ego drove [h].
        km: How far the ego drove [km].
        weighted_hours: The time of each step times the run's weight at that step, summed [h].
        weighted_km: The distance of each step times the run's weight at that step, summed [km].
        weight: The run's weight at the contact or the end.
        contact: Whether the ego touched a vehicle.
        level: The level of the contact, as ``metrics/levels.py`` names it.
        error: The recent error of the other vehicle's driver; None if there is none.
    """

    seed: int
    hours: float
    km: float
    weighted_hours: float
    weighted_km: float
    weight: float
    contact: bool = False
    level: str = "none"
    error: str | None = None


@dataclass
class RateRun:
    """One run on a drive that was just loaded.

    Attributes:
        drive: The drive.
        chances: The model's probability of each error in one decision, ``(kinds,)``.
        proposal: The raised proposal; None draws from the model.
        seed: The seed of the errors.
        pilot: Whether the run counts the results of errors.
        errors: Makes drivers err.
        decisions: Draws the errors.
        counts: The counts of a pilot run.
    """

    drive: Drive
    chances: Floats
    proposal: ErrorProposal | None
    seed: int
    pilot: bool = False

    def __post_init__(self) -> None:
        self.errors = HumanErrors(self.drive.simulation)
        self.decisions = Decisions(np.random.default_rng([self.seed, 1]), self.proposal, pilot=self.pilot)
        self.counts = Counts(*np.zeros((3, len(ERROR_KINDS), DANGER_LEVEL_COUNT)))
        self._begun: dict[str, tuple[int, int]] = {}  # kind and level of danger of each driver's latest error
        self._hours = self._km = self._weighted_hours = self._weighted_km = 0.0

    def until(self, ego: str | None, start: float, end: float, duration: float) -> RateRecord:
        """Drive until the ego has driven for a time, has left, or touches a vehicle.

        Args:
            ego: The id of the ego; None takes the first vehicle that is inserted after ``start``.
            start: The time after which an ego is chosen [s].
            end: The latest end of the run [s].
            duration: The time that the ego drives [s].

        Raises:
            SimulationError: SUMO fails.
        """
        drive, dt = self.drive, self.drive.recording.step_length
        every, left = round(DECISION_INTERVAL_S / dt), round(duration / dt)
        while drive.now < end - 1e-6 and left > 0:
            if drive.ego is not None and left % every == 0:
                self._decide()
            self.errors.before_step()
            there = drive.snapshot.raw if drive.recording.snapshots else {}
            snapshot = drive.tick()
            if drive.ego is None:
                came = snapshot.raw.keys() - there.keys() - drive.obstacles
                new = [n for n in snapshot.raw if n in came] if ego is None and drive.now > start else []
                if ego in snapshot.raw or new:
                    drive.take_over(new[0] if ego is None else ego)
                continue
            name = drive.ego
            if name not in snapshot.raw:
                break
            left -= 1
            weight, km = self.decisions.weight, snapshot.raw[name][3] * dt / 1000.0
            self._hours += dt / SECONDS_PER_HOUR
            self._km += km
            self._weighted_hours += weight * dt / SECONDS_PER_HOUR
            self._weighted_km += weight * km
            touched = self._touched()
            if touched is not None:
                return self._judged(*touched)
        return self._record()

    def _record(self) -> RateRecord:
        """Return the record so far."""
        weighted = self._weighted_hours, self._weighted_km
        return RateRecord(self.seed, self._hours, self._km, *weighted, self.decisions.weight)

    # -- errors -------------------------------------------------------------------------------------------------

    def _decide(self) -> None:
        """Draw and begin the errors of the drivers near the ego."""
        drive = self.drive
        assert drive.ego is not None
        ego = drive.state(drive.ego)
        names = [
            n for n in drive.near(ego, ERRING_DISTANCE_M) if n not in self.errors.active and n not in drive.obstacles
        ]
        model = np.zeros((len(names), len(ERROR_KINDS)))
        for row, name in enumerate(names):
            for kind in self.errors.possible(name, drive.snapshot.raw[name]):
                k = ERROR_KINDS.index(kind)
                model[row, k] = self.chances[k]
        if not model.any():
            return
        levels: Ints | None = None
        if self.decisions.raising:
            x, y, heading, speed = (np.array(getattr(ego, key)) for key in BOX_FIELDS[:4])
            box = Boxes(x, y, heading, speed, ego.length, ego.width, ego.z)
            levels = danger_levels(box, boxes_of([drive.state(name) for name in names]))
        kinds = self.decisions.next(model, levels)
        for row, (name, kind) in enumerate(zip(names, kinds, strict=True)):
            if kind >= 0:
                self.errors.begin(name, ERROR_KINDS[kind], drive.snapshot.raw[name][3])
                if self.pilot and levels is not None:
                    self._begun[name] = (int(kind), int(levels[row, kind]))
                    self.counts.starts[self._begun[name]] += 1.0
        if self.pilot and levels is not None:
            rows, columns = np.nonzero(model)
            np.add.at(self.counts.chances, (columns, levels[rows, columns]), 1.0)

    # -- contacts -----------------------------------------------------------------------------------------------

    def _touched(self) -> tuple[str, float] | None:
        """Return the first vehicle that the ego touched in the last step, and when [s]."""
        drive, dt = self.drive, self.drive.recording.step_length
        ego = drive.ego
        assert ego is not None
        current, before = drive.snapshot, drive.recording.snapshots[-2]
        if ego not in before.raw:
            return None
        me, sizes = current.raw[ego], drive.simulation.fleet.sizes
        times = np.array([before.time, current.time])
        contacts: list[tuple[float, str]] = []
        for name, raw in current.raw.items():
            if name == ego or name not in before.raw or _clear(me, raw, sizes[ego], sizes[name], dt):
                continue
            when = float(first_contact(_rows(drive, ego), _rows(drive, name), times))
            if math.isfinite(when):
                contacts.append((when, name))
        return (min(contacts)[1], min(contacts)[0]) if contacts else None

    def _judged(self, foe: str, when: float) -> RateRecord:
        """Drive on for a while, judge the contact, and return the record."""
        record, drive = self._record(), self.drive
        error = self.errors.last.get(foe)
        recent = error is not None and when - error.since < MAX_ERROR_AGE_S
        start = error.since if error is not None and recent else when - JUDGED_BEFORE_CONTACT_S
        ego = drive.ego
        assert ego is not None
        for _ in range(round(DRIVEN_AFTER_CONTACT_S / drive.recording.step_length)):
            self.errors.before_step()
            drive.tick()
        snapshots = drive.recording.snapshots
        first = next(k for k, s in enumerate(snapshots) if ego in s.raw and s.time >= start - JUDGED_HISTORY_S - 1e-6)
        case = make_case(drive.tracks(foe, start=first), ego, [foe], start, {})
        level = Level.NONE
        if case is not None:
            level = judge_attempt(case, limits=UNLIMITED, driver=own_reference(drive)).level
        if level >= Level.COLLISION and recent and foe in self._begun:
            self.counts.crashes[self._begun[foe]] += 1.0
        return replace(
            record, contact=True, level=str(level), error=str(error.kind) if error is not None and recent else None
        )  # fmt: skip


def boxes_of(states: Sequence[VehicleState]) -> Boxes:
    """Return the boxes of vehicles, ``(vehicles,)``.

    Args:
        states: The states of the vehicles.
    """
    z = np.array([s.z for s in states])
    boxes = Boxes(*(np.array([getattr(s, name) for s in states]) for name in BOX_FIELDS))
    return replace(boxes, z=z) if z.any() else boxes


def _rows(drive: Drive, vehicle: str) -> Boxes:
    """Return a vehicle's last two states, ``(2,)``."""
    return boxes_of([drive.simulation.state(snapshot, vehicle) for snapshot in drive.recording.snapshots[-2:]])


def _clear(a: RawState, b: RawState, size_a: tuple[float, float], size_b: tuple[float, float], dt: float) -> bool:
    """Return whether an axis of ``a`` separates the boxes by more than they can have approached in a step.

    SUMO's states are used: positions are those of the front bumpers, angles are in degrees clockwise from north.
    """
    heading, turn = heading_of(a[2]), math.radians(a[2] - b[2])
    c, s, ct, st = math.cos(heading), math.sin(heading), math.cos(turn), math.sin(turn)
    dx, dy = b[0] - a[0], b[1] - a[1]
    along = abs(c * dx + s * dy + (size_a[0] - size_b[0] * ct) / 2)
    across = abs(c * dy - s * dx - size_b[0] * st / 2)
    return (
        along - (size_a[0] + size_b[0] * abs(ct) + size_b[1] * abs(st)) / 2
        > abs(b[3] * ct - a[3]) * dt + CLEAR_DISTANCE_M
        or across - (size_a[1] + size_b[0] * abs(st) + size_b[1] * abs(ct)) / 2 > abs(b[3] * st) * dt + CLEAR_DISTANCE_M
    )
