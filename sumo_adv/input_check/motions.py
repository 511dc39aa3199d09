"""Motions of a whole simulation, and how far two of them are apart."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from sumo_adv.simulation.simulation import FASTEST_PERSON_M_S, PERSON_JUMP_M
from sumo_adv.simulation.sumo_states import PERSON

State = tuple[float, float, float]  # x, y of the front [m], speed [m/s]
Motions = Mapping[str, Mapping[int, State]]  # by id, persons as ``person:ID``, and time [ms]
SAME_MOTION_TOLERANCE = 0.01  # m and m/s: SUMO's files have six decimals
MAX_NAMED_IDS = 5  # in a sentence


@dataclass(frozen=True, slots=True)
class MotionComparison:
    """How a simulation here differs from that of the program ``sumo``, over all vehicles and persons.

    Attributes:
        seconds: How long both were compared [s].
        step: Of the program ``sumo`` [s].
        vehicles: In SUMO.
        same_vehicles: Those that are here in every step, and nowhere more than ``SAME_MOTION_TOLERANCE`` away.
        persons: In SUMO, on foot.
        same_persons: The same of them.
        position: The largest difference of a position [m].
        speed: The largest difference of a speed [m/s].
        worst: The vehicle or person of the largest difference of a position, with the time [s]; None without one.
        missing: In SUMO, and never here.
        additional: Here, and never in SUMO.
        absent: In SUMO and here, but in some step in one of the two alone.
    """

    seconds: float
    step: float
    vehicles: int
    same_vehicles: int
    persons: int
    same_persons: int
    position: float = 0.0
    speed: float = 0.0
    worst: tuple[str, float] | None = None
    missing: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()
    absent: tuple[str, ...] = field(default=())

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        whole = (self.vehicles, self.persons) == (self.same_vehicles, self.same_persons)
        return whole and not self.additional

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        persons = f" and {self.same_persons} of {self.persons} persons" if self.persons else ""
        words = (
            f"{self.same_vehicles} of {self.vehicles} vehicles{persons}, largest difference {self.position:.3f} m and "
            f"{self.speed:.3f} m/s over {self.seconds:g} s"
        )
        if self.worst is not None and self.position > SAME_MOTION_TOLERANCE:
            words += f" ({self.worst[0]} at {self.worst[1]:.1f} s)"
        for what, names in (
            ("never here", self.missing), ("here alone", self.additional), ("not in the same steps", self.absent)
        ):  # fmt: skip
            if names:
                words += f"; {what}: {listed(names)}"
        return f"{words}."


def listed(names: tuple[str, ...]) -> str:
    """The first of the names, and how many more there are."""
    more = len(names) - MAX_NAMED_IDS
    return ", ".join(names[:MAX_NAMED_IDS]) + (f" and {more} more" if more > 0 else "")


def _without_ends(
    ours: dict[int, State], theirs: dict[int, State], every: int
) -> tuple[dict[int, State], dict[int, State]]:
    """Both without one step at the ends that only one of them has: without interaction, SUMO writes the place at which
    a person appears, and we read that at which it arrives."""
    if ours and theirs:
        ours.pop(max(theirs) + every, None)
        theirs.pop(min(ours) - every, None)
    return ours, theirs


def compare_motions(
    here: Motions, sumo: Motions, begin: float, times: tuple[float, float], step: float
) -> MotionComparison:
    """Compare the states after the first and up to the last of ``times`` [s].

    Args:
        here: Of this program; its step is a part of ``step``.
        sumo: Of the program ``sumo``.
        begin: Of both simulations [s].
        times: Between which they are compared [s].
        step: Of the program ``sumo`` [s].
    """
    first, last = (round(1000 * time) for time in times)
    every, zero = round(1000 * step), round(1000 * begin)
    reach = PERSON_JUMP_M + FASTEST_PERSON_M_S * step
    position, speed, worst = 0.0, 0.0, None
    same, absent, of_sumo = set[str](), set[str](), set[str]()
    seen = set[str]()
    for name in sorted(here.keys() | sumo.keys()):
        ours = {t: s for t, s in here.get(name, {}).items() if first < t <= last and (t - zero) % every == 0}
        theirs = {t: s for t, s in sumo.get(name, {}).items() if first < t <= last}
        if name.startswith(PERSON):  # a step in which it jumps is left out here
            theirs = {t: s for t, s in theirs.items() if math.dist(s[:2], theirs.get(t - every, s)[:2]) < reach}
            ours, theirs = _without_ends(ours, theirs, every)
        of_sumo |= {name} if theirs else set()
        seen |= {name} if ours else set()
        apart = 0.0
        for time in sorted(ours.keys() & theirs.keys()):
            a, b = ours[time], theirs[time]
            distance = math.dist(a[:2], b[:2])
            apart = max(apart, distance, abs(a[2] - b[2]))
            speed = max(speed, abs(a[2] - b[2]))
            if distance > position:
                position, worst = distance, (name, time / 1000)
        if ours and theirs and ours.keys() != theirs.keys():
            absent.add(name)
        elif ours and theirs and apart <= SAME_MOTION_TOLERANCE:
            same.add(name)
    persons = {name for name in of_sumo if name.startswith(PERSON)}
    return MotionComparison(
        times[1] - times[0], step, len(of_sumo - persons), len(same - persons), len(persons), len(same & persons),
        position, speed, worst, tuple(sorted(of_sumo - seen)), tuple(sorted(seen - of_sumo)), tuple(sorted(absent)),
    )  # fmt: skip
