"""Find the faults of a driver: pure functions of its unattacked drives.

The check looks for faults, not for style. Each threshold is far from the behaviour of a good but imperfect driver.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Limits, Track
from sumo_adv.driver_check.drive import UnattackedDrive
from sumo_adv.metrics.boxes import at_time, first_contact, on_grid, row_of
from sumo_adv.metrics.contact import contact_sides
from sumo_adv.metrics.gates import kinematic_gates

# Being this far outside the road or lane for longer than this is more than cutting a corner
MAX_OUTSIDE_DISTANCE_M = 0.3
MAX_OUTSIDE_DURATION_S = 0.5
# The extra time is compared with the standstill of SUMO's IDM in the same scenario
MAX_STANDSTILL_SPEED_M_S = 0.1
MAX_EXTRA_STANDSTILL_S = 10.0
MIN_PROGRESS_SHARE = 0.5  # share of the distance that SUMO's IDM covers in the same time
# From 12 m/s2 on, a pose is a jump, both when braking and accelerating (gate ``continuity``)
POSSIBLE_LIMITS = Limits(braking=8.0, acceleration=6.0)
FRONT_SHARE = (0.35, 0.65)  # share of the ego's length; a jump ahead by about half of it suggests the front bumper


class FindingKind(StrEnum):
    """What can be wrong with a driver."""

    FAILS = "fails"
    COLLIDES = "collides by itself"
    LEAVES_ROAD = "leaves the road"
    LEAVES_LANE = "leaves its lane"
    LINE = "does not wait"
    STANDS = "stands"
    SLOW = "slow"
    JUMPS = "jumps"
    TIME_BASE = "wrong time base"
    RESET = "reset forgets too little"
    RANDOM = "not repeatable"


FINDING_MEANINGS: Mapping[FindingKind, str] = {
    FindingKind.FAILS: "The driver, or SUMO because of it, ended the drive with an error; correct that first.",
    FindingKind.COLLIDES: "Nothing attacked it, so each of these collisions would be counted as found by the "
    "attack; check sizes (x, y is the centre of the box), which vehicles it is given, and its braking.",
    FindingKind.LEAVES_ROAD: "It does not follow its path; check the frame (headings in rad, counter-clockwise "
    "from +x), the reference point (the centre of the box), and the steering (rad, left positive). In a turn "
    "alone: it is too fast, or looks too far ahead and cuts the corner.",
    FindingKind.LEAVES_LANE: "Its centre is not on a lane that leads its way, so it drives against the traffic or "
    "across it; check the sign of its lateral offsets (left positive) and which lanes it is given.",
    FindingKind.LINE: "It passes a line at which it must wait for a light or the right of way; stop there while "
    "observation.road.must_wait is true (road.stop_lines says how far the line is), or answer LaneSpeed, which "
    "SUMO limits.",
    FindingKind.STANDS: "It stands where SUMO's driver drives on; check what it takes for an obstacle or for a "
    "stop line, and whether its speeds are in m/s.",
    FindingKind.SLOW: "It covers less than half of the way of SUMO's driver, and a slow ego meets other attacks; "
    "check its desired speed (m/s) and the speed limit that it is given.",
    FindingKind.JUMPS: "A Pose is where the ego's centre is after the step of dt seconds; return a pose that a "
    "car can reach from observation.ego in that time.",
    FindingKind.TIME_BASE: "It drives differently if only the clock is ahead, so it takes observation.time for the "
    "time since the start or since its plan began; subtract the time of that moment from it.",
    FindingKind.RESET: "After reset, the same object drives differently from a new one; forget plan, controller and "
    "last observation in reset, because each attempt is a run of its own.",
    FindingKind.RANDOM: "Two new drivers drive the same scenario differently, so no attack on it can be "
    "repeated; seed its random numbers in reset(seed), and let no wall clock or thread decide.",
}
"""The meaning of each kind of finding, and what to check."""


@dataclass(frozen=True, slots=True)
class DriverFinding:
    """One finding in one scenario.

    Attributes:
        kind: The kind of fault.
        time: The time at which the fault first shows [s].
        words: The fault in words.
    """

    kind: FindingKind
    time: float
    words: str


def find_faults(drive: UnattackedDrive, idm: UnattackedDrive) -> list[DriverFinding]:
    """Find the faults in one drive.

    Lines, lanes and the road are not judged after a collision, and neither is progress, because later faults may follow
    from it.

    Args:
        drive: The drive of the driver under test.
        idm: The drive of SUMO's IDM in the same scenario.
    """
    findings = [DriverFinding(FindingKind.FAILS, float(drive.ego.time[-1]), drive.failure)] if drive.failure else []
    contact, jump = _contact(drive), _jump(drive)
    end = float(drive.ego.time[-1]) if contact is None else contact.time
    findings += [finding for finding in (contact, jump) if finding is not None]
    findings += _outside(drive, len(drive.ego.between(float(drive.ego.time[0]), end).time))
    for line in drive.lines[:1]:
        if line.time <= end:
            at = "where it gives way" if line.signal in (None, "green") else f"of a light that is {line.signal}"
            findings.append(DriverFinding(FindingKind.LINE, line.time, f"it passes a line {at}"))
    if contact is None and not drive.failure:
        findings += _lags(drive.ego, idm.ego)
    return findings


def _contact(drive: UnattackedDrive) -> DriverFinding | None:
    ego = drive.ego
    if not drive.others or len(ego.time) < 2:
        return None
    when = first_contact(row_of(ego), on_grid(drive.others, ego.time), ego.time)
    first = int(np.argmin(when))
    if not np.isfinite(when[first]):
        return None
    time, foe = float(when[first]), drive.others[first]
    me, it = at_time(ego, time), at_time(foe, time)
    ego_side, foe_side = contact_sides(me, it)
    return DriverFinding(
        FindingKind.COLLIDES, time,
        f"its {ego_side} meets the {foe_side} of '{foe.id}' "
        f"(ego {float(me.speed):.1f} m/s, other {float(it.speed):.1f} m/s)",
    )  # fmt: skip


def _outside(drive: UnattackedDrive, steps: int) -> list[DriverFinding]:
    """Find whether the ego leaves the road or, if it does not, its lane within the first ``steps`` states."""
    time = drive.ego.time[:steps]
    if len(time) < 2:
        return []
    needed = round(MAX_OUTSIDE_DURATION_S / float(time[1] - time[0]))
    for kind, far in ((FindingKind.LEAVES_ROAD, drive.off_road.max(axis=1)), (FindingKind.LEAVES_LANE, drive.off_lane)):
        first, length = longest(far[:steps] > MAX_OUTSIDE_DISTANCE_M)
        if length > needed:
            then = far[first : min(first + length, steps)]
            most = float(then[np.isfinite(then)].max(initial=MAX_OUTSIDE_DISTANCE_M))
            subject = "a corner is" if kind is FindingKind.LEAVES_ROAD else "its centre is"
            return [DriverFinding(kind, float(time[first]), f"{subject} up to {most:.1f} m outside")]
    return []


def _lags(ego: Track, idm: Track) -> list[DriverFinding]:
    """Find whether the ego stands or, if it does not, is slow."""
    dt = float(ego.time[1] - ego.time[0]) if len(ego.time) > 1 else 1.0
    first, steps = longest(ego.speed < MAX_STANDSTILL_SPEED_M_S)
    stood, would = steps * dt, longest(idm.speed < MAX_STANDSTILL_SPEED_M_S)[1] * dt
    if stood > would + MAX_EXTRA_STANDSTILL_S:
        words = f"it stands for {stood:.0f} s, SUMO's idm for {would:.0f} s"
        return [DriverFinding(FindingKind.STANDS, float(ego.time[first]), words)]
    until = min(float(ego.time[-1]), float(idm.time[-1]))
    way, usual = (travelled(t.between(float(t.time[0]), until)) for t in (ego, idm))
    if way < MIN_PROGRESS_SHARE * usual:
        return [DriverFinding(FindingKind.SLOW, until, f"it has come {way:.0f} m, SUMO's idm {usual:.0f} m")]
    return []


def _jump(drive: UnattackedDrive) -> DriverFinding | None:
    """Find the first pose that a car cannot reach in its step."""
    if not drive.poses:
        return None
    dt = float(drive.ego.time[1] - drive.ego.time[0]) if len(drive.ego.time) > 1 else 0.1
    x, y, heading, speed = (
        np.array([[getattr(before, key), getattr(after, key)] for before, after in drive.poses])
        for key in ("x", "y", "heading", "speed")
    )
    steps = Boxes(x, y, heading, speed, drive.ego.length, drive.ego.width)
    broken = kinematic_gates(steps, np.zeros_like(x), np.array([0.0, dt]), POSSIBLE_LIMITS)["continuity"].any(axis=1)
    if not broken.any():
        return None
    k = int(np.argmax(broken))
    c, s = np.cos(heading[k, 0]), np.sin(heading[k, 0])
    dx, dy = x[k, 1] - x[k, 0], y[k, 1] - y[k, 0]
    ahead, left = float(dx * c + dy * s), float(dy * c - dx * s)
    words = f"a pose is {ahead:.1f} m ahead and {left:.1f} m to the left after {dt:g} s at {speed[k, 0]:.1f} m/s"
    beyond = (ahead - float(speed[k].mean()) * dt) / drive.ego.length
    if FRONT_SHARE[0] < beyond < FRONT_SHARE[1]:
        words += ", half its length too far: is that its front bumper?"
    when = drive.ego.time[int(np.argmin(np.hypot(drive.ego.x - x[k, 0], drive.ego.y - y[k, 0])))]
    return DriverFinding(FindingKind.JUMPS, float(when), words)


def first_separation(a: Track, b: Track, beyond: float) -> tuple[float, float]:
    """Compare two motions.

    If they do not separate while both last, but one ends earlier, they separate at its end with an infinite distance.

    Args:
        a: The first motion.
        b: The second motion.
        beyond: The distance from which they count as separated [m].

    Returns:
        The time at which they first separate [s], or inf if they never do; and their largest distance [m].
    """
    steps = min(len(a.time), len(b.time))
    far = np.hypot(a.x[:steps] - b.x[:steps], a.y[:steps] - b.y[:steps])
    over = np.flatnonzero(far > beyond)
    if len(over):
        return float(a.time[over[0]]), float(far.max())
    if len(a.time) != len(b.time):
        return float((a if len(a.time) > steps else b).time[steps]), np.inf
    return np.inf, float(far.max(initial=0.0))


def travelled(track: Track) -> float:
    """Return the length of a motion [m]."""
    return float(np.hypot(np.diff(track.x), np.diff(track.y)).sum())


def longest(flags: Bools) -> tuple[int, int]:
    """Find the longest run of true values.

    Returns:
        Its first index and its length; 0 and 0 if there is none.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    starts, lengths = edges[::2], edges[1::2] - edges[::2]
    if not len(starts):
        return 0, 0
    k = int(np.argmax(lengths))
    return int(starts[k]), int(lengths[k])


PLANNING_SHARE = 0.5  # an answer is a plan if it takes longer than this share of the 99th percentile


@dataclass(frozen=True, slots=True)
class AnswerTimes:
    """How long a driver's answers take.

    Many planners plan in some steps and follow their plan in the others, so the median says nothing about the time of a
    plan. An answer counts as a plan if it takes more than half of the time within which 99 % of the answers arrive.

    Attributes:
        count: The number of answers.
        mean: The mean time of all answers [ms].
        median: The median time of all answers [ms].
        p99: The time within which 99 % of the answers arrive [ms].
        plans: The number of plans.
        plan_mean: The mean time of the plans [ms].
    """

    count: int
    mean: float
    median: float
    p99: float
    plans: int
    plan_mean: float

    @property
    def words(self) -> str:
        """The times in words, on one line."""
        quantiles = f"median {self.median:.3g} ms, 99 % within {self.p99:.3g} ms"
        line = f"An answer takes {self.mean:.3g} ms on average ({quantiles})."
        if self.plans > PLANNING_SHARE * self.count:
            return line
        return f"{line} One in {self.count / self.plans:.3g} is a plan, which takes {self.plan_mean:.3g} ms on average."


def answer_times(drives: Sequence[UnattackedDrive]) -> AnswerTimes | None:
    """Summarize the times of all answers in some drives; None if there are no answers."""
    act = 1e3 * np.concatenate([np.zeros(0), *(drive.act for drive in drives)])
    if not len(act):
        return None
    p99 = float(np.quantile(act, 0.99))
    plans = act[act > PLANNING_SHARE * p99]
    plan_mean = float(plans.mean()) if len(plans) else float(act.mean())
    return AnswerTimes(len(act), float(act.mean()), float(np.median(act)), p99, max(len(plans), 1), plan_mean)
