"""Floating car data as a scenario: what the program exports it takes back, and what is none it refuses."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from cli_samples import ROOT
from run_samples import run_folder
from sumo_samples import make_net
from typer.testing import CliRunner

import sumo_adv
from sumo_adv.cli.main import app
from sumo_adv.errors import UsageError
from sumo_adv.report.export.piece import read_piece
from sumo_adv.report.export.sumo import TYPES_FILE, fcd, write_replay
from sumo_adv.simulation.fcd_scenario import write_scenario
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.scenario import ROUTES_FILE, SCENARIO_FILE, TRACKS_FILE
from sumo_adv.simulation.tracks import read_tracks

NETWORK = ROOT / "networks" / "two_way.net.xml"


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unattacked run of the crossing, exported as FCD and taken back."""
    folder = tmp_path_factory.mktemp("import")
    piece = read_piece(run_folder("crossing"), unattacked=True, whole=True)
    (folder / "fcd.xml.gz").write_bytes(gzip.compress(fcd(piece).encode()))
    (folder / "sumo").mkdir()
    write_replay(folder / "sumo", piece)
    (folder / "made").mkdir()
    write_scenario(folder / "made", folder / "fcd.xml.gz", piece.network, "ego", [folder / "sumo" / TYPES_FILE])
    return folder / "made"


def test_tracks_come_back_as_they_were(imported: Path) -> None:
    piece = read_piece(run_folder("crossing"), unattacked=True, whole=True)
    log = read_tracks(imported / TRACKS_FILE)
    assert set(log.tracks) == {track.id for track in piece.tracks}
    for track in piece.tracks:
        back = log.track(track.id)
        assert back.time == pytest.approx(track.time, abs=1e-6)
        assert np.hypot(back.x - track.x, back.y - track.y).max() < 1e-3
        assert back.speed == pytest.approx(track.speed, abs=1e-3)
        assert (back.length, back.width) == (track.length, track.width)


def test_routes_are_those_that_were_driven(imported: Path) -> None:
    text = (imported / ROUTES_FILE).read_text()
    assert '<route id="ego" edges="west_in east_out"/>' in text
    assert '<route id="turning" edges="east_in south_out"/>' in text  # a left turn


def test_the_scenario_runs(imported: Path, tmp_path: Path) -> None:
    assert load_input(imported / SCENARIO_FILE).ego == "ego"
    bank = tmp_path / "bank.sqlite"
    result = sumo_adv.run(
        imported / SCENARIO_FILE, attempts=1, proposals=24, learn="off", out=tmp_path / "out", memory=bank
    )  # fmt: skip
    assert len(result.outcome.attempts) == 1


def text_of(*vehicles: str) -> str:
    return f'<fcd-export><timestep time="1.00">{"".join(vehicles)}</timestep></fcd-export>'


CAR = '<vehicle id="a" x="12.5" y="-1.6" angle="90" speed="3" lane="eastbound_0" type="t"/>'
PERSON = '<person id="p" x="7" y="5" angle="0" speed="1"/>'


AT_NIGHT = f'<timestep time="1.01">{CAR}</timestep><timestep time="500000">{CAR}</timestep></fcd-export>'  # 5e7 steps


def test_bumpers_become_centres_and_persons_stay(tmp_path: Path) -> None:
    (tmp_path / "fcd.xml").write_text(text_of(CAR, PERSON))
    assert write_scenario(tmp_path, tmp_path / "fcd.xml", NETWORK, "a", warm_up=0.0).objects == 2
    log = read_tracks(tmp_path / TRACKS_FILE)
    car, person = log.tracks["a"], log.tracks["p"]
    assert (car.kind, car.x[0], car.y[0], car.heading[0]) == ("vehicle", 10.0, -1.6, 0.0)  # 5 m long
    assert (person.kind, person.x[0], person.y[0]) == ("pedestrian", 7.0, 5.0)
    assert person.heading[0] == pytest.approx(np.pi / 2, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (text_of(CAR.replace('id="a"', 'id="b"')), "There is no vehicle 'a' in .*; it has b."),
        (text_of(CAR.replace("eastbound_0", "elsewhere_0")), "is on no lane of two_way.net.xml"),
        (text_of(CAR.replace('x="12.5"', 'x="nan"')), "has nan for x, which is not a finite number"),
        (text_of(CAR.replace('angle="90"', "")), "is not SUMO's FCD"),
        (text_of(), "has no vehicle in a timestep"),
        (text_of(CAR).replace('time="1.00"', 'time="inf"'), "a timestep at inf"),
        (text_of(CAR).replace('time="1.00"', 'time="nan"'), "a timestep at nan"),
        (text_of(CAR).replace('time="1.00"', f'time="1{"0" * 400}"'), "a timestep at 1000"),
        (text_of(CAR.replace('x="12.5"', 'x="1e308"')), "not a place on a map"),
        (text_of(CAR).replace("</fcd-export>", AT_NIGHT), "more than 2e.07 states"),
        ('<?xml version="1.0" encoding="klingon"?>' + text_of(CAR), "written in 'klingon': write it in UTF-8"),
        ("<fcd-export><timestep", "is not valid XML"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, text: str, says: str) -> None:
    recording = tmp_path / "fcd.xml"
    recording.write_text(text)
    arguments = [str(recording), "--network", str(NETWORK), "--ego", "a", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, ["import", *arguments])
    assert isinstance(done.exception, UsageError)
    with pytest.raises(UsageError, match=says):
        raise done.exception
    assert [p.name for p in tmp_path.iterdir()] == ["fcd.xml"]


SHORT_NODES = "".join(
    f'<node id="{name}" x="{x}" y="0"/>' for name, x in (("a", 0), ("b", 100), ("c", 112), ("d", 212))
)
SHORT_EDGES = "".join(
    f'<edge id="{way}" from="{way[0]}" to="{way[1]}" speed="20"/>' for way in ("ab", "bc", "cd", "dc")
)


def test_edges_that_a_vehicle_passes_between_two_states_are_on_its_route(tmp_path: Path) -> None:
    """At 20 m/s and with steps of 1 s, ``a`` is never recorded on ``bc`` of 12 m. ``b`` overtakes on the other side of
    ``cd``, to which nothing leads."""
    network = make_net(tmp_path, SHORT_NODES, SHORT_EDGES, "--no-turnarounds", "--offset.disable-normalization")
    state = '<vehicle id="{}" x="{}" y="-1.6" angle="90" speed="20" lane="{}_0" type="t"/>'
    places = [(75, 55, "ab", "ab"), (95, 75, "ab", "ab"), (115, 95, "cd", "ab"), (135, 115, "cd", "dc")]
    steps = "".join(
        f'<timestep time="{k}">{state.format("a", x, on)}{state.format("b", y, other)}</timestep>'
        for k, (x, y, on, other) in enumerate(places)
    )
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    made = write_scenario(tmp_path, tmp_path / "fcd.xml", network, "a", warm_up=0.0)
    text = (tmp_path / ROUTES_FILE).read_text()
    assert '<route id="a" edges="ab bc cd"/>' in text and '<route id="b" edges="ab"/>' in text
    assert made.notes[-1] == (
        "Routes end before the recording does, where no connection leads to the next recorded edge: b."
    )
