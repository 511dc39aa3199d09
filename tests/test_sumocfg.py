"""A .sumocfg is read as SUMO reads it: begin, seed, variables, lists of files, names given twice."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from cli_samples import Program
from simulation_samples import EDGES, NODES, configuration, write_configuration
from sumo_samples import make_net

from sumo_adv.config import load_settings
from sumo_adv.episode.task import make_task
from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import load_input, own_simulation
from sumo_adv.simulation.programs import find_sumo
from sumo_adv.simulation.scan import first_departure, scan_network
from sumo_adv.simulation.sumocfg import read_sumocfg

WE = '<route id="we" edges="WC CE"/>'


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_net(tmp_path_factory.mktemp("network"), NODES, EDGES, name="crossing")


def test_it_begins_at_0_and_the_search_at_the_first_departure(tmp_path: Path, network: Path) -> None:
    """The first vehicle departs at 7 h. SUMO makes the 252 000 steps before, so its lights are where they should be;
    nothing is recorded but the last one of them."""
    run_input = load_input(configuration(tmp_path, network, f'{WE}<vehicle id="v" route="we" depart="7:00:00"/>'))
    assert run_input.begin == 0.0 and own_simulation(run_input) == {"seed": 23423, "step_length": 0.1}
    task = make_task(run_input, load_settings(None, **own_simulation(run_input)), tmp_path)
    assert (task.spec.begin, task.spec.recorded_from, task.end) == (0.0, 25199.9, 25200.0 + 600.0)


@pytest.mark.parametrize(
    ("demand", "first"),
    [
        ('<vehicle depart="9"/><person depart="4"/>', 4.0),
        ('<vehicle depart="9"/><flow period="5"/>', 0.0),
        ('<vehicle depart="9"/><personFlow begin="3" period="5"/>', 3.0),
        ('<vehicle depart="triggered"/><vehicle depart="0:01:00"/>', 60.0),
        ('<interval begin="500" end="520"><flow number="2"/></interval><vehicle depart="600"/>', 500.0),
        ('<interval begin="500" end="520"><flow number="2" begin="505"/></interval>', 505.0),
        ('<interval begin="500" end="520"/><flow period="5"/>', 0.0),
        ("", 0.0),
    ],
)
def test_the_first_departure_is_that_of_anything(tmp_path: Path, demand: str, first: float) -> None:
    (tmp_path / "r.rou.xml").write_text(f"<routes>{demand}</routes>")
    assert first_departure([tmp_path / "r.rou.xml"]) == first


@pytest.mark.parametrize(
    ("demand", "search"),
    [
        ('<vehicle id="v" route="we" depart="10"/><vehicle id="w" route="we" depart="150"/>', 150.0),
        (
            '<flow id="f" route="we" begin="20" end="90" period="10"/><trip id="w" from="WC" to="CE" depart="150"/>',
            150.0,
        ),
        ('<flow id="f" route="we" begin="20" end="200" period="50"/>', 100.0),  # SUMO lets f.0 depart at 120 s
    ],
)
def test_departures_before_the_begin_do_not_count(tmp_path: Path, network: Path, demand: str, search: float) -> None:
    """SUMO begins at 100 s and discards them; the search for encounters lasts 600 s from the first departure."""
    run_input = load_input(configuration(tmp_path, network, WE + demand, begin="100"))
    assert make_task(run_input, load_settings(None, **own_simulation(run_input)), tmp_path).end == search + 600.0


@pytest.mark.parametrize(
    ("text", "begin"),
    [
        ("<begin>3600</begin>", 3600.0), ("<time>7<b> 36<!-- and -->00 </b>8</time>", 3600.0),
        ('<begin value="5"> </begin>', 5.0), ('<begin value="">3600</begin>', 3600.0), ("<time> </time>", 0.0),
    ],
)  # fmt: skip
def test_the_text_of_an_option_is_its_value(tmp_path: Path, text: str, begin: float) -> None:
    (tmp_path / "c.sumocfg").write_text(f"<configuration>\n  {text}\n</configuration>")
    assert read_sumocfg(tmp_path / "c.sumocfg").begin == begin


@pytest.mark.parametrize("name", ["r 1.rou.xml", "100%.rou.xml", "20%25.rou.xml", "x%20y.rou.xml", "b%20%zz.rou.xml"])
def test_names_that_sumo_writes_are_read(tmp_path: Path, network: Path, name: str) -> None:
    """SUMO writes ``r%201.rou.xml`` and ``100%25.rou.xml``."""
    (tmp_path / name).write_text("<routes/>")
    path = tmp_path / "saved.sumocfg"
    command = [str(find_sumo()), "-n", str(network), "-r", str(tmp_path / name), "--save-configuration", str(path)]
    subprocess.run(command, check=True, capture_output=True)
    (given,) = read_sumocfg(path).routes
    assert given.resolve() == (tmp_path / name).resolve()


def test_a_percent_sign_alone_stands_for_itself(tmp_path: Path) -> None:
    """SUMO then takes the whole name as it is."""
    path = write_configuration(tmp_path / "c.sumocfg", {"r": "100%.rou.xml, x%20y.rou.xml,x%20%zz.rou.xml"})
    names = ("100%.rou.xml", "x y.rou.xml", "x%20%zz.rou.xml")
    assert read_sumocfg(path).routes == tuple(tmp_path / name for name in names)


def test_variables_lists_and_short_names(tmp_path: Path) -> None:
    path = tmp_path / "c.sumocfg"
    write_configuration(path, {"n": "${PLACE}/a.net.xml", "routes": "x y.rou.xml, ${B}.rou.xml", "b": "0:01:00"})
    given = read_sumocfg(path, {"PLACE": "sub", "B": "b"})
    assert given.networks == (tmp_path / "sub" / "a.net.xml",)
    assert given.routes == (tmp_path / "x y.rou.xml", tmp_path / "b.rou.xml")
    assert given.begin == 60.0
    with pytest.raises(UsageError, match="names its net-file by the variable PLACE, which is not set"):
        read_sumocfg(path, {"B": "b"})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('<seed value="1"/><seed value="2"/>', "names the option 'seed' twice, which SUMO refuses"),
        ('<n value="a"/><net-file value="a"/>', "names the option 'net-file' twice"),
        ('<seed value="1" v="1"/>', "names the option 'seed' twice"),
        ('<seed value="1">1</seed>', "names the option 'seed' twice"),
        ('<begin value="-5"/>', "begins at -5 s: SUMO takes no negative begin"),
        ('<step-length value="0"/>', "has steps of 0 s: give a step-length above 0"),
        ('<step-length value="-1"/>', "has steps of -1 s"),
        ('<seed value="1e1"/>', "has the seed 1e1: give a whole number from 0 on"),
        ('<seed value="-5"/>', "has the seed -5: give a whole number"),  # SUMO's, but none of numpy
        ('<no-internal-links value="true"/>', "sets no-internal-links: SUMO crashes if a vehicle is moved across"),
    ],
)
def test_what_sumo_refuses_is_refused(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "c.sumocfg").write_text(f"<configuration>{text}</configuration>")
    with pytest.raises(UsageError, match=says):
        read_sumocfg(tmp_path / "c.sumocfg")


def test_an_attribute_that_sumo_passes_over_is_named(tmp_path: Path) -> None:
    (tmp_path / "c.sumocfg").write_text('<configuration><step-length value="0.1" unit="s"/></configuration>')
    assert read_sumocfg(tmp_path / "c.sumocfg").notes == (
        "SUMO passes over the attribute 'unit' of the option 'step-length' in c.sumocfg.",
    )


def test_what_changes_motions_is_told_from_what_only_shows(tmp_path: Path) -> None:
    """A state would bring vehicles, and weights from a file other routes; a log and a window change nothing."""
    (tmp_path / "w.xml").write_text("<meandata/>")
    given = {
        "step-length": "0.1", "log-file": "l.txt", "load-state": "s.xml", "start": "true", "weight-files": "w.xml"
    }  # fmt: skip
    assert read_sumocfg(write_configuration(tmp_path / "c.sumocfg", given)).notes == (
        "Not kept of c.sumocfg, because this program sets them itself: log=l.txt, start=true.",
        "Not kept of c.sumocfg, so traffic moves differently than in SUMO: load-state=s.xml, weight-files=w.xml.",
    )


def test_a_network_without_lanes_on_its_junctions_is_refused(tmp_path: Path) -> None:
    bare = make_net(tmp_path, NODES, EDGES, "--no-internal-links", name="bare")
    with pytest.raises(UsageError, match="has no lanes on its junctions: SUMO crashes if a vehicle is moved across"):
        scan_network(bare)


def test_an_unknown_option_and_emission_models(program: Program, network: Path) -> None:
    """PHEMlight's tables lie in the data of SUMO's wheel, below ``SUMO_HOME``, which the user has not set."""
    car = f'<vType id="c" emissionClass="PHEMlight/PC_G_EU4"/>{WE}<vehicle id="v" type="c" route="we" depart="0"/>'
    few = ("--ego-id", "v", "--attempts", "1", "--total-seconds", "0", "--end", "9", "--out")
    path = configuration(program.folder, network, car)
    done = program.here("run", str(path), *few, "out")
    assert "no encounter" in done.out and done.status == 0, done.err
    done = program.here("run", str(configuration(program.folder, network, car, speed="9")), *few, "other")
    assert (done.status, done.err) == (
        2,
        f"sumo-adv: {path}: SUMO has no option 'speed': correct its name or leave it out.\n",
    )
