"""JSON schemas of the agents' answers for one scene: vehicles, behaviours and modes are enums of the possible choices.

A server that enforces a schema cannot return a name that does not exist. Answers are checked all the same.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import BaseModel

from sumo_adv.agents.teams import ATTACKING, DUTY_DESCRIPTIONS, Teamwork
from sumo_adv.agents.ways import first_of_each_mode
from sumo_adv.datatypes import LibraryEntry
from sumo_adv.llm.prompts import sanitize
from sumo_adv.search.support_intents import SUPPORT_INTENTS

MAX_ENUM_VALUES = 250  # per enum; servers limit long ones, and compile them into their grammars
Schema = dict[str, Any]
Values = Mapping[str, Iterable[str]]
"""Maps class and property, such as ``Choice.bv``, to the values that it may have."""


def analysis_schema(
    answer_type: type[BaseModel], vehicles: Sequence[str], library: Sequence[LibraryEntry],
    teamwork: Teamwork | None = None, colliders: Sequence[str] = (), *, novel: bool,
) -> Schema:  # fmt: skip
    """Return the schema of an analysis.

    Args:
        answer_type: ``Analysis`` or a class that is derived from it.
        vehicles: The aliases of all vehicles that may be chosen.
        library: The intents that may be chosen.
        teamwork: What may be composed; None for one adversary.
        colliders: The aliases of the vehicles that may be chosen without a composition.
        novel: Whether an intent may be new. A new one has any label; all others have one of the library's.
    """
    labels = [sanitize(entry.label) for entry in library]
    attacking = colliders if teamwork is not None else vehicles
    values: dict[str, Iterable[str]] = {
        "Choice.bv": attacking, "Scripted.bv": attacking, "Demand.bv": attacking, "Choice.label": labels,
        "HowTo.mode": _modes(library),
    }  # fmt: skip
    if teamwork is not None:
        supports = [entry.label for duty in DUTY_DESCRIPTIONS for entry in SUPPORT_INTENTS[duty]]
        values["Member.bv"] = vehicles
        values["Member.role"] = [*map(str, ATTACKING), *map(str, DUTY_DESCRIPTIONS)]
        values["Member.label"] = [*labels, *supports]
    free = answer_type.model_json_schema()
    schema = _with_values(free, values)
    if novel:
        new = copy.deepcopy(free["$defs"]["Choice"])
        new["properties"]["bv"] = schema["$defs"]["Choice"]["properties"]["bv"]
        new["properties"]["novel"] = {"type": "boolean", "enum": [True]}
        schema["$defs"]["NovelChoice"] = new
        known = schema["properties"]["intents"]["items"]
        schema["properties"]["intents"]["items"] = {"anyOf": [known, {"$ref": "#/$defs/NovelChoice"}]}
    schema["$defs"]["Choice"]["properties"]["novel"] = {"type": "boolean", "enum": [False]}
    return schema


def same_schema(answer_type: type[BaseModel], nearest: Sequence[LibraryEntry]) -> Schema:
    """Return the schema of the answer whether a behaviour is one of the ``nearest``.

    Args:
        answer_type: The class of the answer.
        nearest: The known intents that may be chosen.
    """
    labels = [sanitize(entry.label) for entry in nearest]
    return _with_values(answer_type.model_json_schema(), {"Same.same_as": labels, "HowTo.mode": _modes(nearest)})


def change_schema(answer_type: type[BaseModel], choices: Mapping[str, Sequence[LibraryEntry]]) -> Schema:
    """Return the schema of a modifier's answer.

    Args:
        answer_type: The class of the answer.
        choices: The intents that each vehicle may be given instead, by the vehicle's alias.
    """
    library = [entry for entries in choices.values() for entry in entries]
    labels = [entry.label for entry in library]
    values = {"Instead.bv": choices, "Instead.label": labels, "Instead.mode": _modes(library)}
    return _with_values(answer_type.model_json_schema(), values)


def _modes(library: Iterable[LibraryEntry]) -> list[str]:
    """Return the modes of all intents."""
    return [planner.mode for entry in library for planner in first_of_each_mode(entry)]


def _with_values(schema: Mapping[str, Any], values: Values) -> Schema:
    """Return a copy of a schema in which properties are enums.

    A property that may be null stays so. A property without values, or with more than ``MAX_ENUM_VALUES``, is not
    changed.
    """
    made: Schema = copy.deepcopy(dict(schema))
    classes = {**made.get("$defs", {}), made["title"]: made}
    for name, allowed in values.items():
        owner, _, key = name.partition(".")
        distinct = list(dict.fromkeys(allowed))
        if owner not in classes or not 0 < len(distinct) <= MAX_ENUM_VALUES:
            continue
        enum = {"type": "string", "enum": distinct}
        nullable = "anyOf" in classes[owner]["properties"][key]
        classes[owner]["properties"][key] = {"anyOf": [enum, {"type": "null"}]} if nullable else enum
    return made
