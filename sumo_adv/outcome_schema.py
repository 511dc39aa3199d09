"""Define the schema of ``outcome.json``, and migrate files of schema 1."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sumo_adv.errors import UsageError

OUTCOME_SCHEMA = 2
GONE = ("verdict_version",)
GONE_FROM_ATTEMPTS = ("avoidable", "predicted_valid")
GONE_FROM_OUTCOME = (
    "avoidable", "hazard_time", "kind", "sensitivity", "latest_careful", "latest_manoeuvre", "reacting",
)  # fmt: skip
GONE_FROM_IMPACT = ("delta_v", "ego_side")
"""Keys of schema 1 that schema 2 does not have. docs/verdicts.md says what replaces them."""
LEVELS_VERSION = 2  # ``verdict_version`` of files of schema 1 that have levels


def check_schema(document: Mapping[str, Any], file: Path, packs: Path | None = None) -> None:
    """Refuse a file of schema 1.

    Args:
        document: The content of ``outcome.json``.
        file: The path of the file.
        packs: The campaign's folder if the file is in one of its packs, otherwise None.

    Raises:
        UsageError: The file has schema 1.
    """
    if document.get("schema") != 1:
        return
    if packs is not None:
        unpack = f"'sumo-adv batch unpack {packs}', then 'sumo-adv judge {packs / 'unpacked'}'"
        raise UsageError(f"{file} has schema 1, in a pack: judge it again with {unpack}.")
    raise UsageError(f"{file} has schema 1: judge it again with 'sumo-adv judge {file.parent}'.")


def migrated(document: Mapping[str, Any], file: Path) -> dict[str, Any]:
    """Convert a file of schema 1 to schema 2. Its figures are kept as they are.

    Args:
        document: The content of ``outcome.json``.
        file: The path of the file.

    Returns:
        The content in schema 2.

    Raises:
        UsageError: The file is so old that it has no levels.
    """
    if document.get("verdict_version") != LEVELS_VERSION:
        raise UsageError(f"{file} was written before verdicts had levels: rerun it.")
    verdict = document["outcome"]
    made = _without(document, GONE) | {
        "schema": OUTCOME_SCHEMA,
        "attempts": [_without(attempt, GONE_FROM_ATTEMPTS) for attempt in document["attempts"]],
    }  # fmt: skip
    if verdict is not None:
        made["outcome"] = _without(verdict, GONE_FROM_OUTCOME) | {
            "impact": None if verdict["impact"] is None else _without(verdict["impact"], GONE_FROM_IMPACT),
            "in_loop": verdict["in_loop"] if "in_loop" in verdict else _in_loop(verdict),
        }
    return made


def _in_loop(verdict: Mapping[str, Any]) -> dict[str, str] | None:
    """Return the in-loop answers of a file that has them as simulated ``references``."""
    if verdict["references"] is None:
        return None
    answers = verdict["references"] if verdict["simulated"] else {}
    return {name: answer for name, answer in answers.items() if answer != "not_applicable"}


def _without(table: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key not in keys}
