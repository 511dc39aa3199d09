"""Copies of a simulation's files from which SUMO writes nothing.

Detectors, mean data, probes, timed events, calibrators, actuated traffic lights and devices name files that SUMO
writes: over the user's own ones, in each attempt and in each fork. In a copy they all write to ``NUL``, which is no
file for SUMO on every platform, so they exist and work as before. A copy holds what its original includes, so it can
be anywhere.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sumo_adv.simulation.scan import READ, parse

NOWHERE = "NUL"
WRITTEN = ("file", "output", "dest")
"""Attributes that name a file to write, where they do not name one to read (``scan.READ``)."""
WRITTEN_PARAMETERS = ("file", "device.ssm.file", "device.toc.file")
"""Keys of ``<param>``; the first is of actuated ``<tlLogic>``s."""
FROM_HERE = "edgesFile"
"""An attribute of ``<edgeData>`` that narrows what is written. SUMO looks for the file in the working folder."""


def silent_copies(additional: Sequence[Path], folder: Path) -> tuple[Path, ...]:
    """Each file itself if it names no other file, else a copy in a new folder in ``folder``.

    Additional files, demand and networks are treated alike. Raises UsageError for a damaged or missing file.
    """
    return tuple(_copy(file, folder) if _names_files(file) else file for file in additional)


def _names_files(file: Path) -> bool:
    changed = False

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal changed
        changed = changed or _silent(tag, attributes) != attributes

    return bool(parse(file, start)) or changed


def _copy(file: Path, folder: Path) -> Path:
    name = file.name[:-3] if file.name.lower().endswith(".gz") else file.name
    target = Path(tempfile.mkdtemp(prefix="silent-", dir=folder)) / name
    with target.open("w", encoding="utf-8", newline="\n") as out:

        def start(tag: str, attributes: dict[str, str]) -> None:
            given = "".join(f" {key}={quoteattr(value)}" for key, value in _silent(tag, attributes).items())
            out.write(f"<{tag}{given}>\n")

        def end(tag: str) -> None:
            out.write(f"</{tag}>\n")

        out.write('<?xml version="1.0" encoding="UTF-8"?>\n')
        parse(file, start, end)
    return target


def _silent(tag: str, attributes: dict[str, str]) -> dict[str, str]:
    """The attributes of an element that writes and reads no file."""
    if tag == "param":
        written = attributes.get("key") in WRITTEN_PARAMETERS
        return {**attributes, "value": NOWHERE} if written else attributes
    read = READ.get(tag)
    kept = {key: value for key, value in attributes.items() if key not in (read, FROM_HERE)}
    return {key: NOWHERE if key in WRITTEN else value for key, value in kept.items()}
