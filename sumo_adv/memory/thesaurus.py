"""Words of driving that mean the same, for comparing intents. Stems are matched, so one form of a word is enough.

Entries are separated by commas; an entry of several words is a phrase, and the longest phrase wins.  A word may stand
under two concepts.  The list was written from the vocabulary of traffic rules and crash typologies before the test set
of paraphrases was; later changes were chosen on the tuning half of that set alone.
"""

from __future__ import annotations

from collections.abc import Mapping

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
