"""What attempts showed, in words for the modifier: the level, what the next one needs, and how both vehicles moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sumo_adv.agents.prompts import sanitize
from sumo_adv.datatypes import Attempt, Diagnosis, Level, LibraryEntry, Verdict
from sumo_adv.metrics.levels import SERIOUS_RISK
from sumo_adv.metrics.reference.brakers import FULL_BRAKING
from sumo_adv.metrics.reference.cc_human import REACTION
from sumo_adv.metrics.severity import SERIOUS_DELTA_V

MAX_EARLIER = 10  # attempts of a line each
ENOUGH = 2.5  # s of warning, from which on a collision that braking does not avoid is not a matter of time
ENDINGS = {
    "contact": "it ended with the contact", "passed": "it ended because the two had passed each other",
    "time_limit": "it ended at its time limit", "ego_left": "it ended because EGO left the network or its recording",
    "planner_failed": "it ended because the planner failed", "ego_lost": "it ended because EGO was not driven any more",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """Both vehicles ``time`` s after the start: the bv's centre ahead and left of the ego [m] in the ego's frame, its
    heading against the ego's [deg], both speeds [m/s], the bv's offset from the way that it took [m, left positive]."""

    time: float
    ahead: float
    left: float
    heading: float
    ego_speed: float
    bv_speed: float
    offset: float


@dataclass(frozen=True, slots=True)
class AttemptReport:
    """An attempt with its motion every half second, its failed gates in words, when it began after the scene that the
    modifier is shown, how long it lasted [s], and the movement of the way that the bv took."""

    attempt: Attempt
    rows: tuple[Row, ...]
    gates: tuple[str, ...]
    begun: float
    lasted: float
    movement: str = "none"


@dataclass(frozen=True, slots=True)
class RepairScene:
    """What the modifier is told besides the attempts with a planner.

    entry: the planner's intent. scene: the adversary, the road, the states and the driver in words. earlier: all
    attempts of the encounter. by_id: the vehicles' aliases. choices: the intents of the library that each BV could try
    instead, by its alias. starts: in words, when attacks may begin.
    """

    entry: LibraryEntry
    scene: str
    earlier: tuple[Attempt, ...]
    by_id: Mapping[str, str]
    choices: Mapping[str, tuple[LibraryEntry, ...]]
    starts: str


def report_words(report: AttemptReport) -> str:
    """One attempt for the modifier."""
    attempt = report.attempt
    v, p = attempt.verdict, attempt.proposal
    numbers = ", ".join(f"{k} = {q:g}" for k, q in p.parameters.items()) or "no parameters"
    lines = [
        f"Attempt {attempt.index + 1} ({numbers}; it began at {report.begun:g} s and lasted "
        f"{report.lasted:.1f} s; {ENDINGS.get(attempt.ending, attempt.ending)}):",
        f"  Level {v.level}: {_came_to(v)}",
        *(f"  It is not the attack that was asked for: {sanitize(lack)}" for lack in v.misfits),
        *(f"  Not feasible, {gate}" for gate in report.gates),
        f"  What the next level needs: {'. '.join(filter(None, next_level(v, attempt.trigger_time)))}.",
    ]
    if attempt.diagnosis is not None:
        lines += [f"  {line}" for line in diagnosis_words(attempt.diagnosis)]
    if attempt.message:
        lines.append(f"  {sanitize(attempt.message)}")
    way = f'way it took (movement "{report.movement}")'
    lines.append(f"  t; bv ahead, left of EGO; heading; EGO's speed, bv's speed; bv's offset to the left of the {way}")
    lines += [
        f"  {r.time:.1f}; {r.ahead:.1f}, {r.left:.1f}; {r.heading:.0f}; {r.ego_speed:.1f}, {r.bv_speed:.1f}; "
        f"{r.offset:.1f}"
        for r in report.rows
    ]
    return "\n".join(lines)


def earlier_words(attempts: Sequence[Attempt], by_id: Mapping[str, str]) -> str:
    """The last ``MAX_EARLIER`` of some attempts, a line each: vehicle (``by_id``: its alias), planner, numbers, level,
    and what it lacked. The text of a planner has a short name of its own."""
    lines = []
    for attempt in attempts[-MAX_EARLIER:]:
        v, p = attempt.verdict, attempt.proposal
        gates = f"; not feasible ({', '.join(v.failed_gates)})" if v.failed_gates else ""
        numbers = ", ".join(f"{k} {q:.3g}" for k, q in p.parameters.items()) or "no parameters"
        planner = f"{sanitize(p.label)}/{sanitize(p.planner.mode)} (text {p.planner.hash[:4]}: {numbers})"
        lack = next_level(v, attempt.trigger_time)[0]
        lines.append(
            f"{attempt.index + 1}: {by_id.get(p.bv, 'a vehicle')}, {planner}: level {v.level}{gates}; needs {lack}."
        )
    return "\n".join(lines)


def _came_to(v: Verdict) -> str:
    if v.collided:
        side = "" if v.contact_side is None else f" at EGO's {v.contact_side}"
        hard = "" if v.delta_v is None else f", delta-v of EGO {v.delta_v:.1f} m/s"
        hard = hard if v.impact_speed is None else f", impact at {v.impact_speed:.1f} m/s"
        return f"they collided{side}{' (the bv ran into the back of EGO)' if v.rear_end else ''}{hard}."
    course = f"least time to collision {v.min_ttc:.2f} s" if v.min_ttc < 100 else "no collision course"
    return f"no contact; {course}, least distance of the boxes {v.min_distance:.1f} m."


def next_level(v: Verdict, start: float) -> tuple[str, str]:
    """What is missing to the next level, and the numbers behind that or nothing. ``start`` of the attempt [s]."""
    p = v.preventability
    if (gone := _before_a_judgement(v)) is not None:
        return gone, ""
    if p is None or v.contact_time is None:
        return "a collision that can be judged", ""
    alarm = p.alarms.get("cc_human")
    warning = None if alarm is None else v.contact_time - alarm
    if p.inconclusive == "no_hazard" or (warning is None and v.level < Level.VALID):
        return "a danger that shows before the contact", "Until then a careful driver saw none in what the bv did"
    if p.inconclusive is not None:
        return "a collision that also takes place if EGO keeps its recorded motion", ""
    if v.level >= Level.STRICT:
        return " and ".join(_to_serious(v)) or "nothing, it is the highest", ""
    return _more_warning(v, warning, alarm, start)


def _before_a_judgement(v: Verdict) -> str | None:
    """What an attempt lacks of a collision that counts, None if it lacks nothing."""
    if not v.feasible:
        return "a motion that is feasible"
    if v.rear_end:
        return "a contact in which the bv does not run into the back of EGO"
    if not v.collided:
        return "a contact"
    if v.ego_stationary:
        return "an EGO that moves in the last second before the contact"
    if v.ego_blocking:
        return "a contact in which EGO does not block a way that has priority over it"
    return None


def _to_serious(v: Verdict) -> list[str]:
    missing = []
    if v.impact_speed is not None and (v.injury_risk or 0.0) < SERIOUS_RISK:
        risk = f"a serious injury in {v.injury_risk:.0%} of cases, wanted {SERIOUS_RISK:.0%}"
        missing.append(f"a harder contact (impact at {v.impact_speed:.1f} m/s: {risk})")
    elif v.impact_speed is None and v.delta_v is not None and v.delta_v < SERIOUS_DELTA_V:
        missing.append(f"a harder contact (delta-v {v.delta_v:.1f}, wanted {SERIOUS_DELTA_V:.2f} m/s)")
    if v.humanlike is False:
        missing.append(f"gentler driving ({', '.join(v.beyond_human)} beyond what people do)")
    return missing


def _more_warning(v: Verdict, warning: float | None, alarm: float | None, start: float) -> tuple[str, str]:
    """For collisions that a careful driver cannot avoid: when the danger showed, and how much earlier it should."""
    by = v.preventability.by if v.preventability is not None else ()
    avoided = f"it is avoided by {', '.join(by)}" if by else "no reference driver avoids it"
    if warning is None or alarm is None:
        return "a danger that shows earlier", f"So far {avoided}"
    shown = f"It showed {alarm - start:.1f} s after the start, {warning:.1f} s before the contact; {avoided}."
    if warning >= ENOUGH:
        return "a contact that braking avoids", (
            f"{shown} That is early enough, but EGO is hit also where it stops: the bv "
            "must come into the way that EGO still has before it, not into EGO's own place"
        )
    return "a danger that shows earlier", (
        f"{shown} A careful driver that only brakes lets {REACTION:.2f} s pass, then brakes "
        f"with up to {FULL_BRAKING:.1f} m/s2; show it 1.5 to 2.5 s before the contact"
    )


def diagnosis_words(d: Diagnosis) -> list[str]:
    """A diagnosis as sentences."""
    lines = [
        f"Nearest {d.time:.1f} s after its start: the bv's centre was {_place(d.ego_frame, 'EGO')}; seen from the"
        f" bv, EGO was {_place(d.bv_frame, 'it')}. Speeds then: EGO {d.ego_speed:.1f}, bv {d.bv_speed:.1f} m/s.",
    ]
    if d.early is not None:
        when = "before" if d.early > 0 else "after"
        lines.append(f"At the place that both came through, the bv was {abs(d.early):.1f} s {when} EGO.")
    reaction = "did not react"
    if d.ego_reaction is not None:
        reaction = f"began to brake {d.ego_reaction:.1f} s after the start, at most {d.ego_braking:.1f} m/s2"
    lines.append(f"EGO {reaction}; it moved {d.ego_shift:.1f} m sideways.")
    if d.bound:
        lines.append(f"The bv drove at its limit of {', '.join(d.bound)}.")
    return lines


def _place(frame: tuple[float, float], of: str) -> str:
    ahead, left = frame
    along = f"{abs(ahead):.1f} m {'ahead of' if ahead >= 0 else 'behind'}"
    return f"{along} and {abs(left):.1f} m to the {'left' if left >= 0 else 'right'} of {of}"
