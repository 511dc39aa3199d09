"""Pass snapshots from a fork through the engine to the front, which may never read them."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from typing import overload

from sumo_adv.simulation.sumo_states import Snapshot


class StoredSnapshots(Sequence[Snapshot]):
    """Snapshots that pass through several processes. They are pickled once, and unpickled when they are first read."""

    def __init__(self, snapshots: Sequence[Snapshot]) -> None:
        """Hold these snapshots, which are not pickled yet."""
        self._count, self._stored = len(snapshots), b""
        self._snapshots: list[Snapshot] | None = list(snapshots)

    def __len__(self) -> int:
        return self._count

    @overload
    def __getitem__(self, index: int) -> Snapshot: ...

    @overload
    def __getitem__(self, index: slice) -> list[Snapshot]: ...

    def __getitem__(self, index: int | slice) -> Snapshot | list[Snapshot]:
        return self._read()[index]

    def __iter__(self) -> Iterator[Snapshot]:
        return iter(self._read())

    def _read(self) -> list[Snapshot]:
        """Return the snapshots, and unpickle them if necessary."""
        if self._snapshots is None:
            self._snapshots, self._stored = pickle.loads(self._stored), b""
        return self._snapshots

    def __getstate__(self) -> tuple[int, bytes]:
        return self._count, self._stored or pickle.dumps(self._snapshots, pickle.HIGHEST_PROTOCOL)

    def __setstate__(self, state: tuple[int, bytes]) -> None:
        (self._count, self._stored), self._snapshots = state, None
