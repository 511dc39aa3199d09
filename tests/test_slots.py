"""Slots of intents: the values read off a text, and behaviours that are no longer confused."""

from __future__ import annotations

from pathlib import Path

import pytest

from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import read_intent_file
from sumo_adv.memory.slots import slots_of

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize(
    ("text", "manoeuvre", "place", "ego"),
    [
        ("The car in front backs up.", {"reverse"}, set(), set()),
        ("It backs off.", set(), set(), set()),
        ("Travelling in the reverse direction, it veers across.", set(), set(), set()),
        ("A taxi turns right at the crossroads.", {"turn right"}, {"junction"}, set()),
        ("A van on our right turns left.", set(), set(), set()),
        ("It stops in the middle of the junction.", {"block"}, {"junction"}, set()),
        ("It does not stop at the junction.", set(), {"junction"}, set()),
        ("A parked car leaves the kerbside.", {"set off"}, {"parking"}, set()),
        ("While the tested car is changing lanes, it closes the gap.", set(), set(), {"changes lane"}),
        ("The vehicle changes lanes while the ego goes on.", set(), set(), set()),
        ("A second van drives beside it, on the ramp.", {"by several vehicles"}, {"ramp"}, set()),
    ],
)
def test_values_of_a_text(text: str, manoeuvre: set[str], place: set[str], ego: set[str]) -> None:
    assert slots_of("", text) == {"manoeuvre": manoeuvre, "place": place, "ego": ego}


def test_a_phrase_does_not_go_on_after_a_comma_or_the_label() -> None:
    assert slots_of("Slow right", "Turn of the ego.")["manoeuvre"] == set()
    assert slots_of("", "It opens the gap")["manoeuvre"] == {"refuse"}
    assert slots_of("", "It opens, then a gap is there")["manoeuvre"] == set()


def test_the_seven_have_no_value_but_the_junction() -> None:
    junctions = set()
    for file in sorted((ROOT / "memory_bank").glob("*/intent.toml")):
        intent = read_intent_file(file)
        slots = slots_of(intent.label, intent.description)
        assert not slots["manoeuvre"] and not slots["ego"]
        if slots["place"]:
            assert slots["place"] == {"junction"}
            junctions.add(intent.label)
    assert junctions == {"Intersection Rush-through Go-straight", "Intersection Rush-through Turn Left"}


@pytest.mark.parametrize(
    ("label", "description"),
    [
        ("Box-in by two vehicles", "One vehicle brakes ahead of the ego, and a second drives beside it."),
        (
            "Blind-Side High-Speed Merge",
            "While both vehicles turn left side by side, the one in the inner turning lane speeds up in the ego's "
            "blind side and swings out into the ego's path before the bend ends.",
        ),
        ("Emergency Reversing", "The vehicle ahead of the ego in its lane brakes hard and then reverses towards it."),
        ("Intersection Rush-through Turn Right", "At an intersection it turns right across the ego's path."),
    ],
)
def test_another_behaviour_in_like_words_is_novel(label: str, description: str) -> None:
    with MemoryBank.open(ROOT / "memory_bank.sqlite", read_only=True) as bank:
        assert bank.retrieve(label, description).hit is None


@pytest.mark.parametrize(
    ("label", "description", "hit"),
    [
        ("Panic stop", "The leader slams on its brakes without warning.", "Emergency Braking"),
        ("Tailgating", "The car behind sticks to the bumper of the ego.", "Close Car-following"),
        ("intersection rush through TURN LEFT", "It reverses in a roundabout.", "Intersection Rush-through Turn Left"),
    ],
)
def test_known_ones_and_exact_labels_are_still_found(label: str, description: str, hit: str) -> None:
    with MemoryBank.open(ROOT / "memory_bank.sqlite", read_only=True) as bank:
        assert bank.retrieve(label, description).hit == hit
