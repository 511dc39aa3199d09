"""``--set NAME=VALUE``: settings by their own names, for commands that run many episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sumo_adv.errors import UsageError
from sumo_adv.parsing import parse_toml


def set_values(given: Sequence[str], example: str) -> dict[str, Any]:
    """``--set`` as data: a value is what TOML makes of it, else text. Raises UsageError, with the ``example``."""
    values: dict[str, Any] = {}
    for each in given:
        name, equals, value = (word.strip() for word in each.partition("="))
        if not equals or not name:
            raise UsageError(f"--set takes NAME=VALUE, such as {example}, not '{each}'.")
        try:
            values[name] = parse_toml(f"value = {value}")["value"]
        except ValueError:
            values[name] = value
    return values
