"""Work on a Ray cluster: a task a job, as many at a time as the cluster has processors.

What a lost node or worker was at is Ray's to try again, ``LOSSES`` times.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import socket
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.local import Pace, Stop
from sumo_adv.campaigns.nouns import Done
from sumo_adv.errors import SumoAdvError, UsageError

LOSSES = 5  # times that Ray tries a job again after its worker or node was lost
JOIN_SECONDS = 60.0  # for a node to say its versions
LOST_SECONDS = 10.0  # for Ray to say that a node is lost which did not answer
KNOCK_SECONDS = 10.0
DESK = "sumo_adv-ray-"  # folders of Ray workers, with their process ids
TICK = 0.5  # s


class RayPool:
    """Runs ``task(sent, job)`` on the cluster for each job; ``sent`` is put into Ray's store once (``put``).

    Raises UsageError: Ray is not installed, no cluster at ``address``, another version on a node.
    """

    def __init__(
        self, task: Callable[..., Any], pace: Pace, address: str, versions: Mapping[str, str], stop: Stop
    ) -> None:
        self._stop = stop
        self._aside = redirect_stdout(sys.stderr)  # where Ray tells of lost workers and nodes: it prints to stdout
        self._ray = connect(address)
        self._aside.__enter__()
        try:
            check_nodes(self._ray, versions)
            self._task = self._ray.remote(num_cpus=1, max_retries=LOSSES, max_calls=pace.recycle)(task)
        except BaseException:
            self.close()
            raise

    def put(self, sent: Any) -> Any:
        """What every task needs, as a reference to Ray's store."""
        return self._ray.put(sent)

    def run(
        self,
        jobs: Iterable[Any],
        sent: Callable[[], Any],
        keep: Callable[[Any, Any], Done],
        lost: Callable[[Any, str, str], Done],
        told: Callable[[Any, Done], None],
    ) -> None:
        """Each job; ``told`` of what ``keep`` makes of its task's result, or ``lost`` of its loss (job, why, text).

        sent: the reference that tasks get which begin from now on. Raises SumoAdvError.
        """
        waiting, running = deque(jobs), dict[Any, Any]()
        while not self._stop.now:
            while waiting and len(running) < self._places() and not self._stop.drain:
                job = waiting.popleft()
                running[self._task.remote(sent(), job)] = job
            if not running:
                break
            for ready in self._ray.wait(list(running), timeout=TICK)[0]:
                job = running.pop(ready)
                told(job, self._result(job, ready, keep, lost))

    def close(self) -> None:
        """Leave the cluster; what still runs there is ended by Ray."""
        self._ray.shutdown()
        self._aside.__exit__(None, None, None)

    def _places(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 0)))

    def _result(
        self, job: Any, ready: Any, keep: Callable[[Any, Any], Done], lost: Callable[[Any, str, str], Done]
    ) -> Done:
        try:
            result = self._ray.get(ready)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause
            raise cause if isinstance(cause, SumoAdvError) else SumoAdvError(f"A node failed ({cause}).") from error
        except self._ray.exceptions.RayError as error:
            return lost(job, f"Its worker or node was lost {LOSSES + 1} times.", str(error))
        return keep(job, result)


def connect(address: str) -> Any:
    """Ray, connected. Raises UsageError."""
    try:
        import ray
    except ImportError as error:
        raise UsageError("--ray needs Ray, which is not installed: pip install 'sumo-adv[ray]'.") from error
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, configure_logging=True, logging_level=logging.ERROR)
    except Exception as error:
        reason = str(error).strip().splitlines()[0].rstrip(".") if str(error).strip() else type(error).__name__
        raise UsageError(f"No Ray cluster answers at {address} ({reason}); see ray start.") from error
    return ray


def _knock(address: str) -> None:
    """Raises OSError if no server listens at HOST:PORT: Ray itself would go on trying for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), KNOCK_SECONDS).close()


def check_nodes(ray: Any, versions: Mapping[str, str]) -> None:
    """Raises UsageError if a node has other versions of what takes part in the numbers."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    alive = [node for node in ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]
    if not alive:
        raise UsageError("The Ray cluster has no node with a processor.")
    task = ray.remote(num_cpus=1, max_retries=LOSSES)(node_versions)
    for node in alive:
        strategy = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
        name = node["NodeManagerHostname"]
        try:
            installed = ray.get(task.options(scheduling_strategy=strategy).remote(list(versions)), timeout=JOIN_SECONDS)
        except ray.exceptions.RayError as error:
            if _gone(ray, node["NodeID"]):
                continue
            raise UsageError(f"The node {name} cannot run sumo_adv ({_first_line(error)}).") from error
        differing = [f"{k} {installed.get(k)} there, {v} here" for k, v in versions.items() if installed.get(k) != v]
        if differing:
            raise UsageError(f"The node {name} has other versions: {'; '.join(differing)}; install the same on all.")


def _gone(ray: Any, node_id: str) -> bool:
    """Whether a node that did not answer was lost. Ray may notice a killed node only some seconds later."""
    until = time.monotonic() + LOST_SECONDS
    while any(node["NodeID"] == node_id and node["Alive"] for node in ray.nodes()):
        if time.monotonic() > until:
            return False
        time.sleep(TICK)
    return True


def _first_line(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip() if lines else type(error).__name__


# -- on a node ---------------------------------------------------------------------------------------------------------


def node_versions(names: Iterable[str]) -> dict[str, str]:
    """What this node has of what takes part in the numbers: ``sumo_adv``, ``python``, and packages."""
    import platform
    from importlib import metadata

    import sumo_adv

    versions = {"sumo_adv": sumo_adv.__version__, "python": platform.python_version()}
    for name in set(names) - set(versions):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def desk_folder() -> Path:
    """A folder for this Ray worker process, removed when it ends; those of killed ones are removed now."""
    _sweep()
    folder = Path(tempfile.mkdtemp(prefix=f"{DESK}{os.getpid()}-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _sweep() -> None:
    """Remove what Ray workers left behind that were killed."""
    if not Path("/proc/self").exists():
        return
    for left in Path(tempfile.gettempdir()).glob(f"{DESK}*"):
        if not Path(f"/proc/{left.name.removeprefix(DESK).partition('-')[0]}").exists():
            shutil.rmtree(left, ignore_errors=True)
