"""The generator played by a language model: from a new intent to a planner's text that the sandbox has tried."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from pydantic import BaseModel, Field

from sumo_adv.agents.expert_generator import MakePlanner
from sumo_adv.agents.prompts import Prompt, Prompts, tame
from sumo_adv.agents.scene_text import Names, relative_words, road_words
from sumo_adv.datatypes import Intent, LibraryEntry, Limits, Planner
from sumo_adv.errors import SandboxError
from sumo_adv.llm.asking import Line, ask
from sumo_adv.situation import Situation

MOST_EXAMPLES = 2  # planners of near behaviours that are shown
Trial = Callable[[Planner], str | None]  # a sentence on what is wrong with a planner, None if it may be used


class Written(BaseModel):
    """A planner as a model gives it."""

    mode: str = Field(default="direct", max_length=40)
    source: str = Field(min_length=1, max_length=40_000)


class ModelGenerator:
    """Asks a model for a planner, and again with the sandbox's words, at most ``tries`` times more.

    ``instruction``: the user's own for the trajectory (the paper's psi), or None.
    """

    def __init__(
        self,
        line: Line,
        prompts: Prompts,
        limits: Limits,
        helpers: str,
        make: MakePlanner,
        trial: Trial,
        *,
        tries: int = 3,
        instruction: str | None = None,
    ) -> None:
        self.name = line.model.name
        self._line, self._prompts, self._limits = line, prompts, limits
        self._helpers, self._make, self._trial = helpers, make, trial
        self._tries, self._instruction = tries, instruction

    def generate(self, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry]) -> tuple[Planner]:
        """A planner that the sandbox ran on its probe set. ``examples``: nearest first; without a situation the text
        is written from the description alone.

        Raises:
            ModelError, BudgetError: no usable planner could be had.
        """
        prompt = generator_prompt(
            self._prompts, intent, situation, examples, self._limits, self._helpers, self._instruction
        )

        def check(answer: Written) -> str | None:
            wrong = faults(self._build, answer.source, intent.label, answer.mode, self._trial)
            if wrong is None and self._instruction and "def trajectory(" not in answer.source:
                return "The planner lacks trajectory(bv, endpoint, road, dt), which the user asks for."
            return wrong

        found = ask(
            self._line, "generator", prompt.system, prompt.user, Written, check=check,
            re_asks=self._tries,
        )  # fmt: skip
        return (self._build(intent.label, found.mode, found.source),)

    def _build(self, label: str, mode: str, source: str) -> Planner:
        return self._make(label, mode_word(mode), bare(source), self.name, None)


def generator_prompt(
    prompts: Prompts,
    intent: Intent,
    situation: Situation | None,
    examples: Sequence[LibraryEntry],
    limits: Limits,
    helpers: str,
    instruction: str | None,
) -> Prompt:
    """What the generator is shown."""
    scene, relation = "None in particular: it is written for the library.", "as the description says"
    if situation is not None:
        names = Names.of(situation)
        alias = names.aliases.get(intent.bv, "BV1")
        relation = situation.targets[intent.bv].relation
        scene = f"The bv is {alias}.\n{road_words(situation, names)}\n{relative_words(situation, names, {})}"
    shown = [e for e in examples if e.planners][:MOST_EXAMPLES]
    psi = (
        f"\nTHE USER'S INSTRUCTION FOR THE TRAJECTORY (define `trajectory` so)\n{tame(instruction)}\n"
        if instruction
        else ""
    )
    return prompts.render(
        "generator", rules=rules(prompts, limits, helpers), label=tame(intent.label),
        description=tame(intent.description), relation=relation, scene=scene, instruction=psi,
        examples="\n\n".join(f"--- {tame(e.label)}: {tame(e.description)}\n{e.planners[0].source}" for e in shown),
    )  # fmt: skip


def rules(prompts: Prompts, limits: Limits, helpers: str) -> str:
    """The signature, the units and the subset, spelled out."""
    numbers = {k: f"{getattr(limits, k):g}" for k in ("braking", "acceleration", "lateral", "curvature", "jerk")}
    return prompts.piece("planner", helpers=helpers, **numbers)


def faults(build: Callable[[str, str, str], Planner], source: str, label: str, mode: str, trial: Trial) -> str | None:
    """What is wrong with a planner's text, as a sentence for its author; None if it may be used."""
    try:
        return trial(build(label, mode, source))
    except SandboxError as error:
        return str(error)


def bare(source: str) -> str:
    """A planner's text without the fence that models like to put around it."""
    found = re.search(r"```(?:python)?\s*\n(.*?)```", source, re.DOTALL)
    return (found.group(1) if found else source).strip() + "\n"


def mode_word(mode: str) -> str:
    """A mode's name as one word of letters, digits, _ and -."""
    return re.sub(r"[^a-z0-9_-]+", "_", mode.strip().lower()).strip("_")[:40] or "direct"
