"""The network as OpenDRIVE, by SUMO's netconvert, in the network's own coordinates."""

from __future__ import annotations

import gzip
import re
import subprocess
import tempfile
from datetime import datetime
from pathlib import Path
from xml.etree import ElementTree

from sumo_adv.errors import SumoAdvError

PATIENCE = 600.0  # s: a town takes seconds


def write_opendrive(netconvert: Path, network: Path, target: Path, written: datetime) -> None:
    """Write the network at ``network`` as OpenDRIVE. World x, y of the file are those of the net.xml.

    netconvert's comment (its command line, the time) is left out, and so is an ``offset`` in the header, which some
    players would add to every position: the net's offset is kept as ``userData``. In left-hand traffic netconvert puts
    the lanes of junctions, which are to the right of their reference line, into ``left``; they are moved.

    Raises SumoAdvError: it failed.
    """
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as scratch:
        made = Path(scratch) / "network.xodr"
        command = [str(netconvert), "-s", str(network.resolve()), "--opendrive-output", str(made)]
        command += ["--precision", "4", "--xml-validation", "never"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, cwd=scratch)
        if done.returncode or not made.is_file():
            reason = (done.stderr.strip().splitlines() or ["no reason given"])[0].removeprefix("Error: ")
            raise SumoAdvError(
                f"netconvert made no OpenDRIVE of {network.name} ({reason.rstrip('.')}); check the network."
            )
        tree = ElementTree.parse(made)
    header = tree.getroot().find("header")
    assert header is not None
    header.set("date", written.strftime("%Y-%m-%dT%H:%M:%S"))
    header.set("name", network.name)
    for offset in header.findall("offset"):
        header.remove(offset)
    ElementTree.SubElement(header, "userData", code="sumoNetOffset", value=_net_offset(network))
    for section in tree.iter("laneSection"):
        left = section.find("left")
        if left is not None and all(lane.get("id", "").startswith("-") for lane in left):
            left.tag = "right"
            section.remove(left)
            section.append(left)  # behind the centre
    tree.write(target, encoding="UTF-8", xml_declaration=True)


def _net_offset(network: Path) -> str:
    """``netOffset`` of a net.xml(.gz), "x,y" [m]."""
    opened = gzip.open if network.suffix == ".gz" else open
    with opened(network, "rt", encoding="utf-8") as file:
        for line in file:
            if match := re.search(r'netOffset="([^"]*)"', line):
                return match.group(1)
    return "0.00,0.00"
