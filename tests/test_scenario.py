"""The scenario file: known keys are read, and unknown ones are refused by name."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from pydantic import ValidationError

from sumo_adv.errors import UsageError
from sumo_adv.simulation.scenario import Scenario, load_scenario

FULL = """
schema = 1
network = "maps/here.net.xml"
tracks = "log.csv"
background = "log"

[demand]
density = 12.5
seed = 4
begin = 10
end = 70.0

[ego]
route = ["a", "b"]
depart = 11.0
lane = 1
position = 25.0
speed = "max"
controller = "idm"
parameters = { tau = 1.2, note = "slow" }
type = "car"

[window]
warm_up = 2.0
trigger = 15.5
horizon = 8.0

[adversary]
candidates = ["x", "y"]
intents = ["Aggressive Cut-in"]

[signals]
files = ["lights.add.xml"]
log = "lights.csv"

[label]
intents = ["Straight Lane Shift"]
source = "oracle"

[[parked]]
x = 1.0
y = -2.0
heading = 0.5
length = 4.5
width = 1.8

[[pedestrians]]
x = 3.0
y = 4.0
heading = 0.0
length = 0.5
width = 0.5
speed = 1.4
times = [12.0, 20.0]
"""
MINIMAL = 'schema = 1\nnetwork = "here.net.xml"\n'
TWO = '[[attackers]]\nid = "a"\n[[attackers]]\nid = "b"\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(UsageError) as caught:
        load_scenario(written(folder, text))
    sentence = str(caught.value)
    assert "case.toml" in sentence
    assert "\n" not in sentence
    return sentence


def test_every_key_is_read_and_paths_count_from_the_scenarios_folder(tmp_path: Path) -> None:
    scenario = load_scenario(written(tmp_path, FULL))
    assert scenario.network == tmp_path / "maps" / "here.net.xml"
    assert scenario.tracks == tmp_path / "log.csv"
    assert scenario.signals.files == (tmp_path / "lights.add.xml",)
    assert (scenario.demand.density, scenario.demand.seed, scenario.demand.begin, scenario.demand.end) == (
        12.5,
        4,
        10,
        70,
    )
    assert scenario.ego.route == ("a", "b")
    assert scenario.ego.parameters == {"tau": 1.2, "note": "slow"}
    assert (scenario.window.trigger, scenario.window.horizon) == (15.5, 8.0)
    assert scenario.label is not None
    assert scenario.label.source == "oracle"
    assert scenario.pedestrians[0].times == (12.0, 20.0)


def test_a_minimal_scenario_has_the_documented_defaults(tmp_path: Path) -> None:
    scenario = load_scenario(written(tmp_path, MINIMAL))
    assert (scenario.background, scenario.window.trigger, scenario.window.warm_up) == (None, "auto", 3.0)
    assert scenario.label is None


def test_an_absolute_path_stays(tmp_path: Path) -> None:
    absolute = tmp_path / "elsewhere" / "x.net.xml"
    assert load_scenario(written(tmp_path, f"schema = 1\nnetwork = '{absolute}'\n")).network == absolute


@pytest.mark.parametrize(
    ("extra", "key", "known"),
    [
        ("colour = 1\n", "'colour'", "background"),
        ("[ego]\nid = 'a'\nspeeed = 3\n", "'ego.speeed'", "controller"),
        ("[[parked]]\nx=0\ny=0\nheading=0\nlength=1\nwidth=1\nheight=2\n", "'parked.0.height'", "times"),
    ],
)
def test_an_unknown_key_is_refused_by_name_with_the_known_ones(
    tmp_path: Path, extra: str, key: str, known: str
) -> None:
    sentence = refusal(tmp_path, MINIMAL + extra)
    assert key in sentence
    assert known in sentence


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ('network = "x.net.xml"\n', "lacks the key 'schema'"),
        ("schema = 1\n", "lacks the key 'network'"),
        ('schema = 2\nnetwork = "x"\n', "schema = 2"),
        ('schema = 1\nnetwork = "' + "x" * 5000 + '"\n', "bad 'network': the name of the file is too long"),
        (MINIMAL + '[ego]\nid = "a"\nroute = ["b"]\ndepart = 1\n', "either id or route"),
        (MINIMAL + '[ego]\nroute = ["b"]\n', "needs a depart time"),
        (MINIMAL + "[ego]\ndepart = 1\n", "depart needs a route"),
        (MINIMAL + '[demand]\nfiles = ["a"]\ndensity = 2\n', "either files or density"),
        (MINIMAL + "[demand]\nbegin = 9\nend = 9\n", "end must be later"),
        (MINIMAL + "[demand]\ndensity = 0\n", "'demand.density'"),
        (MINIMAL + "[demand]\nend = inf\n", "'demand.end'"),
        (MINIMAL + '[window]\ntrigger = "soon"\n', "'window.trigger"),
        (MINIMAL + "[label]\nintents = []\n", "'label.intents'"),
        (MINIMAL + TWO + 'asked = { level = "valid" }\n', "level and within hold for all attackers"),
        (MINIMAL + TWO + "asked = { within = 3.0 }\n", "level and within hold for all attackers"),
        (MINIMAL + "[asked]\nwithin = 3.0\n", "within in [asked] bounds the time between attackers"),
        ("schema = = 1\n", "not valid TOML"),
    ],
)
def test_a_bad_value_is_refused_with_its_key(tmp_path: Path, text: str, part: str) -> None:
    assert part in refusal(tmp_path, text)


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be read"):
        load_scenario(tmp_path / "none.toml")


def test_a_scenario_is_frozen_and_angles_are_radians(tmp_path: Path) -> None:
    scenario = load_scenario(written(tmp_path, FULL))
    assert -math.pi < scenario.parked[0].heading <= math.pi
    with pytest.raises(ValidationError):
        Scenario.__setattr__(scenario, "background", "sumo")
