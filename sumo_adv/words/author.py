"""``write``: a language model turns words into a scenario, is told what is wrong with it, and corrects it.

Each answer is built, loaded and run. The exact error, or what happened, goes back to the model as the fault of its
answer, at most ``MAX_CORRECTIONS`` times. The first scenario that reaches its level and fits the request is kept. If
there is none, the best one is kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sumo_adv.asked import MEANINGS, RequestOrigin
from sumo_adv.datatypes import Level, LibraryEntry
from sumo_adv.errors import BudgetError, ModelError, SumoAdvError, UsageError
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.llm.prompts import Prompts, fenced, sanitize
from sumo_adv.memory.records import IntentRecord, canonical
from sumo_adv.simulation.inputs import data_folder, load_input, shipped_files
from sumo_adv.words.build import build_scenario
from sumo_adv.words.draft import Draft, NovelDraft, SceneDraft
from sumo_adv.words.fit import held
from sumo_adv.words.request import Reading, read_motion
from sumo_adv.words.roads import Net

MAX_CORRECTIONS = 5  # maximum number of corrections after the first answer
MAX_REQUEST_QUESTIONS = 8  # for one request: drafts, readings and planners of novel behaviours
FACTS = 3  # attempts that the model is told about if a draft does not do
QUESTIONS_PER_DRAFT = 2  # maximum number of questions that one more draft takes
DEFAULT_LEVEL = "valid"  # the wanted level if a draft names none
Run = Callable[[Path, Path, Mapping[str, Any]], dict[str, Any]]
"""Runs a scenario.

It takes the scenario's file, the folder to write, and the settings of the goal. It returns the content of
``outcome.json`` and raises SumoAdvError.
"""
Invent = Callable[[IntentRecord], None]
"""Has a planner written for a behaviour, and gives it to the runs from then on. It raises ModelError."""


class NoScenario(SumoAdvError):
    """No scenario can be made of the words."""


@dataclass(frozen=True, slots=True)
class Played:
    """A scenario that ran.

    Attributes:
        draft: The model's answer.
        scenario: The file of the scenario.
        folder: The folder of the run.
        outcome: The content of ``outcome.json``.
        reading: The reader's answer; None if there was no reader.
        given_up: Why the model gave up after this scenario; empty if it did not.
    """

    draft: Draft
    scenario: Path
    folder: Path
    outcome: dict[str, Any]
    reading: Reading | None = None
    given_up: str = ""

    @property
    def scene(self) -> SceneDraft:
        """The scene of the draft."""
        assert self.draft.scene is not None
        return self.draft.scene

    @property
    def level(self) -> Level:
        """The level of the attempt that counts."""
        result = self.outcome["outcome"]
        return Level.NONE if result is None else Level[str(result["level"]).upper()]

    @property
    def reached(self) -> bool:
        """Whether an attempt met the goal, or reached the goal's level without fitting the request."""
        level = goal_of(self.scene)["until"]
        near_miss = self.scene.attack.asked.level == "near_miss"
        return self.outcome["ending"] == "critical" or (not near_miss and self.level >= Level[level.upper()])

    @property
    def result(self) -> str:
        """The result of the attempt that counts, in a word or two."""
        near_miss = self.scene.attack.asked.level == "near_miss" and self.outcome["ending"] == "critical"
        return "near miss" if near_miss else f"level {self.level}"

    @property
    def misfits(self) -> list[str]:
        """What the scenario lacks of the request: by the rules, then by the reader, then by the model that gave up."""
        asked = self.outcome["asked"]
        by_rules = list(asked["misfits"]) if asked and asked["motion"] else ["No attempt was made."]
        read = self.reading
        by_reader = [] if read is None or read.fits else [read.lacks]
        return by_rules + by_reader + ([self.given_up] if self.given_up else [])

    @property
    def worth(self) -> tuple[bool, bool, bool, int, int]:
        """A sort key; higher is better."""
        fits = not self.misfits
        return self.reached and fits, fits, self.reached, -len(self.misfits), int(self.level)


def goal_of(scene: SceneDraft) -> dict[str, Any]:
    """Return the settings of the goal of a scene's attack.

    Args:
        scene: The scene of a draft.
    """
    return scene.attack.asked.settings or {"until": DEFAULT_LEVEL}


class Author:
    """Writes one scenario.

    Attributes:
        best: The best scenario so far; None if none ran.
    """

    def __init__(
        self, metered: MeteredModel, prompts: Prompts, library: Sequence[LibraryEntry], run: Run, invent: Invent,
        folder: Path, name: str, date: str, network: Path | None = None, tell: Callable[[str], None] = lambda _: None,
    ) -> None:  # fmt: skip
        """Prepare to write a scenario.

        Args:
            metered: The language model.
            prompts: The prompts.
            library: The known intents.
            run: Runs a scenario.
            invent: Has a planner written for a behaviour that is not in the library.
            folder: The folder for the files of all tries.
            name: The name of the scenario.
            date: The date to write into the scenario.
            network: The user's network; None if there is none.
            tell: Called with a sentence about each answer.
        """
        self._metered, self._prompts, self._library = metered, prompts, library
        self._run, self._invent = run, invent
        self._folder, self._name, self._date, self._network, self._tell = folder, name, date, network, tell
        self._tries = self._readings = 0
        self._invented: dict[str, NovelDraft | None] = {}  # by canonical label; None if no planner could be written
        self._words = ""
        self.best: Played | None = None

    def write(self, words: str) -> Played:
        """Write the scenario of a request.

        Args:
            words: The request.

        Returns:
            The best scenario that ran.

        Raises:
            NoScenario: The model says that no scenario can be made of the words.
            ModelError: No answer gave a scenario that runs.
        """
        self._words = words
        prompt = self._prompts.render(
            "write", networks=_networks(), given=_given(self._network),
            intents="\n".join(map(_intent, self._library)),
            events="\n".join(f"  - {event}: {meaning}" for event, meaning in MEANINGS.items()),
            request=fenced(words),
        )  # fmt: skip
        try:
            draft = ask(
                self._metered, "author", prompt.system, prompt.user, Draft, check=self._fault, re_asks=MAX_CORRECTIONS
            )
        except ModelError:
            if self.best is None:
                raise
            return self.best
        if draft.cannot and self.best is None:
            raise NoScenario(f"There is no scenario for these words: {sanitize(draft.cannot)}")
        assert self.best is not None
        return replace(self.best, given_up=sanitize(draft.cannot))

    def _fault(self, draft: Draft) -> str | None:
        """Build and run a draft; return the fault of the draft or of its run, or None if there is none."""
        if draft.cannot:
            return "Give either cannot or a scene, not both." if draft.scene is not None else None
        if draft.scene is None:
            return "Give a scene, or in cannot the reason why there is none."
        self._tries += 1
        if draft.left_out:  # told before the run, so that users who need that part can stop the command
            self._tell(f"Answer {self._tries} leaves out: {sanitize(draft.left_out)}")
        folder = self._folder / str(self._tries)
        folder.mkdir()
        try:
            played = self._play(draft, draft.scene, folder)
        except UsageError as error:
            wrong = str(error).replace(f"{folder}/", "")
            self._tell(f"Answer {self._tries}: {wrong}")
            return wrong
        self._compare(played)
        done = (played.reached and not played.misfits) or self._questions > MAX_REQUEST_QUESTIONS - QUESTIONS_PER_DRAFT
        self._tell(f"Answer {self._tries}: {played.result}, {'fits' if not played.misfits else 'does not fit'}.")
        return None if done else _what_happened(played)

    def _compare(self, played: Played) -> None:
        """Keep a scenario as the best one if it is better than those before."""
        if self.best is None or played.worth > self.best.worth:
            self.best = played

    @property
    def _questions(self) -> int:
        """The number of questions so far, without answers that did not match the schema."""
        return self._tries + self._readings + len(self._invented)

    def _play(self, draft: Draft, scene: SceneDraft, folder: Path) -> Played:
        """Build and run a scene; have its motion read if it reached its level and fits.

        If the reader fails, the rules alone decide. If no more questions may be asked, the scenario is kept first.
        """
        known = {canonical(e.label) for e in self._library}
        novel = set() if scene.attack.novel is None else {canonical(scene.attack.novel.label)}
        of_others = [label for other in scene.attack.others for label in other.intents if canonical(label) not in novel]
        named = (label for label in (*scene.attack.intents, *of_others) if canonical(label) not in known)
        unknown = next(named, None)
        if unknown is not None:
            raise UsageError(
                f"There is no intent '{sanitize(unknown)}'; leave intents empty, take some of the list, or describe "
                "the behaviour in novel."
            )
        if scene.attack.novel is not None:
            self._write_planner(scene.attack.novel, known)
        written = RequestOrigin(words=self._words, model=self._metered.model.name, date=self._date)
        file = build_scenario(scene, folder / f"{self._name}.toml", written, self._network)
        load_input(file)
        played = Played(draft, file, folder / "run", self._run(file, folder / "run", goal_of(scene)))
        if played.reached and not played.misfits and self._questions < MAX_REQUEST_QUESTIONS:
            self._readings += 1
            motion = str(played.outcome["asked"]["motion"])
            try:
                reading = read_motion(self._metered, self._prompts, motion, self._words)
            except BudgetError:
                self._compare(played)
                raise
            except ModelError as error:
                self._tell(f"Answer {self._tries}: the rules alone decide, because the reader failed: {error}")
            else:
                played = replace(played, reading=reading)
        return played

    def _write_planner(self, novel: NovelDraft, known: Collection[str]) -> None:
        """Have the planner of a novel behaviour written, unless an earlier draft had the same behaviour."""
        key = canonical(novel.label)
        if key in known:
            raise UsageError(
                f"'{sanitize(novel.label)}' is an intent of the list: name it in intents, and give no novel."
            )
        if key in self._invented:
            if self._invented[key] != novel:
                raise UsageError(
                    f"'{sanitize(novel.label)}' was tried before: give it as it was if a planner was written, or "
                    "another label to another behaviour."
                )
            return
        self._tell(f"No known intent does it: a planner for '{sanitize(novel.label)}' is written.")
        self._invented[key] = novel
        try:
            self._invent(
                IntentRecord(novel.label, " ".join(novel.description.split()), tuple(dict.fromkeys(novel.applies)))
            )
        except BudgetError:
            raise
        except ModelError as error:
            self._invented[key] = None
            raise UsageError(
                f"No planner could be written for '{sanitize(novel.label)}': {error} Describe a simpler behaviour "
                "under another label, or take known intents."
            ) from error


def _what_happened(played: Played) -> str:
    """Describe a run for the model that drafted the scenario."""
    outcome, asked = played.outcome, played.outcome["asked"]
    lines = ["The scenario is built and ran, but what happened is not yet what was asked for."]
    if outcome["best"] is None:
        return f"{lines[0]} No attack began: {outcome['reason']}"
    count = len(outcome["attempts"])
    lines.append(f"The best of {count} attempts reached the level {played.level} (wanted: {outcome['goal']}).")
    if played.level is Level.COLLISION and not played.reached:
        lines.append(
            "No reference driver avoids that collision. Give the EGO more time or room, or ask for a lower level."
        )
    if played.reading is not None and not played.reading.fits:
        lines.append(
            "It fits by the rules, but a reader who sees its motion alone says that it is not what was asked for."
        )
    lines += [f"Missing: {fault}" for fault in played.misfits]
    lines += [holds] if (holds := held(asked["parts"])) else []
    gates = outcome["outcome"]["failed_gates"]
    lines += [f"Gates that failed: {', '.join(gates)}."] if gates else []
    own = [part.label for part in (played.scene.attack.script, played.scene.attack.novel) if part is not None]
    lines += [f"Attempt {fact}" for fact in attempt_facts(outcome["attempts"], own)]
    tried = {attempt["intent"] for attempt in outcome["attempts"]}
    lines += [
        f"No attempt plays '{sanitize(label)}': nobody was where it begins." for label in own if label not in tried
    ]
    who = ", ".join(f"{letter} is '{name}'" for letter, name in zip("ABC", played.scene.attack.attackers, strict=False))
    lines.append(f"Its motion, from when the attack began ({who}):\n{asked['motion']}")
    lines.append("Change places, speeds, the road, intents or what is asked, whichever is the reason.")
    return "\n".join(lines)


def attempt_facts(
    attempts: Sequence[Mapping[str, Any]], wanted: Collection[str] = (), most: int = FACTS
) -> list[str]:  # fmt: skip
    """Say in one line each how far the best attempts came, best first.

    Better attempts have a higher level, lack less of the request, and have a lower minimum TTC. Of attempts with the
    same intent and mode, only the best one is told.

    Args:
        attempts: The attempts of ``outcome.json``.
        wanted: Labels of intents whose best attempt is told in any case.
        most: The maximum number of lines, without those of ``wanted``.
    """

    def worth(attempt: Mapping[str, Any]) -> tuple[int, int, float]:
        ttc = attempt["min_ttc"]
        lacks = len(attempt.get("misfits", ()))
        return -int(Level[str(attempt["level"]).upper()]), lacks, math.inf if ttc is None else float(ttc)

    told: dict[tuple[str, str], str] = {}
    for attempt in sorted(attempts, key=worth):
        told.setdefault((attempt["intent"], attempt["planner"]["mode"]), _fact(attempt))
    return [fact for k, ((label, _), fact) in enumerate(told.items()) if k < most or label in wanted]


def _fact(attempt: Mapping[str, Any]) -> str:
    """Say what an attempt was, how far it came, and what stopped it."""
    numbers = ", ".join(f"{name} {value:.3g}" for name, value in attempt["parameters"].items())
    ttc, seen = attempt["min_ttc"], attempt["diagnosis"]
    parts = [f"level {attempt['level']}, {'no conflict' if ttc is None else f'minimum TTC {ttc:.2f} s'}"]
    if seen is not None:
        ahead, left = seen["ego_frame"]
        place = f"{abs(ahead):.1f} m {'ahead of' if ahead >= 0.0 else 'behind'} the EGO"
        beside = f"{abs(left):.1f} m to its {'left' if left >= 0.0 else 'right'}"
        speeds = f"the EGO at {seen['ego_speed']:.1f} m/s and A at {seen['bv_speed']:.1f} m/s"
        parts.append(f"nearest {seen['time']:.1f} s after its start, A {place} and {beside}, {speeds}")
    parts += [f"beyond the limits of {', '.join(attempt['failed_gates'])}"] if attempt["failed_gates"] else []
    parts += [sanitize(lack).rstrip(".") for lack in attempt.get("misfits", ())]
    mode = f"{sanitize(attempt['intent'])}/{sanitize(attempt['planner']['mode'])}"
    return f"{attempt['index'] + 1} ({mode}{f'; {numbers}' if numbers else ''}): {'; '.join(parts)}."


def _intent(entry: LibraryEntry) -> str:
    """Return a line of the list of intents: the label, the relations that it begins from, and the description."""
    relations = " or ".join(entry.applies).replace("_", " ")
    return f"  - {sanitize(entry.label)} ({relations}): {sanitize(entry.description)}"


def _networks() -> str:
    """Describe the shipped networks: their edges, with lanes, limit and length."""
    folder = data_folder("networks")
    return "\n".join(
        f"  - {name}: {Net(folder / f'{name}.net.xml').words()}" for name in shipped_files("networks", ".net.xml")
    )


def _given(network: Path | None) -> str:
    """Describe the user's network; empty without one."""
    if network is None:
        return ""
    return f"- given: the user's own network, which is to be used. Its edges: {Net(network).words()}\n"
