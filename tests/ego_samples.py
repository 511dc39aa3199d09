"""Drivers for ``--ego ego_samples:Class``. In both of them SUMO's IDM drives; one brakes from a given time on."""

from __future__ import annotations

from sumo_adv.drivers import LaneSpeed, Observation

BRAKES_AT = 6.0  # s: one second after the trigger of the scenario motorway_cut_in_left
BRAKING = 5.0  # m/s2


class CalmEgo:
    """Leaves everything to SUMO."""

    name = "calm"
    forkable = True

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed | None:
        """As SUMO would."""
        return None


class BrakingEgo:
    """Brakes at 5 m/s2 from 6 s on; it does not say that it can be forked, so its attempts load and repeat."""

    name = "braking"

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed | None:
        """As SUMO would, until it is time."""
        if seen.time < BRAKES_AT - 1e-6:
            return None
        return LaneSpeed(lane=None, speed=max(0.0, seen.ego.speed - BRAKING * seen.dt))


class FailingEgo(CalmEgo):
    """Raises at 6 s."""

    name = "failing"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Fails when it is time."""
        if seen.time > BRAKES_AT:
            raise RuntimeError("the driver fell asleep")
        return None
