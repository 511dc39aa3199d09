"""The content of a map of another format, as its reader passes it to the conversion."""

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
        kinds: The kind of each road by its id. For OpenDRIVE, the kind of each lane by ``ROAD_LANE``.
        roads: The number of roads.
        left_hand: Whether traffic drives on the left.
        says_side: Whether the map says on which side traffic drives.
        lost: The number of things that a SUMO network cannot represent, by kind.
        write: Writes the map to a file, in terms that netconvert understands.
    """

    kinds: Mapping[str, str]
    roads: int
    left_hand: bool
    lost: Mapping[str, int]
    write: Callable[[Path], None]
    says_side: bool = True


def parse_map(path: Path, start: Callable[[str, dict[str, str]], None], root: str) -> None:
    """Parse a file that must begin with a certain element.

    Args:
        path: The file.
        start: Receives the tag and attributes of an element that starts.
        root: The name of the first element.

    Raises:
        UsageError: The first element differs, or ``scan.parse_xml`` raises it.
    """
    seen = False

    def checked(tag: str, attributes: dict[str, str]) -> None:
        nonlocal seen
        if not seen and tag.rpartition(":")[2] != root:
            raise UsageError(f"{path} is not a map as its ending says: its root element is <{tag[:40]}>, not <{root}>.")
        seen = True
        start(tag, attributes)

    parse_xml(path, checked)
