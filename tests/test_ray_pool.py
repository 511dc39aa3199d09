"""The pool of a Ray cluster, with a process in Ray's place: hangs, deaths, unfit nodes (Ray: ``test_batch_ray.py``)."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import pytest
import ray_samples

from sumo_adv.campaigns.local import Stop
from sumo_adv.campaigns.ray_pool import CLUSTER_TIMEOUT_S, RayPool
from sumo_adv.campaigns.results import Done
from sumo_adv.errors import SumoAdvError, UsageError


@dataclass(frozen=True)
class Job:
    """A job with its name."""

    id: str


JOBS = [Job(name) for name in "abcd"]


def pool(driver: Any, stop: Stop | None = None, told: list[str] | None = None) -> RayPool:
    said = [] if told is None else told
    return RayPool(
        ray_samples.mute, ray_samples.mute, 9, "10.0.0.1:6379", stop or Stop(), driver=driver, tell=said.append
    )  # type: ignore[arg-type]


def run(driver: Any) -> tuple[dict[str, str], list[str]]:
    """Where each job was done, and what was told of nodes."""
    where, told = dict[str, str](), list[str]()
    with_ray = pool(driver, told=told)
    try:
        run_in(with_ray, where)
    finally:
        with_ray.close()
    return where, told


def run_in(with_ray: RayPool, where: dict[str, str]) -> None:
    with_ray.run(
        JOBS, with_ray.put("needs"), lambda: 0, lambda job, node: Done(job.id, {"node": node}),
        lambda job, why, text: Done(job.id, {"node": why}),
        lambda job, done: where.update({job.id: str((done.row or {})["node"])}),
    )  # fmt: skip


def test_a_cluster_that_does_not_answer_is_given_up_after_ten_seconds() -> None:
    began = time.monotonic()
    with pytest.raises(UsageError, match=r"No Ray cluster answers at 10\.0\.0\.1:6379 \(no answer within 10 s\)"):
        pool(ray_samples.mute)
    assert CLUSTER_TIMEOUT_S == 10.0 and time.monotonic() - began >= CLUSTER_TIMEOUT_S


def test_ctrl_c_ends_the_wait_for_a_cluster() -> None:
    stop = Stop()
    threading.Timer(0.5, lambda: setattr(stop, "drain", True)).start()
    with_ray = pool(ray_samples.mute, stop)
    assert with_ray.processors == 0
    run_in(with_ray, where := dict[str, str]())
    with_ray.close()
    assert where == {}


def test_without_ray_the_extra_is_named() -> None:
    with pytest.raises(UsageError, match=r"--ray needs Ray\. Ray is not installed: pip install 'sumo-adv\[ray\]'\."):
        pool(ray_samples.not_installed)


def test_a_node_without_the_input_is_named_and_gets_no_job() -> None:
    where, told = run(ray_samples.half_fit)
    assert where == dict.fromkeys("abcd", ray_samples.GOOD.id)
    assert told == ["The node bad is left out: There is no file a.net.xml on this node."]


def test_jobs_of_a_node_that_turns_out_to_be_unfit_are_done_elsewhere() -> None:
    where, told = run(ray_samples.fails_later)
    assert where == dict.fromkeys("abcd", ray_samples.GOOD.id)
    assert told == ["The node bad is left out: The file is gone."]


def test_where_no_node_is_fit_it_is_refused() -> None:
    with pytest.raises(UsageError, match=r"No node of the Ray cluster at 10\.0\.0\.1:6379 can be used \(bad: There is"):
        run(ray_samples.unfit)


def test_a_cluster_that_dies_is_one_sentence_and_what_was_done_is_kept() -> None:
    where = dict[str, str]()
    with_ray = pool(ray_samples.dies)
    with pytest.raises(SumoAdvError, match=r"6379 was lost \(No GCS within 60 seconds\)\. Finished work is kept: "):
        run_in(with_ray, where)
    with_ray.close()
    assert where == {"a": "1"}


def test_lost_jobs_are_tried_again() -> None:
    assert run(ray_samples.loses)[0] == dict.fromkeys("abcd", "1")


def test_what_cannot_be_run_anywhere_ends_the_batch() -> None:
    with pytest.raises(SumoAdvError, match="The disk is full"):
        run(ray_samples.raises)
