"""The analyzer played by a language model: the paper's g, with the predictor's evidence in its prompt.

Asked ``samples`` times, its answers give a distribution over intents; the order is by expected risk, and where the
entropy is high the first intents are tried side by side (the paper's first future direction).
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from pydantic import BaseModel, Field

from sumo_adv.agents.prompts import Prompt, Prompts, tame
from sumo_adv.agents.scene_text import Names, driver_words, relative_words, road_words, state_words
from sumo_adv.datatypes import Intent, LibraryEntry, Limits, acceleration_of
from sumo_adv.llm.asking import Line, ask, ask_many
from sumo_adv.situation import Situation

RISKS: Mapping[str, float] = {"low": 0.2, "medium": 0.5, "high": 1.0}
UNDECIDED = 0.5  # share of the greatest possible entropy from which the first intents are tried side by side
MOST_NOVEL = 2
Evidence = Callable[[Names], str]


class Choice(BaseModel):
    """One ranked intent as a model gives it."""

    bv: str
    label: str = Field(min_length=1, max_length=80)
    novel: bool = False
    description: str = Field(default="", max_length=600)
    risk: Literal["low", "medium", "high"]
    acceleration: float | list[list[float]]
    reason: str = Field(default="", max_length=2000)


class Analysis(BaseModel):
    """A model's whole answer."""

    analysis: str = Field(default="", max_length=8000)
    intents: list[Choice] = Field(min_length=1, max_length=6)


class Same(BaseModel):
    """A model's answer on whether a behaviour is known."""

    same_as: str | None
    reason: str = Field(default="", max_length=2000)


@dataclass(frozen=True, slots=True)
class Distribution:
    """What ``samples`` answers came to: (BV, label) -> share of first places; entropy in [0, 1] of the greatest
    possible; the expected risk each ranking was made by."""

    samples: int
    first: Mapping[tuple[str, str], float]
    entropy: float
    expected_risk: Mapping[tuple[str, str], float]

    @property
    def undecided(self) -> bool:
        """Whether the first intents are to be tried side by side."""
        return self.entropy >= UNDECIDED


class ModelAnalyzer:
    """Asks a model about a situation. ``distribution`` is that of the last analysis.

    evidence: the table of ``agents.evidence`` for the names of the situation's vehicles, None to leave it out.
    """

    def __init__(
        self,
        line: Line,
        prompts: Prompts,
        limits: Limits,
        *,
        samples: int = 1,
        allowed: Sequence[str] = (),
        evidence: Evidence | None = None,
    ) -> None:
        self.name = line.model.name
        self._line, self._prompts, self._limits = line, prompts, limits
        self._samples, self._allowed, self._evidence = samples, tuple(allowed), evidence
        self.distribution: Distribution | None = None

    def analyze(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
        """Intents, most dangerous first, from the earliest of the situations.

        Raises:
            ModelError, BudgetError: no usable answer could be had.
        """
        situation = situations[min(situations)]
        entries = [e for e in library if not self._allowed or e.label in self._allowed]
        names = Names.of(situation)
        prompt = analyzer_prompt(self._prompts, situation, entries, self._limits, self._evidence)

        def check(answer: Analysis) -> str | None:
            return self._wrong(answer, situation, names, entries)

        answers = ask_many(
            self._line, "analyzer", prompt.system, prompt.user, Analysis, samples=self._samples, check=check
        )
        ranked, self.distribution = _ranking(answers, names)
        known = {e.label: e for e in entries}
        return [_intent(choice, names, known) for choice in ranked]

    def confirm(self, label: str, description: str, nearest: Sequence[LibraryEntry]) -> str | None:
        """The label among ``nearest`` that a new behaviour is the same as, or None. Raises ModelError."""
        listed = "\n".join(f"- {tame(e.label)}: {tame(e.description)}" for e in nearest)
        prompt = self._prompts.render("confirm", label=tame(label), description=tame(description), nearest=listed)
        labels = {tame(e.label): e.label for e in nearest}

        def check(answer: Same) -> str | None:
            if answer.same_as is None or answer.same_as in labels:
                return None
            return f"'{tame(answer.same_as)}' is not one of the known behaviours: {', '.join(labels)}, or null."

        found = ask(self._line, "analyzer", prompt.system, prompt.user, Same, check=check)
        return None if found.same_as is None else labels[found.same_as]

    def _wrong(
        self, answer: Analysis, situation: Situation, names: Names, library: Sequence[LibraryEntry]
    ) -> str | None:
        """The first thing wrong with an answer, as a sentence that names it."""
        labels = {tame(e.label).lower(): e for e in library}
        seen = set()
        for choice in answer.intents:
            if choice.bv not in names.bvs:
                return f"There is no vehicle '{tame(choice.bv)}' that may be chosen; there are {', '.join(names.bvs)}."
            wrong = self._wrong_acceleration(choice.acceleration)
            entry = labels.get(tame(choice.label).lower())
            if wrong is None and choice.novel:
                wrong = self._wrong_novelty(choice, entry)
            elif wrong is None and entry is None:
                wrong = (
                    f"'{tame(choice.label)}' is not in the library ({', '.join(tame(e.label) for e in library)});"
                    " give one of these, or set novel to true with a description."
                )
            elif wrong is None and entry is not None:
                words = set(situation.targets[names.bvs[choice.bv]].applies())
                if not words & set(entry.applies):
                    wrong = f"'{entry.label}' does not apply to {choice.bv} from where it is."
            if wrong is not None:
                return wrong
            key = (choice.bv, choice.label.lower())
            if key in seen:
                return f"{choice.bv} with '{tame(choice.label)}' is listed twice."
            seen.add(key)
        if sum(c.novel for c in answer.intents) > MOST_NOVEL:
            return f"At most {MOST_NOVEL} intents may be novel."
        return None

    def _wrong_novelty(self, choice: Choice, entry: LibraryEntry | None) -> str | None:
        if self._allowed:
            return f"Only these behaviours are allowed here: {', '.join(self._allowed)}."
        if entry is not None:
            return f"'{entry.label}' is in the library, so it is not novel: set novel to false."
        if len(choice.description.split()) < 5:
            return f"The novel behaviour '{tame(choice.label)}' needs a description of one or two sentences."
        return None

    def _wrong_acceleration(self, acceleration: float | list[list[float]]) -> str | None:
        try:
            acceleration_of(acceleration, self._limits)
        except ValueError as error:
            return str(error)
        return None


def analyzer_prompt(
    prompts: Prompts,
    situation: Situation,
    library: Sequence[LibraryEntry],
    limits: Limits,
    evidence: Evidence | None = None,
) -> Prompt:
    """What the analyzer is shown of a situation. ``library``: what may be chosen from."""
    names = Names.of(situation)
    return prompts.render(
        "analyzer",
        library="\n".join(f"- {tame(e.label)}: {tame(e.description)}" for e in library),
        horizon=f"{situation.horizon:g}",
        braking=f"{limits.braking:g}", acceleration=f"{limits.acceleration:g}", lateral=f"{limits.lateral:g}",
        road=road_words(situation, names), states=state_words(situation, names),
        relative=relative_words(situation, names, {e.label: e.applies for e in library}),
        driver=driver_words(situation), evidence=f"\n{evidence(names)}" if evidence is not None else "",
    )  # fmt: skip


def _ranking(answers: Sequence[Analysis], names: Names) -> tuple[list[Choice], Distribution]:
    """All intents of all answers by expected risk (mean over answers, absent = 0; a later place counts less)."""
    risk: defaultdict[tuple[str, str], float] = defaultdict(float)
    first: Counter[tuple[str, str]] = Counter()
    chosen: dict[tuple[str, str], Choice] = {}
    for answer in answers:
        for place, choice in enumerate(answer.intents):
            key = (choice.bv, choice.label)
            risk[key] += RISKS[choice.risk] / (1 + place) / len(answers)
            chosen.setdefault(key, choice)
        first[(answer.intents[0].bv, answer.intents[0].label)] += 1
    order = sorted(chosen, key=lambda key: -risk[key]) if len(answers) > 1 else list(chosen)
    shares = {(names.bvs[bv], label): count / len(answers) for (bv, label), count in first.items()}
    expected = {(names.bvs[bv], label): round(risk[bv, label], 4) for bv, label in order}
    entropy = -sum(p * math.log(p) for p in shares.values())
    greatest = math.log(min(len(answers), max(len(chosen), 2))) if len(answers) > 1 else 1.0
    return [chosen[k] for k in order], Distribution(len(answers), shares, round(entropy / greatest, 4) + 0.0, expected)


def _intent(choice: Choice, names: Names, known: Mapping[str, LibraryEntry]) -> Intent:
    entry = next((e for label, e in known.items() if tame(label).lower() == tame(choice.label).lower()), None)
    label = entry.label if entry is not None else tame(choice.label)
    description = entry.description if entry is not None else tame(choice.description)
    return Intent(
        names.bvs[choice.bv], label, description, choice.risk, acceleration_of(choice.acceleration),
        tame(choice.reason), "memory" if entry is not None else "generated",
    )  # fmt: skip
