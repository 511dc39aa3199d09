"""The search: variations of a candidate, its price, the library it draws from, and planners for new intents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import crossing, neighbour, situation

from sumo_adv.agents.generator import expert_planners
from sumo_adv.datatypes import Intent, Level, LibraryEntry, Planner, Prediction, Proposal, Verdict
from sumo_adv.planners.text import make_planner
from sumo_adv.search.intents import Selection, compose
from sumo_adv.search.sampling import Sampler, templates_of
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SamplingSettings, SearchSettings
from sumo_adv.situation import Target

ENDPOINT = """

def endpoint(bv, ego, road, parameters, acc, horizon):
    return {"x": 0.0, "y": 0.0, "heading": 0.0, "speed": 1.0, "time": 1.0}
"""
TABLE = 'PARAMETERS = {"gap": (2.0, -3.0, 4.0, "m", "where"), "drift": (3.0, 2.0, 6.0, "s", "how long")}\n'
SHIFT = make_planner("Shift", "side", TABLE + ENDPOINT, "seed")


class Same:
    """Every proposal scores half a point."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        return [replace(p, score=0.5) for p in proposals]


class Best:
    """A brake avoids every proposal: nothing more is drawn."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        return [replace(p, score=0.05) for p in proposals]


NEW = "Ramp Merge Rush"


def verdict(level: Level, *gates: str) -> Verdict:
    """What an attempt came to: its level, and the gates it failed."""
    return Verdict(0.0, 0.0, True, True, not gates, False, gates, level=level)


def proposal(planner: Planner = SHIFT, gap: float = 2.0, drift: float = 3.0) -> Proposal:
    return Proposal("bv", planner.label, planner, {"gap": gap, "drift": drift}, -6.0, 1.5, score=0.3)


def merging() -> Target:
    target = crossing()
    way = replace(target.ways[0], conflict=replace(target.ways[0].conflict, kind="merging"))  # type: ignore[type-var]
    return replace(target, ways=(way,))


def search_of(
    scorer: Same | Best, library: Sequence[LibraryEntry] = (), *, at: Target | None = None, proposals: int = 10,
    selection: Selection | None = None,
) -> AttackSearch:  # fmt: skip
    """A search that has predicted its first candidates, for a neighbour if no target is given."""
    situations = {0.0: situation([neighbour() if at is None else at])}
    settings = SearchSettings(proposals=proposals)
    return AttackSearch(scorer, situations, library, settings, seed=1, selection=selection)


def price(p: Proposal) -> float:
    return search_of(Same()).price(p)


def sampler(seed: int = 1) -> Sampler:
    return Sampler(SamplingSettings(), seed)


# ---- variations


def test_a_variation_is_another_number_for_the_same_way_to_attack() -> None:
    near, far = proposal(gap=0.5), proposal(gap=3.0)
    variations = sampler().variations([near, far], 5)
    assert len(variations) == 5
    assert {(p.bv, p.label, p.planner, p.acceleration, p.delay, p.prediction) for p in variations} == {
        ("bv", "Shift", SHIFT, -6.0, 1.5, None)
    }
    assert all(p.parameters.keys() == {"gap", "drift"} for p in variations)
    assert len({tuple(p.parameters.values()) for p in variations}) == 5
    assert near.parameters["gap"] == 0.5  # as it was
    assert sampler().variations([], 5) == []


def test_variations_stay_within_the_bounds_and_near() -> None:
    """gap: -3 to 4 m, drift: 2 to 6 s; of a range of 4 s 0.12 are 0.48 s, and 3.92 s are 4 of them from 2.0 s."""
    variations = sampler().variations([proposal(gap=4.0, drift=3.92)], 400)
    gaps, drifts = (np.array([p.parameters[name] for p in variations]) for name in ("gap", "drift"))
    assert gaps.max() == 4.0 and np.mean(gaps == 4.0) == pytest.approx(0.5, abs=0.1)  # half would be beyond it
    assert gaps.min() > -3.0
    assert drifts.min() >= 2.0 and drifts.max() <= 6.0
    assert drifts.mean() == pytest.approx(3.92, abs=0.1)
    assert drifts.std() == pytest.approx(SamplingSettings().spread * 4.0, rel=0.15)


def test_they_are_varied_in_turn() -> None:
    first, second = proposal(gap=-3.0), proposal(gap=4.0)
    variations = sampler().variations([first, second], 6)
    assert [p.parameters["gap"] < 0.5 for p in variations] == [True, False] * 3  # 3.5 m are four deviations


def test_a_seed_gives_the_same_variations_and_another_one_others() -> None:
    def numbers(seed: int) -> list[dict[str, float]]:
        return [dict(p.parameters) for p in sampler(seed).variations([proposal()], 8)]

    assert numbers(1) == numbers(1)
    assert numbers(1) != numbers(2)


# ---- prices


def test_a_later_contact_costs_a_little() -> None:
    """0.02 a second; where there is none until the prediction ends, so that a late one is no dearer than none."""
    assert price(replace(proposal(), prediction=Prediction(time=5.0))) == pytest.approx(0.3 + 0.1)
    late, none = (replace(proposal(), score=score, prediction=Prediction(time=11.9)) for score in (1.1, 1.6))
    assert price(late) < price(none) == pytest.approx(1.6 + 0.238)


def test_who_brakes_all_the_time_costs_a_little() -> None:
    """0.1 times the share of the steps up to the contact."""
    assert price(replace(proposal(), prediction=Prediction(braking=0.25))) == pytest.approx(0.3 + 0.025)


def shifts(count: int, mode: str = "side") -> tuple[Planner, ...]:
    return tuple(make_planner("Shift", mode, f"{TABLE}# version {k}\n{ENDPOINT}", "seed") for k in range(count))


def test_of_each_mode_the_two_versions_that_come_first_are_drawn_from() -> None:
    sides, others = shifts(4), shifts(1, "weave")
    entry = LibraryEntry("Shift", "", ("neighbour",), (sides[2], *others, sides[0], sides[1], sides[3]))
    ways = templates_of({0.0: situation([neighbour()])}, [entry])
    assert [w.planner for w in ways] == [sides[2], *others, sides[0]]


def test_versions_that_were_learnt_are_told_from_the_authors_and_two_of_them_count() -> None:
    """A planner adapted from another intent's is no version of it; a version without its author's planner stands for
    the mode."""
    first = shifts(1)[0]
    learnt = [make_planner("Shift", "side", f"{TABLE}# learnt {k}\n{ENDPOINT}", "expert", first.hash) for k in range(3)]
    adapted = make_planner("Merge", "side", f"{TABLE}# adapted\n{ENDPOINT}", "expert", first.hash)
    alone = replace(learnt[0], label="Alone", parent="0" * 64)
    library = [
        LibraryEntry("Shift", "", ("neighbour",), (*learnt, first)),
        LibraryEntry("Merge", "", ("neighbour",), (adapted,)),
        LibraryEntry("Alone", "", ("neighbour",), (alone,)),
    ]
    ways = templates_of({0.0: situation([neighbour()])}, library)
    assert [(w.planner, w.learnt) for w in ways] == [
        (learnt[0], True), (learnt[1], True), (first, False), (adapted, False), (alone, False)
    ]  # fmt: skip


def test_what_is_drawn_does_not_hang_on_the_library_s_order() -> None:
    sides = shifts(2)
    pools = []
    for planners in (sides, sides[::-1]):
        pools.append(search_of(Same(), [LibraryEntry("Shift", "", ("neighbour",), planners)], proposals=9).pool)
    assert pools[0] == pools[1]


def test_a_library_that_has_grown_adds_to_the_pool() -> None:
    """A half of ten for new candidates; predicted ones stay."""
    old = LibraryEntry("Shift", "", ("neighbour",), (SHIFT,))
    new = LibraryEntry("New", "", ("neighbour",), (replace(SHIFT, label="New"),), "generated")
    some = search_of(Best(), [old])
    before = list(some.pool)
    assert len(before) == 10
    some.extend([old, new])
    assert some.pool[:10] == before
    assert [p.label for p in some.pool[10:]] == ["New"] * 5
    some.extend([old, new])
    assert len(some.pool) == 15


def test_what_the_expert_composed_waits_until_it_is_wanted_also_where_the_bank_has_it() -> None:
    """A merging vehicle, and a bank that has learnt the rush from a ramp: it is ranked, and drawn only then."""
    learnt = LibraryEntry(NEW, "", ("merging",), (replace(SHIFT, label=NEW, origin="expert"),), "generated")
    some = search_of(Best(), [learnt], at=merging())
    assert some.pool == []
    ranked = some.ranking([learnt])
    assert [(i.label, i.source) for i in ranked] == [(NEW, "memory")]
    assert [(i.label, i.source) for i in some.ranking([])] == [(NEW, "generated")]
    some.extend([learnt])
    assert {p.label for p in some.pool} == {NEW}
    named = search_of(Best(), [learnt], at=merging(), selection=Selection(frozenset([NEW])))  # a scenario that names it
    assert [i.label for i in named.ranking([learnt])] == [NEW] and len(named.pool) == 10


def test_an_intent_of_that_name_with_somebody_s_own_planner_is_drawn_from_at_once() -> None:
    at = {0.0: situation([merging()])}
    own = LibraryEntry(NEW, "", ("merging",), (replace(SHIFT, label=NEW, origin="person"),))
    some = search_of(Best(), [own], at=merging())
    assert [(i.label, i.source) for i in some.ranking([own])] == [(NEW, "memory")]
    assert len(some.pool) == 10 and compose(at, [own]) == []


@pytest.mark.parametrize(
    ("good", "else_", "first"), [(0, 2.0, 0), (0, 1.2, 1), (1, 2.0, 1), (4, 1.2, 1), (5, 1.2, None)]
)
def test_where_few_are_avoidable_intents_are_composed_and_where_none_collides_they_come_first(
    good: int, else_: float, first: int | None
) -> None:
    """A score of 0.3 is an avoidable collision, of 1.2 an unavoidable one, of 2 a miss."""
    some = search_of(Same(), at=merging())
    some.pool = [replace(proposal(gap=0.1 * k), score=0.3 if k < good else else_) for k in range(10)]
    labels = [i.label for i in some.ranking([LibraryEntry("Shift", "", ("neighbour",), (SHIFT,))])]
    assert labels == (["Shift"] if first is None else (["Shift", NEW] if first else [NEW, "Shift"]))


def test_the_most_dangerous_intent_is_the_one_by_which_most_ways_collide_and_then_the_best() -> None:
    """Of Cut 1 of 4 is predicted to collide, and by that firmly; of Shift 3 of 4, none of them well; of Push as many,
    one of them a little better."""
    some = search_of(Same(), at=crossing())
    scores = {"Cut": (0.0, 2.0, 3.0, 3.0), "Shift": (1.2, 1.2, 1.4, 2.0), "Push": (1.1, 1.2, 1.4, 2.0)}
    planners = {label: make_planner(label, "side", TABLE + ENDPOINT, "seed") for label in scores}
    some.pool = [replace(proposal(planners[name]), score=s) for name, many in scores.items() for s in many]
    library = [LibraryEntry(name, "", ("neighbour",), (planner,)) for name, planner in planners.items()]
    assert [i.label for i in some.ranking(library)] == ["Push", "Shift", "Cut"]
    assert some.ranking(library)[2].reason.startswith("predicted: 1 of 4 candidates collide, 1 of them avoidably")


# ---- planners for new intents


def movement(mode: str, word: str) -> Planner:
    return make_planner("Rush", mode, f'# Rush, mode "{mode}"\n{TABLE}MOVEMENT = "{word}"\n{ENDPOINT}', "seed")


def test_a_new_intent_gets_a_planner_for_each_mode_that_makes_a_movement() -> None:
    rush = (movement("direct", "straight"), movement("weave", "straight"), movement("drift", "none"))
    examples = [LibraryEntry("Shift", "", ("neighbour",), (SHIFT,)), LibraryEntry("Rush", "", ("crossing",), rush)]
    intent = Intent("bv", "Intersection Rush-through Turn Right", "", "medium", 0.0)
    planners = expert_planners(intent, examples)
    assert [(p.label, p.mode, p.origin, p.parent) for p in planners] == [
        (intent.label, "direct", "expert", rush[0].hash),
        (intent.label, "weave", "expert", rush[1].hash),
    ]
    for planner in planners:
        assert planner.text.startswith(f'# {intent.label}, mode "{planner.mode}"\n')
        assert 'MOVEMENT = "right"' in planner.text
        assert planner.defaults() == {"gap": 2.0, "drift": 3.0}


def test_the_nearest_intent_that_makes_a_movement_is_the_example() -> None:
    still = LibraryEntry("Still", "", ("neighbour",), (movement("drift", "none"),))
    near, far = (LibraryEntry(n, "", (), (movement(n.lower(), "left"),)) for n in ("Near", "Far"))
    intent = Intent("bv", "Ramp Merge Rush", "", "medium", 0.0)
    (planner,) = expert_planners(intent, [still, near, far])
    assert (planner.mode, 'MOVEMENT = "any"' in planner.text) == ("near", True)
    assert expert_planners(intent, [still]) == ()
    assert expert_planners(intent, []) == ()


# ---- attacks of several kinds


class ByGap:
    """A serious hit on the ego's front with a gap below 2, a valid one on its left side with a larger gap."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        front, left = Prediction(hit=True, side="front"), Prediction(hit=True, side="left")
        return [
            replace(p, score=0.0, prediction=front)
            if p.parameters["gap"] < 2.0
            else replace(p, score=0.65, prediction=left)
            for p in proposals
        ]


def test_after_a_success_a_lower_level_of_another_kind_is_still_worth_an_attempt() -> None:
    some = search_of(ByGap())
    some.pool = ByGap().score([replace(proposal(gap=g), delay=0.0) for g in (0.5, 1.0, 3.0, 3.5)])
    (first,) = some.propose(1)
    assert first.parameters["gap"] < 2.0
    some.succeeded("Shift / neighbour / front")  # said before the attempt is observed
    some.observe(first, None, verdict(Level.SERIOUS))
    assert [p.parameters["gap"] > 2.0 for p in some.propose(4)[:2]] == [True, True]
