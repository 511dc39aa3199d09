"""The generator: writes planners for a new intent, played by a language model or by the built-in expert."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from pydantic import BaseModel, Field

from sumo_adv.agents.danger import danger_words
from sumo_adv.agents.prompts import Prompt, Prompts, sanitize
from sumo_adv.agents.scene_text import Aliases, driver_words, scene_words
from sumo_adv.datatypes import Intent, LibraryEntry, Limits, Planner
from sumo_adv.errors import SandboxError
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.planners.source import HELPERS_TEXT, make_planner
from sumo_adv.search.composed_intents import NAME, NEW_INTENTS
from sumo_adv.situation import Situation

MAX_EXAMPLES = 2  # planners of similar intents in the prompt
Trial = Callable[[Planner], str | None]  # runs a planner in the sandbox; returns its fault, None for a usable planner


class Written(BaseModel):  # sent to the model as a JSON schema, with its name and docstring
    """A planner as a model gives it."""

    mode: str = Field(default="direct", max_length=40)
    source: str = Field(min_length=1, max_length=40_000)


class ModelGenerator:
    """Asks a model for a planner. The sandbox's fault is sent back at most ``tries`` times.

    instruction: the user's instruction for the trajectory (the paper's psi), or None.
    """

    def __init__(
        self,
        metered: MeteredModel,
        prompts: Prompts,
        limits: Limits,
        trial: Trial,
        *,
        tries: int = 3,
        instruction: str | None = None,
    ) -> None:
        self._metered, self._prompts, self._limits, self._trial = metered, prompts, limits, trial
        self._tries, self._instruction = tries, instruction

    def generate(self, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry]) -> tuple[Planner]:
        """One planner that ran in the sandbox. Raises ModelError, BudgetError.

        situation: None for an intent that is written from its description alone.
        examples: entries of similar intents, nearest first.
        """
        prompt = generator_prompt(self._prompts, intent, situation, examples, self._limits, self._instruction)

        def build(answer: Written) -> Planner:
            source, mode = without_fence(answer.source), mode_name(answer.mode)
            return make_planner(intent.label, mode, source, self._metered.model.name)

        def check(answer: Written) -> str | None:
            fault = planner_fault(lambda: build(answer), self._trial)
            if fault is None and self._instruction and "def trajectory(" not in answer.source:
                return "The planner lacks trajectory(bv, endpoint, road, dt), which the user asks for."
            return fault

        answer = ask(self._metered, "generator", prompt.system, prompt.user, Written, check=check, re_asks=self._tries)
        return (build(answer),)


class ExpertGenerator:
    """The built-in expert: adapts the planners of the nearest intent to a movement that the library lacks."""

    def generate(
        self, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry]
    ) -> tuple[Planner, ...]:
        """Planners for one of ``NEW_INTENTS``, one per mode of the nearest example that has a movement.

        Empty for another intent, or if no example has a movement.
        """
        movement = next((m for _, (label, _, m) in NEW_INTENTS.items() if label == intent.label), None)
        pattern = re.compile(r'^MOVEMENT = "\w+"$', re.MULTILINE)
        for entry in examples if movement is not None else ():
            planners = [p for p in entry.planners if pattern.search(p.source) and 'MOVEMENT = "none"' not in p.source]
            if planners:
                line = f'MOVEMENT = "{movement}"'
                return tuple(_adapted(intent.label, p, pattern.sub(line, p.source)) for p in planners)
        return ()


def generator_prompt(
    prompts: Prompts,
    intent: Intent,
    situation: Situation | None,
    examples: Sequence[LibraryEntry],
    limits: Limits,
    instruction: str | None,
) -> Prompt:
    """The generator's prompt; the arguments are those of ``ModelGenerator``."""
    scene, relation = "None in particular: it is written for the library.", "as the description says"
    driver = "not known."
    if situation is not None:
        aliases = Aliases.of(situation)
        alias = aliases.by_id.get(intent.bv, "BV1")
        relation = situation.targets[intent.bv].relation
        scene, driver = scene_words(situation, aliases, alias), driver_words(situation)
    shown = [e for e in examples if e.planners][:MAX_EXAMPLES]
    texts = [f"--- {sanitize(e.label)}: {sanitize(e.description)}\n{e.planners[0].source}" for e in shown]
    psi = (
        f"\nTHE USER'S INSTRUCTION FOR THE TRAJECTORY (define `trajectory` so)\n{sanitize(instruction)}\n"
        if instruction
        else ""
    )
    return prompts.render(
        "generator", rules=planner_rules(prompts, limits), label=sanitize(intent.label),
        description=sanitize(intent.description), relation=relation, scene=scene, driver=driver, instruction=psi,
        examples="\n\n".join(texts), danger=danger_words(prompts),
    )  # fmt: skip


def planner_rules(prompts: Prompts, limits: Limits) -> str:
    """The rules for planners in a prompt: signature, units, limits and the sandbox's subset of Python."""
    numbers = {k: f"{getattr(limits, k):g}" for k in ("braking", "acceleration", "lateral", "curvature", "jerk")}
    return prompts.piece("planner", helpers=HELPERS_TEXT, **numbers)


def planner_fault(build: Callable[[], Planner], trial: Trial) -> str | None:
    """The fault of a planner as a sentence for its author, None for a usable planner."""
    try:
        return trial(build())
    except SandboxError as error:
        return str(error)


def without_fence(source: str) -> str:
    """A planner's text without the fence that models tend to put around it."""
    fenced = re.search(r"```(?:python)?\s*\n(.*?)```", source, re.DOTALL)
    return (fenced.group(1) if fenced else source).strip() + "\n"


def mode_name(mode: str) -> str:
    """A mode's name as one word of lower-case letters, digits, _ and -."""
    return re.sub(r"[^a-z0-9_-]+", "_", mode.strip().lower()).strip("_")[:40] or "direct"


def _adapted(label: str, planner: Planner, source: str) -> Planner:
    source = re.sub(r"\A# .*", f'# {label}, mode "{planner.mode}"', source)
    return make_planner(label, planner.mode, source, NAME, planner.hash)
