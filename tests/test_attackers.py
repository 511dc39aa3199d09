"""Two and three adversaries that attack: drawn, delayed, varied, judged, compared with a request, and run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest
from attacker_samples import BOTH, both_sides, cut_ins
from cli_samples import Program
from metrics_tracks import cruise, drift
from page_samples import Visit, chromium
from situation_samples import neighbour, situation
from test_several import AHEAD, LEFT, MISS, RIGHT, SCENE, SHIFT, Saved, attack
from test_words_motion import EGO_SPEED, TIME, seen, track

import sumo_adv.app as app
from sumo_adv.asked import Asked, Attacker, Event
from sumo_adv.config import load_settings
from sumo_adv.datatypes import (
    MAX_WAIT_S,
    AttackerResult,
    AttackerRole,
    Attempt,
    Duty,
    Endpoint,
    Level,
    Limits,
    Proposal,
    Verdict,
)
from sumo_adv.episode.attempt import Driven, PlannedAdversary
from sumo_adv.episode.refinement import Refinement, settle_roles
from sumo_adv.episode.task import AttemptResult, make_task
from sumo_adv.errors import UsageError
from sumo_adv.goal import Goal
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.verdict import attackers_of, judge_attempt
from sumo_adv.planners.answers import Answer, PlannerObservation
from sumo_adv.report.manifest import read_manifest
from sumo_adv.report.page import make_page
from sumo_adv.search.evolution import badness
from sumo_adv.search.rollouts import predict
from sumo_adv.search.sampling import varied, varied_in_one
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.simulation.inputs import load_input
from sumo_adv.words.fit import compare_attackers, misfits
from sumo_adv.words.motion import DescribedMotion, words_of

TOGETHER = (Attacker(id="left"), Attacker(id="right", intents=("shift",)))


def search(*attackers: Attacker, adversaries: int = 2) -> AttackSearch:
    """A search that predicts nothing; ``left`` and ``right`` are beside the ego, ``ahead`` is its leader."""
    made = AttackSearch(
        Saved(), {0.0: SCENE}, [SHIFT], SearchSettings(share=400), seed=0, adversaries=adversaries, attackers=attackers,
        predicts=False,
    )  # fmt: skip
    made.follow(made.ranking([SHIFT]), [SHIFT])
    return made


def proposed(made: AttackSearch, count: int) -> list[Proposal]:
    return [made.completed(p) for p in made.propose(count)]


# ---- a scene names its attackers


def test_a_scene_brings_its_attackers_and_their_number(tmp_path: Path) -> None:
    made = load_input(both_sides(tmp_path))
    assert [each.id for each in made.attackers] == ["left", "right"]
    assert made.candidates == ("left", "right") and made.intents == ("Aggressive Cut-in",)
    assert made.settings()["adversaries"] == 2
    task = make_task(made, load_settings(None, adversaries=2), tmp_path)
    assert task.only == ("left", "right")


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (BOTH.replace('id = "right"', 'id = "left"'), "must all be different vehicles"),
        (BOTH.replace('id = "right"', 'id = "nobody"'), "names the attacker 'nobody'"),
        ('[adversary]\ncandidates = ["left"]\n' + BOTH, "either attackers, or candidates"),
        ('[[attackers]]\nid = "left"\n', "a single one is the candidate"),
        (BOTH.replace("asked", "attacks = false\nasked"), "one of the attackers must attack"),
        ('[adversary]\nsupports = ["ego", "other"]\n' + BOTH, "together are at most 3"),
        (BOTH.replace("intents", "intentions", 1), "unknown key 'attackers.0.intentions'; known keys there are id"),
    ],
)
def test_a_scene_with_wrong_attackers_is_one_sentence(tmp_path: Path, more: str, sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence) as raised:
        load_input(both_sides(tmp_path, more))
    assert "\n" not in str(raised.value)


def test_all_attackers_of_a_scene_must_be_allowed(tmp_path: Path) -> None:
    made = load_input(both_sides(tmp_path))
    with pytest.raises(UsageError, match="2 vehicles attack together: give --adversaries 2 or more"):
        make_task(made, load_settings(None, adversaries=1), tmp_path)
    with pytest.raises(UsageError, match="leave out --adversary"):
        make_task(made, load_settings(None, adversaries=2, adversary="left"), tmp_path)


# ---- candidates


def test_each_candidate_of_a_scene_has_all_of_its_attackers() -> None:
    """Each is the collider of some candidates. The other one begins with it, or at most 3 s later."""
    tried = proposed(search(*TOGETHER), 48)
    assert {frozenset(p.bvs) for p in tried} == {frozenset({"left", "right"})}
    assert {p.bv for p in tried} == {"left", "right"}
    assert {p.supports[0].duty for p in tried} == {Duty.ATTACK}
    waits = [p.supports[0].wait for p in tried]
    assert 0.0 in waits and max(waits) <= MAX_WAIT_S and len(set(waits)) > 10
    assert {p.composition for p in tried} == {"Shift + Shift"}


def test_an_attacker_has_only_its_own_intents() -> None:
    other = Attacker(id="right", intents=("Emergency Braking",))
    assert proposed(search(TOGETHER[0], other), 8) == []  # no such intent in the library, so nothing is complete


def test_one_that_only_plays_its_part_is_never_the_collider() -> None:
    tried = proposed(search(TOGETHER[0], Attacker(id="right", attacks=False)), 24)
    assert {p.bv for p in tried} == {"left"} and {p.attackers for p in tried} == {("left",)}
    assert {(p.supports[0].bv, p.supports[0].duty) for p in tried} == {("right", Duty.PLAY)}


def test_attackers_with_intents_of_their_own_keep_them_whatever_the_analyzer_chose() -> None:
    """The analyzer chose Shift alone; the one on the right brakes in each candidate all the same."""
    braking = replace(SHIFT, label="Brakes")
    made = AttackSearch(
        Saved(), {0.0: SCENE}, [SHIFT, braking], SearchSettings(share=400), seed=0, adversaries=2, predicts=False,
        attackers=(TOGETHER[0], Attacker(id="right", intents=("Brakes",))),
    )  # fmt: skip
    made.follow(made.ranking([SHIFT]), [SHIFT, braking])
    assert {p.supports[0].label for p in proposed(made, 12) if p.bv == "left"} == {"Brakes"}


def test_a_candidate_of_any_scene_may_gain_another_attacker() -> None:
    made = search()
    given = proposed(made, 200)
    attacks = [s for p in given for s in p.supports if s.duty is Duty.ATTACK]
    assert {s.label for s in attacks} == {"Shift"} and {s.bv for s in attacks} == {"left", "right"}
    assert any(s.duty is not Duty.ATTACK for p in given for s in p.supports)


def test_a_variation_of_several_attackers_changes_one_of_them() -> None:
    planner = SHIFT.planners[0]
    both = replace(attack("left", planner=planner), parameters={"gap": 0.0}, supports=(
        replace(attack("right", planner=planner), parameters={"gap": 1.0}, duty=Duty.ATTACK, wait=1.5),
    ))  # fmt: skip
    for seed in range(20):
        made = varied_in_one(both, Random(seed), 0.1)
        changed = [a.parameters != b.parameters for a, b in zip(made.members, both.members, strict=True)]
        assert sorted(changed) == [False, True]
        assert (made.supports[0].wait != 1.5) == changed[1]
    assert 0.0 <= varied(both, Random(0), 9.0).supports[0].wait <= MAX_WAIT_S
    alone = attack("left", planner=planner)
    assert varied(alone, Random(0), 9.0).wait == 0.0


# ---- waiting


def test_an_attacker_that_waits_goes_straight_on_until_its_own_start() -> None:
    """12 m/s along y = 3.2 from x = 20; it is asked 1 s after the start, at x = 32, and its own time is then 0."""
    times: list[tuple[float, float]] = []

    def ask(observation: PlannerObservation) -> Answer:
        bv, _ = observation
        times.append((bv["time"], bv["x"]))
        return Answer(Endpoint(bv["x"] + 24.0, 0.0, 0.0, 12.0, 2.0))

    waits = PlannedAdversary(situation([neighbour()]), "bv", Limits(), ask, 1.0)
    places = []
    for k in range(20):
        if k % 5 == 0:
            assert waits.replan(0.1 * k, (k * 1.0, 0.0, 10.0, 0.0)) is None
        places.append(waits.advance())
    assert [(t, x) for t, x in times] == [pytest.approx((0.0, 32.0)), pytest.approx((0.5, 38.0), abs=0.05)]
    assert [places[k].y for k in (0, 9)] == pytest.approx([3.2, 3.2])
    assert places[19].y < 3.0


def test_a_prediction_waits_as_an_attempt_does() -> None:
    """At 10 m/s, the second attacker is asked after 1 s at x = 10; the first one at once."""
    asked: dict[int, list[tuple[float, float]]] = {0: [], 1: []}

    def on(rows: list[int], observations: list[PlannerObservation]) -> list[Answer | None]:
        for k in rows:
            asked[k].append((observations[k][0]["time"], observations[k][0]["x"]))
        ends = [Answer(Endpoint(o[0]["x"] + 20.0, o[0]["y"], 0.0, 10.0, 2.0)) if o[0] else None for o in observations]
        return [ends[k] if k in rows else None for k in range(len(observations))]

    second = replace(attack("right"), duty=Duty.ATTACK, wait=1.0)
    both = replace(attack("left"), supports=(second,))
    rollouts = predict({0.0: SCENE}, [both], on, limits=Limits(), steps=21, replan=5)  # type: ignore[arg-type]
    assert [t for t, _ in asked[0]] == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])
    assert [t for t, _ in asked[1]] == pytest.approx([0.0, 0.5, 1.0])
    assert asked[1][0][1] == pytest.approx(10.0)
    assert rollouts.supports[0][1][0] == pytest.approx(-3.2 * (rollouts.time + 1.0) ** 0)


def test_the_collider_can_be_another_one_of_the_attackers() -> None:
    both = cut_ins("left", "right", wait=1.0)
    other = both.led_by("right")
    assert other.bvs == ("right", "left") and other.attackers == ("right", "left")
    assert (other.wait, other.supports[0].wait) == (1.0, 0.0)
    assert [p.duty for p in other.members] == [Duty.COLLIDER, Duty.ATTACK]
    assert other.composition == "Double Cut-in" and other.led_by("left") == both
    assert both.led_by("left") is both
    assert both.without("right").members == (both.without("right"),)
    assert {t.state.id for t in (LEFT, RIGHT, AHEAD)} == {"left", "right", "ahead"}


# ---- the verdict


EGO = cruise("ego", 0, 0, 15)
NEAR, FAR = cruise("near", 40, 0, 5), cruise("far", 55, 0, 5)  # the ego reaches them after 3.5 s and 5 s


def judged(until: float) -> dict[str, Verdict]:
    """The verdict on each of two attackers, with the other one among the other vehicles, of a recording up to then."""
    ego, near, far = (t.between(0.0, until) for t in (EGO, NEAR, FAR))
    pairs = {"near": (near, far), "far": (far, near)}
    return {
        name: judge_attempt(Case(ego, one, (other,), 1.0, supports=(other,))) for name, (one, other) in pairs.items()
    }


def test_the_attacker_that_touches_first_counts() -> None:
    """The recording ends at 3.6 s, where the front of the ego is 14 m from the back of the far one: 1.4 s."""
    verdicts = judged(3.6)
    assert verdicts["near"].contact_time == pytest.approx(3.5) and not verdicts["far"].collided
    assert attackers_of(dict(reversed(verdicts.items()))) == (
        AttackerResult("near", AttackerRole.TOUCHED, 0.0, 0.0),
        AttackerResult("far", AttackerRole.PLAYED, pytest.approx(1.4), pytest.approx(14.0)),
    )  # fmt: skip
    both_hit = judged(6.0)  # as if the ego went through the near one
    assert [a.role for a in attackers_of(both_hit)] == ["touched", "played"]


def test_without_a_contact_the_attacker_with_the_least_ttc_counts() -> None:
    """At 3 s, 5 m and 20 m are left at 10 m/s: 0.5 s and 2 s."""
    attackers = attackers_of(judged(3.0))
    assert attackers == (
        AttackerResult("near", AttackerRole.PLAYED, pytest.approx(0.5), pytest.approx(5.0)),
        AttackerResult("far", AttackerRole.PLAYED, pytest.approx(2.0), pytest.approx(20.0)),
    )  # fmt: skip


def test_each_attacker_is_judged_by_the_limits_of_its_own_build() -> None:
    """A truck may brake with 7 m/s2, a car with 8: a car that brakes with 7.6 beside a truck is feasible."""
    truck = replace(NEAR, length=12.0)
    firm = replace(cruise("firm", 5, 3.2, 15), acceleration=np.where((EGO.time > 2.0) & (EGO.time < 2.6), -7.6, 0.0))
    case = Case(EGO, truck, (firm,), 1.0, supports=(firm,))
    limits = load_settings(None).limits
    strict = judge_attempt(case, limits=limits.of(truck))
    fair = judge_attempt(case, limits=limits.of(truck), support_limits=limits.of)
    assert "longitudinal" in strict.failed_gates and "longitudinal" not in fair.failed_gates


def test_a_reference_driver_is_alarmed_by_any_of_the_attackers() -> None:
    """The adversary comes over slowly 45 m ahead: alarm at 5.5 s (test_reference_drivers). The other attacker, 20 m
    ahead and as slow, is over the line by 2 s, when 2 s are nearly over: a driver that looked at one only would brake
    3 s too late."""
    late = drift("adversary", 50, 3.2, 9, 2.0, 5.0, 0.0)
    early = drift("early", 25, -3.2, 9, 0.5, 2.0, 0.0)
    alarms = [
        judge_attempt(Case(EGO, late, others, 0.5, supports=others)).preventability.alarms["cc_human"]  # type: ignore[union-attr]
        for others in ((), (early,))
    ]
    assert alarms[0] == pytest.approx(5.5) and alarms[1] < 2.5


class Alone:
    """Runs attempts in which the ego touches only ``right``, and only if ``left`` attacks as well."""

    displaces, repeats = True, True

    def __init__(self) -> None:
        self.tried: list[tuple[str, ...]] = []

    def attempt(self, proposals: Sequence[Proposal]) -> list[AttemptResult]:
        self.tried += [p.bvs for p in proposals]
        hit = replace(MISS, collided=True)
        return [AttemptResult(Driven("passed"), hit if "left" in p.bvs else MISS, 0.0) for p in proposals]

    def references(self, *_: object) -> None:
        return None


def test_an_attacker_without_which_nothing_is_touched_has_forced_the_contact() -> None:
    three = cut_ins("right", "left")
    three = replace(three, supports=(*three.supports, replace(three.supports[0], bv="ahead")))
    played = [AttackerResult(name, AttackerRole.PLAYED, 1.0, 3.0) for name in ("left", "ahead")]
    attackers = (AttackerResult("right", AttackerRole.TOUCHED, 0.0, 0.0), *played)
    hit = replace(MISS, collided=True, min_ttc=0.0, attackers=attackers)
    attempt = Attempt(0, "tuner", three, 0.0, hit, "contact")
    done, runner = Refinement(attempts=[attempt]), Alone()
    settle_roles(done, runner)
    assert runner.tried == [("right", "ahead"), ("right", "left")]
    assert [str(a.role) for a in done.attempts[0].verdict.attackers] == ["touched", "forced", "played"]
    missed = Refinement(attempts=[replace(attempt, verdict=replace(MISS, attackers=attackers))])
    settle_roles(missed, runner)  # nothing was touched, so nothing is simulated
    assert len(runner.tried) == 2 and missed.attempts[0].verdict.attackers == attackers


def test_an_attempt_that_does_not_fit_is_better_the_nearer_all_attackers_came() -> None:
    """A collision that does not fit is 4. The other one stayed 15 m and 5 s away: (0.5 + 0.5) / 2 more."""
    hit = replace(MISS, collided=True, min_ttc=0.0, min_distance=0.0, level=Level.STRICT, misfits=("b is late.",))
    touched = AttackerResult("a", AttackerRole.TOUCHED, 0.0, 0.0)
    other = AttackerResult("b", AttackerRole.PLAYED, 5.0, 15.0)
    assert badness(hit, Goal()) == 4.0
    assert badness(replace(hit, attackers=(touched, other)), Goal()) == pytest.approx(4.5)


# ---- the fit


def cutting_in(side: float, start: float) -> DescribedMotion:
    """At the ego's speed 10 m ahead, 3.6 m beside until ``start``, then 1.2 m/s inwards: in the way 1.6 s later, where
    1.68 m are left and both are 1.8 m wide."""
    y = side * np.clip(3.6 - 1.2 * (TIME - start), 0.0, 3.6)
    return seen(track("cutter", 10.0 + EGO_SPEED * TIME, y, 0.0, EGO_SPEED, (4.8, 1.8)))


SIDES = {"a": Asked(events=(Event.ENTERS_FROM_LEFT,)), "b": Asked(events=(Event.ENTERS_FROM_RIGHT,))}


def test_what_is_asked_of_each_attacker_is_compared_with_its_own_motion() -> None:
    """They enter at 3.6 s and 2.6 s."""
    motions = {"a": cutting_in(1.0, 2.0), "b": cutting_in(-1.0, 1.0)}
    parts = compare_attackers(Asked(within=3.0), SIDES, motions, "b")
    assert [(part.name, part.holds, part.says) for part in parts] == [
        ("a: events: enters_from_left", True, "a: 'enters_from_left' happens at 3.6 s."),
        ("b: events: enters_from_right", True, "b: 'enters_from_right' happens at 2.6 s."),
        ("within", True, "What is asked of the attackers happens within 1.0 s."),
    ]
    assert misfits(compare_attackers(Asked(within=0.5), SIDES, motions, "b")) == (
        "What is asked of the attackers happens within 1.0 s, not 0.5 s.",
    )
    swapped = {"a": motions["b"], "b": motions["a"]}
    assert len(misfits(compare_attackers(Asked(within=3.0), SIDES, swapped, "b"))) == 3


def test_an_attacker_that_is_gone_at_once_does_not_fit() -> None:
    parts = compare_attackers(Asked(within=3.0), SIDES, {"a": cutting_in(1.0, 2.0)}, "a")
    assert misfits(parts) == ("b was gone at once.", "Not all attackers do what is asked of them.")


def test_a_reader_gets_the_facts_of_each_attacker_under_its_own_letter() -> None:
    words = words_of([cutting_in(1.0, 2.0), cutting_in(-1.0, 1.0)])
    assert words.startswith("2 road users act: A, B.")
    first, second = words.split("\n\n")[1:]
    assert "3.6 s: A comes from the left into EGO's way" in first and " B " not in first
    assert "2.6 s: B comes from the right into EGO's way" in second and " A " not in second


# ---- a run


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run in which a vehicle cuts in from each side of SUMO's IDM, both within 3 s."""
    home = tmp_path_factory.mktemp("attackers")
    scenario = both_sides(home, asked='level = "valid"\nwithin = 3.0')
    kept = ("--learn", "off", "--memory", "bank.sqlite", "--out", "out", "--attempts", "8")
    done = Program(home, home).here("run", scenario, *kept)
    assert done.status == 0, done.err
    (home / "said.txt").write_text(done.out)
    return home / "out"


def test_both_attackers_of_a_scene_attack_and_are_named(ran: Path) -> None:
    outcome = json.loads((ran / "outcome.json").read_text())
    assert outcome["ending"] == "critical" and outcome["outcome"]["level"] in ("valid", "strict", "serious")
    assert all(set(a["adversaries"]) == {"left", "right"} for a in outcome["attempts"])
    first, second = outcome["attackers"]
    assert {first["id"], second["id"]} == {"left", "right"}
    assert (first["role"], first["min_ttc"]) == ("touched", 0.0) and second["role"] in ("forced", "played")
    assert [(a["id"], a["role"]) for a in outcome["adversaries"]] == [
        (first["id"], "collider"), (second["id"], "attack"),
    ]  # fmt: skip
    assert outcome["attempts"][outcome["best"]]["composition"] == "Double Cut-in"
    assert f"Attackers: {first['id']} touched the ego, {second['id']} " in (ran.parent / "said.txt").read_text()


def test_both_cut_in_within_the_time(ran: Path) -> None:
    asked = json.loads((ran / "outcome.json").read_text())["asked"]
    assert asked["fits"] and asked["attackers"]["right"] == {"events": ["enters_from_right"]}
    assert [part["name"] for part in asked["parts"]] == [
        "left: events: enters_from_left", "right: events: enters_from_right", "within",
    ]  # fmt: skip
    assert "B comes from the right into EGO's way" in asked["motion"]


def test_a_replay_finds_the_same_with_the_one_that_touched_as_collider(ran: Path) -> None:
    outcome = json.loads((ran / "outcome.json").read_text())
    again = app.replay(read_manifest(ran)).best
    assert again is not None and again.best is not None
    best = outcome["attempts"][outcome["best"]]
    assert list(again.best.proposal.bvs) == best["adversaries"]
    assert again.best.verdict.contact_time == pytest.approx(outcome["outcome"]["contact_time"], abs=1e-3)
    assert [{"id": a.id, "role": str(a.role)} for a in again.best.verdict.attackers] == [
        {"id": a["id"], "role": a["role"]} for a in outcome["attackers"]
    ]  # fmt: skip


def test_the_page_names_the_attackers(ran: Path, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(make_page(ran), encoding="utf-8")
    first = json.loads((ran / "outcome.json").read_text())["attackers"][0]["id"]
    with chromium() as browser, Visit(browser, file) as visit:
        assert f"{first} touched the ego" in visit.page.locator("#badges").inner_text()
