"""An encounter on paper: where each vehicle starts, and the two files that say so.

Nothing in the files tells which vehicle was meant or as what: ids are numbers in the order of departure and place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

EGO = "ego"
HORIZON = 10.0  # s
SEARCHED = 60.0  # s of simulation that a scenario allows
CAR = (4.8, 1.8)  # m: length, width

_TYPE = (
    '    <vType id="{id}" vClass="passenger" carFollowModel="Krauss" sigma="0.5" tau="1" speedDev="0" '
    'maxSpeed="{speed:g}" length="{length:g}" width="{width:g}" lcKeepRight="0" lcSpeedGain="0"/>\n'
)
_VEHICLE = (
    '    <vehicle id="{id}" type="{type}" depart="{depart:g}" departLane="{lane}" departPos="{place:g}" '
    'departSpeed="{speed:g}">\n        <route edges="{edges}"/>\n    </vehicle>\n'
)


@dataclass(frozen=True, slots=True)
class Car:
    """A vehicle at its departure: front bumper at ``place`` [m] of a lane of the first edge, ``speed`` [m/s] (also the
    most it drives), ``depart`` in s after the scenario's begin; ``size``: length and width [m]."""

    edges: tuple[str, ...]
    lane: int
    place: float
    speed: float
    depart: float = 0.0
    size: tuple[float, float] = CAR

    def rounded(self) -> Car:
        """As the files say it."""
        return replace(self, place=round(self.place, 1), speed=round(self.speed, 1), depart=round(self.depart, 1))


@dataclass(frozen=True, slots=True)
class Draft:
    """An encounter as it was drawn. ``bv``: the vehicle meant to be the adversary; ``trigger`` in s after ``begin``."""

    kind: str
    network: str
    ego: Car
    bv: Car
    others: tuple[Car, ...]
    trigger: float
    words: str
    begin: float = 0.0

    def named(self) -> dict[str, Car]:
        """All vehicles by id, in the order in which SUMO wants them; ``self.bv`` is among them."""
        cars = sorted((self.bv, *self.others), key=lambda c: (c.depart, c.edges, c.lane, c.place))
        return {EGO: self.ego, **{f"v{k}": car for k, car in enumerate(cars, 1)}}

    def bv_id(self) -> str:
        """What the vehicle that was meant is called in the files."""
        return next(name for name, car in self.named().items() if car is self.bv)


def write_draft(draft: Draft, name: str, folder: Path) -> Path:
    """Writes ``<name>.toml`` and ``demand/<name>.rou.xml`` into ``folder``, which must hold ``networks``."""
    demand = folder / "demand" / f"{name}.rou.xml"
    _write(demand, _demand(draft))
    scenario = folder / f"{name}.toml"
    _write(scenario, _scenario(draft, name))
    return scenario


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", newline="\n")


def _scenario(draft: Draft, name: str) -> str:
    return f"""# {name}: {draft.words}
schema = 1
network = "networks/{draft.network}.net.xml"

[demand]
files = ["demand/{name}.rou.xml"]
begin = {draft.begin:.1f}
end = {draft.begin + SEARCHED:.1f}

[ego]
id = "{EGO}"

[window]
trigger = {draft.begin + draft.trigger:.1f}
horizon = {HORIZON:.1f}
"""


def _demand(draft: Draft) -> str:
    cars = draft.named()
    ordered = sorted(cars.items(), key=lambda item: item[1].depart)
    types = {_type_id(car): car for car in cars.values()}
    lines = ['<?xml version="1.0" encoding="UTF-8"?>\n\n<routes>\n']
    for name, car in sorted(types.items()):
        lines.append(_TYPE.format(id=name, speed=car.speed, length=car.size[0], width=car.size[1]))
    for name, car in ordered:
        lines.append(
            _VEHICLE.format(
                id=name, type=_type_id(car), depart=draft.begin + car.depart, lane=car.lane, place=car.place,
                speed=car.speed, edges=" ".join(car.edges),
            )
        )  # fmt: skip
    return "".join([*lines, "</routes>\n"])


def _type_id(car: Car) -> str:
    return f"car_{car.speed:g}_{car.size[0]:g}".replace(".", "p")


def apart(car: Car, others: Sequence[Car]) -> bool:
    """Whether a vehicle that departs at once has room in its lane: as much as SUMO wants to insert it, and a little."""
    for neighbour in others:
        if neighbour.edges[0] != car.edges[0] or neighbour.lane != car.lane or neighbour.depart != car.depart:
            continue
        behind = car if car.place < neighbour.place else neighbour
        if abs(car.place - neighbour.place) < 1.15 * behind.speed + 9.0:
            return False
    return True
