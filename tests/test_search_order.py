"""The order in which candidates are tried, and the ranking of intents."""

import random
from dataclasses import replace

import numpy as np
import pytest

from sumo_adv.agents.generator import expert_planners
from sumo_adv.datatypes import Boxes, Intent, Level, LibraryEntry, Prediction, Proposal, Verdict
from sumo_adv.metrics.boxes import touching
from sumo_adv.planners.text import make_planner
from sumo_adv.search.intents import compose
from sumo_adv.search.prediction import batches_of
from sumo_adv.search.ranking import as_written
from sumo_adv.search.sampling import AttackTemplate, Sampler, templates_of
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SamplingSettings, SearchSettings
from sumo_adv.situation import Situation
from tests.situation_samples import EGO_PATH, car, line, neighbour, situation, target

SHIFT = """
PARAMETERS = {"gap": (2.0, -3.0, 4.0, "m", "where"), "drift": (3.0, 2.0, 6.0, "s", "how long")}


def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}
"""
RUSH = (
    '# Title\nPARAMETERS = {"offset": (0.0, -1.0, 1.0, "s", "when")}\nMOVEMENT = "straight"\n'
    + SHIFT.split("\n\n\n")[1]
)


def straight_situation() -> Situation:
    """A car in the lane beside the ego."""
    return situation([neighbour()])


def merging_situation() -> Situation:
    """A car on a ramp that joins the ego's lane 60 m ahead."""
    ramp = line((0.0, -30.0), (60.0, 0.0), (250.0, 0.0))
    return situation([target(car("bv", 0.0, -30.0, 0.46), "merging", [(ramp, "straight", 55.0)], EGO_PATH)])


def entry(label: str, applies: tuple[str, ...], source: str = SHIFT, mode: str = "side") -> LibraryEntry:
    return LibraryEntry(label, f"What {label} does.", applies, (make_planner(label, mode, source, "seed"),))


class ByGap:
    """A scorer with a rule of its own: the nearer the gap to 1 m, the better; other planners never hit."""

    def __init__(self) -> None:
        self.asked = 0

    def score(self, proposals):
        self.asked += len(proposals)
        return [
            Proposal(
                p.bv, p.label, p.planner, p.parameters, p.acceleration, p.delay,
                score=abs(p.parameters.get("gap", 9.0) - 1.0) / 4.0, prediction=Prediction(min_ttc=0.5),
            )
            for p in proposals
        ]  # fmt: skip


class NeverHits(ByGap):
    """Predicts that nothing reaches the ego."""

    def score(self, proposals):
        self.asked += len(proposals)
        return [replace(p, score=4.0) for p in proposals]


class InTurn:
    """Gives one score to a number of candidates, then the next score; the last one to all further."""

    def __init__(self, *scores: tuple[int, float]) -> None:
        self.scores = [score for count, score in scores for _ in range(count)]
        self.asked = 0

    def score(self, proposals):
        places = range(self.asked, self.asked + len(proposals))
        self.asked += len(proposals)
        return [
            replace(p, score=self.scores[min(k, len(self.scores) - 1)]) for k, p in zip(places, proposals, strict=True)
        ]


def search_of(scorer, situations, library, proposals: int = 30, share: int = 8, seed: int = 7) -> AttackSearch:
    """A search that has predicted its first candidates and follows the intents of the library."""
    settings = SearchSettings(proposals=proposals, share=share, predicted=25)
    search = AttackSearch(scorer, situations, library, settings, seed=seed)
    search.follow([Intent("bv", e.label, "", "high", 0.0) for e in library], library)
    return search


def shifts_of(scorer, proposals: int = 30, delays: tuple[float, ...] = (0.0,)) -> AttackSearch:
    """A search with a pool that holds predictions of one way to attack."""
    return search_of(scorer, dict.fromkeys(delays, straight_situation()), [entry("Shift", ("neighbour",))], proposals)


def empty(share: int = 8) -> AttackSearch:
    """A search without candidates of its own."""
    return search_of(NeverHits(), {0.0: straight_situation()}, [], 1, share)


def test_families_are_what_applies_to_each_vehicle():
    situation = straight_situation()
    library = [entry("Shift", ("neighbour",)), entry("Oncoming", ("oncoming",))]
    templates = templates_of({0.0: situation}, library)
    assert {(f.target.relation, f.entry.label) for f in templates} == {("neighbour", "Shift")}
    assert templates_of({0.0: situation}, library, ["Oncoming"]) == []


def test_the_first_proposal_of_a_family_has_its_authors_numbers_and_drawn_ones_stay_in_bounds():
    situation = straight_situation()
    family = templates_of({0.0: situation}, [entry("Shift", ("neighbour",))])[0]
    assert family.proposal(None).parameters == {"gap": 2.0, "drift": 3.0}
    for seed in range(50):
        drawn = family.proposal(random.Random(seed)).parameters
        assert -3.0 <= drawn["gap"] <= 4.0 and 2.0 <= drawn["drift"] <= 6.0


def test_the_best_score_ranks_an_intent_first():
    situation = straight_situation()
    library = [entry("Far", ("neighbour",), SHIFT.replace("-3.0, 4.0", "1.9, 2.1")), entry("Shift", ("neighbour",))]
    ranked = search_of(ByGap(), {0.0: situation}, library, 40, seed=1).ranking(library)
    assert [i.label for i in ranked] == ["Shift", "Far"]  # 2.0 +- 0.1 m is never within 0.9 m of the best place
    assert ranked[0].risk == "high" and "predicted" in ranked[0].reason


def test_same_seed_same_order():
    orders = [[p.parameters["gap"] for p in shifts_of(ByGap()).propose(8)] for _ in range(2)]
    assert orders[0] == orders[1] and len(orders[0]) == 8


def test_a_planner_gets_at_most_its_share():
    situation, library = straight_situation(), [entry("Shift", ("neighbour",))]
    search = search_of(ByGap(), {0.0: situation}, library, share=3)
    assert len(search.propose(10)) == 3
    assert search.exhausted() == [library[0].planners[0].hash]


def learnt_version(library: list[LibraryEntry]) -> LibraryEntry:
    """The entry with a version of its planner that was learnt: its gap is 1.5 m, not 2."""
    first = library[0].planners[0]
    again = make_planner(first.label, first.mode, SHIFT.replace("(2.0,", "(1.5,"), "expert", first.hash)
    return replace(library[0], planners=(again, first))  # its evidence is better, so it comes first in the bank


def test_what_was_learnt_is_one_proposal_more_and_takes_no_draws_from_others():
    situation, library = straight_situation(), [entry("Shift", ("neighbour",))]
    searches = [search_of(ByGap(), {0.0: situation}, some) for some in (library, [learnt_version(library)])]
    gaps = [[p.parameters["gap"] for p in search.pool] for search in searches]
    assert sorted(gaps[1]) == sorted([*gaps[0], 1.5])


def test_versions_of_a_mode_that_are_there_at_first_have_one_share_and_a_new_one_its_own():
    situation, learnt = straight_situation(), learnt_version([entry("Shift", ("neighbour",))])
    search = search_of(ByGap(), {0.0: situation}, [learnt], share=3)
    assert len(search.propose(10)) == 3
    most = search.exhausted()
    assert most == [learnt.planners[1].hash]  # of 31 candidates 30 are the author's: nearest to 1 m are three of these
    changed = make_planner("Shift", "side", SHIFT.replace("(2.0,", "(0.5,"), "expert", most[0])
    search.add_version(changed)
    assert [p.planner.hash for p in search.propose(10)] == [changed.hash] * 3


def candidate(score: float, **predicted) -> Proposal:
    """A candidate that is predicted to hit."""
    planner = entry("Near", ("neighbour",)).planners[0]
    return Proposal("bv", "Near", planner, {}, 0.0, 0.0, score=score, prediction=Prediction(hit=True, **predicted))


def verdict(level: Level, *gates: str) -> Verdict:
    """What an attempt came to: its level, and the gates it failed."""
    return Verdict(0.0, 0.0, True, True, not gates, False, gates, level=level)


def promised(search, count):
    """Of the next candidates those that were chosen by their prediction; the others vary what was tried."""
    return [p for p in search.propose(count) if p.prediction is not None]


def test_only_what_promises_more_than_was_reached_is_tried():
    """After a valid attempt candidates that are predicted to be strict (from 0.3 to 0.6) are tried, valid ones not."""
    search = empty()
    first, strict, valid = candidate(0.6), candidate(0.4), candidate(0.7)
    search.pool = [first, valid]
    assert search.propose(1) == [first]
    search.observe(first, None, verdict(Level.VALID))
    assert promised(search, 1) == []
    assert search.result == "No serious attack found in 3 candidates; the best level is valid."
    search.pool.append(strict)
    assert promised(search, 2) == [strict]
    for kind, words in (("a", "one kind"), ("b", "2 kinds")):
        search.succeeded(kind)
        assert search.result.startswith(f"Attacks of {words} succeeded; ")


def test_what_is_predicted_to_be_hopeless_is_not_tried():
    search = empty()
    first = candidate(0.0)
    search.pool = [
        first, candidate(0.1, off_road=True), candidate(0.2, third_party=True), candidate(3.0)
    ]  # fmt: skip
    assert search.propose(4) == [first]


def test_the_first_attempt_is_made_even_if_nothing_is_promised():
    """It shows why: here that the candidate misses by far."""
    search = empty()
    search.pool = [candidate(7.0), candidate(7.5)]
    assert [p.score for p in search.propose(2)] == [7.0]


def test_after_a_success_another_kind_is_looked_for():
    """A kind is an intent, the vehicle's relation to the ego, and the side of the ego that is hit."""
    search = empty()
    left, again = candidate(0.0, side="left"), candidate(0.0, side="left")
    front = candidate(0.2, side="front")
    search.pool = [left, again, front]
    assert search.propose(1) == [left]
    search.observe(left, None, verdict(Level.SERIOUS))
    search.succeeded("Near / neighbour / left")
    assert promised(search, 2) == [front]


def test_tries_cost_so_another_family_has_its_turn():
    situation = straight_situation()
    near, far = entry("Near", ("neighbour",)), entry("Other", ("neighbour",), SHIFT + "\n# another text\n")
    search, cost = empty(), SearchSettings().price.tried
    planner_a, planner_b = near.planners[0], far.planners[0]
    bv = next(iter(situation.targets))
    search.pool = [Proposal(bv, "Near", planner_a, {}, 0.0, 0.0, by="memory", score=0.01 * k) for k in range(4)]
    search.pool.append(Proposal(bv, "Other", planner_b, {}, 0.0, 0.0, by="memory", score=cost + 0.015))
    # 0.00 first; then 0.01 + 0.12 against 0.135: Near again (0.13); third turn goes to the least tried family
    assert [p.label for p in search.propose(3)] == ["Near", "Near", "Other"]


@pytest.mark.parametrize(
    ("scores", "drawn"),
    [
        ([(1, 4.0)], 30 + 3 * 150),  # nothing reaches the ego: 450 more
        ([(1, 0.7)], 30 + 3 * 150),  # nor would a valid collision do where a serious one is wanted
        ([(1, 0.25)], 30 + 3 * 150),  # serious with little to spare
        ([(40, 0.5), (1, 0.05)], 30 + 150),  # serious after the first round
        ([(1, 0.05)], 30),  # serious already
    ],
)
def test_more_is_drawn_until_the_goal_is_predicted_with_something_to_spare(scores, drawn):
    """30 are wanted, and 150 are drawn at once."""
    search = shifts_of(InTurn(*scores))
    taken = search.propose(1)
    assert len([*search.pool, *taken]) == drawn


def test_half_of_what_is_redrawn_is_near_the_best_ones():
    """Of the gaps from -3 to 4 m those of the ten best are all -3 m: with a spread of 0.12 * 7 = 0.84 m, cut off at the
    bound, variations lie at -2.7 m in the mean, evenly drawn ones at 0.5 m."""
    templates = templates_of({0.0: straight_situation()}, [entry("Shift", ("neighbour",))])
    best = [replace(templates[0].proposal(None), parameters={"gap": -3.0, "drift": 3.0})] * 10
    gaps = [p.parameters["gap"] for p in Sampler(SamplingSettings(), 7).more(templates, best)]
    assert len(gaps) == 150
    assert np.mean(gaps[75:]) < -2.2
    assert np.mean(gaps[:75]) > -1.0


def test_new_intents_are_composed_only_for_what_the_library_does_not_cover():
    situation = merging_situation()
    library = [entry("Shift", ("neighbour",))]
    ranked = search_of(NeverHits(), {0.0: situation}, library, 10, seed=0).ranking(library)
    assert ranked[0].label == "Ramp Merge Rush" and ranked[0].source == "generated"
    assert compose({0.0: situation}, [entry("Somebody's own", ("merging",))]) == []
    rush = entry("Ramp Merge Rush", ("merging",))
    learnt = compose({0.0: situation}, [replace(rush, planners=(replace(rush.planners[0], origin="expert"),))])
    assert [(i.label, i.source) for i in learnt] == [("Ramp Merge Rush", "memory")]


def test_the_generator_adapts_a_movement_planner_and_keeps_its_parent():
    examples = [entry("Shift", ("neighbour",)), entry("Go-straight", ("crossing_straight",), RUSH, "direct")]
    intent = Intent("bv", "Intersection Rush-through Turn Right", "", "medium", 0.0)
    (planner,) = expert_planners(intent, examples)
    assert 'MOVEMENT = "right"' in planner.text
    assert planner.parent == examples[1].planners[0].hash and planner.origin == "expert"
    assert expert_planners(Intent("bv", "Something else", "", "low", 0.0), examples) == ()


def test_a_family_of_emergency_braking_is_driven_with_a_braking_acceleration():
    situation = straight_situation()
    braking = entry("Emergency Braking", ("neighbour",))
    family = AttackTemplate(0.0, next(iter(situation.targets.values())), braking, braking.planners[0])
    assert family.proposal(None).acceleration == -7.5
    assert -8.0 <= family.proposal(random.Random(3)).acceleration <= -5.0


def test_without_a_tuner_the_authors_numbers_are_tried_at_the_earliest_moment():
    situation = straight_situation()
    library = [entry("Shift", ("neighbour",))]
    ways = templates_of({4.0: situation, 5.5: situation}, library)
    intent = Intent("bv", "Shift", "", "high", ((0.0, -2.0), (1.0, 1.0)))
    remembered = ways[0].proposal(random.Random(1))
    plans = as_written([intent], ways, [remembered])
    assert plans[0] is remembered
    assert [(p.delay, p.parameters, p.acceleration) for p in plans[1:]] == [
        (4.0, {"gap": 2.0, "drift": 3.0}, ((0.0, -2.0), (1.0, 1.0)))
    ]


def test_planners_are_predicted_in_batches_that_fit_the_sandbox():
    planners = [make_planner("Shift", f"m{k}", SHIFT + f"# {k}\n", "seed") for k in range(30)]
    proposals = [Proposal("bv", "Shift", p, {}, 0.0, delay) for p in planners for delay in (0.0, 1.5)]
    batches = batches_of(proposals)
    assert [len(hashes) for hashes in batches] == [12, 12, 6]  # both moments together
    assert {h for hashes in batches for h in hashes} == {p.hash for p in planners}


def test_long_vehicles_touch_from_further_away():
    zero = np.array([[0.0]])
    car = Boxes(zero, zero, zero, zero, 5.0, 1.8)
    bus = Boxes(zero + 8.0, zero, zero, zero, 12.0, 2.5)
    assert touching(car, bus).all()  # 2.5 + 6 m reach further than the 8 m between the centres
    assert not touching(car, Boxes(zero + 8.6, zero, zero, zero, 12.0, 2.5)).any()


def test_an_intent_whose_planners_all_failed_says_no_infinite_time():
    search, near = empty(), entry("Near", ("neighbour",))
    broken = Prediction("It divides by zero.")
    search.pool = [Proposal("bv", "Near", near.planners[0], {}, 0.0, 0.0, score=9.0, prediction=broken)]
    (intent, *_) = search.ranking([near])
    assert intent.reason.endswith("min TTC 10.00 s")
