"""Choosing an attack: what counts as success, which intents and relations are tried, and that a run records it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program, refusal_of
from situation_samples import neighbour, situation

import sumo_adv
from sumo_adv.app import shipped_bank
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Level, LibraryEntry, Prediction, Proposal, Verdict
from sumo_adv.episode.memory_access import selected
from sumo_adv.errors import UsageError
from sumo_adv.goal import Goal
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import write_part
from sumo_adv.memory.migrations import utc_now
from sumo_adv.planners.text import make_planner
from sumo_adv.search.intents import Selection, select
from sumo_adv.search.scoring import goal_score
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import ScoreSettings, SearchSettings

LABELS = ("Straight Lane Shift", "Emergency Braking")
ENDPOINT = """
def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}
"""


def verdict(level: Level, *, min_ttc: float = 0.0, delta_v: float | None = None, collided: bool = True) -> Verdict:
    """A feasible attempt that is no rear-end."""
    seen = Verdict(min_ttc, 0.0, collided, True, True, False)
    return replace(seen, level=level, delta_v=delta_v)


# -- what counts as success


def test_a_level_is_met_from_itself_upwards() -> None:
    goal = Goal(Level.VALID)
    assert [goal.met(verdict(level)) for level in Level] == [False, False, False, True, True, True]


def test_a_near_miss_lies_in_the_band_and_touches_nothing() -> None:
    goal = Goal(Level.CRITICAL, ttc=(0.5, 1.5))
    apart = [verdict(Level.CRITICAL, min_ttc=t, collided=False) for t in (0.4, 0.5, 1.5, 1.6)]
    assert [goal.met(v) for v in apart] == [False, True, True, False]
    assert not goal.met(verdict(Level.SERIOUS, min_ttc=0.0, delta_v=9.0))
    assert not goal.met(replace(apart[1], feasible=False))


def test_a_least_delta_v_takes_a_collision_at_any_level() -> None:
    goal = Goal(Level.CRITICAL, min_delta_v=4.0)
    assert goal.met(verdict(Level.COLLISION, delta_v=4.0))
    assert not goal.met(verdict(Level.SERIOUS, delta_v=3.9))
    assert not goal.met(verdict(Level.CRITICAL, min_ttc=0.3, collided=False))
    assert goal.reached(verdict(Level.SERIOUS, delta_v=3.9)) is Level.CRITICAL


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"ttc": (1.5, 0.5)}, "LOW is 0 s or more, HIGH is larger"),
        ({"ttc": (0.5, 1.5), "until": "valid"}, "ttc wants a near miss and until = valid a collision"),
        ({"ttc": (0.5, 1.5), "min_delta_v": 3.0}, "ttc wants a near miss and min_delta_v a collision"),
        ({"ttc": 1.0}, "the min TTC that is critical is the setting critical_ttc"),
        ({"kind": "oncomming"}, "There is no kind 'oncomming'; the nearest is 'oncoming'; known kinds are leader"),
    ],
)
def test_what_cannot_be_wanted_is_one_sentence(given: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        load_settings(None, **given)


# -- scores


WEIGHTS = ScoreSettings()


def near(min_ttc: float, gap: float = 1.0) -> Prediction:
    return Prediction(min_ttc=min_ttc, gap=gap)


def test_a_near_miss_is_best_in_the_middle_of_the_band() -> None:
    goal = Goal(Level.CRITICAL, ttc=(0.5, 1.5))
    scores = [goal_score(goal, 9.0, near(t), WEIGHTS) for t in (1.0, 1.25, 1.5, 1.6, 3.0)]
    assert scores[:3] == pytest.approx([0.0, 0.15, 0.3])  # strict 0.3, times 0, half and the whole way to the edge
    assert scores[3] == pytest.approx(1.5 + 0.3 * 0.1 + 0.1)  # a miss: 0.1 s too late, 1 m away
    assert scores == sorted(scores)
    hit = goal_score(goal, 0.0, Prediction(hit=True, min_ttc=0.0, level=Level.SERIOUS), WEIGHTS)
    assert hit == pytest.approx(1.5 + 0.3 * 0.5 + 0.3)


def test_what_fails_anyway_keeps_its_score() -> None:
    goal = Goal(Level.CRITICAL, ttc=(0.5, 1.5))
    assert goal_score(goal, 3.0, replace(near(1.0), off_road=True), WEIGHTS) == 3.0
    assert goal_score(goal, 5.0, Prediction(hit=True, min_ttc=0.0), WEIGHTS) == 5.0  # into the ego's back


def test_a_collision_that_is_too_mild_scores_as_a_miss() -> None:
    goal = Goal(Level.VALID, min_delta_v=4.0)
    hit = Prediction(hit=True, level=Level.SERIOUS, delta_v=3.0)
    assert goal_score(goal, 0.0, hit, WEIGHTS) == pytest.approx(1.5 + 0.3 * 0.25)
    assert goal_score(goal, 0.0, replace(hit, delta_v=4.0), WEIGHTS) == 0.0


# -- which intents


def test_intents_are_known_in_any_case_and_spacing() -> None:
    chosen = select(LABELS, ["straight lane-shift"])
    assert chosen.allows("Straight Lane Shift") and not chosen.allows("Emergency Braking")
    without = select(LABELS, exclude=["emergency braking"])
    assert without.allows("Straight Lane Shift") and not without.allows("Emergency Braking")
    assert select(LABELS).is_open and not without.is_open


def test_the_setting_goes_before_the_intents_of_the_scenario() -> None:
    own = ["Emergency Braking", "Close Car-following"]
    assert [select(LABELS, scenario=own).allows(label) for label in LABELS] == [False, True]
    chosen = select(LABELS, ["Straight Lane Shift"], scenario=own)
    assert [chosen.allows(label) for label in LABELS] == [True, False]
    with pytest.raises(UsageError, match="left to try: the scenario's own list and exclude together leave none"):
        select(LABELS, exclude=["Emergency Braking"], scenario=["Emergency Braking"])


def test_an_unknown_intent_is_refused_with_the_known_ones() -> None:
    with pytest.raises(
        UsageError, match="'Strait Lane Shift'; the nearest is 'Straight Lane Shift'; known intents are"
    ):
        select(LABELS, ["Strait Lane Shift"])
    with pytest.raises(UsageError, match="No intent is left to try"):
        select(LABELS, ["Emergency Braking"], ["Emergency Braking"])


def test_the_intents_of_a_scenario_are_known_in_any_case_too() -> None:
    assert [select(LABELS, scenario=["emergency-braking"]).allows(label) for label in LABELS] == [False, True]


def test_a_scenario_may_name_what_the_program_ships_and_nothing_else(tmp_path: Path) -> None:
    with MemoryBank.open(shipped_bank(), read_only=True) as bank:
        write_part(bank, tmp_path / "one.sqlite", ["Emergency Braking"], utc_now)
    settings = load_settings()
    with MemoryBank.open(tmp_path / "one.sqlite", read_only=True) as bank:
        assert not selected(settings, bank, ["Aggressive Cut-in"]).allows("Emergency Braking")
        with pytest.raises(UsageError, match="There is no intent 'Cut-in'; known intents are"):
            selected(settings, bank, ["Aggressive Cut-in", "Cut-in"])
        chosen = load_settings(None, intents=["Emergency Braking"])  # goes before the scenario's list
        assert selected(chosen, bank, ["Cut-in"]).allows("Emergency Braking")


class Counted:
    """All candidates collide; ``labels`` are the intents that were predicted."""

    def __init__(self) -> None:
        self.labels = set[str]()

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        self.labels |= {p.label for p in proposals}
        return [replace(p, score=0.05) for p in proposals]


def test_nothing_of_another_intent_is_even_predicted() -> None:
    library = [
        LibraryEntry(
            label, label, ("neighbour",), (make_planner(label, "side", "PARAMETERS = {}\n" + ENDPOINT, "seed"),)
        )
        for label in LABELS
    ]
    scorer = Counted()
    AttackSearch(
        scorer, {0.0: situation([neighbour()])}, library, SearchSettings(proposals=10), seed=1,
        selection=Selection(exclude=frozenset(["Emergency Braking"])),
    )  # fmt: skip
    assert scorer.labels == {"Straight Lane Shift"}


# -- through the command line and the interface


QUICK = ("--attempts", "1", "--learn", "off", "--out", "out")


def test_unknown_intents_and_kinds_are_refused_before_anything_runs(program: Program) -> None:
    refusal = refusal_of(program, "run", "motorway_cut_in_left", "--intents", "Cut-in", "--out", "out")
    assert "There is no intent 'Cut-in'" in refusal and "Aggressive Cut-in, Close Car-following" in refusal
    assert "known kinds are leader, follower" in refusal_of(program, "run", "motorway_cut_in_left", "--kind", "left")
    refusal = refusal_of(program, "batch", "motorway_cut_in_left", "--exclude", "Cut-in", "--out", "out")
    assert "There is no intent 'Cut-in'" in refusal


def test_a_run_tries_what_was_chosen_records_it_and_replays(program: Program) -> None:
    chosen = (
        "--intents",
        "Straight Lane Shift,Aggressive Cut-in",
        "--exclude",
        "aggressive cut-in",
        "--ttc",
        "0.4",
        "1.8",
    )
    done = program.here("run", "motorway_cut_in_left", *chosen, *QUICK, "--json")
    assert done.status == 0, done.err
    assert {i["label"] for i in done.outcome["intents"]} == {"Straight Lane Shift"}
    assert done.outcome["goal"] == "near miss with a min TTC of 0.4 to 1.8 s"
    settings = done.manifest["settings"]
    assert settings["intents"] == ["Straight Lane Shift", "Aggressive Cut-in"] and settings["ttc"] == [0.4, 1.8]
    again = json.loads(program.here("run", "--replay", "out", "--out", "again", "--json").out)
    assert again["outcome"] == done.outcome["outcome"]


def test_only_vehicles_of_the_kind_are_candidates(program: Program) -> None:
    result = sumo_adv.run(
        "oncoming_four_lanes", kind=["oncoming"], attempts=1, learn="off", memory=program.folder / "bank.sqlite"
    )
    assert {r["relation"] for r in result.outcome.document["encounter"]["ranking"]} == {"oncoming"}


def test_a_batch_takes_the_same_options(program: Program) -> None:
    done = program.here(
        "batch", "motorway_cut_in_left", "--kind", "neighbour", "--min-delta-v", "3", "--until", "valid", "--attempts",
        "1", "--set", "proposals=8", "--out", "out", "--json",
    )  # fmt: skip
    assert done.status == 0, done.err
    (settings,) = json.loads((program.folder / "out" / "plan.json").read_text(encoding="utf-8"))["settings"]
    assert (settings["kind"], settings["min_delta_v"], settings["until"]) == (["neighbour"], 3.0, "valid")
