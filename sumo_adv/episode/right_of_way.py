"""Whether the ego must wait at a line: lights, signs, and vehicles with the right of way. One rule for all drivers.

A vehicle with the right of way counts if it arrives where its way meets the ego's before the ego would be across, and
has not left that place when the ego is at its line. The margins and the expected acceleration are those of
``drivers/sumo_rules.py``, which copies SUMO's own drivers. A reason to wait stays until the other vehicle is gone or
has clearly slowed down: the answer does not flicker while the ego brakes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.drivers.sumo_rules import AHEAD, CLEARANCE, FOE_ACCELERATION, FOE_SPEED, HALTING, seconds
from sumo_adv.simulation.meetings import Link, Meeting, Meetings
from sumo_adv.simulation.network import Connection

COMFORTABLE = 3.0  # m/s2: a driver that can stop with this braking stops at a yellow light, and keeps ``AHEAD``
STOPS = 4.5  # m/s2: a driver that cannot stop with this (SUMO's ``decel``) passes, unless it had to wait already
CAN_STOP = 0.5  # m: a driver that would stop at most this far beyond the line can still stop before it
RELAX = 1.0  # s more than ``AHEAD`` before a reason to wait goes away: SUMO's own margin once more
PASSED = 0.5  # m by which the front bumper may be over a line and still stand at it, as in ``drivers/sumo_rules.py``
AT_SIGN = 3.0  # m before a stop sign's line within which a standstill counts
LETS_GO = 3.0  # s: a vehicle that has stood this long lets the ego go first, so that two do not wait for each other


@dataclass(frozen=True, slots=True)
class Line:
    """A line on the ego's path. room: metres from the front bumper to it. begin: from the beginning of the way over
    the junction to it, above zero where the ego waits on the junction. letter: SUMO's, of light or sign."""

    link: Link
    way: Connection
    room: float
    begin: float
    letter: str
    limit: float  # m/s, of the way over the junction


@dataclass(frozen=True, slots=True)
class Foe:
    """Another vehicle that comes to a junction. to_line: metres from its front bumper to the beginning of its way over
    the junction, negative once it is on it. stood: for how long it has been standing [s]."""

    id: str
    link: Link
    to_line: float
    length: float
    speed: float
    stood: Callable[[], float]
    letter: str  # SUMO's, of its light now or of its sign


def signal_of(letter: str, *, light: bool) -> str | None:
    """``green``, ``yellow``, ``red``; None if there is no light or it is off."""
    colours = {
        "G": "green",
        "g": "green",
        "s": "green",
        "y": "yellow",
        "Y": "yellow",
        "r": "red",
        "R": "red",
        "u": "red",
    }
    return colours.get(letter) if light else None


def sign_of(letter: str) -> str | None:
    """``stop`` or ``yield`` where the ego has to give way while it may go, else None."""
    if letter in "sw":
        return "stop"
    return "yield" if letter in "mgo=" else None


class RightOfWay:
    """State: for which vehicles the ego waits, at which lines it has waited and may go, for how long it has stood at
    which stop signs [s], and at which yellow lights it stops."""

    def __init__(self, meetings: Meetings) -> None:
        self._meetings = meetings
        self._waits: set[tuple[Link, str]] = set()
        self._stood: dict[Link, float] = {}
        self._let_go: set[Link] = set()
        self._yellow: set[Link] = set()

    def must_wait(self, line: Line, length: float, speed: float, stood: float, foes: Sequence[Foe]) -> bool:
        """For an ego of a length [m] and a speed [m/s] that has been standing for ``stood`` seconds."""
        if line.room < -PASSED:
            self._forget(line.link)
            return False
        signal = signal_of(line.letter, light=line.way.light[1] >= 0 and line.begin == 0.0)
        if signal == "red":
            return True
        if signal == "yellow":
            if speed * speed <= 2 * COMFORTABLE * max(line.room, 0.0) or speed < HALTING:
                self._yellow.add(line.link)
            return line.link in self._yellow
        self._yellow.discard(line.link)
        if sign_of(line.letter) == "stop":
            if speed < HALTING and line.room <= AT_SIGN:
                self._stood[line.link] = max(stood, self._stood.get(line.link, 0.0))
            elif line.link not in self._stood:
                return True
        if sign_of(line.letter) is None:
            return False
        reasons = {(line.link, foe.id) for foe in foes if self._goes_first(line, length, speed, foe)}
        before = {reason for reason in self._waits if reason[0] == line.link}
        self._waits = self._waits - before | reasons
        if reasons:
            self._let_go.discard(line.link)
        elif before:
            self._let_go.add(line.link)
        return bool(reasons)

    def yields(self, line: Line, meeting: Meeting, letter: str) -> bool:
        """Whether vehicles on the other way go before the ego; ``letter``: of their light or sign."""
        return meeting.yields and sign_of(line.letter) is not None and letter not in "rRu"

    def _forget(self, link: Link) -> None:
        self._waits = {reason for reason in self._waits if reason[0] != link}
        self._stood.pop(link, None)
        self._yellow.discard(link)
        self._let_go.discard(link)

    def _goes_first(self, line: Line, length: float, speed: float, foe: Foe) -> bool:
        """Whether the ego has to wait for a vehicle; a vehicle on the junction counts even without priority."""
        entered = foe.to_line < 0.0
        if foe.letter in "rRuyY" and not entered:
            return False
        margin = AHEAD
        if (line.link, foe.id) in self._waits:
            margin = AHEAD + RELAX
        elif line.room <= speed * speed / (2 * STOPS) - CAN_STOP:
            return False
        elif line.link in self._let_go or line.room <= speed * speed / (2 * COMFORTABLE) - CAN_STOP:
            margin = 0.0
        for meeting in self._meetings.of(line.link):
            if meeting.other != foe.link or not (meeting.yields or entered) or meeting.at < line.begin:
                continue
            to_zone = foe.to_line + meeting.other_at - CLEARANCE
            to_clear = foe.to_line + meeting.other_at + foe.length + CLEARANCE
            if to_clear <= 0.0:
                continue
            if to_zone > 0.0 and foe.speed < HALTING and foe.stood() >= LETS_GO:
                continue
            if line.letter == "w" and not entered and foe.stood() <= self._stood[line.link]:
                continue
            to_meeting = line.room + meeting.at - line.begin
            at_line = _seconds(line.room, speed)
            across = _seconds(to_meeting + length + CLEARANCE, speed, line.limit)
            gone = to_clear / max(foe.speed, HALTING)
            if across + margin > _seconds(to_zone, foe.speed) and gone > at_line:
                return True
        return False


def _seconds(distance: float, speed: float, fastest: float = FOE_SPEED) -> float:
    return float(seconds(np.array([distance]), np.array([speed]), FOE_ACCELERATION, fastest)[0])
