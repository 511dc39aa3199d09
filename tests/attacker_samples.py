"""A motorway with a vehicle on each side of the ego, both of which attack, and proposals of two attackers."""

from __future__ import annotations

from pathlib import Path

from bank_samples import shipped_planners

from sumo_adv.datatypes import Duty, Proposal

TYPE = (
    '<vType id="car" vClass="passenger" carFollowModel="Krauss" sigma="0" tau="1" speedDev="0" maxSpeed="28" '
    'length="4.8" width="1.8" lcKeepRight="0" lcSpeedGain="0"/>'
)
BOTH = """
[[attackers]]
id = "left"
intents = ["Aggressive Cut-in"]
asked = { events = ["enters_from_left"] }

[[attackers]]
id = "right"
intents = ["Aggressive Cut-in"]
asked = { events = ["enters_from_right"] }
"""


def both_sides(folder: Path, more: str = BOTH, asked: str = 'level = "valid"') -> Path:
    """All drive 28 m/s: the ego in the middle lane, ``left`` 24 m and ``right`` 40 m ahead of it."""
    places = (("ego", 1, 150), ("left", 2, 174), ("right", 0, 190))
    vehicles = "".join(
        f'<vehicle id="{name}" type="car" depart="0" departLane="{lane}" departPos="{at}" departSpeed="28">'
        '<route edges="eastbound"/></vehicle>'
        for name, lane, at in places
    )
    (folder / "sides.rou.xml").write_text(f"<routes>{TYPE}{vehicles}</routes>")
    file = folder / "sides.toml"
    file.write_text(
        'schema = 1\nnetwork = "motorway"\n\n[demand]\nfiles = ["sides.rou.xml"]\nbegin = 0.0\nend = 60.0\n\n'
        '[ego]\nid = "ego"\n\n[window]\nwarm_up = 2.0\ntrigger = 4.0\nhorizon = 10.0\n\n'
        f"[asked]\n{asked}\n{more}"
    )
    return file


def cut_ins(first: str, second: str, wait: float = 0.0) -> Proposal:
    """Both cut in, the second one ``wait`` s after the first."""
    planner = shipped_planners()["Aggressive Cut-in", "side"]
    numbers = planner.defaults()
    other = Proposal(second, planner.label, planner, numbers, 0.0, 0.0, duty=Duty.ATTACK, wait=wait)
    return Proposal(first, planner.label, planner, numbers, 0.0, 0.0, supports=(other,), composition="Double Cut-in")
