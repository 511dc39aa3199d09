"""Describe what attempts showed, for the modifier. The sentences are in ``prompts/feedback.md``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from sumo_adv.datatypes import Attempt, Diagnosis, Level, Verdict
from sumo_adv.llm.prompts import Prompts, sanitize
from sumo_adv.metrics.levels import SERIOUS_RISK
from sumo_adv.metrics.reference.brakers import FULL_BRAKING_M_S2
from sumo_adv.metrics.reference.cc_human import HUMAN_REACTION_S
from sumo_adv.metrics.severity import SERIOUS_DELTA_V_M_S

MAX_EARLIER_ATTEMPTS = 10  # maximum number of attempts that get one line each
LONG_WARNING_S = 2.5  # with more warning, time is not the reason why braking does not avoid the collision
NO_COURSE_TTC_S = 100.0  # above this TTC there is no collision course

Say = Callable[..., str]
"""Returns a sentence by its name, with its variables: ``Prompts.phrase`` of the feedback."""


@dataclass(frozen=True, slots=True)
class Row:
    """Both vehicles at one time, in the ego's frame.

    Attributes:
        time: The time after the start [s].
        ahead: How far the BV's centre is ahead of the ego's [m].
        left: How far the BV's centre is to the left of the ego's [m].
        heading: The BV's heading relative to the ego's [deg].
        ego_speed: The ego's speed [m/s].
        bv_speed: The BV's speed [m/s].
        offset: The BV's offset from the way that it took, positive to the left [m].
    """

    time: float
    ahead: float
    left: float
    heading: float
    ego_speed: float
    bv_speed: float
    offset: float


@dataclass(frozen=True, slots=True)
class AttemptReport:
    """An attempt, as reported to the modifier.

    Attributes:
        attempt: The attempt.
        rows: Its motion every half second.
        gates: Its failed gates, in words.
        begun: How long after the scene that the modifier is shown the attempt began [s].
        lasted: How long the attempt lasted [s].
        movement: The movement of the way that the BV took.
    """

    attempt: Attempt
    rows: tuple[Row, ...]
    gates: tuple[str, ...]
    begun: float
    lasted: float
    movement: str = "none"


def report_words(prompts: Prompts, report: AttemptReport) -> str:
    """Describe one attempt for the modifier.

    Args:
        prompts: The prompts.
        report: The attempt.
    """
    say = partial(prompts.phrase, "feedback")
    attempt = report.attempt
    v, p = attempt.verdict, attempt.proposal
    numbers = ", ".join(f"{k} = {q:g}" for k, q in p.parameters.items()) or say("no_parameters")
    ending = f"ending_{attempt.ending}"
    details = [
        say("level", level=str(v.level), result=_came_to(say, v)),
        *(say("misfit", lack=sanitize(lack)) for lack in v.misfits),
        *(say("infeasible", gate=gate) for gate in report.gates),
        say("needs", needs=". ".join(filter(None, _next_level(say, v, attempt.trigger_time)))),
        *([] if attempt.diagnosis is None else _diagnosis_words(say, attempt.diagnosis)),
        *([sanitize(attempt.message)] if attempt.message else []),
        say("table", movement=report.movement),
        *(
            say(
                "row", time=f"{r.time:.1f}", ahead=f"{r.ahead:.1f}", left=f"{r.left:.1f}", heading=f"{r.heading:.0f}",
                ego_speed=f"{r.ego_speed:.1f}", bv_speed=f"{r.bv_speed:.1f}", offset=f"{r.offset:.1f}",
            )
            for r in report.rows
        ),
    ]  # fmt: skip
    head = say(
        "attempt", number=str(attempt.index + 1), numbers=numbers, begun=f"{report.begun:g}",
        lasted=f"{report.lasted:.1f}",
        ending=say(ending) if ending in prompts.phrases("feedback") else attempt.ending,
    )  # fmt: skip
    return "\n  ".join([head, *details])


def earlier_words(prompts: Prompts, attempts: Sequence[Attempt], by_id: Mapping[str, str]) -> str:
    """Describe the last ``MAX_EARLIER_ATTEMPTS`` of some attempts, one line each.

    A line holds the vehicle, the planner, its parameter values, the level, and what the attempt lacked. The text of a
    planner has a short name of its own.

    Args:
        prompts: The prompts.
        attempts: The attempts.
        by_id: The aliases of the vehicles, by id.
    """
    say = partial(prompts.phrase, "feedback")
    lines = []
    for attempt in attempts[-MAX_EARLIER_ATTEMPTS:]:
        v, p = attempt.verdict, attempt.proposal
        numbers = ", ".join(f"{k} {q:.3g}" for k, q in p.parameters.items()) or say("no_parameters")
        lines.append(
            say(
                "earlier", number=str(attempt.index + 1), vehicle=by_id.get(p.bv, say("some_vehicle")),
                label=sanitize(p.label), mode=sanitize(p.planner.mode), text=p.planner.hash[:4], numbers=numbers,
                level=str(v.level), lack=_next_level(say, v, attempt.trigger_time)[0],
                gates=say("earlier_infeasible", gates=", ".join(v.failed_gates)) if v.failed_gates else "",
            )
        )  # fmt: skip
    return "\n".join(lines)


def _came_to(say: Say, v: Verdict) -> str:
    """Say whether and how the two vehicles touched."""
    if v.collided:
        severity = "" if v.delta_v is None else say("delta_v", delta_v=f"{v.delta_v:.1f}")
        return say(
            "collided", side="" if v.contact_side is None else say("at_side", side=v.contact_side),
            rear_end=say("into_the_back") if v.rear_end else "",
            severity=severity if v.impact_speed is None else say("impact", speed=f"{v.impact_speed:.1f}"),
        )  # fmt: skip
    course = say("course", ttc=f"{v.min_ttc:.2f}") if v.min_ttc < NO_COURSE_TTC_S else say("no_course")
    return say("no_contact", course=course, distance=f"{v.min_distance:.1f}")


def _next_level(say: Say, v: Verdict, start: float) -> tuple[str, str]:
    """Say what is missing to the next level, and the numbers behind that, if any; ``start`` is the attempt's [s]."""
    p = v.preventability
    if gone := _before_a_judgement(v):
        return say(gone), ""
    if p is None or v.contact_time is None:
        return say("lacks_judgement"), ""
    alarm = p.alarms.get("cc_human")
    warning = None if alarm is None else v.contact_time - alarm
    if p.inconclusive == "no_hazard" or (warning is None and v.level < Level.VALID):
        return say("lacks_danger"), say("no_danger_seen")
    if p.inconclusive is not None:
        return say("lacks_influence"), ""
    if v.level >= Level.STRICT:
        return " and ".join(_to_serious(say, v)) or say("nothing"), ""
    return _more_warning(say, v, warning, alarm, start)


def _before_a_judgement(v: Verdict) -> str:
    """Name what an attempt lacks of a collision that counts; empty if it lacks nothing."""
    if not v.feasible:
        return "lacks_feasibility"
    if v.rear_end:
        return "lacks_front"
    if not v.collided:
        return "lacks_contact"
    if v.ego_stationary:
        return "lacks_moving_ego"
    return "lacks_priority" if v.ego_blocking else ""


def _to_serious(say: Say, v: Verdict) -> list[str]:
    """Say what a strict collision lacks of a serious one."""
    missing = []
    if v.impact_speed is not None and (v.injury_risk or 0.0) < SERIOUS_RISK:
        risk, wanted = f"{v.injury_risk:.0%}", f"{SERIOUS_RISK:.0%}"
        missing.append(say("lacks_injury", speed=f"{v.impact_speed:.1f}", risk=risk, wanted=wanted))
    elif v.impact_speed is None and v.delta_v is not None and v.delta_v < SERIOUS_DELTA_V_M_S:
        missing.append(say("lacks_delta_v", delta_v=f"{v.delta_v:.1f}", wanted=f"{SERIOUS_DELTA_V_M_S:.2f}"))
    if v.humanlike is False:
        missing.append(say("lacks_gentleness", signals=", ".join(v.beyond_human)))
    return missing


def _more_warning(say: Say, v: Verdict, warning: float | None, alarm: float | None, start: float) -> tuple[str, str]:
    """Say when the danger showed and how much earlier it should, for collisions that a careful driver cannot avoid."""
    by = v.preventability.by if v.preventability is not None else ()
    avoided = say("avoided", drivers=", ".join(by)) if by else say("unavoided")
    if warning is None or alarm is None:
        return say("lacks_warning"), say("so_far", avoided=avoided)
    shown = say("shown", after=f"{alarm - start:.1f}", warning=f"{warning:.1f}", avoided=avoided)
    if warning >= LONG_WARNING_S:
        return say("lacks_braking"), say("early_enough", shown=shown)
    times = {"reaction": f"{HUMAN_REACTION_S:.2f}", "braking": f"{FULL_BRAKING_M_S2:.1f}"}
    return say("lacks_warning"), say("show_earlier", shown=shown, **times)


def _diagnosis_words(say: Say, d: Diagnosis) -> list[str]:
    """Say a diagnosis in sentences."""
    lines = [
        say(
            "nearest", time=f"{d.time:.1f}", bv_place=_place(say, "place_ego", d.ego_frame),
            ego_place=_place(say, "place_bv", d.bv_frame), ego_speed=f"{d.ego_speed:.1f}", bv_speed=f"{d.bv_speed:.1f}",
        )
    ]  # fmt: skip
    if d.early is not None:
        lines.append(say("same_place", early=f"{abs(d.early):.1f}", when="before" if d.early > 0 else "after"))
    reaction = say("no_reaction")
    if d.ego_reaction is not None:
        reaction = say("braked", after=f"{d.ego_reaction:.1f}", braking=f"{d.ego_braking:.1f}")
    lines.append(say("reaction", reaction=reaction, shift=f"{d.ego_shift:.1f}"))
    if d.bound:
        lines.append(say("limits", limits=", ".join(d.bound)))
    return lines


def _place(say: Say, name: str, frame: tuple[float, float]) -> str:
    """Say where a vehicle is in a frame: ahead and left [m]."""
    ahead, left = frame
    return say(
        name, along=f"{abs(ahead):.1f}", ahead=say("ahead" if ahead >= 0 else "behind"), across=f"{abs(left):.1f}",
        side="left" if left >= 0 else "right",
    )  # fmt: skip
