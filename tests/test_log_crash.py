"""A recorded vehicle that SUMO cannot take costs the run nothing but its place in SUMO's traffic."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from cli_samples import Program
from log_samples import LEFT, MIDDLE, RIGHT, moving, write_scenario

from sumo_adv.simulation.forks import can_fork


@pytest.mark.skipif(not can_fork(), reason="this system cannot rehearse a log in a fork")
def test_one_vehicle_is_left_out_and_named(program: Program, tmp_path: Path) -> None:
    """The demand has a vehicle of the third one's name, which departs later: SUMO refuses the recorded one."""
    tracks = [moving("e", 100.0, MIDDLE, 12.0), moving("n", 130.0, LEFT, 10.0), moving("third", 160.0, RIGHT, 10.0)]
    case = write_scenario(tmp_path, tracks, routed=("e", "n", "third"))
    routes = tmp_path / "log.rou.xml"
    later = '<vehicle id="third" route="n" depart="60"/>'
    routes.write_text(routes.read_text().replace("</routes>", f"{later}</routes>"))
    done = program.here("run", case, "--background", "log", "--attempts", "1", "--learn", "off", "--out", "out")
    assert done.status == 0, done.err
    assert "only obstacles, because SUMO crashes on them: third" in done.out
    encounter = done.outcome["encounter"]
    assert encounter["beside"] == ["third"]
    assert "n" in [vehicle["id"] for vehicle in encounter["ranking"]]
    states = gzip.decompress((done.folder / "states.csv.gz").read_bytes()).decode()
    assert ",third," in states  # it is there for the verdict
