"""What the model that writes a scenario is told about attempts that did not do."""

from __future__ import annotations

from typing import Any

from sumo_adv.words.author import attempt_facts


def attempt(index: int, intent: str, level: str, min_ttc: float | None, **more: Any) -> dict[str, Any]:
    return {
        "index": index, "intent": intent, "planner": {"mode": "side"}, "parameters": {"gap": 3.0}, "level": level,
        "min_ttc": min_ttc, "failed_gates": [], "diagnosis": None, **more,
    }  # fmt: skip


def test_the_best_attempt_of_each_intent_is_told_best_first() -> None:
    """Five attempts of three intents: a collision, then the one that lacks least, then the closest of the others."""
    tried = [
        attempt(0, "Cut", "none", 0.9),
        attempt(1, "Cut", "none", 0.4, misfits=["It does not come over.", "It does not brake."]),
        attempt(2, "Brake", "critical", 0.3),
        attempt(3, "Brake", "collision", 0.0),
        attempt(4, "Drift", "none", None),
    ]
    assert attempt_facts(tried) == [
        "4 (Brake/side; gap 3): level collision, minimum TTC 0.00 s.",
        "1 (Cut/side; gap 3): level none, minimum TTC 0.90 s.",
        "5 (Drift/side; gap 3): level none, no conflict.",
    ]
    assert len(attempt_facts(tried, most=1)) == 1
    assert attempt_facts(tried, ["Drift"], most=1) == [  # the behaviour that was written for it is told in any case
        "4 (Brake/side; gap 3): level collision, minimum TTC 0.00 s.",
        "5 (Drift/side; gap 3): level none, no conflict.",
    ]


def test_a_fact_says_where_it_was_nearest_and_what_stopped_it() -> None:
    """The adversary is 6 m behind the ego and 4.3 m to its left when it is nearest."""
    seen = {"time": 6.0, "ego_frame": [-6.0, 4.3], "ego_speed": 16.6, "bv_speed": 15.2}
    (fact,) = attempt_facts([
        attempt(0, "Cut", "none", 2.0, diagnosis=seen, failed_gates=["off_road"], misfits=["It does not brake."])
    ])  # fmt: skip
    assert fact == (
        "1 (Cut/side; gap 3): level none, minimum TTC 2.00 s; nearest 6.0 s after its start, A 6.0 m behind the EGO "
        "and 4.3 m to its left, the EGO at 16.6 m/s and A at 15.2 m/s; beyond the limits of off_road; "
        "It does not brake."
    )
