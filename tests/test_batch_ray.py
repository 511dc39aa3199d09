"""Batches and crash rates on a Ray cluster of two nodes on this machine; skipped without Ray (extra ``ray``)."""

from __future__ import annotations

import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from batch_samples import INPUTS, QUICK, SMALL, clean, summary, table
from cli_samples import PATIENCE, ROOT, Done, Program, files_of, refused
from test_interrupt import children_of, wait_until

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'sumo-adv[ray]'")

from ray.cluster_utils import Cluster  # noqa: E402

from sumo_adv.app import cluster_processors  # noqa: E402
from sumo_adv.campaigns.cluster import (  # noqa: E402
    Needs,
    unfit,
    wrong_content,
)
from sumo_adv.campaigns.local import WorkerPace  # noqa: E402
from sumo_adv.errors import UsageError  # noqa: E402
from sumo_adv.memory.bank import MemoryBank  # noqa: E402
from sumo_adv.rate.blocks import (  # noqa: E402
    Block,
    RateNodeContent,
    RatePlan,
    block,
)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes with one processor each."""
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    made.add_node(num_cpus=1)
    made.wait_for_nodes()
    yield made
    made.shutdown()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> tuple[Program, Done]:
    """The small plan on this machine's own workers."""
    program = Program(tmp_path_factory.mktemp("whole"), caches)
    return program, program(*SMALL, "--workers", "2")


def ray_workers() -> list[int]:
    """Processes that run an episode's task."""
    pids = []
    for pid in children_of(os.getpid()):
        try:
            if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"ray::episode"):
                pids.append(pid)
        except OSError:
            continue
    return pids


def settled(outcomes: dict[str, bytes]) -> dict[str, bytes]:
    """Files without those that say how long it took."""
    return {name: data for name, data in outcomes.items() if not name.endswith("outcome.json")}


def test_a_cluster_gives_the_same_rows_and_folders(program: Program, whole: tuple[Program, Done], cluster: Any) -> None:
    report = summary(program(*SMALL, "--ray", cluster.address, "--json"))
    assert (report["finished"], report["ran"], report["failed"]) == (4, 4, 0)
    assert table(program.folder / "out") == table(whole[1].folder)
    clustered, local = (settled(files_of(folder / "runs")) for folder in (program.folder / "out", whole[1].folder))
    assert clustered == local
    assert summary(program(*SMALL, "--json"))["ran"] == 0  # gone on with without a cluster
    clean(program)


@pytest.mark.parametrize("victim", ["worker", "node"])
def test_kill_9_on_the_cluster_loses_nothing(
    program: Program, whole: tuple[Program, Done], cluster: Any, victim: str
) -> None:
    spare = cluster.add_node(num_cpus=1) if victim == "node" else None
    cluster.wait_for_nodes()
    with program.start(*SMALL, "--ray", cluster.address, "--json") as process:
        wait_until(process, lambda: len(ray_workers()) >= 2)
        time.sleep(1.0)
        if spare is None:
            os.kill(ray_workers()[0], signal.SIGKILL)
        else:
            cluster.remove_node(spare, allow_graceful=False)
        out, err = process.communicate(timeout=PATIENCE)
    report = json.loads(out)  # on stderr Ray tells what it lost
    assert (process.returncode, report["finished"], report["failed"]) == (0, 4, 0), err
    assert table(program.folder / "out") == table(whole[1].folder)


def test_a_corrupt_network_fails_by_name_on_a_cluster_too(program: Program, cluster: Any) -> None:
    (program.folder / "corrupt.net.xml").write_text("<net>")
    done = program("batch", INPUTS[0], "corrupt.net.xml", *QUICK, "--out", "out", "--ray", cluster.address)
    assert done.status == 0 and "Traceback" not in done.err
    good, corrupt = sorted(table(done.folder), key=lambda row: row["failure"])
    assert good["failure"] == "" and "corrupt.net.xml" in corrupt["failure"]


def test_what_is_learnt_during_comes_back(program: Program, cluster: Any) -> None:
    (program.folder / "bank.sqlite").write_bytes((ROOT / "memory_bank.sqlite").read_bytes())
    options = ("--learn", "during", "--memory", "bank.sqlite", "--ray", cluster.address)
    done = program(*SMALL, *options)
    assert done.status == 0
    with MemoryBank.open(program.folder / "bank.sqlite", read_only=True) as bank:
        assert bank.evidence()


def test_a_crash_rate_is_the_same_on_a_cluster(program: Program, cluster: Any) -> None:
    words = ["rate", ROOT / "benchmarks" / "rate" / "side_by_side.toml", "--errors", "100", "--duration", "2"]
    words += ["--pilot", "20", "--runs", "40", "--json"]
    here = program(*words, "--workers", "1", "--out", "here")
    there = program(*words, "--ray", cluster.address, "--out", "there")
    assert there.status == 0, there.err
    assert json.loads(there.out) == {**json.loads(here.out), "folder": "there"}
    folders = [program.folder / name for name in ("here", "there")]
    assert files_of(folders[0] / "blocks") == files_of(folders[1] / "blocks")
    none = program(*words, "--ray", "127.0.0.1:1", "--out", "none")
    refused(none, 2, "No Ray cluster", "127.0.0.1:1")


def test_a_crash_rate_of_another_content_on_a_node_is_refused(tmp_path: Path) -> None:
    plan = RatePlan(ROOT / "benchmarks" / "rate" / "side_by_side.toml", "idm")
    with pytest.raises(UsageError, match=r"On a node, the content of .* differs"):
        block(RateNodeContent(plan, WorkerPace(1, 60.0, 1), "0" * 64), Block("plain", 0, None))
    gone = RatePlan(tmp_path / "gone.toml", "idm")
    with pytest.raises(UsageError, match=r"On a node: There is no file .*gone\.toml"):
        block(RateNodeContent(gone, WorkerPace(1, 60.0, 1), "0" * 64), Block("plain", 0, None))


def test_a_node_that_lacks_something_says_what(tmp_path: Path) -> None:
    assert unfit(Needs({}, (), ("idm", "ego_samples:CalmEgo"))) == ""
    other = unfit(Needs({"libsumo": "0.1"}, (), ()))
    assert other == "it has other versions: libsumo 1.28.0 there, 0.1 here; install the same versions on all nodes"
    assert "No module named 'nowhere'" in unfit(Needs({}, (), ("nowhere:Mine",)))
    assert "no file" in unfit(Needs({}, ((tmp_path / "b.net.xml", "0" * 64, None),), ()))


def test_a_driver_that_no_node_has_is_a_sentence(program: Program, cluster: Any) -> None:
    done = program("batch", INPUTS[0], "--egos", "nowhere:Mine", *QUICK, "--out", "out", "--ray", cluster.address)
    assert done.status == 2 and "is left out: The module of the ego 'nowhere:Mine'" in done.err
    assert f"No node of the Ray cluster at {cluster.address} can be used" in done.err.splitlines()[-1]
    clean(program)


def test_a_hunt_is_sized_by_the_cluster(cluster: Any) -> None:
    assert cluster_processors(cluster.address) == 2


def test_a_server_that_is_no_cluster_is_a_sentence_too(program: Program) -> None:
    with socket.socket() as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        place = f"127.0.0.1:{mute.getsockname()[1]}"
        refused(program(*SMALL, "--ray", place, "--json"), 2, "No Ray cluster", place, "no answer within 10 s")


def test_no_cluster_is_a_sentence(program: Program) -> None:
    done = program(*SMALL, "--ray", "127.0.0.1:1", "--json")
    refused(done, 2, "No Ray cluster", "127.0.0.1:1")


def test_another_content_on_a_node_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.net.xml"
    file.write_bytes((ROOT / "networks" / "two_way.net.xml").read_bytes())
    assert "differs from the plan" in wrong_content(file, "0" * 64, None)
    assert "no file" in wrong_content(tmp_path / "b.net.xml", "0" * 64, None)
