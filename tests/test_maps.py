"""Maps of others, OpenStreetMap and OpenDRIVE, are converted and run."""

from __future__ import annotations

import gzip
import json
import subprocess
from pathlib import Path

import pytest
from cli_samples import Program

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.maps import convert_map
from sumo_adv.simulation.programs import find_netconvert, find_type_maps
from sumo_adv.simulation.scan import scan_network

NODES = {1: (48.0, 11.0), 2: (48.0, 11.004), 3: (48.0, 11.008), 4: (48.003, 11.004), 5: (47.997, 11.004)}
CROSSING = [(10, "highway", "secondary", (1, 2, 3)), (11, "highway", "residential", (4, 2, 5))]
RAILWAY = (12, "railway", "rail", (4, 1))


def osm(*ways: tuple[int, str, str, tuple[int, ...]], left: bool = False) -> str:
    """A map with these ways; the nodes are about 300 m apart."""
    nodes = "".join(f'<node id="{k}" lat="{lat}" lon="{lon}"/>' for k, (lat, lon) in NODES.items())
    side = '<tag k="driving_side" v="left"/>' if left else ""
    lines = [
        f'<way id="{name}">{"".join(f"""<nd ref="{k}"/>""" for k in along)}<tag k="{key}" v="{value}"/>{side}</way>'
        for name, key, value, along in ways
    ]
    return f'<osm version="0.6">{nodes}{"".join(lines)}</osm>'


@pytest.fixture(autouse=True)
def _needs_netconvert() -> None:
    try:
        find_netconvert()
    except UsageError as error:
        pytest.skip(str(error))


def test_a_town_of_openstreetmap_runs_and_says_what_is_left_out(program: Program) -> None:
    """Two ways both ways meet in a junction: four arms of two edges. The railway is no road for cars."""
    (program.folder / "town.osm.gz").write_bytes(gzip.compress(osm(*CROSSING, RAILWAY).encode()))
    done = program.here(
        "run", "town.osm.gz", "--until", "collision", "--learn", "off", "--attempts", "8", "--out", "out"
    )
    assert done.status == 0, done.err
    assert "Converted town.osm.gz with netconvert: 8 edges with 8 lanes for cars" in done.out
    assert "Left out: 1 railway rail." in done.out
    manifest = json.loads((program.folder / "out" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["conversion"]["lost"] == {"railway rail": 1}
    (program.folder / "town.osm.gz").unlink()
    again = program.here("run", "--replay", "out", "--out", "again")  # the run's folder has the network
    assert again.status == 0, again.err


def test_left_hand_traffic_is_kept(tmp_path: Path) -> None:
    (tmp_path / "town.osm").write_text(osm(*CROSSING, left=True))
    made = convert_map(tmp_path / "town.osm", cache=tmp_path / "cache")
    assert "--lefthand" in made.options and "left-hand traffic" in made.said[0]
    assert scan_network(made.network).drivable


def test_nothing_is_converted_twice(tmp_path: Path) -> None:
    (tmp_path / "town.osm").write_text(osm(*CROSSING))
    first = convert_map(tmp_path / "town.osm", cache=tmp_path / "cache")
    when = first.network.stat().st_mtime_ns
    again = convert_map(tmp_path / "town.osm", cache=tmp_path / "cache")
    assert (again.network, again.network.stat().st_mtime_ns) == (first.network, when)
    assert len(list((tmp_path / "cache").iterdir())) == 1


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("town.osm", osm(RAILWAY), "has no road: nothing can be run there"),
        ("town.osm", "<OpenDRIVE/>", "is not a map as its ending says: its root element is <OpenDRIVE>, not <osm>"),
        ("town.xodr", "<osm/>", "is not a map as its ending says: its root element is <osm>, not <OpenDRIVE>"),
        ("town.osm.pbf", "", "is packed in a way that netconvert does not read"),
        ("town.osm", osm((10, "highway", "footway", (1, 2, 3))), "has no road for cars"),
    ],
)
def test_a_map_without_a_road_for_cars_is_refused_in_a_sentence(
    tmp_path: Path, name: str, text: str, sentence: str
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match=sentence):
        load_input(tmp_path / name)


def test_an_exported_road_comes_back_as_an_input(program: Program) -> None:
    """The junction with lights has eight edges; our OpenDRIVE of it has them when netconvert has read it."""
    options = ("--until", "collision", "--learn", "off", "--attempts", "3", "--out")
    assert program.here("run", "signals_red_light", *options, "first").status == 0
    assert program.here("export", "first", "--format", "openscenario", "--out", "scenario").status == 0
    (road,) = (program.folder / "scenario").glob("*.xodr")
    done = program.here("run", road, *options, "out")
    assert done.status == 0, done.err
    assert "Converted road.xodr with netconvert: 8 edges" in done.out


@pytest.mark.parametrize("place", ["data/typemap", "share/sumo/data/typemap"])
def test_type_maps_are_found_beside_netconvert(tmp_path: Path, place: str) -> None:
    """As the wheel has them, and as a system's package has them."""
    (tmp_path / place).mkdir(parents=True)
    assert find_type_maps(tmp_path / "bin" / "netconvert") == tmp_path / place


def test_a_network_without_internal_links_is_refused(program: Program) -> None:
    """Two ways that meet, written by netconvert without lanes inside the junction: SUMO dies of a vehicle that is moved
    across."""
    (program.folder / "town.osm").write_text(osm(*CROSSING))
    made = program.folder / "town.net.xml"
    subprocess.run(
        [find_netconvert(), "--osm-files", program.folder / "town.osm", "--no-internal-links", "-o", made], check=True
    )
    assert 'function="internal"' not in made.read_text()
    done = program.here("run", made, "--out", "out")
    assert done.status == 2 and "town.net.xml has no lanes on its junctions" in done.err
