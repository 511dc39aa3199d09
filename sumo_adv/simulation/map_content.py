"""What a map of another format holds, as its reader hands it to the conversion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.simulation.scan import parse_xml


@dataclass(frozen=True, slots=True)
class MapContent:
    """A map that has been read and checked.

    Attributes:
        kinds: the kind of each road by its id; of OpenDRIVE, of each lane by ``ROAD_LANE``.
        roads: number of roads.
        left_hand: whether its traffic drives on the left.
        lost: numbers of things that no network of SUMO has, by kind.
        write: writes the map to a file, in the words that netconvert understands.
    """

    kinds: Mapping[str, str]
    roads: int
    left_hand: bool
    lost: Mapping[str, int]
    write: Callable[[Path], None]


def parse_map(path: Path, start: Callable[[str, dict[str, str]], None], root: str) -> None:
    """Parse a file that must begin with the element ``root``. Raises UsageError like ``scan.parse_xml``."""
    seen = False

    def checked(tag: str, attributes: dict[str, str]) -> None:
        nonlocal seen
        if not seen and tag.rpartition(":")[2] != root:
            raise UsageError(f"{path} is no map of its ending: its root element is <{tag[:40]}>, not <{root}>.")
        seen = True
        start(tag, attributes)

    parse_xml(path, checked)
