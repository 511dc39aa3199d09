"""The same estimate on a Ray cluster. Each block is a task. Its worker runs the block in a watched process of its own,
as on one machine, and sends the records back.

Inputs are found on the nodes under the same paths (a shared file system) or are shipped ones; their content is compared
with the plan's.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from sumo_adv.campaigns.cluster import RayPool, desk_folder
from sumo_adv.campaigns.local import LocalWorkers, Pace, Stop
from sumo_adv.campaigns.results import Done
from sumo_adv.errors import UsageError
from sumo_adv.rate.blocks import Block, BlockRunner, failed
from sumo_adv.rate.plan import RatePlan


@dataclass(frozen=True, slots=True)
class Sent:
    """What a node needs for all blocks."""

    plan: RatePlan
    pace: Pace
    content: str


class ClusterBlocks:
    """Runs blocks as Ray tasks. Raises UsageError as ``RayPool`` does."""

    def __init__(self, plan: RatePlan, pace: Pace, address: str, versions: Mapping[str, str], stop: Stop) -> None:
        source = plan.source.absolute() if plan.source.is_file() else plan.source  # nodes work in other folders
        self._pool = RayPool(block, pace, address, versions, stop)
        self._sent = self._pool.put(Sent(replace(plan, source=source), replace(pace, workers=1), plan.content()))

    def run(self, jobs: Iterable[Any], told: Callable[[Any, Done], None]) -> None:
        """Each block, ``told`` of each that is finished. Raises SumoAdvError."""
        self._pool.run(jobs, lambda: self._sent, lambda _, done: done, failed, told)

    def close(self) -> None:
        """Leave the cluster; what still runs there is ended by Ray."""
        self._pool.close()


# -- on a node ---------------------------------------------------------------------------------------------------------

_workers: list[LocalWorkers] = []  # of this Ray worker process: one, from its first block on


def block(sent: Sent, job: Block) -> Done:
    """One block on this node. Raises UsageError: the input is another one here; SimulationError: it failed twice."""
    if not _workers:
        _check(sent)
        workers = LocalWorkers(sent.plan, sent.pace, desk_folder(), failed, Stop(), BlockRunner)
        atexit.register(workers.close)
        _workers.append(workers)
    results: list[Done] = []
    _workers[0].run([job], lambda _, done: results.append(done))
    return results[0]


def _check(sent: Sent) -> None:
    try:
        same = sent.plan.content() == sent.content
    except (UsageError, OSError) as error:
        raise UsageError(f"On a node: {error}") from error
    if not same:
        raise UsageError(f"On a node {sent.plan.source} has another content than here; give all nodes the same files.")
