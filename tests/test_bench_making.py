"""Suites: the shipped ones are whole and frozen, fresh ones calm and the same for the same seed, bad ones say why."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from sumo_adv.benchmark.drafts import (
    JUNCTION_KINDS,
    JUNCTION_NETWORKS,
    STRAIGHT_KINDS,
    Car,
    EncounterDraft,
    draw_junction,
    draw_straight,
    keep_apart,
    meetings,
    write_draft,
)
from sumo_adv.benchmark.making import ENCOUNTERS_PER_KIND, TrialWorker, candidate, make_suite, places_of, scenario_trial
from sumo_adv.benchmark.suites import load_suite, shipped_suites
from sumo_adv.errors import UsageError
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.forks import can_fork
from sumo_adv.simulation.inputs import data_folder, load_input

WOMD = Path(__file__).parents[2] / "shared" / "womd"
needs_forks = pytest.mark.skipif(not can_fork(), reason="suites are made where processes can be forked")


def test_suite81_is_fifty_straight_and_31_at_junctions_and_speaks_of_no_kind() -> None:
    suite = load_suite("suite81")
    assert Counter(case.group for case in suite.cases) == {"straight": 50, "intersection": 31}
    assert Counter(case.kind for case in suite.cases) == ENCOUNTERS_PER_KIND
    for case in suite.cases:
        run_input = load_input(case.path)
        assert run_input.name == case.name
        assert run_input.ego == "ego"
        assert run_input.label is None
        assert run_input.candidates == ()
        text = case.path.read_text() + run_input.routes[0].read_text()
        assert not any(word in text for word in ("leader", "follower", "neighbour", "oncoming", "crossing_"))
        assert 'sigma="0.5"' in text


def test_suite81_is_varied() -> None:
    inputs = [load_input(case.path) for case in load_suite("suite81").cases]
    assert len({given.network.name for given in inputs}) == 19
    vehicles = [given.routes[0].read_text().count("<vehicle ") for given in inputs]
    assert min(vehicles) == 2
    assert max(vehicles) >= 12


def test_smoke_names_six_cases_of_suite81_and_its_own_content() -> None:
    whole, smoke = load_suite("suite81"), load_suite("smoke")
    assert Counter(case.group for case in smoke.cases) == {"straight": 3, "intersection": 3}
    assert all(case in whole.cases for case in smoke.cases)
    assert smoke.content != whole.content
    assert shipped_suites() == ("smoke", "suite81")


def test_shipped_suites_are_small() -> None:
    size = sum(path.stat().st_size for path in data_folder("suites").rglob("*") if path.is_file())
    assert size < 1_500_000


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two encounters made with another seed than the shipped suite's."""
    folder = tmp_path_factory.mktemp("made") / "fresh"
    make_suite(7, folder, shares={"neighbour_ahead": 1, "crossing_priority": 1})
    return folder


@needs_forks
def test_a_fresh_copy_has_the_same_structure_and_other_figures(fresh: Path) -> None:
    suite = load_suite(str(fresh))
    assert (suite.name, [c.name for c in suite.cases]) == ("suite81-7", ["straight-01", "intersection-01"])
    shipped = {case.kind: case for case in reversed(load_suite("suite81").cases)}
    for case in suite.cases:
        fresh_input, shipped_input = load_input(case.path), load_input(shipped[case.kind].path)
        assert fresh_input.network.name == shipped_input.network.name
        assert fresh_input.routes[0].read_text() != shipped_input.routes[0].read_text()
        assert fresh_input.network.is_relative_to(fresh)


@needs_forks
def test_the_same_seed_makes_the_same_files(fresh: Path, tmp_path: Path) -> None:
    make_suite(7, tmp_path / "again", shares={"neighbour_ahead": 1, "crossing_priority": 1})
    files = {p.relative_to(fresh): p.read_bytes() for p in fresh.rglob("*") if p.is_file()}
    again = {p.relative_to(tmp_path / "again"): p.read_bytes() for p in (tmp_path / "again").rglob("*") if p.is_file()}
    assert files == again
    assert list(tmp_path.iterdir()) == [tmp_path / "again"]


def test_what_is_drawn_depends_on_seed_and_place_alone() -> None:
    place = places_of(ENCOUNTERS_PER_KIND)[0]
    assert candidate(place, 1, 0) == candidate(place, 1, 0)
    assert len({candidate(place, seed, k).ego for seed in (1, 2) for k in (0, 1)}) == 4


def write_pair(folder: Path, ego: Car, bv: Car, kind: str) -> tuple[Path, str]:
    """A scenario of two cars on the road with three lanes, and what the other one is called."""
    draft = EncounterDraft(kind, "straight_3lane", ego, bv, (), 4.0, "two cars.")
    (folder / "networks").mkdir(parents=True, exist_ok=True)
    shutil.copyfile(data_folder("networks") / "straight_3lane.net.xml", folder / "networks" / "straight_3lane.net.xml")
    return write_draft(draft, "pair", folder), draft.bv_id()


@needs_forks
def test_what_is_wrong_with_an_encounter_is_found_in_sumo(tmp_path: Path) -> None:
    ego = Car(("eastbound",), 1, 200.0, 20.0)
    leader = Car(("eastbound",), 1, 240.0, 20.0)
    stories = {
        "fine": (leader, "leader", ""),
        "ahead": (Car(("eastbound",), 1, 285.0, 20.0), "leader", ""),  # 80 m before it, and no vehicle is nearer
        "side": (leader, "neighbour_ahead", "the vehicle meant stands otherwise by then"),
        "far": (Car(("eastbound",), 1, 600.0, 20.0), "leader", "no vehicle near could endanger the ego"),
        "short": (ego, "leader", "the ego stays too short"),
    }
    trials = []
    for name, (bv, kind, _) in stories.items():
        me = Car(("eastbound",), 1, 1000.0, 20.0) if name == "short" else ego
        adversary = Car(("eastbound",), 1, 1040.0, 20.0) if name == "short" else bv
        scenario, meant = write_pair(tmp_path / name, me, adversary, kind)
        trials.append(scenario_trial(scenario, "idm", meant, kind))
    with Engine(TrialWorker, slots=1) as engine:
        assert engine.call(TrialWorker.trials, trials) == [expected for _, _, expected in stories.values()]


def test_ways_at_every_junction_meet_behind_both_stop_lines() -> None:
    for network in sorted({name for names in JUNCTION_NETWORKS.values() for name in names}):
        pairs = meetings(network)
        assert pairs, network
        assert all(m.conflict.ego_s > m.ego.ends - 1.0 and m.conflict.bv_s > m.bv.ends - 1.0 for m in pairs)
        assert all(m.ego.edges[0] != m.bv.edges[0] for m in pairs)


@pytest.mark.parametrize("kind", [*STRAIGHT_KINDS, *JUNCTION_KINDS])
def test_drawn_vehicles_fit_the_road_and_one_another(kind: str) -> None:
    draw = draw_straight if kind in STRAIGHT_KINDS else draw_junction
    for number in range(4):
        draft = draw(kind, number, Random(f"{kind}{number}"))
        cars = [draft.ego, *draft.others]
        assert all(5.0 <= car.speed <= 25.0 and car.place > 0 for car in [*cars, draft.bv])
        assert all(keep_apart(car, cars[:k]) for k, car in enumerate(cars) if car.depart == 0)
        assert next(iter(draft.named())) == "ego"
        assert draft.named()[draft.bv_id()] is draft.bv


def test_room_behind_a_leader_grows_with_speed() -> None:
    """At 20 m/s 1.15 s are 23 m, and 9 m for the car ahead and the gap: 32 m from front to front."""
    leader = Car(("a",), 0, 100.0, 20.0)
    assert not keep_apart(Car(("a",), 0, 69.0, 20.0), [leader])
    assert keep_apart(Car(("a",), 0, 67.0, 20.0), [leader])
    assert keep_apart(Car(("a",), 1, 99.0, 20.0), [leader])


def test_a_changed_file_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "suite"
    shutil.copytree(data_folder("suites") / "suite81", folder)
    demand = folder / "demand" / "straight-07.rou.xml"
    demand.write_text(demand.read_text() + "\n")
    with pytest.raises(UsageError, match=r"straight-07\.rou\.xml was changed since .* frozen"):
        load_suite(str(folder))
    demand.unlink()
    with pytest.raises(UsageError, match=r"lists demand/straight-07\.rou\.xml, which is missing"):
        load_suite(str(folder / "suite.toml"))


def test_labels_stand_beside_the_list_and_are_not_frozen(tmp_path: Path) -> None:
    folder = tmp_path / "suite"
    shutil.copytree(data_folder("suites") / "suite81", folder)
    before = load_suite(str(folder)).content
    labels = {"straight-01": {"idm": {"collision": ["Straight Lane Shift"], "valid": []}}}
    (folder / "labels.json").write_text(json.dumps(labels))
    suite = load_suite(str(folder))
    assert suite.content == before
    assert suite.cases[0].labels == {"idm": {"collision": ("Straight Lane Shift",), "valid": ()}}
    (folder / "labels.json").write_text(json.dumps({"straight-99": {}}))
    with pytest.raises(UsageError, match=r"labels 'straight-99', which is not a case"):
        load_suite(str(folder))


def test_what_people_hold_to_be_most_dangerous_comes_from_a_scenario_or_stands_beside_records(tmp_path: Path) -> None:
    shipped = load_suite("leader_two_lanes").cases[0].labels
    assert shipped == {"people": {"annotated": ("Straight Lane Shift", "Aggressive Cut-in")}}
    records = tmp_path / "records"
    records.mkdir()
    (records / "manifest.csv").write_text("id,suite\nab.1,straight\n")
    (records / "ab.1.tfrecord").write_bytes(b"")
    (records / "labels.json").write_text(json.dumps({"ab.1": {"people": {"annotated": ["Aggressive Cut-in"]}}}))
    assert load_suite(f"womd:{records}").cases[0].labels == {"people": {"annotated": ("Aggressive Cut-in",)}}
    (records / "labels.json").write_text(json.dumps({"cd.2": {}}))
    with pytest.raises(UsageError, match=r"labels 'cd\.2', which is not a case of .*manifest\.csv"):
        load_suite(f"womd:{records}")


def test_scenario_files_are_a_suite_too(tmp_path: Path) -> None:
    suite = load_suite("oncoming_country_road", "priority_straight_from_right")
    assert [(c.name, c.kind, c.group) for c in suite.cases] == [
        ("oncoming_country_road", "own", "straight"),
        ("priority_straight_from_right", "own", "intersection"),
    ]
    listed = tmp_path / "mine.toml"
    scenario = data_folder("scenarios") / "leader_two_lanes.toml"
    listed.write_text(
        'schema = 1\nname = "mine"\nversion = "3"\n[[cases]]\nname = "a"\nkind = "leader"\ngroup = "straight"\n'
        f"file = {json.dumps(str(scenario))}\n"
    )
    own_suite = load_suite(str(listed))
    assert (own_suite.name, own_suite.version) == ("mine", "3")
    assert (own_suite.cases[0].kind, own_suite.cases[0].path) == ("leader", scenario)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("cases = [", "not valid TOML"),
        ('schema = 2\nname = "a"\nversion = "1"\ncases = []', "bad 'schema'"),
        ('schema = 1\nname = "a"\nversion = "1"\ncases = []', "bad 'cases'"),
        ('schema = 1\nname = "a"\nversion = "1"\nsuite = "suite81"\ncases = ["x"]', "names 'x', which is not a case"),
        ('schema = 1\nname = "a"\nversion = "1"\nwhat = 1\ncases = []', "unknown key 'what'"),
        ('schema = 1\nname = "a"\nversion = "1"\nsuite = "smoke"\ncases = ["x"]', "not a list of scenarios"),
    ],
)
def test_a_bad_list_is_one_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "suite.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=sentence) as caught:
        load_suite(str(path))
    assert "\n" not in str(caught.value)


def test_what_is_no_suite_is_said_with_those_there_are(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no suite, folder or scenario 'suite99'; shipped suites are smoke, suite81"):
        load_suite("suite99")
    with pytest.raises(UsageError, match=r"holds neither a suite\.toml nor a scenario"):
        load_suite(str(tmp_path))
    with pytest.raises(UsageError, match=r"no manifest\.csv"):
        load_suite(f"womd:{tmp_path}")
    manifest = tmp_path / "manifest.csv"
    manifest.write_bytes(b"id,suite\n\xff\xfe,straight\n")
    with pytest.raises(UsageError, match=r"^The suite womd:.* cannot be read \("):
        load_suite(f"womd:{tmp_path}")
    manifest.write_text("id,suite\none,straight\none,straight\n", encoding="utf-8")
    with pytest.raises(UsageError, match=r"lists 'one' twice\.$"):
        load_suite(f"womd:{tmp_path}")
    manifest.unlink()
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    with pytest.raises(UsageError, match="not empty"):
        make_suite(1, tmp_path / "taken")
    with pytest.raises(UsageError, match="'my suite' is not a valid name for a suite"):
        make_suite(1, tmp_path / "new", name="my suite")


def test_a_manifest_of_records_is_a_suite(tmp_path: Path) -> None:
    (tmp_path / "manifest.csv").write_text(
        "id,future,suite\nab12,log,straight\ncd34.adv,synthetic adversary,intersection\n"
    )
    with pytest.raises(UsageError, match=r"ab12\.tfrecord, which is missing"):
        load_suite(f"womd:{tmp_path}")
    for name in ("ab12", "cd34.adv"):
        (tmp_path / f"{name}.tfrecord").write_bytes(name.encode())
    suite = load_suite(f"womd:{tmp_path}")
    assert [(c.name, c.record, c.kind, c.group) for c in suite.cases] == [
        ("ab12", "ab12", "log", "straight"),
        ("cd34.adv", "cd34", "synthetic_adversary", "intersection"),
    ]


@pytest.mark.skipif(not WOMD.is_dir(), reason="the Waymo records are not on this machine")
def test_the_waymo_records_are_45() -> None:
    suite = load_suite(f"womd:{WOMD}")
    assert Counter(case.group for case in suite.cases) == {"straight": 26, "intersection": 19}
