"""The words of a person: checked, compared with the shipped scenarios, and with what happened."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, Field

from sumo_adv.asked import MAX_REQUEST_CHARACTERS
from sumo_adv.errors import UsageError
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.llm.chat import one_line
from sumo_adv.llm.prompts import Prompts, fenced
from sumo_adv.memory.similarity import TfIdf
from sumo_adv.simulation.shipped import shipped_scenarios

MAX_NAMED_SCENARIOS = 3
UNRELATED_DISTANCE = 0.95  # from which a scenario has nothing to do with the words


def checked_words(text: str) -> str:
    """The words without control characters, as one paragraph. Raises UsageError for none, and for too many."""
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
    """The names of the shipped scenarios with the descriptions most like the words, nearest first; empty if no
    description is like them."""
    shipped = shipped_scenarios()
    entries = [(s.name.replace("_", " "), f"{s.description} {' '.join(s.intents)}") for s in shipped]
    text = TfIdf()
    text.fit(entries)
    distances = text.distances("", words)
    order = np.argsort(distances, kind="stable")[:MAX_NAMED_SCENARIOS]
    return [shipped[k].name for k in order if distances[k] < UNRELATED_DISTANCE]


def needs_model(what: str, words: str) -> UsageError:
    """The error of a request without a model, with the shipped scenarios that are nearest to it."""
    names = nearest_scenarios(words)
    near = "no shipped scenario is like it"
    if names:
        near = f"the nearest shipped scenarios by text are {', '.join(names)}"
    return UsageError(f"{what} needs a language model, named with --llm; {near}.")


class Reading(BaseModel):
    """What a reader makes of a motion."""

    happened: str = Field(max_length=1000)
    fits: bool
    lacks: str = Field(default="", max_length=600)


def read_motion(metered: MeteredModel, prompts: Prompts, motion: str, request: str) -> Reading:
    """A model's reading of a motion in words. It sees neither the plan nor the verdict. Raises ModelError."""
    prompt = prompts.render("reading", motion=motion, request=fenced(request))
    return ask(metered, "reader", prompt.system, prompt.user, Reading)
