"""Which shipped scenarios are nearest to some words, by text alone."""

from __future__ import annotations

import numpy as np

from sumo_adv.errors import UsageError
from sumo_adv.memory.similarity import TfIdf
from sumo_adv.simulation.shipped import shipped_scenarios

NAMED = 3  # scenarios at most
FAR = 0.95  # distance from which a scenario has nothing to do with the words


def nearest_scenarios(words: str) -> list[str]:
    """The names of the shipped scenarios with the descriptions most like the words, nearest first; empty if no
    description is like them."""
    shipped = shipped_scenarios()
    entries = [(s.name.replace("_", " "), f"{s.description} {' '.join(s.intents)}") for s in shipped]
    text = TfIdf()
    text.fit(entries)
    distances = text.distances("", words)
    order = np.argsort(distances, kind="stable")[:NAMED]
    return [shipped[k].name for k in order if distances[k] < FAR]


def needs_model(what: str, words: str) -> UsageError:
    """The error of a request without a model, with the shipped scenarios that are nearest to it."""
    names = nearest_scenarios(words)
    near = "no shipped scenario is like it"
    if names:
        near = f"the nearest shipped scenarios by text are {', '.join(names)}"
    return UsageError(f"{what} needs a language model, named with --llm; {near}.")
