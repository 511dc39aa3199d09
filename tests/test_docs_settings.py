"""``docs/settings.md`` cannot drift: its names, defaults and bounds are those of the models that read settings and
scenario files."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from enum import EnumType
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

import pytest
from cli_samples import ROOT
from pydantic import BaseModel, SecretStr
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from sumo_adv.asked import Asked, Attacker, RequestOrigin
from sumo_adv.config import LimitSettings, ModelSettings, Settings
from sumo_adv.config_odd import Odd
from sumo_adv.ego_sensing import EgoSensing
from sumo_adv.ego_way import EgoMove, SightStretch
from sumo_adv.script import Action, Condition, Script
from sumo_adv.simulation.scenario import Adversary, AttackWindow, Demand, Ego, Label, ObstacleBox, Scenario, Signals

PAGE = ROOT / "docs" / "settings.md"
MODELS: Mapping[str, type[BaseModel]] = {
    "Settings of a run": Settings, "Limits": LimitSettings, "Sensors": EgoSensing,
    "Operational design domain": Odd, "Servers of language models": ModelSettings,
}  # fmt: skip
PARTS: Mapping[str, type[BaseModel]] = {  # of a scenario file, all in one table
    "": Scenario, "[demand] ": Demand, "[ego] ": Ego, "[window] ": AttackWindow, "[adversary] ": Adversary,
    "[signals] ": Signals, "[label] ": Label, "[written] ": RequestOrigin, "[asked] ": Asked, "[[...]] ": ObstacleBox,
    "[[scripts]] ": Script, "[[scripts.actions]] ": Action, "[scripts.actions.when] ": Condition,
    "[[moves]] ": EgoMove, "[[sight]] ": SightStretch,
    "[[attackers]] ": Attacker,
}  # fmt: skip
WORDS = {float: "number", int: "whole number", str: "text", bool: "true, false", Path: "path", SecretStr: "text"}
SIGNS = {"gt": "> {}", "ge": ">= {}", "lt": "< {}", "le": "<= {}", "min_length": "{} or more characters"}


def rows_of(heading: str) -> dict[str, tuple[str, str]]:
    """The table below a heading of the page: name -> default and what is allowed."""
    text = PAGE.read_text(encoding="utf-8")
    part = re.search(rf"^#+ {re.escape(heading)}\n(.*?)(?=^#|\Z)", text, re.MULTILINE | re.DOTALL)
    assert part is not None, f"the page has no heading {heading!r}"
    lines = [line.strip("| ").split(" | ") for line in part[1].splitlines() if line.startswith("| `")]
    return {cells[0].strip("`"): (cells[1], cells[2]) for cells in lines if len(cells) == 4}


def fields_of(model: type[BaseModel]) -> Iterator[tuple[str, str, str]]:
    """Name, default and allowed values, as the page has them."""
    for name, field in model.model_fields.items():
        if model is Settings and name in ModelSettings.model_fields:
            continue  # they have a table of their own
        yield field.alias or name, default_of(field), allowed_of(field)


def default_of(field: FieldInfo) -> str:
    if field.is_required():
        return "needed"
    value = field.get_default(call_default_factory=True)
    if value is None or value == () or value == {} or isinstance(value, BaseModel) or value is PydanticUndefined:
        return "-"
    if isinstance(value, tuple):
        return ", ".join(map(number, value))
    return number(value) if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)


def number(value: float) -> str:
    """Without ``.0`` behind whole ones."""
    return str(int(value)) if value == int(value) else str(value)


def allowed_of(field: FieldInfo) -> str:
    return _words(field.annotation, field.metadata)


def _words(kind: Any, metadata: list[Any]) -> str:
    """A type and its bounds in words."""
    if hasattr(kind, "__metadata__"):
        further = [m for m in kind.__metadata__ if not isinstance(m, FieldInfo)]
        inner = [m for f in kind.__metadata__ if isinstance(f, FieldInfo) for m in f.metadata]
        return _words(kind.__origin__, [*further, *inner, *metadata])
    bound_values = ((sign, getattr(m, sign, None)) for m in metadata for sign in SIGNS)
    bounds = list(dict.fromkeys(SIGNS[sign].format(number(value)) for sign, value in bound_values if value is not None))
    bounds = ["not empty" if b == "1 or more characters" else b for b in bounds]
    origin, inside = get_origin(kind), get_args(kind)
    if origin is Literal:
        words = ", ".join(sorted(str(value) for value in inside))  # equal ones share an order
    elif origin is tuple and inside[-1] is not Ellipsis:
        words = " and ".join(_words(each, []) for each in inside)
    elif origin is tuple:
        words = f"list: {_words(inside[0], [])}"
    elif origin is dict or kind is dict:
        words = "table"
    elif inside:  # a union
        words = " or ".join(dict.fromkeys(_words(each, []) for each in inside if each is not NoneType))
    elif isinstance(kind, EnumType):
        words = ", ".join(kind)
    elif isinstance(kind, type) and issubclass(kind, BaseModel):
        return "table"
    else:
        words = WORDS[kind]
    return ", ".join([words, *bounds])


@pytest.mark.parametrize("heading", MODELS)
def test_the_page_says_what_is_read(heading: str) -> None:
    assert rows_of(heading) == {name: (default, allowed) for name, default, allowed in fields_of(MODELS[heading])}


def test_the_page_has_every_key_of_a_scenario_file() -> None:
    keys = {
        f"{part}{name}": (default, allowed)
        for part, model in PARTS.items()
        for name, default, allowed in fields_of(model)
        if not allowed.endswith("table") or model is Ego  # a part has rows of its own; the ego's parameters have none
    }
    assert rows_of("Scenario files") == keys


def test_a_changed_default_would_be_seen() -> None:
    attempts = {name: (default, allowed) for name, default, allowed in fields_of(Settings)}["attempts"]
    assert attempts == ("400", "whole number, >= 1, <= 10000")
