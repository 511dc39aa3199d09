"""Predict egos along their path: first by the unattacked profile, then by their driver model.

An ego follows its unattacked profile until it is disturbed: the adversary leads it or is in its way at a junction, and
a safe speed is below the profile. From then on, its driver model drives (Krauss's safe speed, IDM, the careful driver's
brake). None of them steers. An adversary leads once the middle of its front is in the ego's lane. At junctions, SUMO's
drivers follow ``MSLink``.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.careful import CarefulDrivers
from sumo_adv.road_users import unprotected
from sumo_adv.simulation.sumo_rules import AtJunction, CarFollowing, Junctions, SituationBatch

DISTURBED_SPEED_LOSS_M_S = 0.005  # an ego that must be slower than unattacked by more than this is disturbed
ACROSS_ANGLES_RAD = (0.9, 2.2)  # a vehicle at such an angle is no leader


class PredictedEgos:
    """``n`` copies of the ego along its path, each against one adversary or more.

    With ``each`` adversaries per ego, there are ``N = each * n`` pairs: the first adversaries of all egos, then their
    second ones. Arrays of adversaries are ``(N,)``, and the cost grows with N.

    Attributes:
        s: Station ``(n,)`` [m].
        v: Speed ``(n,)`` [m/s].
        a: Acceleration ``(n,)`` [m/s2].
        disturbed: Whether the ego has left its unattacked profile ``(n,)``.
        scenes: The situations of the egos.
        model: The driver model of the egos.
    """

    def __init__(self, scenes: SituationBatch, length: Floats, width: Floats, each: int = 1) -> None:
        """Start the egos at the trigger.

        Args:
            scenes: The situations of the adversaries ``(N,)``.
            length: Lengths of the adversaries ``(N,)`` [m].
            width: Widths of the adversaries ``(N,)`` [m].
            each: Number of adversaries per ego.
        """
        self._pairs, self._each, self._length, self._width = scenes, each, length, width
        n = len(length) // each
        self.scenes = scenes = scenes if each == 1 else SituationBatch(scenes.of[:n])
        self.model = scenes.driver
        self.s = scenes.each(lambda s: float(s.baseline.s[0]))
        self.v = scenes.each(lambda s: float(s.baseline.v[0]))
        self.a = scenes.each(lambda s: float(s.baseline.a[0]))
        self.disturbed = np.zeros(n, bool)
        size = (scenes.ego.length, scenes.ego.width)
        self._lane = self._pairs.each(lambda s: s.road.lane_width)
        self._driver = CarFollowing(self.model, scenes.dt)
        self._junctions = Junctions(self._pairs, self._driver)
        careful = self.model.kind == "careful"
        self._careful = CarefulDrivers(size, length, width, scenes.dt, self._lane / 2) if careful else None
        self._unprotected = unprotected(length, width)  # SUMO's drivers brake for these at any angle (measured)

    def step(
        self, now: float, adversary: tuple[Floats, Floats, Floats], speed: Floats,
        at_junction: AtJunction | None = None,
    ) -> None:  # fmt: skip
        """Advance all egos by a step.

        Args:
            now: Time since the trigger [s].
            adversary: Stations [m], offsets [m] and headings [rad] of the adversaries' box centres in the frame of the
                ego's path, each ``(N,)``.
            speed: Speeds of the adversaries ``(N,)`` [m/s].
            at_junction: Where the adversaries are at junctions; None if the ways meet at no junction.
        """
        if not self.reacts:
            self.step_alone(now)
            return
        dt = self.scenes.dt
        next_s, next_v = self.scenes.profile_now(now + dt)
        (s, d, h), half = adversary, self._length / 2
        front_d = d + half * np.sin(h)
        ahead = s + half * np.cos(h) > self._of_pairs(self.s) + self.scenes.ego.length / 2
        bound = self._bound(adversary, speed, (ahead, front_d), at_junction)
        self.disturbed |= bound < next_v - DISTURBED_SPEED_LOSS_M_S
        v = next_v
        if self.disturbed.any():
            pace = np.maximum(self.scenes.pace(self.s), next_v)
            free = np.minimum(self._driver.free(self.v), pace)
            reaction = np.maximum(np.minimum(free, bound), self.v - self.model.hardest_braking * dt)
            v = np.where(self.disturbed, reaction, next_v)
        v = np.maximum(v, 0.0)
        self.a = (v - self.v) / dt
        self.s = np.where(self.disturbed, self.s + v * dt, next_s)
        self.v = v

    @property
    def reacts(self) -> bool:
        """Whether the egos' motions depend on the adversaries; they do not if the egos replay a log."""
        return self.model.kind != "replay"

    def step_alone(self, now: float) -> None:
        """Advance egos that do not react by a step.

        Args:
            now: Time since the trigger [s].
        """
        next_s, next_v = self.scenes.profile_now(now + self.scenes.dt)
        self.s, self.a, self.v = next_s, (next_v - self.v) / self.scenes.dt, next_v

    def pose(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return x [m], y [m], heading [rad] and speed [m/s] of the egos, each ``(n,)``."""
        return (*self.scenes.ego_at(self.s), self.v)

    def onwards(self, steps: int) -> Floats:
        """Return x, y, heading and speed of the egos over the next ``steps`` at constant speed, ``(4, n, steps)``."""
        s = self.s[:, None] + self.v[:, None] * self.scenes.dt * np.arange(steps)
        return np.stack([*self.scenes.ego_at(s), np.broadcast_to(self.v[:, None], s.shape)])

    def _bound(
        self, adversary: tuple[Floats, Floats, Floats], speed: Floats, front: tuple[Bools, Floats],
        at_junction: AtJunction | None,
    ) -> Floats:  # fmt: skip
        """Return the highest speed [m/s] that the adversaries leave to the drivers ``(n,)``; inf if nothing limits it.

        Args:
            adversary: Stations, offsets and headings of the adversaries.
            speed: Speeds of the adversaries [m/s].
            front: Whether the adversaries' fronts are ahead of the egos', and the offsets of the fronts [m].
            at_junction: Where the adversaries are at junctions.
        """
        own_s, own_v, own_a = (self._of_pairs(q) for q in (self.s, self.v, self.a))
        (s, _, h), (ahead, front_d) = adversary, front
        across = (np.abs(h) > ACROSS_ANGLES_RAD[0]) & (np.abs(h) < ACROSS_ANGLES_RAD[1]) & ~self._unprotected
        leads = (np.abs(front_d) < self._lane / 2) & ahead & ~across
        nose = s + self._length / 2 * np.cos(h)  # SUMO places the rear of a turned leader its length behind the nose
        gap = nose - self._length - own_s - self.scenes.ego.length / 2
        bound = np.full(len(gap), np.inf)
        if leads.any():
            bound = np.where(leads, self._driver.behind(own_v, gap, speed), bound)
        if self._careful is not None:
            bound = np.minimum(bound, self._careful.bound((own_s, own_v, own_a), adversary, speed))
        if at_junction is not None:
            bound = np.minimum(bound, self._junctions.bound(at_junction, own_s, own_v))
        return bound if self._each == 1 else bound.reshape(self._each, -1).min(axis=0)

    def _of_pairs(self, of_egos: Floats) -> Floats:
        """Repeat an array of the egos ``(n,)`` for each pair ``(N,)``."""
        return of_egos if self._each == 1 else np.tile(of_egos, self._each)
