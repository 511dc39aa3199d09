"""The modifier played by a language model: a planner's text and what its attempts showed give a changed text."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel, Field

from sumo_adv.agents.expert_generator import MakePlanner
from sumo_adv.agents.generator import Trial, bare, faults, rules
from sumo_adv.agents.prompts import Prompt, Prompts, tame
from sumo_adv.datatypes import Attempt, Diagnosis, Limits, Planner
from sumo_adv.llm.asking import Line, ask

MOST_TOLD = 4  # attempts of a planner that are told of: the best ones


class Changed(BaseModel):
    """A changed planner as a model gives it."""

    diagnosis: str = Field(default="", max_length=8000)
    source: str = Field(min_length=1, max_length=40_000)


class ModelModifier:
    """Asks a model for a changed planner, and again with the sandbox's words, at most ``tries`` times more."""

    def __init__(
        self,
        line: Line,
        prompts: Prompts,
        limits: Limits,
        helpers: str,
        make: MakePlanner,
        trial: Trial,
        *,
        ttc: float,
        tries: int = 2,
    ) -> None:
        self.name = line.model.name
        self._line, self._prompts, self._limits = line, prompts, limits
        self._helpers, self._make, self._trial = helpers, make, trial
        self._ttc, self._tries = ttc, tries

    def modify(self, planner: Planner, attempts: Sequence[Attempt], description: str = "") -> Planner | None:
        """A changed planner whose parent is the old one; None if none of the attempts is the planner's.

        Raises:
            ModelError, BudgetError: no usable planner could be had.
        """
        mine = [a for a in attempts if a.proposal.planner.hash == planner.hash]
        if not mine:
            return None
        prompt = modifier_prompt(self._prompts, planner, description, mine, self._limits, self._helpers, self._ttc)

        def build(label: str, mode: str, source: str) -> Planner:
            return self._make(label, mode, bare(source), self.name, planner.hash)

        def check(answer: Changed) -> str | None:
            if bare(answer.source) == planner.source:
                return "This is the old text; change it."
            return faults(build, answer.source, planner.label, planner.mode, self._trial)

        found = ask(
            self._line, "modifier", prompt.system, prompt.user, Changed, check=check,
            re_asks=self._tries,
        )  # fmt: skip
        return build(planner.label, planner.mode, found.source)


def modifier_prompt(
    prompts: Prompts,
    planner: Planner,
    description: str,
    attempts: Sequence[Attempt],
    limits: Limits,
    helpers: str,
    ttc: float,
) -> Prompt:
    """What the modifier is shown: the ``attempts`` are the planner's own."""
    told = sorted(attempts, key=lambda a: (a.verdict.min_ttc, a.verdict.min_distance))[:MOST_TOLD]
    return prompts.render(
        "modifier", rules=rules(prompts, limits, helpers), ttc=f"{ttc:g}", label=tame(planner.label),
        description=tame(description), mode=tame(planner.mode), source=planner.source,
        feedback="\n".join(feedback(a) for a in told),
    )  # fmt: skip


def feedback(attempt: Attempt) -> str:
    """What one attempt showed, in words."""
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
        lines.append(f"  {tame(attempt.message)}")
    return "\n".join(lines)


def diagnosis_words(d: Diagnosis) -> list[str]:
    """A diagnosis in sentences."""
    lines = [
        f"Nearest {d.time:.1f} s after its start: the bv's centre was {_place(d.ego_frame, 'the ego')}; seen from the"
        f" bv, the ego was {_place(d.bv_frame, 'it')}. Speeds then: ego {d.ego_speed:.1f}, bv {d.bv_speed:.1f} m/s.",
    ]
    if d.early is not None:
        who = "early" if d.early > 0 else "late"
        lines.append(f"The bv was {abs(d.early):.1f} s too {who} at the place where their paths come together.")
    did = "did not react" if d.ego_reaction is None else (
        f"began to brake {d.ego_reaction:.1f} s after its start, at most {d.ego_braking:.1f} m/s2"
    )  # fmt: skip
    lines.append(f"The ego {did}; it moved {d.ego_shift:.1f} m sideways.")
    lines.append(f"Limits that bound the bv: {', '.join(d.bound) or 'none'}.")
    return lines


def _place(frame: tuple[float, float], of: str) -> str:
    ahead, left = frame
    along = f"{abs(ahead):.1f} m {'ahead of' if ahead >= 0 else 'behind'}"
    return f"{along} and {abs(left):.1f} m to the {'left' if left >= 0 else 'right'} of {of}"
