"""A drive on a shipped network or another one; the ego's driver keeps what it sees."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from sumo_samples import make_spec

from sumo_adv.drivers import Action, Observation, UserEgo
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.right_of_way import Meetings
from sumo_adv.episode.surroundings import Surroundings
from sumo_adv.simulation.network import read_network


class Watcher:
    """SUMO drives it. ``kept``: what ``look`` made of each observation."""

    forkable = True

    def __init__(self, look: Callable[[Observation], Any], answer: Callable[[Observation], Action]) -> None:
        self._look, self._answer = look, answer
        self.kept: list[Any] = []

    def reset(self, seed: int) -> None:
        """Nothing seen."""
        self.kept = []

    def act(self, seen: Observation) -> Action:
        """Keep what is asked for."""
        self.kept.append(self._look(seen))
        return self._answer(seen)


@contextmanager
def drive(
    folder: Path,
    network: str | Path,
    vehicles: Iterable[str],
    look: Callable[[Observation], Any],
    answer: Callable[[Observation], Action] = lambda _: None,
    additional: tuple[Path, ...] = (),
    **attributes: Any,
) -> Iterator[tuple[Drive, Watcher]]:
    """A drive before its first step in which the vehicle ``ego`` gets a watcher with these class attributes."""
    watcher = type("Watcher", (Watcher,), attributes)(look, answer)
    controller = UserEgo("watcher", watcher)
    spec = make_spec(folder, network, vehicles)
    spec = replace(spec, additional=(ego_type_file(controller, folder, spec.routes), *additional))
    moving = Drive(spec, controller, 0)
    road = read_network(spec.network)
    moving.observe = Surroundings(road, Meetings(road), moving, additional)
    try:
        yield moving, watcher
    finally:
        moving.simulation.close()


def steps(moving: Drive, count: int) -> None:
    """Steps; the ego is taken over as soon as it is there, and the drive ends early when it leaves."""
    for _ in range(count):
        snapshot = moving.tick()
        if moving.ego is None and "ego" in snapshot.raw:
            moving.take_over("ego")
        elif moving.ego is not None and "ego" not in snapshot.raw:
            return
