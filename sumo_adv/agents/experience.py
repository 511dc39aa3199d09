"""What came off elsewhere: numbers of the planners' modes that were avoidable in other encounters, by relation.

Most of what is drawn evenly within a planner's bounds comes to nothing.  Numbers near those that came off where a
vehicle stood much alike come off more than twice as often, so proposals are drawn near these as well.  They come from
``memory_bank/experience.json`` (``benchmarks/experience.py`` makes it, by prediction, on suites made for it) and from
what the bank has learnt since.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from random import Random

import numpy as np

from sumo_adv.agents.firmness import varied
from sumo_adv.agents.ways import Family
from sumo_adv.datatypes import Acceleration, Floats, Proposal
from sumo_adv.geometry import wrap_all
from sumo_adv.situation import Situation, Target

Scene = tuple[float, ...]

SCALES = np.array([10.0, 3.0, 0.4, 3.0, 3.0])  # m, m, rad, m/s, m/s: a clear change of each number of a scene
AMONG = 8  # of so many that are drawn the one from the most similar scene is taken
SPREAD = 0.06  # of a parameter's range: standard deviation around numbers that came off


@dataclass(frozen=True, slots=True)
class Worked:
    """Numbers with which a mode came off, against which class of drivers (``driver_class``), and the scene: the
    vehicle's place ahead and to the left of the ego [m], its heading in the ego's frame [rad], both speeds [m/s]."""

    driver: str
    relation: str
    mode: str
    scene: Scene
    parameters: Mapping[str, float]
    acceleration: Acceleration


class Experience:
    """Draws proposals near what came off in scenes like theirs."""

    def __init__(self, worked: Iterable[Worked] = (), driver: str | None = None) -> None:
        """``driver``: the class of drivers that are met; what came off against others only counts where nothing did
        against these."""
        ones = list(worked)
        alike = {one.relation for one in ones if one.driver == driver}
        found: dict[str, list[Worked]] = {}
        for one in ones:
            if one.driver == driver or one.relation not in alike:
                found.setdefault(one.relation, []).append(one)
        self._known = {relation: (ones, np.array([w.scene for w in ones])) for relation, ones in found.items()}

    def draw(
        self, situations: Mapping[float, Situation], ways: Sequence[Family], count: int, draw: Random
    ) -> list[Proposal]:
        """``count`` proposals without scores, for vehicles and moments in turn; none where nothing like it is known."""
        groups: dict[tuple[float, str], list[Family]] = {}
        for way in ways:
            groups.setdefault((way.delay, way.target.state.id), []).append(way)
        known = [k for g in groups.values() if (k := self._of(situations[g[0].delay], g)).ways]
        return [known[k % len(known)].proposal(draw) for k in range(count if known else 0)]

    def _of(self, situation: Situation, ways: Sequence[Family]) -> _Known:
        """What is known of one vehicle at one moment."""
        target = ways[0].target
        ones, scenes = self._known.get(target.relation, ([], np.empty((0, 5))))
        modes: dict[tuple[str, frozenset[str]], list[Family]] = {}
        for way in ways:
            modes.setdefault((way.planner.mode, frozenset(way.planner.defaults())), []).append(way)
        mine = [modes.get((w.mode, frozenset(w.parameters)), []) for w in ones]
        rows = [k for k, found in enumerate(mine) if found]
        far = apart(scenes[rows], scene_of(situation, target))
        return _Known([ones[k] for k in rows], [mine[k] for k in rows], far.tolist())


@dataclass(frozen=True, slots=True)
class _Known:
    """What came off where a vehicle had this relation, the ways to do it here, how unlike the scene was."""

    worked: Sequence[Worked]
    ways: Sequence[Sequence[Family]]
    far: Sequence[float]

    def proposal(self, draw: Random) -> Proposal:
        """Near one of them."""
        k = min((draw.randrange(len(self.far)) for _ in range(AMONG)), key=self.far.__getitem__)
        one = self.worked[k]
        first = draw.choice(self.ways[k]).proposal(None)
        return varied(replace(first, parameters=dict(one.parameters), acceleration=one.acceleration), draw, SPREAD)


def driver_class(driver: str) -> str:
    """Whose attacks are alike: ``replay`` reacts to nothing, ``lattice`` also swerves, all others brake."""
    return driver if driver in ("replay", "lattice") else "brakes"


def scene_of(situation: Situation, target: Target) -> Scene:
    """A scene as ``Worked`` has it."""
    bv = target.state
    x, y, heading = situation.frame.to_local(bv.x, bv.y, bv.heading)
    return x, y, heading, bv.speed, situation.ego.speed


def apart(scenes: Floats, here: Scene) -> Floats:
    """How unlike scenes ``(n, 5)`` are to one, ``(n,)``: clear changes, headings the shorter way round."""
    off = scenes - np.array(here)
    off[:, 2] = wrap_all(off[:, 2])
    return np.asarray(np.hypot.reduce(off / SCALES, axis=1))


@lru_cache(maxsize=4)
def read_experience(path: Path) -> tuple[Worked, ...]:
    """What is shipped. Raises OSError, ValueError, KeyError: it is broken."""
    found = []
    for table in json.loads(path.read_text())["modes"]:
        for row in table["rows"]:
            numbers = dict(zip(table["parameters"], row[6:], strict=True))
            known = (table["driver"], table["relation"], table["mode"])
            found.append(Worked(*known, tuple(row[:5]), numbers, row[5]))
    return tuple(found)
