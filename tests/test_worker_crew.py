"""Worker processes that stay from one batch to the next, and the end of their work by a clock."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from sumo_adv.campaigns.local import OVERTIME_S, Crew, LocalWorkers, Stop, WorkerPace
from sumo_adv.campaigns.results import Done


@dataclass(frozen=True)
class Nap:
    """A job that takes some seconds."""

    id: str
    seconds: float


class Sleeper:
    """Runs naps, and answers with its process and its setup."""

    def __init__(self, setup: str) -> None:
        self.setup = setup

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def renew(self, setup: str) -> None:
        self.setup = setup

    def run(self, job: Nap, *, last: bool) -> Done:
        time.sleep(job.seconds)
        return Done(job.id, {"process": os.getpid(), "setup": self.setup})


def failed(job: Any, why: str, text: str) -> Done:
    return Done(job.id, {"failure": why})


def answers(workers: LocalWorkers, jobs: Sequence[Nap]) -> dict[str, Any]:
    """Run naps; the answers by the id of the nap."""
    done: dict[str, Any] = {}
    workers.run(jobs, lambda job, result: done.update({job.id: result.row}))
    return done


def test_a_crew_serves_two_batches_with_the_same_process() -> None:
    """The second batch has a setup of its own."""
    pace = WorkerPace(1, 60.0, 100)
    with Crew(Sleeper) as crew:
        first, second = (crew.workers(setup, pace, failed, Stop()) for setup in ("one", "two"))
        one = answers(first, [Nap("a", 0.0)])["a"]
        first.close()
        two = answers(second, [Nap("b", 0.0)])["b"]
        second.close()
    assert (one["setup"], two["setup"]) == ("one", "two")
    assert one["process"] == two["process"] != os.getpid()


def test_a_job_that_goes_on_long_after_the_end_is_left_out(tmp_path: Path) -> None:
    """The work should have ended 6 s ago, and a nap of a minute is killed 8 s after the end, so in 2 s."""
    began = time.monotonic()
    pace = WorkerPace(2, 60.0, 100, until=time.time() + 2.0 - OVERTIME_S)
    workers = LocalWorkers("", pace, tmp_path, failed, Stop(), Sleeper)
    assert answers(workers, [Nap("long", 60.0)]) == {}
    workers.close()
    assert time.monotonic() - began < 30.0
