"""The three lists of named scenarios, filters by their names, what was met, and where roads join."""

from __future__ import annotations

import json
from typing import Any

import pytest
from cli_samples import ROOT, Program
from page_samples import attempt, outcome

from sumo_adv.datatypes import Level, NamedScenario, RoadGeometry
from sumo_adv.report.scenario_table import never_met, scenario_csv, scenario_rows, scenario_section, tallies_of
from sumo_adv.scenario_names import EVERY, ISO_34502, NHTSA, ScenarioName, columns_of, is_one_of, wanted
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.road_geometry import geometry_of

BRAKES = NamedScenario("leader brakes", 25, "main roadway, lane keep, deceleration", "CCRb")
CROSSES = NamedScenario("crosses from the left", 30, "", "CCCscp")


def test_the_lists_have_37_scenarios_and_24_disturbances() -> None:
    assert (len(NHTSA), len(ISO_34502), len(set(ISO_34502))) == (37, 24, 24)
    assert columns_of(BRAKES) == {
        "motion": "leader brakes", "nhtsa": "25 Lead vehicle decelerating",
        "iso_34502": "main roadway, lane keep, deceleration", "euro_ncap": "CCRb",
    }  # fmt: skip
    assert set(columns_of(None).values()) == {None}


def test_a_filter_takes_names_of_each_list() -> None:
    """``cut-in`` is a name of Euro NCAP and one of six disturbances: three geometries, two behaviours."""
    assert wanted(["ccftap"]) == (ScenarioName("Euro NCAP", "CCFtap"),)
    assert len(wanted(["cut-in"])) == 7 and len(wanted(["merge zone"])) == 8
    assert is_one_of(columns_of(BRAKES), wanted(["nhtsa-25"])) and is_one_of(
        columns_of(BRAKES), wanted(["CCRb", "CPNA"])
    )
    assert not is_one_of(columns_of(CROSSES), wanted(["deceleration"]))
    with pytest.raises(ValueError, match="there is no scenario 'CCRx'"):
        wanted(["CCRx"])
    with pytest.raises(ValueError, match="no attack shows the scenario 'nhtsa-9'"):
        wanted(["nhtsa-9"])


def episode(*attempts: tuple[NamedScenario, str]) -> dict[str, Any]:
    """An episode with attempts of these scenarios and levels."""
    listed = [
        {**attempt(k, "a", level=level), "named_scenario": columns_of(scenario)}
        for k, (scenario, level) in enumerate(attempts)
    ]
    return outcome(attempts=listed)


def test_encounters_count_once_in_a_scenario_with_their_highest_level() -> None:
    """Two attempts of one encounter, and an encounter before it that gave no success."""
    document = episode((BRAKES, "collision"), (BRAKES, "valid"))
    document["encounters_tried"] = [
        {"time": -1.0, "named_scenarios": [{**columns_of(BRAKES), "attempts": 5, "level": "critical"}]}
    ]
    rows = {row.name.name: row for row in scenario_rows(tallies_of(document))}
    row = rows["CCRb"]
    assert (row.encounters, row.attempts) == (2, 7)
    assert [row.reached[level] for level in (Level.CRITICAL, Level.COLLISION, Level.VALID, Level.STRICT)] == [
        2,
        1,
        1,
        0,
    ]
    assert rows["25 Lead vehicle decelerating"].attempts == 7 and rows["CCCscp"].encounters == 0


def test_what_was_never_met_is_listed_but_for_what_no_attack_shows() -> None:
    rows = scenario_rows(tallies_of(episode((BRAKES, "valid"))))
    assert len(rows) == len(EVERY) == len(scenario_csv(rows).splitlines()) - 1
    assert "26" in never_met(rows, "NHTSA") and not {"25", "9"} & {*never_met(rows, "NHTSA")}
    section = scenario_section(rows)
    assert "<td>CCRb</td>" in section and "Euro NCAP, never met" in section
    assert scenario_section(scenario_rows([])) == ""


@pytest.mark.parametrize(
    ("network", "expected"),
    [
        ("straight_3lane", RoadGeometry.MAIN),
        ("onramp_merge", RoadGeometry.MERGE),
        ("priority_crossing", None),
        ("t_junction", None),
    ],
)
def test_where_roads_join_and_cross(network: str, expected: RoadGeometry | None) -> None:
    """80 m before the end of the first road that leads on."""
    road = read_network(ROOT / "networks" / f"{network}.net.xml")
    leading_on = [lane for lane in road.lanes.values() if lane.connections and not lane.internal]
    lane = (leading_on or list(road.lanes.values()))[0]
    assert geometry_of(road, lane, max(lane.length - 80.0, 0.0), 120.0) is expected


def test_a_run_looks_for_a_named_scenario(program: Program) -> None:
    """A leader brakes in each attempt, so that no attempt is a cut-in; as CCRb it succeeds."""
    few = ("--attempts", "3", "--until", "collision", "--ego", "idm", "--learn", "off")
    done = program.here("run", "leader_brakes_hard", *few, "--scenario", "CCRb", "--out", "braking")
    assert done.status == 0 and "COLLISION" in done.out.upper(), done.err
    other = program.here("run", "leader_brakes_hard", *few, "--scenario", "cut-in", "--out", "cut_in")
    assert "It shows leader brakes" in (program.folder / "cut_in" / "outcome.json").read_text(), other.err
    repeated = program.here("run", "--replay", "cut_in", "--out", "again")
    endings = [json.loads((program.folder / f / "outcome.json").read_text()) for f in ("cut_in", "again")]
    assert [o["ending"] for o in endings] == ["attempts_exhausted"] * 2, repeated.err
    assert endings[1]["attempts"][0]["misfits"] == ["It shows leader brakes, not cut-in."]
    refused = program.here("run", "leader_brakes_hard", "--scenario", "CCRx")
    assert refused.status == 2 and "there is no scenario 'CCRx'" in refused.err
