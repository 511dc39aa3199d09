"""The analyzer: the paper's g, played by a language model. The built-in expert's answer is ``AttackSearch.ranking``.

A model sees the scene and the evidence of the predictions. It chooses intents, and for each one the modes, their
parameter values and the start. Its answers to ``samples`` equal questions give a distribution over intents, which are
ordered by expected risk. If the entropy of the distribution is high, the first intents are tried side by side (the
paper's first future direction).
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import BaseModel, Field

from sumo_adv.agents.choices import analysis_schema, same_schema
from sumo_adv.agents.request import (
    MAX_SCRIPTS,
    Demand,
    ReadRequest,
    Scripted,
    attackers_of,
    demands_fault,
    script_fault,
    script_intent,
)
from sumo_adv.agents.scene_text import Aliases, driver_words, outlook_words, relative_words, road_words, state_words
from sumo_adv.agents.teams import MAX_PROPOSED_COMPOSITIONS, Team, Teamwork, casts_of, team_fault, teams_words
from sumo_adv.agents.ways import MAX_WAYS_PER_INTENT, HowTo, library_words, modes_words, starts_words, way_fault, way_of
from sumo_adv.asked import MEANINGS, Asked
from sumo_adv.datatypes import MAX_ADVERSARIES, Intent, LibraryEntry, Limits, acceleration_of
from sumo_adv.llm.asking import MeteredModel, ask, ask_many
from sumo_adv.llm.prompts import MAX_PROMPT_TEXT_CHARACTERS, Prompt, Prompts, danger_words, fenced, sanitize
from sumo_adv.search.supports import Cast
from sumo_adv.situation import Situation

RISK_VALUES: Mapping[str, float] = {"low": 0.2, "medium": 0.5, "high": 1.0}
UNDECIDED_ENTROPY_SHARE = 0.5  # at this share of the maximum entropy or more, the first intents are tried side by side
MAX_NOVEL_INTENTS = 2  # maximum number of novel intents in one answer
Evidence = Callable[[Aliases], str]

# The classes below are sent to the model as a JSON schema, with their names and docstrings.


class Choice(BaseModel):
    """One ranked intent as a model gives it."""

    bv: str
    label: str = Field(min_length=1, max_length=80)
    novel: bool = False
    description: str = Field(default="", max_length=MAX_PROMPT_TEXT_CHARACTERS)
    risk: Literal["low", "medium", "high"]
    acceleration: float | list[list[float]] = 0.0
    ways: list[HowTo] = Field(default_factory=list, max_length=MAX_WAYS_PER_INTENT)
    reason: str = Field(default="", max_length=2000)


class Analysis(BaseModel):
    """A model's whole answer."""

    analysis: str = Field(default="", max_length=8000)
    intents: list[Choice] = Field(max_length=6)


class TeamAnalysis(Analysis):
    """A model's whole answer where several vehicles may act together."""

    compositions: list[Team] = Field(default_factory=list, max_length=MAX_PROPOSED_COMPOSITIONS)


class AskedAnalysis(TeamAnalysis):
    """A model's whole answer where an attack is asked for in words."""

    can_be_played: bool
    why_not: str = Field(default="", max_length=600)
    asked: Asked = Asked()
    scripts: list[Scripted] = Field(default_factory=list, max_length=MAX_SCRIPTS)
    attackers: list[Demand] = Field(default_factory=list, max_length=MAX_ADVERSARIES)


class Same(BaseModel):
    """A model's answer on whether a behaviour is known."""

    same_as: str | None
    ways: list[HowTo] = Field(default_factory=list, max_length=MAX_WAYS_PER_INTENT)
    reason: str = Field(default="", max_length=2000)


@dataclass(frozen=True, slots=True)
class Distribution:
    """The distribution of answers over intents, each given as (BV id, label).

    Attributes:
        samples: The number of answers.
        first: The share of the answers that rank the intent first.
        entropy: The entropy of ``first``, as a share of the maximum, in [0, 1].
        expected_risk: The value by which the intents are ordered.
    """

    samples: int
    first: Mapping[tuple[str, str], float]
    entropy: float
    expected_risk: Mapping[tuple[str, str], float]

    @property
    def undecided(self) -> bool:
        """Whether the answers disagree, so that the first intents must be tried side by side."""
        return self.entropy >= UNDECIDED_ENTROPY_SHARE and self.samples > 1

    def as_dict(self) -> dict[str, Any]:
        """Return the ``analysis`` of ``outcome.json``."""
        return {
            "samples": self.samples, "entropy": self.entropy, "side_by_side": self.undecided,
            "first": [{"bv": bv, "label": label, "share": round(s, 4)} for (bv, label), s in self.first.items()],
            "expected_risk": [{"bv": bv, "label": label, "risk": r} for (bv, label), r in self.expected_risk.items()],
        }  # fmt: skip


class ModelAnalyzer:
    """Asks a model about a situation.

    Attributes:
        read: What the last analysis makes of the request; None without a request.
        distribution: The answers of the last analysis; None before the first one.
        casts: The compositions that these answers propose.
    """

    def __init__(
        self, metered: MeteredModel, prompts: Prompts, limits: Limits, *, samples: int = 1, allowed: Sequence[str] = (),
        evidence: Evidence | None = None, teamwork: Teamwork | None = None, request: str = "",
    ) -> None:  # fmt: skip
        """Prepare to ask.

        Args:
            metered: The language model.
            prompts: The prompts.
            limits: The limits of the adversary.
            samples: The number of answers to each analysis.
            allowed: The labels that the model may choose; empty allows all.
            evidence: Makes the table of ``agents.ways.evidence_words`` from the vehicles' aliases; None leaves the
                table out.
            teamwork: What the model may compose; None if only one adversary is allowed.
            request: The attack that a user wants, in words; empty for the most dangerous ones.
        """
        self._metered, self._prompts, self._limits = metered, prompts, limits
        self._samples, self._allowed, self._evidence = samples, tuple(allowed), evidence
        self._teamwork, self._request = teamwork, request
        self.read: ReadRequest | None = None
        self.distribution: Distribution | None = None
        self.casts: tuple[Cast, ...] = ()

    def analyze(self, situations: Mapping[float, Situation], library: Sequence[LibraryEntry]) -> list[Intent]:
        """Choose intents for the earliest situation, most dangerous first.

        Args:
            situations: The situations by delay after the trigger [s].
            library: The known intents.

        Returns:
            The intents, scripts first; none if the model sees nothing dangerous.

        Raises:
            ModelError: The model failed.
            BudgetError: The run may ask no more.
        """
        situation = situations[min(situations)]
        entries = [e for e in library if not self._allowed or e.label in self._allowed]
        aliases = Aliases.of(situation)
        prompt = analyzer_prompt(
            self._prompts, situations, entries, self._limits, self._evidence, self._teamwork, self._request
        )
        answer_type: type[Analysis] = Analysis if self._teamwork is None else TeamAnalysis
        answer_type = AskedAnalysis if self._request else answer_type

        def check(answer: Analysis) -> str | None:
            return self._fault(answer, situation, aliases, entries)

        colliders = [a for a, bv in aliases.bvs.items() if self._teamwork is None or self._teamwork.may_collide(bv)]
        schema = analysis_schema(
            answer_type, list(aliases.bvs), entries, self._teamwork, colliders, novel=not self._allowed
        )
        answers = ask_many(
            self._metered, "analyzer", prompt.system, prompt.user, answer_type, samples=self._samples, check=check,
            schema=schema,
        )  # fmt: skip
        scripted = list[Intent]()
        if isinstance(answers[0], AskedAnalysis):
            self.read = _read(answers[0], aliases)
            scripted = [script_intent(each, aliases) for each in answers[0].scripts]
            answers = [answers[0]]  # the conditions must come from a single reading of the request
        ranked, distribution = _ranking(answers, aliases)
        self.distribution = _with_scripts(distribution, scripted)
        teams = (team for answer in answers if isinstance(answer, TeamAnalysis) for team in answer.compositions)
        self.casts = casts_of(teams, aliases, entries)
        return [*scripted, *(_intent(choice, aliases, entries, situations) for choice in ranked)]

    def confirm(
        self, intent: Intent, nearest: Sequence[LibraryEntry], situations: Mapping[float, Situation]
    ) -> Intent | None:
        """Check whether a new intent is a known one.

        Args:
            intent: The new intent.
            nearest: The known intents that it may be.
            situations: The situations by delay after the trigger [s].

        Returns:
            The intent by the label among ``nearest`` that means the same behaviour, with the ways to carry it out; None
            for a novel one.

        Raises:
            ModelError: The model failed.
        """
        situation = situations[min(situations)]
        aliases = Aliases.of(situation)
        listed = "\n".join(
            line for e in nearest for line in (f"- {sanitize(e.label)}: {sanitize(e.description)}", *modes_words(e))
        )
        prompt = self._prompts.render(
            "confirm", label=sanitize(intent.label), description=sanitize(intent.description), nearest=listed,
            scene=relative_words(situation, aliases, {}), bv=aliases.by_id[intent.bv], starts=starts_words(situations),
        )  # fmt: skip
        entries = {sanitize(e.label): e for e in nearest}

        def check(answer: Same) -> str | None:
            if answer.same_as is None:
                return None
            entry = entries.get(answer.same_as)
            if entry is None:
                labels = ", ".join(entries)
                return f"'{sanitize(answer.same_as)}' is not one of the known behaviours: {labels}, or null."
            return next((f for how in answer.ways if (f := way_fault(how, entry)) is not None), None)

        schema = same_schema(Same, nearest)
        answer = ask(self._metered, "analyzer", prompt.system, prompt.user, Same, check=check, schema=schema)
        if answer.same_as is None:
            return None
        entry, ways = entries[answer.same_as], tuple(way_of(how, situations, intent.bv) for how in answer.ways)
        return replace(intent, label=entry.label, description=entry.description, source="memory", ways=ways)

    def _fault(
        self, answer: Analysis, situation: Situation, aliases: Aliases, library: Sequence[LibraryEntry]
    ) -> str | None:
        """Return the first fault of an answer as a sentence for the model; None if the answer is usable."""
        labels = {sanitize(e.label).lower(): e for e in library}
        seen = set()
        for choice in answer.intents:
            if choice.bv not in aliases.bvs:
                choices = ", ".join(aliases.bvs)
                return f"There is no vehicle '{sanitize(choice.bv)}' that may be chosen; there are {choices}."
            if self._teamwork is not None and not self._teamwork.may_collide(aliases.bvs[choice.bv]):
                return f"{choice.bv} may only be a support, in a composition."
            fault = _acceleration_fault(choice.acceleration, self._limits)
            entry = labels.get(sanitize(choice.label).lower())
            if fault is None and choice.novel:
                fault = self._novelty_fault(choice, entry)
            elif fault is None and entry is None:
                choices = ", ".join(sanitize(e.label) for e in library)
                fault = (
                    f"'{sanitize(choice.label)}' is not in the library ({choices});"
                    " give one of these, or set novel to true with a description."
                )
            elif fault is None and entry is not None:
                words = set(situation.targets[aliases.bvs[choice.bv]].applies())
                if not words & set(entry.applies):
                    fault = f"'{entry.label}' does not apply to {choice.bv} from where it is."
                else:
                    fault = next((f for how in choice.ways if (f := way_fault(how, entry)) is not None), None)
            if fault is not None:
                return fault
            key = (choice.bv, choice.label.lower())
            if key in seen:
                return f"{choice.bv} with '{sanitize(choice.label)}' is listed twice."
            seen.add(key)
        if isinstance(answer, AskedAnalysis) and (wrong := self._request_fault(answer, situation, aliases)) is not None:
            return wrong
        if sum(c.novel for c in answer.intents) > MAX_NOVEL_INTENTS:
            return f"At most {MAX_NOVEL_INTENTS} intents may be novel."
        if self._teamwork is None or not isinstance(answer, TeamAnalysis):
            return None
        faults = (team_fault(team, self._teamwork, situation, aliases, library) for team in answer.compositions)
        return next((fault for fault in faults if fault is not None), None)

    def _request_fault(self, answer: AskedAnalysis, situation: Situation, aliases: Aliases) -> str | None:
        """Return the fault of the parts that answer a request; None if they are usable."""
        if (fault := _asked_fault(answer)) is not None:
            return fault
        for scripted in answer.scripts:
            fault = script_fault(scripted, situation, aliases, self._limits, self._teamwork, self._allowed)
            if fault is not None:
                return fault
        attacking = [each.bv for each in answer.scripts] + [choice.bv for choice in answer.intents]
        return demands_fault(answer.attackers, attacking, answer.compositions, self._teamwork)

    def _novelty_fault(self, choice: Choice, entry: LibraryEntry | None) -> str | None:
        """Return the fault of a novel intent; None if it is usable."""
        if self._allowed:
            return f"Only these behaviours are allowed here: {', '.join(self._allowed)}."
        if entry is not None:
            return f"'{entry.label}' is in the library, so it is not novel: set novel to false."
        if len(choice.description.split()) < 5:
            return f"The novel behaviour '{sanitize(choice.label)}' needs a description of one or two sentences."
        return None


def _acceleration_fault(acceleration: float | list[list[float]], limits: Limits) -> str | None:
    """Return the fault of an acceleration; None if it is usable."""
    try:
        acceleration_of(acceleration, limits)
    except ValueError as error:
        return str(error)
    return None


def analyzer_prompt(
    prompts: Prompts, situations: Mapping[float, Situation], library: Sequence[LibraryEntry], limits: Limits,
    evidence: Evidence | None = None, teamwork: Teamwork | None = None, request: str = "",
) -> Prompt:  # fmt: skip
    """Return the analyzer's prompt for the earliest situation.

    Args:
        prompts: The prompts.
        situations: The situations by delay after the trigger [s].
        library: The intents that the model may choose.
        limits: The limits of the adversary.
        evidence: Makes the evidence of the predictions; None leaves it out.
        teamwork: What the model may compose; None if it is not asked for compositions.
        request: An attack to carry out, in a user's words; empty for the most dangerous ones.
    """
    situation = situations[min(situations)]
    aliases = Aliases.of(situation)
    words = {word for target in situation.target_list() for word in target.applies()}
    fitting = {e.label for e in library if words & set(e.applies)}
    table = evidence(aliases) if evidence is not None else ""
    prompt = prompts.render(
        "analyzer",
        library="\n".join(f"- {sanitize(e.label)}: {sanitize(e.description)}" for e in library),
        horizon=f"{situation.horizon:g}",
        braking=f"{limits.braking:g}", acceleration=f"{limits.acceleration:g}", lateral=f"{limits.lateral:g}",
        road=road_words(situation, aliases), states=state_words(situation, aliases),
        relative=relative_words(situation, aliases, {e.label: e.applies for e in library}),
        outlook=outlook_words(situation), modes=library_words(library, fitting) or "None of the library applies.",
        starts=starts_words(situations),
        driver=driver_words(situation), evidence=f"\n{table}" if table else "", danger=danger_words(prompts),
    )  # fmt: skip
    more = [] if teamwork is None else [teams_words(prompts, teamwork, situation, aliases, library)]
    if request:
        events = "\n".join(f" - {event}: {meaning}" for event, meaning in MEANINGS.items())
        sides = " Traffic keeps left here: exchange left and right in a script." if situation.frame.hand < 0 else ""
        more.append(prompts.piece("request", request=fenced(request), events=events, sides=sides))
    return replace(prompt, user="\n\n".join([prompt.user, *more]))


def _asked_fault(answer: AskedAnalysis) -> str | None:
    """Return the fault of the answer to a request; None if the answer is usable."""
    if answer.can_be_played and not (answer.intents or answer.scripts):
        return "The request can be played, so give one intent or script or more, or set can_be_played to false."
    if not answer.can_be_played and (answer.intents or answer.scripts):
        return "The request cannot be played here, so give no intents and no scripts, or set can_be_played to true."
    if not answer.can_be_played and len(answer.why_not.split()) < 3:
        return "Say in why_not, in one sentence, why the request cannot be played here."
    return None


def _read(answer: AskedAnalysis, aliases: Aliases) -> ReadRequest:
    """Return what a usable answer makes of the request."""
    scripts = tuple(each.script for each in answer.scripts)
    attackers = attackers_of(answer.attackers, aliases.bvs)
    return ReadRequest(answer.asked, sanitize(answer.why_not), scripts, attackers)


def _ranking(answers: Sequence[Analysis], aliases: Aliases) -> tuple[list[Choice], Distribution]:
    """Order all intents of all answers by expected risk: the mean over the answers of risk / place.

    An answer without the intent counts as 0.
    """
    risk: defaultdict[tuple[str, str], float] = defaultdict(float)
    first: Counter[tuple[str, str]] = Counter()
    chosen: dict[tuple[str, str], Choice] = {}
    for answer in answers:
        for place, choice in enumerate(answer.intents):
            key = (choice.bv, choice.label)
            risk[key] += RISK_VALUES[choice.risk] / (1 + place) / len(answers)
            chosen.setdefault(key, choice)
        if answer.intents:
            first[(answer.intents[0].bv, answer.intents[0].label)] += 1
    order = sorted(chosen, key=lambda key: -risk[key]) if len(answers) > 1 else list(chosen)
    shares = {(aliases.bvs[bv], label): count / len(answers) for (bv, label), count in first.items()}
    expected = {(aliases.bvs[bv], label): round(risk[bv, label], 4) for bv, label in order}
    entropy = -sum(p * math.log(p) for p in shares.values())
    maximum = math.log(min(len(answers), max(len(chosen), 2))) if len(answers) > 1 else 1.0
    return [chosen[k] for k in order], Distribution(len(answers), shares, round(entropy / maximum, 4) + 0.0, expected)


def _with_scripts(distribution: Distribution, scripted: Sequence[Intent]) -> Distribution:
    """Return the distribution of a single answer with its scripts before its other intents."""
    if not scripted:
        return distribution
    risks = {(i.bv, i.label): RISK_VALUES[i.risk] for i in scripted}
    first = {(scripted[0].bv, scripted[0].label): 1.0}
    return replace(distribution, first=first, expected_risk=risks | dict(distribution.expected_risk))


def _intent(
    choice: Choice, aliases: Aliases, library: Sequence[LibraryEntry], situations: Mapping[float, Situation]
) -> Intent:
    """Return a model's choice as an intent."""
    entry = next((e for e in library if sanitize(e.label).lower() == sanitize(choice.label).lower()), None)
    label = entry.label if entry is not None else sanitize(choice.label)
    description = entry.description if entry is not None else sanitize(choice.description)
    bv = aliases.bvs[choice.bv]
    return Intent(
        bv, label, description, choice.risk, acceleration_of(choice.acceleration), sanitize(choice.reason),
        "memory" if entry is not None else "generated", tuple(way_of(how, situations, bv) for how in choice.ways),
    )  # fmt: skip
