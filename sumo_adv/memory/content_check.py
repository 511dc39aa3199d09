"""Columns of the bank to nouns. Its results are as if the program had written the file.

Each function raises ValueError, TypeError, RecursionError or BankError with a text that names the fault.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from sumo_adv.datatypes import Parameter, Planner, acceleration_of
from sumo_adv.memory.composition_record import COMPOSITION, composition_of
from sumo_adv.memory.records import Evidence, IntentRecord, SceneSignature, canonical, is_number

MOST_BRACKETS = 100  # in a setting: a few are in use, and about 1,000 nested ones exceed Python's recursion limit
MERGED, EPSILON = "merged.", "epsilon."  # settings with values of one kind


def intent(key: str, label: str, description: str, applies: str, status: str) -> IntentRecord:
    """An intent; ``key``: its label in canonical form."""
    if key != canonical(label):
        raise ValueError(f"the key of the intent {label[:80]!r} is not that of its label")
    relations = json.loads(applies)
    if not isinstance(relations, list) or not all(isinstance(each, str) for each in relations):
        raise ValueError(f"the intent {label[:80]!r} must apply to a list of relations")
    return IntentRecord(label, description, tuple(relations), status)


def planner(
    label: str, planner_hash: str, mode: str, source: str, parameters: str, parent: str | None, origin: str
) -> Planner:
    """A planner of the intent ``label``."""
    table = json.loads(parameters)
    if not isinstance(table, list) or not all(isinstance(each, list) and 5 <= len(each) <= 6 for each in table):
        raise ValueError("the parameters of a planner must be lists of name, default, low, high, unit and meaning")
    made = Planner(label, mode, source, tuple(Parameter(*each) for each in table), origin, parent)
    if made.hash != planner_hash:
        raise ValueError(f"the planner {mode[:80]!r} has another text than its hash says")
    parameters_of(made)
    return made


def parameters_of(made: Planner) -> None:
    """Check the parameters of a planner: texts, finite numbers in order, each name once."""
    names = [p.name for p in made.parameters]
    texts = [text for p in made.parameters for text in (p.name, p.unit, p.meaning)]
    if not all(isinstance(text, str) for text in texts) or len(set(names)) < len(names):
        raise ValueError(f"the planner {made.mode[:80]!r} has a parameter without a name, unit or meaning of its own")
    for p in made.parameters:
        if not all(map(is_number, (p.default, p.low, p.high))) or not p.low <= p.default <= p.high:
            raise ValueError(f"the parameter {p.name[:40]!r} must have finite numbers with low <= default <= high")


def evidence(label: str, planner_hash: str, values: Sequence[Any]) -> Evidence:
    """Evidence about the intent ``label``, from the columns of ``rows``."""
    geometry, relation, relative, controller, parameters, acceleration, knots, delay, attempts, min_ttc, *rest = values
    collided, critical, feasible, rear_end, valid, strict, version, network, seed, created = rest
    return Evidence(
        label=label,
        planner_hash=planner_hash,
        scene=SceneSignature(geometry, relation, json.loads(relative), controller),
        attempts=attempts,
        min_ttc=math.inf if min_ttc is None else min_ttc,
        collided=bool(collided),
        critical=bool(critical),
        feasible=bool(feasible),
        rear_end=bool(rear_end),
        valid=None if valid is None else bool(valid),
        strict=None if strict is None else bool(strict),
        version=version,
        network=network,
        seed=seed,
        parameters=json.loads(parameters),
        acceleration=acceleration if knots is None else acceleration_of(json.loads(knots)),
        delay=delay,
        created=created,
    )


def setting(key: str, text: str) -> Any:
    """The value of a setting."""
    if text.count("[") + text.count("{") > MOST_BRACKETS:
        raise ValueError("it nests deeper than a setting does")
    value = json.loads(text)
    if key.startswith(MERGED) and not isinstance(value, str):
        raise ValueError("it must be the label of an intent")
    if key.startswith(EPSILON):
        ok = isinstance(value, dict) and is_number(value.get("epsilon")) and isinstance(value.get("calibrated_on"), str)
        if not ok:
            raise ValueError("it must hold a number, epsilon, and a text, calibrated_on")
    if key.startswith(COMPOSITION) and key != composition_of(value).key:
        raise ValueError("its key must be that of its label")
    return value
