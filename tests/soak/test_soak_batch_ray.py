"""A batch on a cluster of two nodes, a node or a worker of which is killed, twenty times, at random times."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from batch_samples import INPUTS, QUICK, clean, patient, summary, table, thin_out
from cli_samples import Program

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'sumo-adv[ray]'")

from ray.cluster_utils import Cluster  # noqa: E402
from test_batch_ray import ray_workers  # noqa: E402

KILLS = int(os.environ.get("SOAK_KILLS", "20"))
PLAN = ("batch", *INPUTS, "--seeds", "10", *QUICK, "--out", "out", "--json")
EPISODES = 20
PAUSE = (0.2, 8.0)  # s between kills


class Victims:
    """A cluster with a head that stays, and the second node, which may be killed."""

    def __init__(self, cluster: Any, rng: random.Random) -> None:
        self._cluster, self._rng = cluster, rng
        self._second = cluster.add_node(num_cpus=1)

    def node(self) -> bool:
        """Kill the second node, with all its processes, and let another one join."""
        self._cluster.remove_node(self._second, allow_graceful=False)
        self._second = self._cluster.add_node(num_cpus=1)
        return True

    def worker(self) -> bool:
        """Kill a process that runs an episode's task; whether there was one."""
        workers = ray_workers()
        if workers:
            os.kill(self._rng.choice(workers), signal.SIGKILL)
        return bool(workers)


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A head with one processor."""
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    yield made
    made.shutdown()


@pytest.mark.soak
@pytest.mark.parametrize("victim", ["worker", "node"])
def test_killed_twenty_times_on_a_cluster(program: Program, tmp_path: Path, cluster: Any, victim: str) -> None:
    whole, broken = (Program(tmp_path / name, program._caches) for name in ("whole", "broken"))
    summary(whole(*PLAN, "--workers", "2"))
    rng = random.Random(8)
    victims, kills, rounds = Victims(cluster, rng), 0, 0
    kill = getattr(victims, victim)
    cluster.wait_for_nodes()
    while kills < KILLS:
        rounds += 1
        with broken.start(*PLAN, "--ray", cluster.address) as process:
            while kills < KILLS and process.poll() is None:
                time.sleep(rng.uniform(*PAUSE))
                if process.poll() is None:
                    kills += kill()
            done = patient(broken, process)
        assert done.status == 0, done.err
        if kills < KILLS:
            thin_out(broken)
    said = summary(broken(*PLAN, "--retry-failed", "--workers", "2"))
    print(
        f"\n{kills} kills of a {victim} in {rounds} rounds; {said['ran']} of {EPISODES} episodes were left for the end"
    )
    assert said["finished"] == EPISODES and said["failed"] == 0
    assert table(broken.folder / "out") == table(whole.folder / "out")
    clean(broken)
