"""A user's words: check them, and compare them with the shipped scenarios and with what happened."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, Field, computed_field

from sumo_adv.asked import MAX_REQUEST_CHARACTERS
from sumo_adv.errors import UsageError
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.llm.chat import one_line
from sumo_adv.llm.prompts import Prompts, fenced
from sumo_adv.memory.similarity import TfIdf
from sumo_adv.simulation.shipped import shipped_scenarios

MAX_NAMED_SCENARIOS = 3
UNRELATED_DISTANCE = 0.95  # a scenario at least this far from the words has nothing to do with them


def checked_words(text: str) -> str:
    """Return the words without control characters, as one paragraph.

    Args:
        text: The words.

    Raises:
        UsageError: The text holds no words, or too many characters.
    """
    plain = one_line(text)
    if not any(c.isalpha() for c in plain):
        raise UsageError("The request holds no words: say in a sentence or two what is to happen on the road.")
    if len(plain) > MAX_REQUEST_CHARACTERS:
        raise UsageError(
            f"The request has {len(plain)} characters, and at most {MAX_REQUEST_CHARACTERS} are read: "
            "shorten it to what happens on the road."
        )
    return plain


def nearest_scenarios(words: str) -> list[str]:
    """Find the shipped scenarios whose descriptions are most similar to the words.

    Args:
        words: The words.

    Returns:
        Their names, nearest first; empty if no description is similar.
    """
    shipped = shipped_scenarios()
    entries = [(s.name.replace("_", " "), f"{s.description} {' '.join(s.intents)}") for s in shipped]
    text = TfIdf()
    text.fit(entries)
    distances = text.distances("", words)
    order = np.argsort(distances, kind="stable")[:MAX_NAMED_SCENARIOS]
    return [shipped[k].name for k in order if distances[k] < UNRELATED_DISTANCE]


def needs_model(what: str, words: str) -> UsageError:
    """Return the error of a request without a model, with the shipped scenarios nearest to it.

    Args:
        what: What needs a model.
        words: The words of the request.
    """
    names = nearest_scenarios(words)
    near = "no shipped scenario is like it"
    if names:
        near = f"the nearest shipped scenarios by text are {', '.join(names)}"
    return UsageError(f"{what} needs a language model, named with --llm; {near}.")


class ReadPart(BaseModel):
    """A part of the request: in its words, what the facts show of it, and whether it holds."""

    part: str = Field(min_length=1, max_length=300)
    shown: str = Field(max_length=400)
    holds: bool


class Reading(BaseModel):
    """What a reader makes of a motion. happened: what the facts say. parts: those of the request."""

    happened: str = Field(max_length=1000)
    parts: list[ReadPart] = Field(min_length=1, max_length=10)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def fits(self) -> bool:
        """Whether all parts hold."""
        return all(part.holds for part in self.parts)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def lacks(self) -> str:
        """What the facts show of the parts that do not hold; empty if all hold."""
        return " ".join(f"'{each.part}' does not hold: {each.shown}" for each in self.parts if not each.holds)


def read_motion(metered: MeteredModel, prompts: Prompts, motion: str, request: str) -> Reading:
    """Have a model read a motion in words. It sees neither the plan nor the verdict.

    Args:
        metered: The language model.
        prompts: The prompts.
        motion: The motion in words.
        request: The words of the request.

    Returns:
        The model's answer.

    Raises:
        ModelError: The model gave no usable answer.
    """
    prompt = prompts.render("reading", motion=motion, request=fenced(request))
    return ask(metered, "reader", prompt.system, prompt.user, Reading)
