"""The modifier: a language model changes how an intent is carried out, after attempts that did not reach the level.

It may give a planner other parameter values, rewrite its text, name another intent that is better here, or stop. The
built-in expert has no modifier: the search itself tries other parameters, modes, vehicles and start times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from pydantic import BaseModel, Field

from sumo_adv.agents.choices import change_schema
from sumo_adv.agents.feedback import AttemptReport, earlier_words, report_words
from sumo_adv.agents.generator import Trial, planner_fault, planner_rules, without_fence
from sumo_adv.agents.ways import HowTo, library_words, way_fault
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, LibraryEntry, Limits, Planner
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.llm.prompts import Prompt, Prompts, danger_words, sanitize
from sumo_adv.planners.text import make_planner


@dataclass(frozen=True, slots=True)
class RepairScene:
    """What the modifier is told in addition to the attempts with a planner.

    Attributes:
        entry: The planner's intent.
        scene: The adversary, the road, the states and the driver, in words.
        earlier: All attempts of the encounter.
        by_id: The aliases of the vehicles, by id.
        choices: The intents of the library that each BV could try instead, by its alias.
        starts: When attacks may begin, in words.
    """

    entry: LibraryEntry
    scene: str
    earlier: tuple[Attempt, ...]
    by_id: Mapping[str, str]
    choices: Mapping[str, tuple[LibraryEntry, ...]]
    starts: str


# -- the modifier ---------------------------------------------------------------------------------------------------

MAX_SHOWN_ATTEMPTS = 3  # maximum number of a planner's attempts in the prompt, best first
MAX_RE_ASKS = 2  # how often a fault is sent back, at most


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
    """What the modifier wants tried next: a planner with new parameter values, or another intent.

    With neither, the modifier says that nothing can work here.

    Attributes:
        words: What was decided, for reports.
        planner: The planner; None if it is not to be tried.
        parameters: The parameter values that differ from the planner's defaults.
        begin: The start after the scene [s]; None keeps the start.
        instead: The other intent; None if there is none.
    """

    words: str
    planner: Planner | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    begin: float | None = None
    instead: Instead | None = None


@dataclass(frozen=True, slots=True)
class ModelModifier:
    """Asks a model for a change.

    The fault of an answer is sent back at most ``MAX_RE_ASKS`` times.

    Attributes:
        metered: The language model.
        prompts: The prompts.
        limits: The limits of the adversary.
        trial: Runs a planner in the sandbox.
        settings: The settings of the run.
    """

    metered: MeteredModel
    prompts: Prompts
    limits: Limits
    trial: Trial
    settings: Settings

    def modify(self, planner: Planner, reports: Sequence[AttemptReport], scene: RepairScene) -> Change:
        """Ask for a change after attempts with a planner.

        Args:
            planner: The planner.
            reports: Its attempts, best first.
            scene: What the modifier is told in addition.

        Returns:
            The change. A new text has the old planner's hash as ``parent``.

        Raises:
            ModelError: The model gave no usable answer.
            BudgetError: The run may ask no more.
        """
        prompt = modifier_prompt(self.prompts, planner, reports, scene, self.limits, self.settings)

        def build(answer: Changed) -> Planner:
            text, author = without_fence(answer.source), self.metered.model.name
            return make_planner(planner.label, planner.mode, text, author, planner.hash)

        def check(answer: Changed) -> str | None:
            match answer.action:
                case "numbers":
                    return _numbers_fault(answer, planner, reports)
                case "another":
                    return _instead_fault(answer.instead, scene)
                case "text":
                    if without_fence(answer.source) == planner.text:
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
    """Return the fault of new parameter values; None if they are usable."""
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
    """Return the fault of another intent; None if it is usable."""
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
    """Return the modifier's prompt.

    Args:
        prompts: The prompts.
        planner: The planner.
        reports: Its attempts, best first.
        scene: What the modifier is told in addition.
        limits: The limits of the adversary.
        settings: The settings of the run.
    """
    others = [f"- {alias}: {', '.join(sanitize(e.label) for e in es) or 'none'}" for alias, es in scene.choices.items()]
    entries = {e.label: e for es in scene.choices.values() for e in es}
    others.append(library_words(list(entries.values()), set(entries)))
    shown = reports[:MAX_SHOWN_ATTEMPTS]
    return prompts.render(
        "modifier", rules=planner_rules(prompts, limits), until=str(settings.until), ttc=f"{settings.critical_ttc:g}",
        label=sanitize(scene.entry.label), description=sanitize(scene.entry.description), mode=sanitize(planner.mode),
        source=planner.text, scene=scene.scene, duration=f"{settings.duration:g}", starts=scene.starts,
        feedback="\n".join(report_words(prompts, r) for r in shown), earlier=_others_tried(prompts, shown, scene),
        others="\n".join(others), danger=danger_words(prompts),
    )  # fmt: skip


def _others_tried(prompts: Prompts, shown: Sequence[AttemptReport], scene: RepairScene) -> str:
    """Describe the attempts that are not described in full, with a heading; empty without any."""
    shown_indices = {r.attempt.index for r in shown}
    others = [a for a in scene.earlier if a.index not in shown_indices]
    words = earlier_words(prompts, others, scene.by_id)
    return f"{prompts.phrase('feedback', 'earlier_heading')}\n{words}\n\n" if words else ""
