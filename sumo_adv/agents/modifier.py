"""The modifier: a language model changes how an intent is carried out, after attempts that did not reach the level.

It may give a planner other numbers, rewrite its text, name another intent that is better here, or stop. The built-in
expert has no modifier: the search itself tries other parameters, modes, vehicles and start times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from pydantic import BaseModel, Field

from sumo_adv.agents.choices import change_schema
from sumo_adv.agents.generator import Trial, planner_fault, planner_rules, without_fence
from sumo_adv.agents.ways import HowTo, library_words, way_fault
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Diagnosis, Level, LibraryEntry, Limits, Planner, Verdict
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.llm.prompts import Prompt, Prompts, danger_words, sanitize
from sumo_adv.metrics.levels import SERIOUS_RISK
from sumo_adv.metrics.reference.brakers import FULL_BRAKING_M_S2
from sumo_adv.metrics.reference.cc_human import HUMAN_REACTION_S
from sumo_adv.metrics.severity import SERIOUS_DELTA_V_M_S
from sumo_adv.planners.source import make_planner

# -- what attempts showed -------------------------------------------------------------------------------------------

MAX_EARLIER_ATTEMPTS = 10  # attempts of a line each
LONG_WARNING_S = 2.5  # of warning, from which on a collision that braking does not avoid is not a matter of time
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
    """The last ``MAX_EARLIER_ATTEMPTS`` of some attempts, a line each: vehicle (``by_id``: its alias), planner,
    numbers, level, and what it lacked. The text of a planner has a short name of its own."""
    lines = []
    for attempt in attempts[-MAX_EARLIER_ATTEMPTS:]:
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
    elif v.impact_speed is None and v.delta_v is not None and v.delta_v < SERIOUS_DELTA_V_M_S:
        missing.append(f"a harder contact (delta-v {v.delta_v:.1f}, wanted {SERIOUS_DELTA_V_M_S:.2f} m/s)")
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
    if warning >= LONG_WARNING_S:
        return "a contact that braking avoids", (
            f"{shown} That is early enough, but EGO is hit also where it stops: the bv "
            "must come into the way that EGO still has before it, not into EGO's own place"
        )
    return "a danger that shows earlier", (
        f"{shown} A careful driver that only brakes lets {HUMAN_REACTION_S:.2f} s pass, then brakes "
        f"with up to {FULL_BRAKING_M_S2:.1f} m/s2; show it 1.5 to 2.5 s before the contact"
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


# -- the modifier ---------------------------------------------------------------------------------------------------

MAX_SHOWN_ATTEMPTS = 3  # attempts of a planner in the prompt, the best ones
MAX_RE_ASKS = 2  # times that a fault is sent back


# The two classes below are sent to the model as a JSON schema, with their names and docstrings.


class Instead(HowTo):
    """Another intent of the library, for a BV, with the way to carry it out."""

    bv: str
    label: str = Field(min_length=1, max_length=80)


class Changed(BaseModel):
    """A change as a model gives it."""

    diagnosis: str = Field(default="", max_length=8000)
    action: Literal["numbers", "text", "another", "stop"] = "text"
    parameters: dict[str, float] = Field(default_factory=dict)
    source: str = Field(default="", max_length=40_000)
    begin: float | None = None
    instead: Instead | None = None


@dataclass(frozen=True, slots=True)
class Change:
    """What the modifier wants tried next: a planner with the numbers that differ from its defaults, or another intent.
    With neither it says that nothing can work here. ``begin``: the start [s] after the scene, None = as before.
    ``words``: what was decided, for reports."""

    words: str
    planner: Planner | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    begin: float | None = None
    instead: Instead | None = None


@dataclass(frozen=True, slots=True)
class ModelModifier:
    """Asks a model for a change. The fault of an answer is sent back at most ``MAX_RE_ASKS`` times."""

    metered: MeteredModel
    prompts: Prompts
    limits: Limits
    trial: Trial
    settings: Settings

    def modify(self, planner: Planner, reports: Sequence[AttemptReport], scene: RepairScene) -> Change:
        """The change after the attempts in ``reports``, which are the planner's own. A new text has the old planner's
        hash as ``parent``. Raises ModelError, BudgetError."""
        prompt = modifier_prompt(self.prompts, planner, reports, scene, self.limits, self.settings)

        def build(answer: Changed) -> Planner:
            source, author = without_fence(answer.source), self.metered.model.name
            return make_planner(planner.label, planner.mode, source, author, planner.hash)

        def check(answer: Changed) -> str | None:
            match answer.action:
                case "numbers":
                    return _numbers_fault(answer, planner, reports)
                case "another":
                    return _instead_fault(answer.instead, scene)
                case "text":
                    if without_fence(answer.source) == planner.source:
                        return "This is the old text; change it, or give other numbers."
                    return planner_fault(lambda: build(answer), self.trial)
                case _:
                    return None

        schema = change_schema(Changed, scene.choices)
        answer = ask(
            self.metered, "modifier", prompt.system, prompt.user, Changed,
            check=check, re_asks=MAX_RE_ASKS, schema=schema,
        )  # fmt: skip
        match answer.action:
            case "numbers":
                return Change(f"other numbers for '{planner.mode}'", planner, dict(answer.parameters), answer.begin)
            case "text":
                return Change(f"a new text for '{planner.mode}'", build(answer), begin=answer.begin)
            case "another":
                assert answer.instead is not None
                return Change(f"'{sanitize(answer.instead.label)}' instead", instead=answer.instead)
            case _:
                return Change("nothing can work here")


def _numbers_fault(answer: Changed, planner: Planner, reports: Sequence[AttemptReport]) -> str | None:
    parameters = {p.name: p for p in planner.parameters}
    for name, value in answer.parameters.items():
        if name not in parameters:
            return f"The planner has no parameter '{sanitize(name)}'; it has {', '.join(parameters) or 'none'}."
        if not parameters[name].low <= value <= parameters[name].high:
            return f"{name} = {value:g} is not within {parameters[name].low:g} and {parameters[name].high:g}."
    numbers = planner.defaults() | answer.parameters
    if answer.begin is None and any(dict(r.attempt.proposal.parameters) == numbers for r in reports):
        return "These numbers were tried; give others or another begin, or change the text."
    return None


def _instead_fault(instead: Instead | None, scene: RepairScene) -> str | None:
    if instead is None:
        return "The action 'another' needs 'instead'."
    if instead.bv not in scene.choices:
        return f"There is no vehicle '{sanitize(instead.bv)}'; there are {', '.join(scene.choices)}."
    entries = {e.label: e for e in scene.choices[instead.bv]}
    if instead.label not in entries:
        return f"'{sanitize(instead.label)}' does not apply to {instead.bv}; there are {', '.join(entries) or 'none'}."
    return way_fault(instead, entries[instead.label])


def modifier_prompt(
    prompts: Prompts, planner: Planner, reports: Sequence[AttemptReport], scene: RepairScene, limits: Limits,
    settings: Settings,
) -> Prompt:  # fmt: skip
    """The modifier's prompt. ``reports``: of the attempts with this planner, the best ones first."""
    others = [f"- {alias}: {', '.join(sanitize(e.label) for e in es) or 'none'}" for alias, es in scene.choices.items()]
    entries = {e.label: e for es in scene.choices.values() for e in es}
    others.append(library_words(list(entries.values()), set(entries)))
    shown = reports[:MAX_SHOWN_ATTEMPTS]
    return prompts.render(
        "modifier", rules=planner_rules(prompts, limits), until=str(settings.until), ttc=f"{settings.critical_ttc:g}",
        label=sanitize(scene.entry.label), description=sanitize(scene.entry.description), mode=sanitize(planner.mode),
        source=planner.source, scene=scene.scene, duration=f"{settings.duration:g}", starts=scene.starts,
        feedback="\n".join(report_words(r) for r in shown), earlier=_others_tried(shown, scene),
        others="\n".join(others), danger=danger_words(prompts),
    )  # fmt: skip


def _others_tried(shown: Sequence[AttemptReport], scene: RepairScene) -> str:
    """The attempts that are not told of in full, with their heading; empty without any."""
    shown_indices = {r.attempt.index for r in shown}
    words = earlier_words([a for a in scene.earlier if a.index not in shown_indices], scene.by_id)
    return (
        f"THE OTHER ATTEMPTS SO FAR (the last ones; number, vehicle, planner, what it came to)\n{words}\n\n"
        if words
        else ""
    )
