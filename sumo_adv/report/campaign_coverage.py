"""The coverage of a campaign: its runs, its bank and its ODDs, read from its folder."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sumo_adv.config_odd import Odd
from sumo_adv.errors import UsageError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.report.coverage import Coverage, coverage_csv, make_coverage
from sumo_adv.report.page.document import write_document

OUTCOME, PLAN, BANK, TABLE = "outcome.json", "plan.json", "bank.sqlite", "coverage.csv"


def campaign_coverage(folder: Path, runs: Sequence[Path], packed: Mapping[str, str], bank: Path) -> Coverage:
    """The coverage of the runs in a campaign's folder.

    packed: the outcomes of packed runs as text, by id. bank: its intents make the cells if the folder has no bank.
    Raises UsageError or BankError.
    """
    own = folder / BANK
    with MemoryBank.open(own if own.is_file() else bank, read_only=True) as opened:
        library = opened.intents()
    return make_coverage(_outcomes(runs, packed), library, _odds(folder / PLAN))


def write_coverage(target: Path, coverage: Coverage) -> Path:
    """Write ``coverage.csv`` into the folder of the pages. Raises UsageError: it cannot be written."""
    write_document(target / TABLE, coverage_csv(coverage))
    return target / TABLE


def _outcomes(runs: Sequence[Path], packed: Mapping[str, str]) -> Iterator[dict[str, Any]]:
    """The outcomes that can be read. Damaged ones are told where their pages are made."""
    for run in runs:
        try:
            file = run / OUTCOME
            document = json.loads(file.read_text(encoding="utf-8") if file.is_file() else packed[run.name])
            _ = document["encounter"], document["attempts"], document["ego"]["controller"]
            yield document
        except (OSError, ValueError, KeyError, TypeError):
            continue


def _odds(plan: Path) -> list[Odd]:
    """The ODDs of a campaign's variants; none if a variant has none. Raises UsageError: the plan is damaged."""
    if not plan.is_file():
        return []
    try:
        odds = [variant.get("odd") for variant in json.loads(plan.read_text(encoding="utf-8")).get("settings", ())]
        return [Odd.model_validate(odd) for odd in odds] if all(odds) else []
    except (ValueError, AttributeError) as error:
        raise UsageError(f"{plan} is damaged ({error}); restore it from a copy.") from error
