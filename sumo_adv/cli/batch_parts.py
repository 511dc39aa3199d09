"""What ``batch`` composes for its workers: functions importable by name, since they go to other processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sumo_adv.batch.nouns import Parts
from sumo_adv.cli.memory_common import make_similarity
from sumo_adv.cli.models import open_agents
from sumo_adv.cli.records import load
from sumo_adv.report.folder import staged, write_run
from sumo_adv.report.outcome import MODEL_FILE


def records(path: Path) -> Iterator[tuple[str, str] | str]:
    """Id and hash of the content of each Waymo record in a file, or what is wrong with it. Raises UsageError."""
    from sumo_adv.womd.reader import read_records

    wrong: list[str] = []
    for record in read_records(path, told=lambda error: wrong.append(str(error))):
        yield from wrong
        wrong.clear()
        yield record.scenario_id, record.content
    yield from wrong


def batch_parts() -> Parts:
    """All of them."""
    return Parts(load, records, open_agents, make_similarity, staged, write_run, MODEL_FILE)
