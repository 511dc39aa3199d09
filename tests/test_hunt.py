"""A hunt: distinct failures, rounds that follow from what was found, a clock, and going on."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program, refusal_of
from test_report_page import data_of

import sumo_adv
from sumo_adv.campaigns.campaign import Orders, Summary
from sumo_adv.campaigns.local import WorkerPace
from sumo_adv.campaigns.plan import CampaignPlan
from sumo_adv.campaigns.results import Input, Learn
from sumo_adv.cli.hunt import never_met_words, progress_line
from sumo_adv.datatypes import Level
from sumo_adv.drivers.timing import DriverTime
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.goal import Goal
from sumo_adv.hunting.failures import distinct, failure_of, table
from sumo_adv.hunting.hunt import Found, Hunt, HuntProgress, RunCampaign, count_failures
from sumo_adv.hunting.rounds import over_time
from sumo_adv.metrics.species import discovery

ROW: Mapping[str, Any] = {
    "id": "a", "level": "serious", "intent": "Cut", "composition": None, "relation": "neighbour", "road": "motorway",
    "ego_speed": 25.0, "kind": "Cut / neighbour / left", "delta_v": 3.0, "network": "good", "seed": 1,
    "adversary": "bv", "preventable_by": "cc_human", "attempts": 2, "failure": "", "critical": True,
    "ending": "critical", "cause": "late", "cause_sentence": "Your driver was late.",
}  # fmt: skip


Finished = Callable[[Mapping[str, Any]], None]
OUTCOME = '{"attempts": [], "encounter": null, "timing": {"first_success": 2.0}}'


def row(**changes: Any) -> dict[str, Any]:
    return {**ROW, **changes}


def test_a_cell_is_the_intent_the_relation_the_road_the_speed_the_side_and_the_cause() -> None:
    failure = failure_of(ROW, Path("runs"))
    assert failure is not None
    assert failure.cell == ("Cut", "neighbour", "motorway", "from 22 m/s", "left", "late")
    assert failure.words == (
        "serious: Cut (neighbour, motorway), hit on the left with 3.0 m/s. Your driver was late"
    )  # fmt: skip
    assert failure.run == Path("runs/a")


def test_an_episode_of_an_earlier_version_has_an_unknown_cause() -> None:
    failure = failure_of({name: ROW[name] for name in ROW if not name.startswith("cause")}, Path())
    assert failure is not None and (failure.cell.cause, failure.why) == ("unknown", "")
    assert failure.words == "serious: Cut (neighbour, motorway), hit on the left with 3.0 m/s"


@pytest.mark.parametrize("level", ["collision", "critical", None])
def test_what_no_reference_driver_avoids_is_no_failure(level: str | None) -> None:
    assert failure_of(row(level=level), Path()) is None


def test_of_equal_levels_a_robust_one_stands_for_its_cell() -> None:
    """The harder one does not hold where the adversary comes a little earlier."""
    rows = [row(robust=False, delta_v=5.0), row(id="b", robust=True)]
    (found,) = distinct(f for r in rows if (f := failure_of(r, Path())) is not None)
    assert (found.run.name, found.count, found.robust) == ("b", 2, True)


def test_the_most_serious_one_stands_for_its_cell_and_the_worst_comes_first() -> None:
    """Two of a cell, a harder one of the same level, and a valid one of another side."""
    rows = [row(), row(id="b", delta_v=5.0), row(id="c", level="strict", delta_v=9.0), row(
        id="d", level="valid", delta_v=12.0, kind="Cut / neighbour / rear")]  # fmt: skip
    found = distinct(f for r in rows if (f := failure_of(r, Path())) is not None)
    assert [(f.run.name, f.count, f.level) for f in found] == [("b", 3, Level.SERIOUS), ("d", 1, Level.VALID)]


def test_the_same_crash_by_another_fault_is_another_failure() -> None:
    rows = [row(), row(id="b", cause="no_reaction"), row(id="c", delta_v=1.0)]
    found = distinct(f for r in rows if (f := failure_of(r, Path())) is not None)
    assert [(f.cell.cause, f.count) for f in found] == [("late", 2), ("no_reaction", 1)]


def test_robust_and_humanlike_failures_come_first_within_a_level_and_near_touches_last() -> None:
    """A serious one with 0.4 m/s (below 1 mph) stands behind a valid one."""
    rows = [
        row(id="fragile", kind="k / a", delta_v=9.0, robust=False, humanlike=False),
        row(id="touch", kind="k / b", delta_v=0.4, robust=True, humanlike=True),
        row(id="human", kind="k / c", delta_v=5.0, robust=False, humanlike=True),
        row(id="both", kind="k / d", delta_v=3.0, robust=True, humanlike=True),
        row(
            id="valid", kind="k / e", level="valid", robust=True, humanlike=True, fault="ego", overlap=0.5, warning=1.5
        ),
    ]
    found = distinct(f for r in rows if (f := failure_of(r, Path())) is not None)
    assert [f.run.name for f in found] == ["both", "human", "fragile", "valid", "touch"]
    told = table(found, Path())
    assert [each["near_touch"] for each in told] == [False] * 4 + [True]
    assert [told[3][key] for key in ("humanlike", "fault", "overlap", "warning")] == [True, "ego", 0.5, 1.5]
    assert count_failures(found, Level.VALID) == 4


def test_a_hit_of_a_pedestrian_is_no_near_touch() -> None:
    """The delta-v of a car that hits a pedestrian at 8.2 m/s is 0.3 m/s."""
    failure = failure_of(row(delta_v=0.3, impact_speed=8.2), Path())
    assert failure is not None and not failure.near_touch
    assert failure.words == "serious: Cut (neighbour, motorway), hit on the left with 8.2 m/s. Your driver was late"


class Campaigns:
    """Rounds in which each first success takes 2 s.

    The input ``good`` always fails on a side of its own for each seed, and ``dull`` never does.
    """

    def __init__(self) -> None:
        self.rounds: list[tuple[tuple[str, ...], tuple[int, ...]]] = []
        self.bounds: list[tuple[float, int]] = []  # s of an encounter, and kinds of attacks

    def __call__(self, plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        self.rounds.append((tuple(i.name for i in plan.inputs), tuple(plan.seeds)))
        self.bounds.append((plan.variants[0]["seconds"], plan.variants[0]["diverse"]))
        rows = []
        for job in plan.jobs:
            run = orders.out / "runs" / job.id
            run.mkdir(parents=True, exist_ok=True)
            (run / "outcome.json").write_text(OUTCOME)
            level = "serious" if job.input.name == "good" else "collision"
            kind = f"Cut / neighbour / side {job.seed}"
            rows.append(row(id=job.id, network=job.input.name, seed=job.seed, level=level, kind=kind))
            finished(rows[-1])
            if orders.stop.drain:
                break
        return Summary(orders.out, len(plan.jobs), rows, len(rows), len(rows) < len(plan.jobs), orders.stop.drain)


def plan_of(*names: str) -> CampaignPlan:
    inputs = [Input(name, Path(name), None, f"content of {name}") for name in names]
    return CampaignPlan(inputs, ("idm",), (0,), [{"until": "serious"}], [{}], Learn.OFF, None, False)


def hunted(folder: Path, campaign: RunCampaign, most: int | None = 4, plan: CampaignPlan | None = None) -> Found:
    orders = Orders(folder / "out", folder / "bank.sqlite", {}, WorkerPace(1, 60.0, 200))
    told: list[HuntProgress] = []
    return Hunt(plan or plan_of("good", "dull"), orders, campaign, 10.0, most).run(told.append)


def test_an_encounter_gets_three_times_the_median_first_success_and_more_kinds_where_nothing_new_comes(
    tmp_path: Path,
) -> None:
    """A hunt with a round of one failure and rounds of three, and five rounds of an input that never fails."""
    good, dull = Campaigns(), Campaigns()
    hunted(tmp_path, good, most=6, plan=plan_of("good"))
    assert good.bounds == [(20.0, 1), (6.0, 1), (6.0, 1)]

    def four(plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        return replace(dull(plan, orders, finished), interrupted=len(dull.rounds) == 4)

    hunted(tmp_path / "dull", four, most=None, plan=plan_of("dull"))
    assert [kinds for _, kinds in dull.bounds] == [1, 1, 3, 3]


def test_an_encounter_may_be_given_more_or_less_time_at_first(tmp_path: Path) -> None:
    """Slow planners need more than 20 s; 3 times the median first success, 6 s, holds then as before."""
    for longest, first in ((40.0, 40.0), (5.0, 5.0)):
        campaign = Campaigns()
        orders = Orders(tmp_path / str(longest) / "out", tmp_path / "bank.sqlite", {}, WorkerPace(1, 60.0, 200))
        Hunt(plan_of("good"), orders, campaign, 10.0, 6, longest=longest).run(lambda _: None)
        assert [seconds for seconds, _ in campaign.bounds] == [first, *[min(longest, 6.0)] * 2]


def test_an_encounter_has_time_for_twelve_attempts_whatever_one_costs(tmp_path: Path) -> None:
    """The two attempts of an episode took 10 s, so twelve take 60 s; that is a tenth of what is left of 10 min."""
    campaign = Campaigns()

    def costly(plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        summary = campaign(plan, orders, lambda _: None)
        for file in orders.out.glob("runs/*/outcome.json"):
            file.write_text('{"attempts": [], "encounter": null, "timing": {"attempts": 10.0, "total": 12.0}}')
        return replace(summary, interrupted=len(campaign.rounds) == 2)

    hunted(tmp_path, costly, None, plan_of("dull"))
    assert [seconds for seconds, _ in campaign.bounds] == [20.0, pytest.approx(60.0, abs=0.1)]


def test_a_line_follows_when_an_episode_brings_a_new_failure(tmp_path: Path) -> None:
    """Three failures of a kind each are told one by one, also within a round; what ``dull`` brings is not told."""
    told: list[HuntProgress] = []
    orders = Orders(tmp_path / "out", tmp_path / "bank.sqlite", {}, WorkerPace(1, 60.0, 200))
    Hunt(plan_of("good"), orders, Campaigns(), 10.0, 3).run(told.append)
    assert [progress.count(Level.SERIOUS) for progress in told] == [1, 2, 3]
    assert [progress.newest is not None for progress in told] == [True] * 3


def test_what_the_workers_spent_their_time_on_comes_to_the_time_of_the_hunt(tmp_path: Path) -> None:
    """Each episode of 0.3 s says that attempts took 0.2 s of 0.25 s; the other 0.05 s are ``between``."""
    campaign = Campaigns()

    def timed(plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        time.sleep(0.3 * len(plan.jobs))
        summary = campaign(plan, orders, lambda _: None)
        for file in orders.out.glob("runs/*/outcome.json"):
            timing = '{"seek": 0.05, "attempts": 0.2, "total": 0.25, "first_success": null}'
            file.write_text(f'{{"attempts": [], "encounter": null, "timing": {timing}}}')
        return replace(summary, interrupted=True)

    spent = hunted(tmp_path, timed, None, plan_of("dull")).spent
    assert spent == {"seek": 0.05, "attempts": 0.2, "between": pytest.approx(0.05, abs=0.04)}


def test_a_hunt_ends_with_enough_distinct_failures_and_ranks_them(tmp_path: Path) -> None:
    """The first round of one worker has an episode, of ``dull``. Later ones have one of each of the two inputs."""
    campaign = Campaigns()
    found = hunted(tmp_path, campaign)
    assert (found.ended, len(found.failures), found.episodes, found.attempts) == ("distinct", 4, 8, 16)
    assert (found.episodes, [seeds for _, seeds in campaign.rounds]) == (8, [(0,), (1,), (2,), (3,), (4,)])
    with (tmp_path / "out" / "results.csv").open(newline="") as text:
        shown = list(csv.DictReader(text))
    assert [r["rank"] for r in shown] == ["1", "2", "3", "4"]
    assert all((tmp_path / "out" / r["run"]).is_dir() for r in shown)
    assert {r["network"] for r in shown} == {"good"}


def test_failures_are_those_that_reach_the_level_asked_for(tmp_path: Path) -> None:
    """All that the input comes to is serious, so with that level all count, and with 5 m/s of delta-v none."""
    for folder, goal, many in (("a", Goal(Level.SERIOUS), 1), ("b", Goal(Level.VALID, min_delta_v=5.0), 0)):
        orders = Orders(tmp_path / folder / "out", tmp_path / "bank.sqlite", {}, WorkerPace(1, 60.0, 200))
        campaign = Campaigns()

        def once(plan: CampaignPlan, orders: Orders, finished: Finished, campaign: Campaigns = campaign) -> Summary:
            return replace(campaign(plan, orders, finished), interrupted=True)

        found = Hunt(plan_of("good"), orders, once, 10.0, None, goal).run(lambda _: None)
        assert len(found.failures) == many


def test_where_failures_come_from_gets_more_of_the_rounds(tmp_path: Path) -> None:
    """Ten inputs, one of which fails; a round has three of them. By chance it would be in three of ten rounds."""
    campaign = Campaigns()
    hunted(tmp_path, campaign, 8, plan_of("good", *(f"dull {k}" for k in range(9))))
    later = [inputs for inputs, _ in campaign.rounds][-8:]
    assert sum("good" in inputs for inputs in later) >= 6


@pytest.mark.parametrize("wrong", [("motorwy",), ("motorway", "--ego", "nix"), ("motorway", "--ego", "no_module:No")])
def test_a_wrong_input_is_refused_before_the_hunt_begins(program: Program, wrong: tuple[str, ...]) -> None:
    assert refusal_of(program, "hunt", *wrong).count(wrong[-1])  # nothing on stdout, one sentence on stderr


def test_the_same_hunt_goes_on_and_another_is_refused(tmp_path: Path) -> None:
    first = hunted(tmp_path, Campaigns(), 2)
    campaign = Campaigns()
    again = hunted(tmp_path, campaign, 3)
    assert (len(first.failures), len(again.failures)) == (2, 3)
    assert [seeds for _, seeds in campaign.rounds] == [(0,), (1,), (2,), (3,)]  # finished rounds are read again
    with pytest.raises(UsageError, match="holds a hunt with other inputs, egos or settings"):
        hunted(tmp_path, Campaigns(), plan=plan_of("good"))


def test_ctrl_c_in_the_last_episode_of_a_round_ends_the_hunt_too(tmp_path: Path) -> None:
    """Nothing of the round of one episode is missing then, and no other round begins."""
    campaign = Campaigns()

    def pressed(plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        return replace(campaign(plan, orders, finished), interrupted=True)

    found = hunted(tmp_path, pressed)
    assert (found.ended, found.episodes, len(campaign.rounds)) == ("stopped", 1, 1)


def test_a_round_that_would_take_longer_than_the_time_that_is_left_is_smaller(tmp_path: Path) -> None:
    """Ten inputs, one worker, a hunt of 2.6 s, an episode of 0.9 s: after the first one there is time for two."""
    campaign = Campaigns()

    def slow(plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        time.sleep(0.9 * len(plan.jobs))
        return campaign(plan, orders, finished)

    orders = Orders(tmp_path / "out", tmp_path / "bank.sqlite", {}, WorkerPace(1, 60.0, 200))
    names = [f"dull {k}" for k in range(10)]
    Hunt(plan_of(*names), orders, slow, 2.6 / 60.0, None).run(lambda _: None)
    assert [len(inputs) for inputs, _ in campaign.rounds] == [1, 2]


def test_the_failures_over_time_are_drawn(tmp_path: Path, program: Program) -> None:
    """The first round finds nothing, and four more find a serious failure each."""
    hunted(tmp_path, Campaigns())
    after = over_time(tmp_path / "out")
    assert [a.found for a in after] == [dict.fromkeys(("valid", "strict", "serious"), k) for k in range(5)]
    assert [a.minutes for a in after] == sorted(a.minutes for a in after)
    # eight encounters: four kinds, all seen once, so half of the encounters brought a new one
    last = after[-1].discovery
    assert last is not None and (last.samples, last.kinds, last.chance, last.least) == (8, 4, 0.5, 10.0)
    done = program.here("figure", tmp_path / "out", "--out", "over_time.svg")
    assert done.status == 0, done.err
    assert "<svg" in (program.folder / "over_time.svg").read_text()
    film = program.here("figure", tmp_path / "out", "--out", "over_time.gif")
    assert (film.status, "A hunt has no film" in film.err) == (2, True)


def test_where_all_episodes_fail_the_hunt_says_why_at_once(tmp_path: Path) -> None:
    def broken(plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        rows = [row(id=job.id, ending="simulation_failed", failure="No licence.", level=None) for job in plan.jobs]
        return Summary(orders.out, len(rows), rows, len(rows))

    with pytest.raises(SumoAdvError, match=r"All 3 episodes of the hunt failed, the first one because: No licence\."):
        hunted(tmp_path, broken)


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="is not empty and holds no hunt"):
        hunted(tmp_path, Campaigns())


def test_without_an_input_that_can_be_run_the_reason_is_said(tmp_path: Path) -> None:
    broken = plan_of("good")
    broken = replace(broken, inputs=[replace(broken.inputs[0], error="It is no network.")])
    with pytest.raises(UsageError, match=r"No input of the hunt can be run: It is no network\."):
        hunted(tmp_path, Campaigns(), plan=broken)


def test_a_hunt_from_the_command_line_goes_on_from_python_and_is_kept(program: Program) -> None:
    (program.folder / "few.toml").write_text('proposals = 20\nattempts = 6\nuntil = "valid"\n')
    options = ("--ego", "idm", "--settings", "few.toml", "--distinct", "1", "--minutes", "2")
    options = (*options, "--workers", "1", "--out", "hunt")
    done = program.here("hunt", "signals_red_light", *options)
    assert done.status == 0, done.err
    assert "Enough distinct failures were found: " in done.out
    page = (program.folder / "hunt" / "report" / "index.html").read_text(encoding="utf-8")
    episodes = len(list((program.folder / "hunt").glob("rounds/*/runs/*/outcome.json")))
    (ego,) = data_of(page)["egos"]
    assert ego["episodes"] == episodes  # also those without a failure
    plan = json.loads((program.folder / "hunt" / "rounds" / "0001" / "plan.json").read_text(encoding="utf-8"))
    assert plan["settings"][0]["until"] == "valid"  # as the file says
    for command in (("report", "hunt"), ("compare", "hunt", "hunt")):
        asked = program.here(*command)
        assert (asked.status, "is the folder of a hunt" in asked.err) == (2, True), asked.err
    kept = program.here("keep", "hunt/failures", "--suite", "suite")
    assert kept.status == 0, kept.err
    assert "into suite" in kept.out
    refused = program.here("hunt", "motorway", *options)
    assert (refused.status, "holds a hunt with other inputs" in refused.err) == (2, True)


def test_the_result_of_a_hunt_is_a_table() -> None:
    """The columns are those of ``results.csv``."""
    from sumo_adv.api_batch import HuntResult

    result = HuntResult(Found(Path(), [], 0, 0, 0.0, "time", discovery([])), [], None)
    assert list(result.table)[:3] == ["rank", "level", "intent"]
    assert sumo_adv.hunt.__module__ == "sumo_adv.api_batch"


def test_a_line_says_that_a_near_touch_is_not_counted() -> None:
    """Its delta-v of 0.1 m/s is below 1 mph."""
    lines = []
    for delta_v in (0.1, 5.0):
        (newest,) = found = distinct(f for f in [failure_of(row(level="strict", delta_v=delta_v), Path())] if f)
        lines.append(
            progress_line(HuntProgress(60.0, 1, 1, 0.5, found, newest, 0, discovery([set()]), DriverTime(), 1.0))
        )
    assert "1 episode, 1 attempt (" in lines[0] and "Newest (a near-touch, not counted): strict: " in lines[0]
    assert ": 0 serious, 0 strict, 0 valid;" in lines[0]
    assert "Newest: strict: " in lines[1] and ": 0 serious, 1 strict, 1 valid;" in lines[1]


def test_at_most_eight_scenarios_that_were_never_met_are_named() -> None:
    names = [f"s{k}" for k in range(10)]
    assert never_met_words(names) == "s0; s1; s2; s3; s4; s5; s6; s7 and 2 more (scenarios.csv)"
    assert never_met_words(names[:8]).endswith("; s7") and never_met_words([]) == "none"
