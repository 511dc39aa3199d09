"""``--set NAME=VALUE``: settings by their own names, for commands that run many episodes."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any

from sumo_adv.errors import UsageError


def set_values(given: Sequence[str], example: str) -> dict[str, Any]:
    """``--set`` as data: a value is what TOML makes of it, else text. Raises UsageError, with the ``example``."""
    values: dict[str, Any] = {}
    for each in given:
        name, equals, value = (word.strip() for word in each.partition("="))
        if not equals or not name:
            raise UsageError(f"--set takes NAME=VALUE, such as {example}, not '{each}'.")
        try:
            values[name] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            values[name] = value
    return values
