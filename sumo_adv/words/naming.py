"""Name the scenario that an attempt shows, from its tracks and the road (``scenario_names.py`` has the lists).

The conflict is named by where the adversary comes from, in the frame of the ego's path:

================ ====================================================================================================
adversary        rule
================ ====================================================================================================
pedestrian,      by its heading at the decisive moment: along the ego's path (within 45 degrees) or across it; the near
cyclist          side is that of the kerb
oncoming         at first it heads against the ego's path by 120 degrees or more
crossing         at first it heads across the ego's path, by 35 to 120 degrees
                 (of the path, its nearest place counts; of an ego that turns, its place at the take-over)
the same way     all others: it enters the ego's way, is ahead in it (leader), or behind in it (follower)
================ ====================================================================================================

The decisive moment is the contact or, without one, the nearest approach. A leader *stands* if it stood for the last
second. It *brakes* or *speeds up* if it lost or gained 2 m/s after the take-over. A vehicle that enters the ego's way
with less than 0.5 m/s to the side *drifts*; a faster one changes lanes. NHTSA gives no numbers for these words. A road
user is *hidden* if other boxes hid it from the ego at first. The boxes do not tell an adult from a child.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sumo_adv.asked import Event
from sumo_adv.datatypes import NamedScenario, RoadGeometry
from sumo_adv.geometry import wrap
from sumo_adv.road_users import RoadUser, is_motorcycle, road_user
from sumo_adv.scenario_names import Disturbance, EgoBehaviour, disturbance
from sumo_adv.words.motion import (
    CROSSING_ANGLE_RAD,
    DESCRIBED_AS_STANDING_SPEED_M_S,
    EGO_TURN_ANGLE_RAD,
    MIN_SPEED_CHANGE_M_S,
    ONCOMING_ANGLE_RAD,
    Course,
    heading_from_ego,
)

ALONG_RAD = math.radians(45)  # maximum heading relative to the ego's path of walkers that go along it
TURNED_RAD = math.radians(
    12
)  # minimum change of the heading relative to the ego's path in a turn at a junction; most are hit early in the turn
DRIFT_M_S = 0.5  # a vehicle that moves to the side more slowly drifts; a lane change of 3.5 m in 5 s has 0.7 m/s
DRIFT_OVER_S = 1.0  # this speed is averaged over the last second before the vehicle enters the ego's way
STOOD_S = 1.0  # how long before the decisive moment a vehicle must have stood
BEYOND_M = 15.0  # past the ego's place at the decisive moment; a turn that it has begun ends within this distance
ENTRY_SIDES = {
    Event.ENTERS_FROM_LEFT: "left", Event.ENTERS_FROM_RIGHT: "right",
    Event.CROSSES_FROM_LEFT: "left", Event.CROSSES_FROM_RIGHT: "right",
}  # fmt: skip
TURNS = {Event.TURNS_LEFT: "left", Event.TURNS_RIGHT: "right"}


@dataclass(frozen=True, slots=True)
class NamingContext:
    """What naming needs in addition to the tracks.

    Attributes:
        relation: The adversary's relation to the ego at the start of the encounter.
        hidden: Whether other boxes hide the adversary from the ego at first.
        junction: Whether a junction at which ways meet is near.
        signalised: Whether a traffic light is ahead of the ego or the adversary.
        red: Whether one of them passes its stop line on red.
        geometry: The geometry of the road; None before a junction at which ways cross.
        changes_lane: Whether the ego changes lanes without an attack.
        ego_turn: How much the ego's path turns from its place at the take-over to ``BEYOND_M`` past its place at the
            decisive moment [rad].
        movements: What the adversary may do at its next junction: ``straight``, ``left``, ``right``.
        hand: 1 in right-hand traffic, -1 in left-hand traffic.
    """

    relation: str
    hidden: bool = False
    junction: bool = False
    signalised: bool = False
    red: bool = False
    geometry: RoadGeometry | None = RoadGeometry.MAIN
    changes_lane: bool = False
    ego_turn: float = 0.0
    movements: frozenset[str] = frozenset()
    hand: float = 1.0

    @property
    def ego_turns(self) -> str:
        """The side to which the ego turns at a junction; empty if it goes straight on."""
        if not self.junction or abs(self.ego_turn) < EGO_TURN_ANGLE_RAD:
            return ""
        return "left" if self.ego_turn > 0 else "right"

    @property
    def far_side(self) -> str:
        """The side of oncoming traffic."""
        return "left" if self.hand > 0 else "right"


def decisive(course: Course, contact: bool) -> int:
    """Return the index of the decisive moment: the last state before a contact, otherwise the nearest approach.

    Args:
        course: The states of the ego and the adversary.
        contact: Whether the two collide.
    """
    if contact:
        return len(course.time) - 1
    return int(np.argmin(np.hypot(course.ego.x - course.adversary.x, course.ego.y - course.adversary.y)))


def named(course: Course, around: NamingContext, *, contact: bool) -> NamedScenario:
    """Name what an attempt shows.

    Args:
        course: The states of the ego and the adversary.
        around: The road and the traffic lights.
        contact: Whether the two collide.
    """
    k = decisive(course, contact)
    user = road_user(course.adversary)
    if user is not RoadUser.VEHICLE:
        return _unprotected(course, around, user, k)
    heading = abs(_first_heading(course, around))
    if heading >= ONCOMING_ANGLE_RAD:
        return _oncoming(course, around, k)
    if heading >= CROSSING_ANGLE_RAD or (around.relation == "crossing" and around.junction):
        return _crossing(course, around, k)
    return _same_way(course, around, k, contact=contact)


def _first_heading(course: Course, around: NamingContext) -> float:
    """Return the adversary's first heading relative to the ego's path [rad]."""
    nearest = float(course.along.turn[0])
    if not around.ego_turns or abs(nearest) < CROSSING_ANGLE_RAD:  # it may go the same way ahead, after the turn
        return nearest
    return heading_from_ego(course.ego, course.adversary, course.ego_along)


def _unprotected(course: Course, around: NamingContext, user: RoadUser, k: int) -> NamedScenario:
    """Name the conflict with a pedestrian or cyclist."""
    letters = "CP" if user is RoadUser.PEDESTRIAN else "CB"
    manoeuvre = bool(around.ego_turns) or around.changes_lane
    nhtsa = (11 if user is RoadUser.PEDESTRIAN else 13) + (not manoeuvre)
    side = "left" if course.along.d[0] > 0 else "right"
    turn = abs(float(course.along.turn[k]))
    if around.ego_turns:
        return NamedScenario(f"{user} beside an ego that turns {around.ego_turns}", nhtsa, euro_ncap=f"{letters}TA")
    if turn < ALONG_RAD:
        return NamedScenario(f"{user} goes along the ego's way", nhtsa, euro_ncap=f"{letters}LA")
    if turn > math.pi - ALONG_RAD:
        return NamedScenario(f"{user} comes towards the ego", nhtsa)
    hidden = {"CP": "CPNCO", "CB": "CBNAO"}[letters]
    near = hidden if around.hidden else f"{letters}NA"
    name = f"{letters}FA" if side == around.far_side else near
    return NamedScenario(f"{'hidden ' * around.hidden}{user} crosses from the {side}", nhtsa, euro_ncap=name)


def _oncoming(course: Course, around: NamingContext, k: int) -> NamedScenario:
    """Name the conflict with an oncoming vehicle."""
    motorcycle = is_motorcycle(course.adversary)
    turned = _turned(course, around, k)
    entered = _when(course, Event.COMES_OVER)
    across = around.ego_turns == around.far_side  # such an ego is hit by those that go straight on
    if around.junction and entered is not None and around.far_side in around.movements and not across:
        turned = turned or around.far_side  # most are hit before their turn shows
    if across and not turned:
        tap = "CMFtap" if motorcycle else "CCFtap"
        return NamedScenario(
            f"oncoming vehicle, the ego turns {around.ego_turns} across its way", 27 if around.signalised else 29,
            euro_ncap=tap,
        )  # fmt: skip
    if turned == around.far_side and not around.ego_turns:
        return NamedScenario(f"oncoming vehicle turns {turned} across the ego's way", 27 if around.signalised else 29)
    if turned or around.ego_turns:
        return NamedScenario("oncoming vehicle, ways join in a turn", _turning(around, turned or around.ego_turns))
    if abs(float(course.along.d[0])) < _touching(course, 0):
        return NamedScenario("oncoming vehicle in the ego's lane", 21, euro_ncap="" if motorcycle else "CCFhos")
    if entered is None:
        return NamedScenario("oncoming vehicle passes")
    if _sideways(course, entered) < DRIFT_M_S:
        return NamedScenario("oncoming vehicle drifts over", 21)
    return NamedScenario("oncoming vehicle comes over", 20, euro_ncap="" if motorcycle else "CCFhol")


def _crossing(course: Course, around: NamingContext, k: int) -> NamedScenario:
    """Name the conflict with a crossing vehicle."""
    side = "left" if _first_heading(course, around) < 0 else "right"  # a vehicle from the left heads to the right
    turned = _turned(course, around, k)
    entered = any(event in (Event.ENTERS_FROM_LEFT, Event.ENTERS_FROM_RIGHT) for _, event in course.events)
    if turned or entered or around.ego_turns:
        does = f", the ego turns {around.ego_turns}" if around.ego_turns else " and turns into the ego's way"
        words = f"comes from the {side}{f' and turns {turned}' if turned else does}"
        turns_to = turned or around.ego_turns or around.far_side
        return NamedScenario(words, 4 if around.red else _turning(around, turns_to))
    nhtsa = 4 if around.red else 37 if around.signalised else 30
    name = "CMCscp" if is_motorcycle(course.adversary) else "CCCscp"
    red = ", one of them on red" if around.red else ""
    return NamedScenario(f"crosses from the {side}{red}", nhtsa, euro_ncap=name)


def _same_way(course: Course, around: NamingContext, k: int, *, contact: bool) -> NamedScenario:
    """Name the conflict with a vehicle that goes the same way."""
    motorcycle, turned = is_motorcycle(course.adversary), _turned(course, around, k)
    if turned == around.ego_turns:
        turned = ""  # it turns beside the ego, not across its way
    entered = next(((t, ENTRY_SIDES[e]) for t, e in course.events if e in ENTRY_SIDES), None)
    leaves = _when(course, Event.LEAVES)
    in_way = abs(float(course.along.d[0])) < _touching(course, 0)
    behind = bool(course.along.s[0] < course.ego_along.s[0])
    if in_way and entered is not None and leaves is not None and entered[0] > leaves:
        in_way = False  # it leaves the ego's way and comes back
    if (turned or around.ego_turns) and not in_way and not (entered and around.relation == "merging"):
        who = f"turns {turned} across the ego's way" if turned else f"is beside an ego that turns {around.ego_turns}"
        return NamedScenario(who, 16)
    if not in_way and entered is not None:
        time, side = entered
        if _sideways(course, time) < DRIFT_M_S:
            return NamedScenario(f"drifts in from the {side}", 19, _iso(around, Disturbance.CUT_IN), "cut-in")
        return NamedScenario(f"cuts in from the {side}", 18, _iso(around, Disturbance.CUT_IN), "cut-in")
    if not in_way:
        if around.changes_lane:
            return NamedScenario("is beside an ego that changes lanes", 18, _iso(around, Disturbance.DECELERATION))
        return NamedScenario("stays beside the ego")
    if behind:
        return _rear(course, around, k) if contact or leaves is None else NamedScenario("follower goes past the ego")
    if not contact and leaves is not None:
        return NamedScenario("leader leaves the lane", 18, _iso(around, Disturbance.CUT_OUT), "cut-out")
    return _leader(course, around, k, motorcycle)


def _leader(course: Course, around: NamingContext, k: int, motorcycle: bool) -> NamedScenario:
    """Name the conflict with a vehicle ahead of the ego in its lane."""
    iso = _iso(around, Disturbance.DECELERATION)
    stands, braked, gained = _speeds(course.adversary.speed[: k + 1], course.time[: k + 1])
    number = 22 if around.changes_lane else 26 if stands else 25 if braked else 23 if gained else 24
    stood = bool((course.adversary.speed[: k + 1] < DESCRIBED_AS_STANDING_SPEED_M_S).all())
    rear = "CMR" if motorcycle else "CCR"
    if stood:
        return NamedScenario("leader stands", number, iso, f"{rear}s")
    if braked:
        return NamedScenario("leader brakes" + " to a standstill" * stands, number, iso, f"{rear}b")
    if gained:
        return NamedScenario("leader speeds up", number, _iso(around, Disturbance.ACCELERATION))
    return NamedScenario("leader drives slower", number, iso, "" if motorcycle else "CCRm")


def _rear(course: Course, around: NamingContext, k: int) -> NamedScenario:
    """Name the conflict with a vehicle behind the ego in its lane; the ego is the lead vehicle."""
    stands, braked, gained = _speeds(course.ego.speed[: k + 1], course.time[: k + 1])
    number = 26 if stands else 25 if braked else 23 if gained else 24
    return NamedScenario("follower closes up", number, _iso(around, Disturbance.ACCELERATION))


def _speeds(speed: np.ndarray, time: np.ndarray) -> tuple[bool, bool, bool]:
    """Return whether a vehicle stands at the end, and whether it has lost or gained ``MIN_SPEED_CHANGE_M_S``."""
    stands = bool((speed[time >= time[-1] - STOOD_S] < DESCRIBED_AS_STANDING_SPEED_M_S).all())
    gained = float(speed[-1] - speed[0])
    return stands, gained <= -MIN_SPEED_CHANGE_M_S, gained >= MIN_SPEED_CHANGE_M_S


def _iso(around: NamingContext, motion: Disturbance) -> str:
    """Return the disturbance of ISO 34502; empty before a junction at which ways cross."""
    if around.geometry is None:
        return ""
    return disturbance(around.geometry, EgoBehaviour.CHANGE if around.changes_lane else EgoBehaviour.KEEP, motion)


def _turning(around: NamingContext, side: str) -> int:
    """Return NHTSA's number for a turn at a junction."""
    if not around.signalised:
        return 31
    return 37 if side == around.far_side else 28


def _turned(course: Course, around: NamingContext, k: int) -> str:
    """Return the side to which the adversary turns at a junction; empty if it does not.

    Its heading is taken relative to the ego's path, which may follow a curve of the road, unless the ego turns.
    """
    if not around.junction:
        return ""
    heading = course.adversary.heading if around.ego_turns else course.along.turn
    change = float(wrap(np.asarray(heading[k] - heading[0])))
    if abs(change) >= TURNED_RAD:
        return "left" if change > 0 else "right"
    if not around.movements or "straight" in around.movements:
        return ""
    later = next((TURNS[event] for _, event in course.events if event in TURNS), around.far_side)
    return later if later in around.movements else sorted(around.movements)[0]


def _touching(course: Course, k: int) -> float:
    """Return the offset from the ego's path below which the adversary is in the ego's way [m]."""
    return float(course.along.half[k]) + course.ego.width / 2


def _when(course: Course, wanted: Event) -> float | None:
    """Return when an event first happens [s after the take-over]."""
    return next((time for time, event in course.events if event is wanted), None)


def _sideways(course: Course, until: float) -> float:
    """Return the mean speed towards the ego's path in the second before a time [m/s]."""
    end = min(int(np.searchsorted(course.time, until - 1e-6)), len(course.time) - 1)
    start = int(np.searchsorted(course.time, until - DRIFT_OVER_S - 1e-6))
    if end <= start:
        return math.inf
    gone = abs(float(course.along.d[start])) - abs(float(course.along.d[end]))
    return gone / float(course.time[end] - course.time[start])
