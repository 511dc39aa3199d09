"""Slots of an intent: the values in its text that set it apart as a behaviour, found with a table of words.

A slot is a question about a behaviour: which unusual manoeuvre, in which place, what the ego does meanwhile. Its values
are the answers in the label and the description, none or several. Braking, changing lanes and the like are no values,
nor is the relation to the ego. Many descriptions mention them in passing, and contradictions in them did not tell known
from novel intents on the tuning sets. They are compared as words of the text (``similarity.py``).

``SLOTS`` has the phrases of each value, and ``VALUE_NAMES`` the words that are read as one. In both, stems are
compared, so that one form of a word is enough. The words in ``LEFT_OUT_TEXT`` are skipped, and commas separate entries.
The table was written from the vocabulary of traffic rules and crash typologies, and completed on the tuning sets alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

from sumo_adv.memory.words import phrases, stem

Slots = Mapping[str, frozenset[str]]
"""Values by slot. The set is empty if the text gives no answer."""

OPTIONAL = frozenset({"place"})
"""Slots that a text may leave unanswered although the behaviour has a value."""

VALUE_NAMES: Mapping[str, str] = {
    "vehicle": (
        "car, van, truck, lorry, suv, sedan, saloon, taxi, cab, pickup, automobile, driver, motorist, agent, "
        "adversary, hatchback, coupe, minivan, tractor, motorcycle, motorcyclist, rider, attacker, opponent, "
        "challenger, bv, bus, coach"
    ),
    "ego": (
        "us, we, our, av, tested vehicle, tested car, automated vehicle, automated car, automated driver, "
        "autonomous vehicle, autonomous car, subject vehicle, subject car, host vehicle, ego vehicle, ego car, victim"
    ),
    "while": (
        "when, as, once, after, whilst, where, before, until, if, whenever, because, moment, each time, every time"
    ),
    "oncoming": "reverse direction, reverse flow, opposite, opposing, contraflow, counterflow",
    "junction": (
        "junction box, intersection, crossroads, four way, traffic light, red light, green light, stop line, "
        "stop sign, conflict area"
    ),
    "roundabout": "traffic circle, rotary, gyratory, circulatory",
    "kerb": "curb, kerbside, curbside, roadside",
    "bus stop": "bus stop, bus bay, bus shelter",
    "bus lane": "bus lane, tram lane",
    "lane change": "lane change, change lane, change of lane, switch lane, lane switch",
    "left turn": (
        "turn left, right turns left, left turn, left hand turn, swing left, bend left, curve left, curved path"
    ),
    "right turn": "turn right, left turns right, right turn, right hand turn, hook right, right hook, turn to right",
    "vehicle corner": "front corner, rear corner, back corner, ego corner, corner of ego",
    "not stopping": (
        "not stop, without stopping, fail to stop, never stops, instead of stopping, rather than stopping, "
        "should stop, must stop, have to stop, supposed to stop, refuse to stop, obliged to stop, stop controlled, "
        "no stop, neither stop"
    ),
    "not hesitating": "without hesitation, not hesitate",
    "a hindrance": "as obstacle, becomes obstacle",
}
"""The words that are read as one: a name, and the words that are replaced by it.

Thus a phrase can be kept from being read as its parts.
"""

LEFT_OUT_TEXT = "a an the its his her their very already just still own"

SLOTS: Mapping[str, Mapping[str, str]] = {
    "manoeuvre": {
        "reverse": (
            "reverse, back up, back out, back into, back away, backward, roll back, rollback, rolls ~ back, slides back"
        ),
        "u-turn": (
            "u turn, uturn, turn around, turn round, turns about, about turn, double back, turn back, half circle, "
            "180, three point turn"
        ),
        "turn right": "right turn, rightward turn",
        "set off": (
            "parked, from kerb, at kerb, kerb space, double park, from standstill, starting off, standing start, "
            "from rest"
        ),
        "block": (
            "stop ~ junction, halt ~ junction, stand ~ junction, rest ~ junction, stop ~ middle of it, "
            "halt ~ middle of it, rest ~ middle of it, block ~ junction, junction block, stall, stop inside, "
            "waits there, gridlock, refuse to move, stuck, standoff, barricade, stop across, stand across, "
            "halt across, rest across, block both, sit across, linger, pause, mid junction, stop ~ across, stay put, "
            "not start, fail to start, not clear, park across"
        ),
        "pass a queue": (
            "overtake ~ queue, queue overtake, length of queue, past ~ queue, pass ~ queue, queue of, oncoming queue, "
            "row of, column of, line of vehicle, string of, line of oncoming, undertake, filter, lane split"
        ),
        "avoid": (
            "obstacle, debris, pothole, reveal, uncover, expose, stationary vehicle, stopped vehicle, broken down, "
            "breakdown, disabled, hidden, hide, conceal, occlude, occlusion, obscure, swerve around, swerve round, "
            "vehicle dodges, cut out, steer around, steer round, evade, evasive, slow moving, swerve to avoid"
        ),
        "crawl": (
            "crawl, speed very gradually, gradually slow, walking pace, below limit, below speed limit, dawdle, "
            "far below, low speed, slow leader, inch forward, inch into, nose out, creep out, creep into, creep past, "
            "creep forward, nose past, coast, unusually slow, loiter, snail"
        ),
        "oscillate": (
            "zigzag, back and forth, repeatedly, repeated, over and over, rhythm, stop and go, alternate, slalom, "
            "again and again, several times, side to side, seesaw, pulse, accordion, brake again, and brakes again, "
            "accelerate and brake, brake and accelerate, start and stop, starts then stops, speeds up and slows"
        ),
        "refuse": (
            "shut, open ~ gap, opens up, offer ~ gap, create ~ gap, close ~ gap again, then close, speed up to keep, "
            "deny ego gap, keep ego from, keep it from, keep station, not let, refuse to let, bait, lure, trap, "
            "invite, escort, pace ego, herd, prevent ~ change, prevent ~ overtake, prevent ~ pass, prevent ~ merge, "
            "prevent ~ return, hold ego, pin ego, cannot change, block ~ overtake, block ~ lane change"
        ),
        "feint": (
            "hesitate, abort, feint, fake, false, bluff, pretend, swing back, swerve back, change mind, try again, "
            "unclear, mislead, indecisive, tease, deceptive, decoy, signals ~ but, indicates ~ but, cancel, "
            "return to lane, back to lane, back into lane, back into original, return to original"
        ),
        "lose control": (
            "spin, skid, loss of control, lose control, grip, aquaplane, hydroplane, jackknife, rotate, fishtail, "
            "overturn, shed load, cargo, lose ~ load, blowout, slippery, icy"
        ),
        "cross several lanes": (
            "several lane, multiple lane, all lane, three lane, across two lane, two lane away, lane away, "
            "two lane over, diagonally across, diagonal sweep, far lane, third lane"
        ),
        "swing wide": (
            "swing wide, run wide, wide turn, turn wide, go wide, too wide, wide arc, wide vehicle, wide swing, "
            "swing out, apex, corner, outward, overshoot, tail swing"
        ),
        "by several vehicles": (
            "box in, boxing ego, pincer, sandwich, hem in, pen in, enclose, surround, encircle, roadblock, "
            "two vehicle, three vehicle, second vehicle, while second, and second, third vehicle, while another, "
            "and another, pair of vehicle, accomplice, convoy, platoon, partner, companion, coordinate, tandem, "
            "cooperate, another adversary, jointly"
        ),
        "open a door": "open ~ door, door opening, fling ~ door",
        "ram": "ram, shunt",
    },
    "place": {
        "junction": "junction",
        "ramp": (
            "ramp, slip road, acceleration lane, acceleration strip, exit, feeder, lane end, taper, gore, "
            "merging lane, zipper, lane drop, closing lane, ending lane, interchange, weaving section, "
            "deceleration lane, become one, into one lane"
        ),
        "roundabout": "roundabout, circulate, inner ring, outer ring",
        "bend": "bend, curve, hairpin, curvature",
        "parking": (
            "parking, double park, from kerb, at kerb, kerb space, lay by, garage, car park, driveway, forecourt, "
            "petrol station, gas station, fuel station, alley, loading bay, from bay, leave bay, out of bay, "
            "into bay, courtyard, drop off, yard"
        ),
        "public transport": "bus stop, bus lane, tram, railway, rail crossing, rail track, level crossing, school",
        "foot and cycle paths": (
            "cycle, bike, bicycle, cyclist, pedestrian, crosswalk, zebra, sidewalk, pavement, child, walker, footpath"
        ),
        "shoulder": (
            "hard shoulder, on shoulder, along shoulder, from shoulder, shoulder passing, via shoulder, emergency lane"
        ),
        "one-way street": "one way, wrong end",
        "turn lane": (
            "turn lane, left turn lane, right turn lane, inner lane, outer lane, dual turn, dual left, dual right, "
            "double turn, turn only, lane meant, wrong lane"
        ),
        "work zone": "work zone, cone, roadworks, construction",
        "slope": "hill, uphill, downhill, slope, incline, gradient, crest",
        "narrow road": "narrow road, narrow street, bottleneck, single lane, single track, bridge, tunnel, toll",
        "median opening": "median opening, gap in median, median gap, median break",
    },
    "ego": {
        "turns": (
            "while ego ~ turn, while ego ~ left turn, while ego ~ right turn, turning ego, both ~ turn, "
            "both ~ left turn, both ~ right turn, during turn, mid turn"
        ),
        "changes lane": "while ego ~ lane change",
        "overtakes": "while ego ~ overtake, being overtaken, while ego passes it, while ego is passing it",
        "merges": "while ego ~ merge, while ego ~ join",
        "leaves or waits": (
            "while ego ~ exit, while ego leave, while ego ~ wait, while ego ~ reverse, while ego ~ park, ego is waiting"
        ),
        "begins something": (
            "while ego try, while ego attempt, while ego want, while ego signal, while ego begin, while ego start"
        ),
    },
}
"""The phrases that give a value, by slot and value. ``~`` stands for up to three words in between."""

_GAP = "~"
_MAX_GAP_WORDS = 3
_WORD_OR_GAP = re.compile(r"[a-z0-9]+|~")
_END = re.compile(r"[.,;:!?]")  # a phrase ends here at the latest


def slots_of(label: str, description: str) -> Slots:
    """Return the values that an intent's texts give for each slot.

    Args:
        label: The label of the intent.
        description: Its description.
    """
    values: dict[str, set[str]] = {slot: set() for slot in SLOTS}
    for part in _END.split(f"{label}. {description}"):
        words = _read(part)
        for at, word in enumerate(words):
            for phrase, slot, value in _SLOT_PHRASES.get(word, ()):
                if _begins(phrase, words, at):
                    values[slot].add(value)
    return {slot: frozenset(given) for slot, given in values.items()}


def _stems(text: str) -> list[str]:
    """Return the stems of a text, without the words that are skipped."""
    words = _WORD_OR_GAP.findall(text.casefold().replace("'s", "").replace("'", ""))
    return [stem(word) for word in words if word not in _LEFT_OUT]


def _read(text: str) -> list[str]:
    """Return the stems of a text, with entries of ``VALUE_NAMES`` replaced by their names, the longest first."""
    stems = _stems(text)
    return [name or stems[at] for at, name in phrases(stems, _STEMMED_NAMES, _MAX_NAME_WORDS)]


def _begins(phrase: Sequence[str], words: Sequence[str], at: int) -> bool:
    """Return whether a phrase begins at this place of ``words``."""
    for i, word in enumerate(phrase):
        if word == _GAP:
            return any(_begins(phrase[i + 1 :], words, at + i + skipped) for skipped in range(_MAX_GAP_WORDS + 1))
        if at + i >= len(words) or words[at + i] != word:
            return False
    return True


def _phrases() -> Iterator[tuple[tuple[str, ...], str, str]]:
    """Yield each phrase with its slot and value."""
    for slot, values in SLOTS.items():
        for value, entries in values.items():
            for entry in entries.split(","):
                yield tuple(_read(entry)), slot, value


_LEFT_OUT = frozenset(LEFT_OUT_TEXT.split())
_STEMMED_NAMES = {
    tuple(_stems(entry)): "-".join(_stems(name))
    for name, entries in VALUE_NAMES.items()
    for entry in entries.split(",")
}
_MAX_NAME_WORDS = max(map(len, _STEMMED_NAMES))
_SLOT_PHRASES: dict[str, list[tuple[tuple[str, ...], str, str]]] = {}  # by their first word
for _phrase in _phrases():
    _SLOT_PHRASES.setdefault(_phrase[0][0], []).append(_phrase)
