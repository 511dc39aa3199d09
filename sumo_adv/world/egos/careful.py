"""The careful and competent human driver of UN Regulation No. 157, on top of one of SUMO's drivers.

SUMO drives until a hazard shows (``hazard.py``). From then the driver perceives for 0.4 s, reacts for 0.75 s, and
brakes: the deceleration rises evenly over 0.6 s to 0.774 g and stays there until the hazard is over or the ego stands.
It does not steer. Source: UN R157, performance models of a careful and competent human driver; made for motorway
cut-ins, and an extrapolation anywhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sumo_adv.errors import UsageError
from sumo_adv.world.egos.hazard import HazardWatch
from sumo_adv.world.egos.protocol import Action, LaneSpeed, Observation
from sumo_adv.world.egos.sumo_driven import MODELS, sumo_type

PERCEPTION = 0.4  # s
REACTION = 0.75  # s
RAMP = 0.6  # s, until full braking
FULL_BRAKING = 0.774 * 9.81  # m/s2
MEMORY = 0.5  # s without a hazard until the driver is at ease again


def braking_at(since_hazard: float) -> float:
    """Deceleration [m/s2] at ``since_hazard`` [s] after the hazard showed."""
    pressed = since_hazard - PERCEPTION - REACTION
    return FULL_BRAKING * min(max(pressed / RAMP, 0.0), 1.0)


def speed_lost(since_hazard: float) -> float:
    """Integral of ``braking_at`` from 0 to ``since_hazard`` [s], in m/s."""
    pressed = max(since_hazard - PERCEPTION - REACTION, 0.0)
    rising = min(pressed, RAMP)
    return FULL_BRAKING * (rising**2 / (2.0 * RAMP) + pressed - rising)


class CarefulEgo:
    """SUMO's driver with the reactions of UN R157. State: when the hazard showed, when it was last there."""

    name = "careful"
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """``parameters``: ``driver`` (krauss, idm or eidm; default idm) and that model's own. Raises UsageError."""
        own = dict(parameters or {})
        driver = own.pop("driver", "idm")
        if driver not in MODELS:
            raise UsageError(f"The ego 'careful' has no driver {driver!r}; choose one of {', '.join(MODELS)}.")
        self.sumo_type: Mapping[str, str] = sumo_type(driver, own)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """At ease, nobody seen yet; the seed is not needed."""
        self._watch = HazardWatch()
        self._shown: float | None = None
        self._last = 0.0

    def act(self, observation: Observation) -> Action:
        """Brake if a hazard has been there for long enough; else None."""
        hazards = self._watch.update(observation)
        if not hazards:
            if self._shown is not None and observation.time - self._last > MEMORY:
                self._shown = None
            return None
        if self._shown is None:
            self._shown = observation.time
        self._last = observation.time
        since = observation.time - self._shown
        lost = speed_lost(since + observation.dt) - speed_lost(since)
        if lost <= 1e-9:
            return None
        return LaneSpeed(None, max(0.0, observation.ego.speed - lost))
