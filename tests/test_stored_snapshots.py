"""Snapshots that are pickled from process to process."""

from __future__ import annotations

import pickle

from sumo_adv.simulation.stored_snapshots import StoredSnapshots
from sumo_adv.simulation.sumo_states import Snapshot

SNAPSHOTS = [Snapshot(0.1 * k, {"ego": (1.0 * k, 2.0, 90.0, 10.0, "e_0")}) for k in range(4)]


def test_they_are_the_same_after_two_processes() -> None:
    stored = StoredSnapshots(SNAPSHOTS)
    for _ in range(2):
        stored = pickle.loads(pickle.dumps(stored))
        assert len(stored) == 4 and bool(stored)
    assert list(stored) == SNAPSHOTS and stored[-1] == SNAPSHOTS[-1] and stored[1:3] == SNAPSHOTS[1:3]


def test_a_process_that_does_not_read_them_hands_the_same_bytes_on() -> None:
    once = pickle.dumps(StoredSnapshots(SNAPSHOTS))
    assert pickle.dumps(pickle.loads(once)) == once


def test_none_are_false() -> None:
    assert not pickle.loads(pickle.dumps(StoredSnapshots([])))
