"""Tiny net.xml files written by hand for the measures of a conversion; SUMO is not asked whether it likes them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from sumo_adv.womd.matching import SumoNet, read_net


@dataclass(frozen=True)
class Piece:
    """What a converter says of a part of a WOMD lane."""

    sumo_lane: str
    start: float
    end: float
    internal: bool = False


Shape = list[tuple[float, float]]


def lane(name: str, shape: Shape, *, width: float = 3.5, allow: str = "") -> str:
    """A lane element; its name ends in the index."""
    length = sum(((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2) ** 0.5 for a, b in pairwise(shape))
    points = " ".join(f"{x:.2f},{y:.2f}" for x, y in shape)
    rule = f' allow="{allow}"' if allow else ""
    return (
        f'<lane id="{name}" index="{name.rpartition("_")[2]}" speed="13.9" length="{length:.2f}" width="{width}" '
        f'shape="{points}"{rule}/>'
    )


def edge(name: str, *shapes: Shape, width: float = 3.5, allow: str = "") -> str:
    """An edge with a lane a shape, the rightmost first; internal if its name begins with a colon."""
    function = ' function="internal"' if name.startswith(":") else ""
    lanes = "".join(lane(f"{name}_{i}", shape, width=width, allow=allow) for i, shape in enumerate(shapes))
    return f'<edge id="{name}"{function}>{lanes}</edge>'


def link(start: str, end: str, via: str = "", direction: str = "s", signal: tuple[str, int] | None = None) -> str:
    """A connection between two lanes."""
    (a, i), (b, j) = start.rsplit("_", 1), end.rsplit("_", 1)
    light = f' tl="{signal[0]}" linkIndex="{signal[1]}"' if signal else ""
    middle = f' via="{via}"' if via else ""
    return f'<connection from="{a}" to="{b}" fromLane="{i}" toLane="{j}" dir="{direction}"{middle}{light}/>'


def net(folder: Path, *elements: str) -> SumoNet:
    """The network of these elements."""
    path = folder / "network.net.xml"
    path.write_text(f"<net>{''.join(elements)}</net>")
    return read_net(path)


def junction(folder: Path) -> SumoNet:
    """A road of 100 m ("in") that goes on by 20 m inside a junction to "out" (80 m, then "far" of 400 m), or turns
    left by two internal lanes to "up" (50 m); "bike" is for bicycles only."""
    return net(
        folder,
        edge("in", [(0, 0), (100, 0)], [(0, 3.5), (100, 3.5)]), edge("out", [(120, 0), (200, 0)]),
        edge("far", [(200, 0), (600, 0)]), edge("up", [(110, 20), (110, 70)]),
        edge("bike", [(0, -3), (100, -3)], width=1.5, allow="bicycle"),
        edge(":J_0", [(100, 0), (120, 0)]), edge(":J_1", [(100, 3.5), (106, 6)]), edge(":J_2", [(106, 6), (110, 20)]),
        link("in_0", "out_0", ":J_0_0"), link(":J_0_0", "out_0"), link("out_0", "far_0"),
        link("in_1", "up_0", ":J_1_0", "l", ("J", 1)), link(":J_1_0", "up_0", ":J_2_0"), link(":J_2_0", "up_0"),
    )  # fmt: skip
