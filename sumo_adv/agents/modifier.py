"""The modifier: a language model changes a planner's text after attempts that were not critical.

The built-in expert has no modifier. The search itself tries other parameters, modes, vehicles and start times.
"""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel, Field

from sumo_adv.agents.generator import Trial, planner_fault, planner_rules, without_fence
from sumo_adv.agents.prompts import Prompt, Prompts, sanitize
from sumo_adv.datatypes import Attempt, Diagnosis, Limits, Planner
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.planners.source import make_planner

MAX_ATTEMPTS = 4  # attempts of a planner in the prompt, the best ones


class Changed(BaseModel):  # sent to the model as a JSON schema, with its name and docstring
    """A changed planner as a model gives it."""

    diagnosis: str = Field(default="", max_length=8000)
    source: str = Field(min_length=1, max_length=40_000)


class ModelModifier:
    """Asks a model for a changed planner. The sandbox's fault is sent back at most ``tries`` times.

    ttc: the criterion that the attempts missed [s].
    """

    def __init__(
        self,
        metered: MeteredModel,
        prompts: Prompts,
        limits: Limits,
        trial: Trial,
        *,
        ttc: float,
        tries: int = 2,
    ) -> None:
        self._metered, self._prompts, self._limits, self._trial = metered, prompts, limits, trial
        self._ttc, self._tries = ttc, tries

    def modify(self, planner: Planner, attempts: Sequence[Attempt], description: str = "") -> Planner | None:
        """A changed planner with the old planner's hash as ``parent``; None if no attempt used the planner.

        Raises ModelError, BudgetError.
        """
        own_attempts = [a for a in attempts if a.proposal.planner.hash == planner.hash]
        if not own_attempts:
            return None
        prompt = modifier_prompt(self._prompts, planner, description, own_attempts, self._limits, self._ttc)

        def build(answer: Changed) -> Planner:
            source, author = without_fence(answer.source), self._metered.model.name
            return make_planner(planner.label, planner.mode, source, author, planner.hash)

        def check(answer: Changed) -> str | None:
            if without_fence(answer.source) == planner.source:
                return "This is the old text; change it."
            return planner_fault(lambda: build(answer), self._trial)

        answer = ask(self._metered, "modifier", prompt.system, prompt.user, Changed, check=check, re_asks=self._tries)
        return build(answer)


def modifier_prompt(
    prompts: Prompts,
    planner: Planner,
    description: str,
    attempts: Sequence[Attempt],
    limits: Limits,
    ttc: float,
) -> Prompt:
    """The modifier's prompt. ``attempts``: those of this planner; ``ttc`` [s]: the criterion that they missed."""
    best = sorted(attempts, key=lambda a: (a.verdict.min_ttc, a.verdict.min_distance))[:MAX_ATTEMPTS]
    return prompts.render(
        "modifier", rules=planner_rules(prompts, limits), ttc=f"{ttc:g}", label=sanitize(planner.label),
        description=sanitize(description), mode=sanitize(planner.mode), source=planner.source,
        feedback="\n".join(feedback(a) for a in best),
    )  # fmt: skip


def feedback(attempt: Attempt) -> str:
    """The result of one attempt in words."""
    v, p = attempt.verdict, attempt.proposal
    numbers = ", ".join(f"{k} = {q:g}" for k, q in p.parameters.items())
    lines = [f"Attempt {attempt.index + 1} ({numbers or 'no parameters'}; began {p.delay:g} s after the trigger):"]
    if v.collided:
        how = "rear-end, which does not count" if v.rear_end else str(v.avoidable or "").replace("_", " ")
        lines.append(f"  They collided ({how}).")
    elif v.min_ttc < 100:
        when = f", {v.min_ttc_time - attempt.trigger_time:.1f} s after its start" if v.min_ttc_time is not None else ""
        lines.append(
            f"  Least time to collision {v.min_ttc:.2f} s{when}; least distance of the boxes {v.min_distance:.1f} m."
        )
    else:
        lines.append(f"  They were never on a collision course; least distance of the boxes {v.min_distance:.1f} m.")
    if attempt.diagnosis is not None:
        lines += [f"  {line}" for line in diagnosis_words(attempt.diagnosis)]
    if v.failed_gates:
        lines.append(f"  Not feasible: {', '.join(v.failed_gates)}.")
    if attempt.message:
        lines.append(f"  {sanitize(attempt.message)}")
    return "\n".join(lines)


def diagnosis_words(d: Diagnosis) -> list[str]:
    """A diagnosis as sentences."""
    lines = [
        f"Nearest {d.time:.1f} s after its start: the bv's centre was {_place(d.ego_frame, 'the ego')}; seen from the"
        f" bv, the ego was {_place(d.bv_frame, 'it')}. Speeds then: ego {d.ego_speed:.1f}, bv {d.bv_speed:.1f} m/s.",
    ]
    if d.early is not None:
        when = "early" if d.early > 0 else "late"
        lines.append(f"The bv was {abs(d.early):.1f} s too {when} at the place where their paths come together.")
    reaction = "did not react"
    if d.ego_reaction is not None:
        reaction = f"began to brake {d.ego_reaction:.1f} s after its start, at most {d.ego_braking:.1f} m/s2"
    lines.append(f"The ego {reaction}; it moved {d.ego_shift:.1f} m sideways.")
    lines.append(f"Limits that bound the bv: {', '.join(d.bound) or 'none'}.")
    return lines


def _place(frame: tuple[float, float], of: str) -> str:
    ahead, left = frame
    along = f"{abs(ahead):.1f} m {'ahead of' if ahead >= 0 else 'behind'}"
    return f"{along} and {abs(left):.1f} m to the {'left' if left >= 0 else 'right'} of {of}"
