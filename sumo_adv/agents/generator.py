"""The generator: writes planners for a new intent, played by a language model or by the built-in expert."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pydantic import BaseModel, Field

from sumo_adv.agents.scene_text import Aliases, driver_words, scene_words
from sumo_adv.datatypes import Intent, LibraryEntry, Limits, Planner
from sumo_adv.errors import SandboxError
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.llm.prompts import Prompt, Prompts, danger_words, sanitize
from sumo_adv.planners.sessions import MOVEMENT
from sumo_adv.planners.text import HELPERS_TEXT, make_planner
from sumo_adv.search.intents import EXPERT, NEW_INTENTS
from sumo_adv.situation import Situation

MAX_EXAMPLE_PLANNERS = 2  # maximum number of planners of similar intents in the prompt
Trial = Callable[[Planner], str | None]  # runs a planner in the sandbox; returns its fault or None


class Written(BaseModel):  # sent to the model as a JSON schema, with its name and docstring
    """A planner as a model gives it."""

    mode: str = Field(default="direct", max_length=40)
    source: str = Field(min_length=1, max_length=40_000)


@dataclass(frozen=True, slots=True)
class ModelGenerator:
    """Asks a model for a planner.

    Attributes:
        metered: The language model.
        prompts: The prompts.
        limits: The limits of the adversary.
        trial: Runs a planner in the sandbox.
        tries: How often the sandbox's fault is sent back to the model, at most.
        instruction: The user's instruction for the trajectory (the paper's psi), or None.
        applies: The relations from which an intent begins that is written from its description alone.
    """

    metered: MeteredModel
    prompts: Prompts
    limits: Limits
    trial: Trial
    tries: int = 3
    instruction: str | None = None
    applies: Sequence[str] = ()

    def generate(self, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry]) -> tuple[Planner]:
        """Write one planner that runs in the sandbox.

        Args:
            intent: The intent.
            situation: The situation in which it is tried; None if it is written from its description alone.
            examples: Similar intents with planners, nearest first.

        Raises:
            ModelError: The model gave no usable planner.
            BudgetError: The run may ask no more.
        """
        prompt = generator_prompt(
            self.prompts, intent, situation, examples, self.limits, self.instruction, self.applies
        )

        def build(answer: Written) -> Planner:
            text, mode = without_fence(answer.source), mode_name(answer.mode)
            return make_planner(intent.label, mode, text, self.metered.model.name)

        def check(answer: Written) -> str | None:
            fault = planner_fault(lambda: build(answer), self.trial)
            if fault is None and self.instruction and "def trajectory(" not in answer.source:
                return "The planner lacks trajectory(bv, endpoint, road, dt), which the user asks for."
            return fault

        answer = ask(self.metered, "generator", prompt.system, prompt.user, Written, check=check, re_asks=self.tries)
        return (build(answer),)


def expert_planners(intent: Intent, examples: Sequence[LibraryEntry]) -> tuple[Planner, ...]:
    """Return the built-in expert's planners for one of ``NEW_INTENTS``.

    They are those of the nearest example that has a movement, adapted to the new intent.

    Args:
        intent: The intent.
        examples: Known intents with planners, nearest first.

    Returns:
        The planners; none for another intent, or if no example has a movement.
    """
    movement = next((m for _, (label, _, m) in NEW_INTENTS.items() if label == intent.label), None)
    for entry in examples if movement is not None else ():
        planners = [p for p in entry.planners if MOVEMENT.search(p.text) and 'MOVEMENT = "none"' not in p.text]
        if planners:
            line, name = f'MOVEMENT = "{movement}"', intent.label
            texts = [re.sub(r"\A# .*", f'# {name}, mode "{p.mode}"', MOVEMENT.sub(line, p.text)) for p in planners]
            return tuple(make_planner(name, p.mode, t, EXPERT, p.hash) for p, t in zip(planners, texts, strict=True))
    return ()


def generator_prompt(
    prompts: Prompts, intent: Intent, situation: Situation | None, examples: Sequence[LibraryEntry], limits: Limits,
    instruction: str | None, applies: Sequence[str] = (),
) -> Prompt:  # fmt: skip
    """Return the generator's prompt.

    Args:
        prompts: The prompts.
        intent: The intent.
        situation: The situation in which it is tried; None if it is written from its description alone.
        examples: Similar intents with planners, nearest first.
        limits: The limits of the adversary.
        instruction: The user's instruction for the trajectory (the paper's psi), or None.
        applies: The relations from which an intent begins that is written from its description alone.
    """
    driver = "not known."
    if situation is None:
        on_foot_or_bicycle = any(relation.startswith(("pedestrian", "cyclist")) for relation in applies)
        walkers = prompts.piece("walkers") if on_foot_or_bicycle else ""
        scene = prompts.piece("novel", walkers=walkers).strip()
        relation = " or ".join(applies).replace("_", " ") or "as the description says"
    else:
        aliases = Aliases.of(situation)
        alias = aliases.by_id.get(intent.bv, "BV1")
        relation = situation.targets[intent.bv].relation
        scene, driver = scene_words(situation, aliases, alias), driver_words(situation)
    shown = [e for e in examples if e.planners][:MAX_EXAMPLE_PLANNERS]
    texts = [f"--- {sanitize(e.label)}: {sanitize(e.description)}\n{e.planners[0].text}" for e in shown]
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
    """Return the rules for planners in a prompt: signature, units, limits and the sandbox's subset of Python.

    Args:
        prompts: The prompts.
        limits: The limits of the adversary.
    """
    numbers = {k: f"{getattr(limits, k):g}" for k in ("braking", "acceleration", "lateral", "curvature", "jerk")}
    return prompts.piece("planner", helpers=HELPERS_TEXT, **numbers)


def planner_fault(build: Callable[[], Planner], trial: Trial) -> str | None:
    """Return the fault of a planner as a sentence for its author; None if it is usable.

    Args:
        build: Makes the planner.
        trial: Runs a planner in the sandbox.
    """
    try:
        return trial(build())
    except SandboxError as error:
        return str(error)


def without_fence(text: str) -> str:
    """Return a planner's text without the fence that models tend to put around it.

    Args:
        text: The text of an answer.
    """
    fenced = re.search(r"```(?:python)?\s*\n(.*?)```", text, re.DOTALL)
    return (fenced.group(1) if fenced else text).strip() + "\n"


def mode_name(mode: str) -> str:
    """Return a mode's name as one word of lower-case letters, digits, _ and -.

    Args:
        mode: The name in an answer.
    """
    return re.sub(r"[^a-z0-9_-]+", "_", mode.strip().lower()).strip("_")[:40] or "direct"
