"""What a run may start from: every right input is resolved, every wrong one is one sentence before anything begins."""

from __future__ import annotations

import gzip
import time
from pathlib import Path

import pytest
from sumo_samples import write

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import EgoRoute, data_folder, input_name, load_input, own_simulation, shipped_names
from sumo_adv.simulation.scan import scan_demand
from sumo_adv.simulation.sumo_options import parse_options, refuse

NET = """<net version="1.20">
    <edge id=":n_0" function="internal"><lane id=":n_0_0" index="0" speed="10" length="5" shape="0,0 5,0"/></edge>
    <edge id="a" from="m" to="n"><lane id="a_0" index="0" {lane} speed="10" length="50" shape="0,0 50,0"/></edge>
    <edge id="b" from="n" to="o"><lane id="b_0" index="0" {lane} speed="10" length="50" shape="55,0 99,0"/></edge>
</net>
"""
ROUTES = """<routes>
    <vehicle id="ego" depart="0"><route edges="a b"/></vehicle>
    <trip id="t" depart="1" from="a" to="b"/>
    <flow id="f" begin="0" end="9" number="3" from="a" to="b"/>
</routes>
"""


def network(folder: Path, lane: str = "") -> Path:
    return write(folder / "small.net.xml", NET.format(lane=lane))


def refusal(path: Path) -> str:
    with pytest.raises(UsageError) as caught:
        load_input(path)
    sentence = str(caught.value)
    assert caught.value.exit_status == 2
    assert sentence.endswith(".")
    assert "\n" not in sentence
    return sentence


def test_a_network_alone_has_no_demand_and_no_ego(tmp_path: Path) -> None:
    path = network(tmp_path)
    loaded = load_input(path)
    assert (loaded.name, loaded.network, loaded.routes, loaded.ego) == ("small", path, (), None)
    assert (loaded.begin, loaded.density, loaded.trigger) == (None, None, "auto")
    assert loaded.files == (path,)


def test_a_packed_network_is_read(tmp_path: Path) -> None:
    path = tmp_path / "packed.net.xml.gz"
    path.write_bytes(gzip.compress(NET.format(lane="").encode()))
    assert load_input(path).name == "packed"


def test_a_configuration_keeps_its_files_begin_and_end(tmp_path: Path) -> None:
    network(tmp_path)
    write(tmp_path / "one.rou.xml", ROUTES)
    write(tmp_path / "two three.rou.xml", "<routes/>")
    write(tmp_path / "x.add.xml", '<additional><vType id="car"/></additional>')
    text = """<configuration><input>
        <net-file value="small.net.xml"/><route-files value="one.rou.xml, two three.rou.xml"/>
        <additional-files value="x.add.xml"/></input>
        <time><begin value="0:01:40"/><end value="200"/><step-length value="0.5"/></time></configuration>"""
    loaded = load_input(write(tmp_path / "case.sumocfg", text))
    assert [path.name for path in loaded.routes] == ["one.rou.xml", "two three.rou.xml"]
    assert [path.name for path in loaded.additional] == ["x.add.xml"]
    assert (loaded.begin, loaded.end) == (100.0, 200.0)
    assert len(loaded.files) == 5


def test_an_end_of_minus_one_is_no_end(tmp_path: Path) -> None:
    network(tmp_path)
    text = '<configuration><n value="small.net.xml"/><end value="-1"/></configuration>'
    assert load_input(write(tmp_path / "case.sumocfg", text)).end is None


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("<configuration/>", "names no network"),
        ('<configuration><net-file value="gone.net.xml"/></configuration>', "gone.net.xml, which is missing"),
        ('<configuration><net-file value="small.net.xml"/><begin value="noon"/></configuration>', "begin time 'noon'"),
        (
            '<configuration><n value="small.net.xml"/><b value="50"/><e value="50"/></configuration>',
            "not after its begin",
        ),
        ("<configuration>", "not valid XML"),
    ],
)
def test_a_bad_configuration_is_refused(tmp_path: Path, text: str, part: str) -> None:
    network(tmp_path)
    assert part in refusal(write(tmp_path / "case.sumocfg", text))


def test_a_scenario_gives_everything(tmp_path: Path) -> None:
    network(tmp_path)
    write(tmp_path / "one.rou.xml", ROUTES)
    text = (
        'schema = 1\nnetwork = "small.net.xml"\n[demand]\nfiles = ["one.rou.xml"]\nend = 30\n'
        '[ego]\nid = "ego"\ncontroller = "krauss"\nparameters = { tau = 1.5 }\n[window]\ntrigger = 4\nhorizon = 9\n'
        '[adversary]\ncandidates = ["t", "f.2"]\nintents = ["Aggressive Cut-in"]\n'
        '[label]\nintents = ["Aggressive Cut-in"]\n'
    )
    loaded = load_input(write(tmp_path / "case.toml", text))
    assert (loaded.ego, loaded.ego_controller, loaded.ego_parameters) == ("ego", "krauss", {"tau": 1.5})
    assert (loaded.trigger, loaded.horizon, loaded.end, loaded.warm_up) == (4.0, 9.0, 30.0, 3.0)
    assert (loaded.candidates, loaded.intents) == (("t", "f.2"), ("Aggressive Cut-in",))
    assert loaded.label is not None
    assert loaded.label.source == "annotated"
    assert {path.name for path in loaded.files} == {"case.toml", "small.net.xml", "one.rou.xml"}


def test_a_scenarios_own_ego_has_sumos_defaults_filled_in(tmp_path: Path) -> None:
    network(tmp_path)
    text = 'schema = 1\nnetwork = "small.net.xml"\n[ego]\nroute = ["a", "b"]\ndepart = 2\nlane = 0\n'
    loaded = load_input(write(tmp_path / "case.toml", text))
    assert loaded.ego == EgoRoute(edges=("a", "b"), depart=2.0, lane=0, position="base", speed="max")


@pytest.mark.parametrize(
    ("extra", "part"),
    [
        ('tracks = "log.csv"\n', "log.csv cannot be read: No such file"),
        ('background = "log"\n', "background 'log' needs recorded tracks"),
        ('[signals]\nlog = "l.csv"\n', "l.csv cannot be read: No such file"),
        ('[demand]\nfiles = ["one.rou.xml"]\n[ego]\nid = "nobody"\n', "the ego 'nobody'"),
        ('[demand]\nfiles = ["one.rou.xml"]\n[adversary]\ncandidates = ["g.1"]\n', "adversary candidate 'g.1'"),
        ('[ego]\nroute = ["a", "z"]\ndepart = 0\n', "edge 'z'"),
        ('[demand]\nfiles = ["none.rou.xml"]\n', "none.rou.xml, which is missing"),
    ],
)
def test_what_a_scenario_asks_in_vain_is_refused(tmp_path: Path, extra: str, part: str) -> None:
    network(tmp_path)
    write(tmp_path / "one.rou.xml", ROUTES)
    assert part in refusal(write(tmp_path / "case.toml", 'schema = 1\nnetwork = "small.net.xml"\n' + extra))


def test_a_demand_for_another_network_names_edge_and_file(tmp_path: Path) -> None:
    network(tmp_path)
    write(tmp_path / "other.rou.xml", ROUTES.replace('edges="a b"', 'edges="a elsewhere"'))
    text = '<configuration><n value="small.net.xml"/><r value="other.rou.xml"/></configuration>'
    sentence = refusal(write(tmp_path / "case.sumocfg", text))
    assert "'elsewhere'" in sentence
    assert "other.rou.xml" in sentence


@pytest.mark.parametrize(
    ("lane", "drivable"),
    [
        ("", True),
        ('allow="bus passenger"', True),
        ('allow="all"', True),
        ('disallow="tram rail"', True),
        ('allow="bus bicycle"', False),
        ('disallow="passenger truck"', False),
        ('disallow="all"', False),
    ],
)
def test_a_network_needs_a_lane_for_passenger_cars(tmp_path: Path, lane: str, drivable: bool) -> None:
    path = network(tmp_path, lane)
    if drivable:
        assert load_input(path).network == path
    else:
        assert "no lane that a passenger car" in refusal(path)


def test_damaged_networks_are_refused(tmp_path: Path) -> None:
    whole = gzip.compress(NET.format(lane="").encode())
    cut = tmp_path / "cut.net.xml.gz"
    cut.write_bytes(whole[:-20])
    assert "truncated" in refusal(cut)
    noise = tmp_path / "noise.net.xml.gz"
    noise.write_bytes(b"no gzip at all")
    assert "damaged" in refusal(noise)
    assert "not valid XML" in refusal(write(tmp_path / "half.net.xml", NET.format(lane="")[:200]))
    assert "not valid XML" in refusal(write(tmp_path / "empty.net.xml", ""))
    assert "<routes>" in refusal(write(tmp_path / "one.rou.xml", ROUTES))


def test_what_is_no_input_is_refused(tmp_path: Path) -> None:
    assert "no file" in refusal(tmp_path / "none.net.xml")
    assert "is a folder" in refusal(tmp_path)
    assert "convert it" in refusal(write(tmp_path / "v.tfrecord-00001-of-00150", "x"))
    assert "is not an input" in refusal(write(tmp_path / "notes.txt", "x"))
    assert "shipped" in refusal(Path("no_such_place"))


@pytest.mark.parametrize("name", ["two_way", "two_way.net.xml", "networks/two_way.net.xml", "networks/two_way"])
def test_a_shipped_network_is_found_from_anywhere(name: str, tmp_path: Path) -> None:
    if not (data_folder("networks") / "two_way.net.xml").is_file():
        pytest.skip("the networks are not built")
    loaded = load_input(Path(name))
    assert loaded.name == "two_way"
    assert loaded.network.resolve() == (data_folder("networks") / "two_way.net.xml").resolve()


def test_a_file_at_hand_goes_before_a_shipped_name(tmp_path: Path) -> None:
    own_network = write(tmp_path / "two_way.net.xml", NET.format(lane=""))
    assert load_input(own_network).path == own_network


def test_every_shipped_name_loads() -> None:
    names = shipped_names()
    assert len(names) == len(set(names))
    assert all(load_input(Path(name)).name == name for name in names)


def test_names_lose_their_known_endings() -> None:
    names = ("x.net.xml.gz", "a.b.net.xml", "run.sumocfg", "s.toml")
    assert [input_name(Path(name)) for name in names] == ["x", "a.b", "run", "s"]


def test_five_megabytes_of_demand_take_less_than_a_second(tmp_path: Path) -> None:
    line = '<vehicle id="v{}" depart="{}" departLane="best"><route edges="a b a b a b a b a b a b"/></vehicle>\n'
    text = "<routes>" + "".join(line.format(i, i) for i in range(52_000)) + "</routes>"
    path = write(tmp_path / "big.rou.xml", text)
    assert path.stat().st_size > 5_000_000
    begin = time.process_time()  # of this process, so that a busy machine fails no test
    scan = scan_demand(path)
    assert time.process_time() - begin < 1.0
    assert scan.edges == ("a", "b")
    assert len(scan.vehicles) == 52_000


def test_a_sumocfg_keeps_its_options_and_names_those_that_it_cannot_keep(tmp_path: Path) -> None:
    """A step of 0.05 s, a seed, ballistic motion and SUMO's own action on collisions are kept; outputs are not."""
    network(tmp_path)
    configured = write(
        tmp_path / "own.sumocfg",
        '<configuration><input><net-file value="small.net.xml"/></input><time><step-length value="0.05"/></time>'
        '<processing><step-method.ballistic value="true"/><collision.action value="teleport"/>'
        '<time-to-teleport value="90"/></processing><output><fcd-output value="fcd.xml"/></output>'
        '<random_number><seed value="7"/></random_number></configuration>',
    )
    loaded = load_input(configured)
    assert loaded.options == {
        "step-method.ballistic": "true", "time-to-teleport": "90", "collision.action": "teleport"
    }  # fmt: skip
    assert own_simulation(loaded) == {"seed": 7, "step_length": 0.05}
    assert loaded.notes == ("Not kept of own.sumocfg, because this program sets them itself: fcd-output=fcd.xml.",)


def test_collisions_are_as_configured_where_an_attack_can_be_told_apart(tmp_path: Path) -> None:
    """SUMO passes over collisions of a moved vehicle under ``teleport`` alone, and not on junctions. So a stop after
    one is not kept under ``warn``, nor a teleport where collisions on junctions are looked for."""
    network(tmp_path)
    configured = write(
        tmp_path / "own.sumocfg",
        '<configuration><input><net-file value="small.net.xml"/></input><time><step-length value="0.1"/></time>'
        '<processing><collision.action value="warn"/><collision.stoptime value="3"/>'
        '<collision.mingap-factor value="1"/><collision.check-junctions value="false"/></processing></configuration>',
    )
    loaded = load_input(configured)
    assert loaded.options == {
        "collision.mingap-factor": "1", "collision.check-junctions": "false", "collision.action": "warn",
        "collision.stoptime": "0",
    }  # fmt: skip
    (note,) = loaded.notes
    assert "collisions is not kept (collision.action=warn, collision.stoptime=3)" in note
    for given, action, notes in (
        ("", None, 0), ('<collision.stoptime value="3"/>', None, 0), ('<collision.action value="remove"/>', "warn", 1),
        ('<collision.check-junctions value="true"/>', "warn", 1), ('<collision.action value="none"/>', "none", 0),
    ):  # fmt: skip
        text = f'<net-file value="small.net.xml"/><step-length value="0.1"/>{given}'
        loaded = load_input(write(tmp_path / "own.sumocfg", f"<configuration>{text}</configuration>"))
        assert (loaded.options or {}).get("collision.action") == action and len(loaded.notes) == notes


@pytest.mark.parametrize(
    ("given", "brought", "said"),
    [
        ("2", 0.1, "2 s, is not kept: this program takes steps of 0.01 to 0.5 s, here of 0.1 s, of which 20 make one."),
        ("0.75", 0.075, "0.75 s, is not kept: this program takes steps of 0.01 to 0.5 s, here of 0.075 s, of which 10"),
        (None, 0.1, "SUMO's default of 1 s, is not kept: this program takes steps of 0.01 to 0.5 s, here of 0.1 s, of"),
        ("0.997", None, "0.997 s, is not kept: this program takes steps of 0.01 to 0.5 s, here of its own."),
        ("0.001", None, "0.001 s, is not kept: this program takes steps of 0.01 to 0.5 s, here of its own."),
    ],
)
def test_a_step_that_is_not_kept_is_a_multiple_of_the_one_taken(
    tmp_path: Path, given: str | None, brought: float | None, said: str
) -> None:
    """997 ms are a prime number of them, and 1 ms has no shorter part."""
    network(tmp_path)
    step = f'<time><step-length value="{given}"/></time>' if given else ""
    configured = write(
        tmp_path / "own.sumocfg",
        f'<configuration><input><net-file value="small.net.xml"/></input>{step}</configuration>',
    )
    loaded = load_input(configured)
    assert own_simulation(loaded) == {"seed": 23423, **({} if brought is None else {"step_length": brought})}
    assert len(loaded.notes) == 1
    assert loaded.notes[0].startswith(f"The step-length of own.sumocfg, {said}")


def test_a_network_alone_brings_no_options_of_its_own(tmp_path: Path) -> None:
    loaded = load_input(network(tmp_path))
    assert (loaded.options, own_simulation(loaded), loaded.notes) == (None, {}, ())


def test_options_of_sumo_are_name_and_value_and_have_one_place() -> None:
    assert parse_options(["time-to-teleport=300", "--scale=2"]) == {"time-to-teleport": "300", "scale": "2"}
    with pytest.raises(UsageError, match="takes NAME=VALUE, such as time-to-teleport=300, not 'scale'"):
        parse_options(["scale"])
    with pytest.raises(UsageError, match="'seed' cannot be passed through: use --seed"):
        refuse({"seed": "3"})
    with pytest.raises(UsageError, match=r"'collision.action' is set by this program: leave it out"):
        refuse({"collision.action": "remove"})
