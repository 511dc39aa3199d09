"""From text to features: words, stop words, a small stemmer, and a thesaurus of driving.

The stemmer follows the shape of Porter's (M. F. Porter, "An algorithm for suffix stripping", 1980): plural, -ed/-ing,
-y, then one derivational ending, each only if enough of the word is left. It is meant for behaviours in traffic,
described in a few sentences of plain English. For other texts it need not agree with Porter's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TypeVar

_STOP_TEXT = """
a about above after again against all also although am an and any are as at be became because become been before
being below between both but by can come comes could did do does doing down during each either else even ever
every few for from further get gets getting give given go goes going gone had has have having he her here him
his how i if in into is it its itself just keep keeps kept let lets like made make makes making many may might
more most much must my no nor not now of off on once one only onto or other our out over own per put puts rather
same she should since so some still such take takes taken taking than that the their them then there these they
this those though through thus to too toward towards two under until up upon us very was we were what when where
whether which while who whom whose why will with within without would yet you your adversary agent automobile
autonomous av background bv car driver drive ego motorist our road roadway scenario sedan self street subject
tested traffic truck van vehicle
"""

STOP_WORDS: tuple[str, ...] = tuple(_STOP_TEXT.split())

CONCEPTS: Mapping[str, str] = {
    # what the speed does
    "brake": (
        "brake, decelerate, deceleration, slam, stomp, stop, halt, standstill, slow, slow down, slowdown, pull up "
        "short, lose speed, shed speed, scrub speed, kill speed, stand on the pedal, anchors, come to rest, drop "
        "speed, reduce speed, speed drop, retard, brake check, cut speed, stop dead, braking, dead stop"
    ),
    "accelerate": (
        "accelerate, acceleration, speed up, rush, race, dash, dart, floor it, gun, sprint, hurry, hasten, "
        "charge, step on the gas, throttle, full speed, bolt, shoot, zoom, beat, barrel, tear, hurtle, blast, "
        "surge, plough, burst, high speed, speed, fast, quick, rapid, pick up speed, punch"
    ),
    "sudden": (
        "sudden, abrupt, unexpected, sharp, hard, violent, heavy, emergency, without warning, out of nowhere, "
        "panic, full force, no warning, surprise, instant, jerk, harsh, forceful, maximum, at once, no reason, "
        "fierce"
    ),
    "aggressive": (
        "aggressive, reckless, rude, bully, impatient, assertive, hostile, ruthless, dangerous, press, pressure"
    ),
    # where the adversary is
    "ahead": ("ahead, front, in front, lead, leading, leader, preceding, precede, first in line, in front of, nose"),
    "behind": ("behind, rear, back, bumper, tail, in the mirror, rear view, backside, aft, boot, trunk, rear end"),
    "beside": (
        "beside, adjacent, neighbour, neighbor, neighbouring, neighboring, next, next to, alongside, side, "
        "parallel, flank, abreast, side by side, next lane, other lane, blind spot, level with, another lane"
    ),
    "oncoming": (
        "oncoming, opposite, opposing, contraflow, head on, wrong way, wrong side, facing, opposite direction, "
        "other direction, other way, centre line, center line, centreline, centerline, median, dividing line, "
        "counterflow, against traffic, against the flow, yellow line, opposite side, other side, wrong lane, "
        "approaching, opposite way, double line, middle of the road, head to head, face to face, double yellow, "
        "ghost driver, frontal, counter, opposed"
    ),
    "junction": (
        "intersection, junction, crossing, crossroad, crossroads, conflict point, side street, cross street, "
        "crossing point, traffic light, lights, four way, box, cross road, minor road, side road"
    ),
    # what it does
    "follow": (
        "follow, car following, tailgate, trail, shadow, pursue, chase, stick to, cling, glue, hang, stay on, "
        "ride, hug, sit on, stalk, dog, on the tail, on the heels, heels, "
        "draft, slipstream, breathe down"
    ),
    "close": (
        "close, near, tight, short, small, inches, crowd, headway, gap, spacing, following distance, distance, "
        "creep up, closing, tiny, barely, hardly any, centimetres, metre, half a second, safe distance, thin, "
        "minimal"
    ),
    "cut_in": (
        "cut in, cut off, cuts, cut, squeeze, merge, barge, wedge, force in, push in, insert, nose in, jump in, "
        "dive, swoop, slot, lane change, change lanes, change lane, changing lanes, switch lanes, snatch, butt "
        "in, muscle, shove, move over, lane switch, slip into, pull in, pull in front, pull out, sweep in, slice, "
        "elbow, chop, steal, cuts back, cut back, pull back in, swing across"
    ),
    "drift": (
        "drift, swerve, veer, shift, slide, wander, sideways, sideway, lateral, encroach, weave, stray, edge, "
        "lean, lurch, creep over, sway, sidle, laterally, lane shift, straddle, deviate, deviation, bear, "
        "sideswipe, steer, nudge, lane marking, lane line, over the line, lane boundary, lane departure, leave "
        "lane, offset, lane position"
    ),
    "intrude": "intrude, intrusion, invade, trespass, enter, cross over, cross, incursion, occupy, spill",
    "left": (
        "left, turn left, left turn, left hand, left turning, turning left, turn to the left, turn across, hook left"
    ),
    "right": "right turn, turn right, turning right, right hand, right turning",
    "turn": "turn, turning, swing, corner",
    "straight": (
        "straight, go straight, straight ahead, straight on, straight through, straight across, drive through, "
        "run through, go through, keep straight, perpendicular, cross traffic, crossing traffic, t bone, "
        "broadside, right angle"
    ),
    "not_yield": (
        "yield, give way, right of way, priority, red light, run a red, stop sign, ignore, disregard, fail to "
        "yield, refuse to yield, rush through, jump the light, jump the lights, amber, red, signal, yellow light, "
        "run the light, late yellow, without yielding, without stopping, without waiting, wait, precedence, "
        "concede"
    ),
    "overtake": "overtake, pass, overtaking, passing",
    "lane": "lane",
}


CONCEPT_MARK = "@"

_WORD = re.compile(r"[a-z]+")
_VOWEL = re.compile(r"[aeiouy]")
_MEASURE = re.compile(r"[aeiouy]+[^aeiouy]+")
T = TypeVar("T")
_WORD_SUFFIXES = (
    ("ational", ""), ("ization", ""), ("fulness", ""), ("ousness", ""), ("iveness", ""), ("ively", ""), ("ently", ""),
    ("antly", ""), ("fully", ""), ("lessly", ""), ("ously", ""), ("ation", ""), ("ingly", ""), ("ally", ""),
    ("ness", ""), ("ment", ""), ("able", ""), ("ible", ""), ("edly", ""), ("ion", ""), ("ous", ""), ("ive", ""),
    ("ful", ""), ("less", ""), ("ily", "y"), ("ant", ""), ("ent", ""), ("ate", ""), ("ly", ""), ("al", ""), ("er", ""),
    ("or", ""),
)  # fmt: skip


@lru_cache(maxsize=65536)
def stem(word: str) -> str:
    """Return the stem of a word: ``braking``, ``brakes`` and ``braked`` all give ``brak``.

    Args:
        word: The word, in lower case.
    """
    if len(word) <= 3:
        return word
    word = _past_or_progressive(_singular(word))
    for suffix, ending in _WORD_SUFFIXES:
        if word.endswith(suffix) and len(_MEASURE.findall(word[: -len(suffix)])) >= 1 and len(word) - len(suffix) >= 4:
            word = word[: -len(suffix)] + ending
            break
    if word.endswith("y") and _VOWEL.search(word[:-1]):
        word = word[:-1] + "i"
    if word.endswith("e") and len(word) > 4:
        word = word[:-1]
    doubled = len(word) > 4 and word[-1] == word[-2] and word[-1] not in "aeiouls"
    return word[:-1] if doubled else word


def _singular(word: str) -> str:
    """Strip a plural ending."""
    if word.endswith("sses"):
        return word[:-2]
    if word.endswith("ies"):
        return word[:-3] + ("y" if len(word) > 4 else "ie")
    if word.endswith("s") and not word.endswith(("ss", "us", "is")):
        return word[:-1]
    return word


def _past_or_progressive(word: str) -> str:
    """Strip -ed or -ing."""
    for suffix in ("ing", "ed"):
        root = word[: -len(suffix)]
        if word.endswith(suffix) and _VOWEL.search(root) and len(root) >= 3:
            return root if _MEASURE.findall(root) and not root.endswith(("at", "iz")) else root + "e"
    return word


_STOP_STEMS = frozenset(STOP_WORDS) | frozenset(stem(word) for word in STOP_WORDS)


def _phrases() -> dict[tuple[str, ...], tuple[str, ...]]:
    """Map the stemmed words of each thesaurus entry to its concepts."""
    table: dict[tuple[str, ...], list[str]] = {}
    for concept, entries in CONCEPTS.items():
        for entry in entries.split(","):
            key = tuple(stem(word) for word in _WORD.findall(entry))
            names = table.setdefault(key, [])
            if concept not in names:
                names.append(concept)
    return {key: tuple(names) for key, names in table.items()}


_CONCEPT_PHRASES = _phrases()
_MAX_CONCEPT_WORDS = max(len(key) for key in _CONCEPT_PHRASES)


def text_features(text: str) -> Iterator[str]:
    """Yield the features of a text, in order.

    A word or phrase that the thesaurus knows (longest phrase first) gives ``@concept``. Any other word gives its stem,
    unless it is a stop word.

    Args:
        text: The text.
    """
    raw = _WORD.findall(text.casefold().replace("'", ""))
    stems = [stem(word) for word in raw]
    for at, names in phrases(stems, _CONCEPT_PHRASES, _MAX_CONCEPT_WORDS):
        if names is not None:
            yield from (CONCEPT_MARK + name for name in names)
        elif raw[at] not in _STOP_STEMS and stems[at] not in _STOP_STEMS and len(raw[at]) > 1:
            yield stems[at]


def phrases(stems: Sequence[str], table: Mapping[tuple[str, ...], T], longest: int) -> Iterator[tuple[int, T | None]]:
    """Find the phrases of a table in a text, the longest first.

    Args:
        stems: The stems of the text.
        table: Maps phrases to values.
        longest: The number of words of the longest phrase.

    Yields:
        The place of each phrase with its value, and the place of every other word with None, in order of the text.
    """
    at = 0
    while at < len(stems):
        sizes = range(min(longest, len(stems) - at), 0, -1)
        size = next((n for n in sizes if tuple(stems[at : at + n]) in table), 0)
        yield at, table[tuple(stems[at : at + size])] if size else None
        at += size or 1
