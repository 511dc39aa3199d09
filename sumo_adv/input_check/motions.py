"""Motions of a whole simulation, and the comparison of two of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from sumo_adv.simulation.simulation import FASTEST_PERSON_M_S, PERSON_JUMP_M
from sumo_adv.simulation.sumo_states import PERSON

State = tuple[float, float, float]  # x, y of the front [m], speed [m/s]
Motions = Mapping[str, Mapping[int, State]]  # by id, persons as ``person:ID``, and time [ms]
SAME_MOTION_TOLERANCE = 0.01  # m and m/s: SUMO's files have six decimals
MAX_NAMED_IDS = 5  # ids that a sentence names


@dataclass(frozen=True, slots=True)
class MotionComparison:
    """The differences between a simulation of this program and one of the program ``sumo``.

    Attributes:
        seconds: The time that was compared [s].
        step: The step length of ``sumo`` [s].
        vehicles: The number of vehicles in ``sumo``.
        same_vehicles: The number of vehicles that are present in the same steps in both, and never differ by more than
            ``SAME_MOTION_TOLERANCE``.
        persons: The number of persons on foot in ``sumo``.
        same_persons: The number of persons for which the same holds.
        position: The largest difference between positions [m].
        speed: The largest difference between speeds [m/s].
        worst: The vehicle or person with the largest difference between positions, and the time of that difference [s];
            None if no positions differ.
        missing: The ids that appear in ``sumo`` and never in this program.
        additional: The ids that appear in this program and never in ``sumo``.
        absent: The ids that appear in both, but in some step only in one of the two.
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
        """The comparison in one sentence."""
        persons = f" and {self.same_persons} of {self.persons} persons" if self.persons else ""
        words = (
            f"{self.same_vehicles} of {self.vehicles} vehicles{persons}, largest difference {self.position:.3f} m and "
            f"{self.speed:.3f} m/s over {self.seconds:g} s"
        )
        if self.worst is not None and self.position > SAME_MOTION_TOLERANCE:
            words += f" ({self.worst[0]} at {self.worst[1]:.1f} s)"
        for what, names in (
            ("never here", self.missing), ("only here", self.additional), ("not in the same steps", self.absent)
        ):  # fmt: skip
            if names:
                words += f"; {what}: {listed(names)}"
        return f"{words}."


def listed(names: tuple[str, ...]) -> str:
    """Join the first ``MAX_NAMED_IDS`` names, and say how many more there are."""
    more = len(names) - MAX_NAMED_IDS
    return ", ".join(names[:MAX_NAMED_IDS]) + (f" and {more} more" if more > 0 else "")


def _without_ends(
    ours: dict[int, State], theirs: dict[int, State], every: int
) -> tuple[dict[int, State], dict[int, State]]:
    """Remove one step at each end that only one of the two motions has.

    With the non-interacting pedestrian model, SUMO writes the place at which a person appears, and this program reads
    the place at which the person arrives.
    """
    if ours and theirs:
        ours.pop(max(theirs) + every, None)
        theirs.pop(min(ours) - every, None)
    return ours, theirs


def compare_motions(
    here: Motions, sumo: Motions, begin: float, times: tuple[float, float], step: float
) -> MotionComparison:
    """Compare the motions of two simulations.

    Args:
        here: The motions of this program. Its step length must divide ``step``.
        sumo: The motions of the program ``sumo``.
        begin: The beginning of both simulations [s].
        times: The period of the comparison [s]. States at its beginning are left out.
        step: The step length of ``sumo`` [s].
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
        if name.startswith(PERSON):  # this program leaves out a step in which a person jumps
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
