"""The lattice driver as an ego, which brakes and swerves.

In every step, it takes the cheapest of its candidates (``lattice_candidates.py``) on the frame of its route path. It
carries out the beginning of the candidate with the bicycle model (``protocol.py``). Without danger, it drives as IDM
behind the vehicle ahead. It is slower in bends, and wherever SUMO's own driver would be (``Road.advised``: lights and
right of way).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.drivers.lattice import (
    MIN_DESIRED_SPEED_M_S,
    Expected,
    LatticeEgos,
    LatticeSettings,
    Memory,
    Size,
    eased,
    look_ahead,
    reference,
    steering,
)
from sumo_adv.drivers.lattice_candidates import Space, choose
from sumo_adv.drivers.lattice_frame import LINE_HOLDING_M_S2, RoadFrame, VehicleHistory, expect, others_on
from sumo_adv.drivers.protocol import Action, Observation, Road, Steer, Wishes
from sumo_adv.drivers.sumo_driven import Idm, sumo_type
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap

# Without advice, an ego stands at a line if it is slower than this and its centre is nearer to the line than this.
LINE_STANDING_SPEED_M_S, LINE_STANDING_DISTANCE_M = 1.0, 12.5
OWN_SETTINGS = ("horizon", "braking", "lateral")  # settings that SUMO does not know


class LatticeEgo:
    """The controller. Its state is the path's frame, the past of other vehicles, and what the ego began last step."""

    name = "lattice"
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """Read the parameters.

        Args:
            parameters: ``horizon``, ``braking`` and ``lateral`` of ``LatticeSettings``, ``visible_only`` of ``Wishes``
                (default False), and those of IDM.

        Raises:
            UsageError: A parameter is unknown or out of range.
        """
        others = dict(parameters or {})
        visible_only = others.pop("visible_only", False)
        if not isinstance(visible_only, bool):
            raise UsageError(f"The ego 'lattice' needs 'visible_only' to be true or false, not {visible_only!r}.")
        self.wishes = Wishes(needs_road=True, visible_only=visible_only)
        own = {name: others.pop(name) for name in OWN_SETTINGS if name in others}
        for name, value in own.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.5 <= value <= 20.0:
                raise UsageError(f"The ego 'lattice' needs {name!r} to be a number from 0.5 to 20, not {value!r}.")
        self.sumo_type: Mapping[str, str] = sumo_type("idm", others)
        idm = Idm(**{name: float(value) for name, value in self.sumo_type.items() if name != "carFollowModel"})
        self.settings = LatticeSettings(**{name: float(value) for name, value in own.items()}, idm=idm)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget everything; the seed is not needed."""
        self._watch = VehicleHistory()
        self._points: Sequence[tuple[float, float]] | None = None
        self._frame: RoadFrame | None = None
        self._memory: Memory | None = None
        self._speed, self._asked = 0.0, 0.0  # [m/s] before the last step, and asked for after it
        self._cruising: float | None = None

    def act(self, observation: Observation) -> Action:
        """Return pedals and wheel for the step.

        Returns:
            None (SUMO drives) without a path, and when the route leaves the network.
        """
        ego, dt, settings = observation.ego, observation.dt, self.settings
        moving = self._watch.look(observation.time, observation.others)
        frame = self._framed(observation)
        if frame is None or (observation.road is not None and observation.road.leaves):
            return None
        if self._memory is None:
            acceleration, self._speed, self._asked = np.array([ego.acceleration]), ego.speed, ego.speed
            self._memory = Memory.first(acceleration, acceleration)
        memory, size = self._memory, Size(ego.length, ego.width)
        place = frame.locate(ego)
        egos = memory.egos(*(np.array([q]) for q in (*place, ego.speed)))
        others = expect(others_on(frame, ego, observation.others, moving), egos, size, settings.times, frame.project)
        road = observation.road or Road(self._free_speed(ego))
        space = Space.between(np.array([road.width / 2]), [road.sides], np.array([road.until]), ego.width)
        ordinary = self._reference(frame, egos, size, others, road, dt)
        chosen = choose(
            egos, size, ordinary, np.array([road.limit]), others, space, settings, dt, lambda s: frame.bend(s)[0]
        )
        ahead = look_ahead(egos.speed)
        x, y, _ = frame.path.at(egos.s + ahead, chosen.offset_after(ahead))
        angle = wrap(math.atan2(y[0] - ego.y, x[0] - ego.x) - ego.heading)
        wheel, slip = steering(np.array([angle]), ahead, egos.speed, settings.lateral)
        pedal = float(chosen.acceleration[0])
        self._speed, self._asked = ego.speed, max(0.0, ego.speed + pedal * dt)
        self._memory = Memory(
            np.maximum(chosen.acceleration, -egos.speed / dt), ordinary[:, 0], slip, chosen.target,
            chosen.duration - dt, chosen.second,
        )  # fmt: skip
        return Steer(pedal, float(wheel[0]))

    def _framed(self, observation: Observation) -> RoadFrame | None:
        """Return the frame of the present path or, without one, the last frame.

        The target offset is carried over to a new frame.
        """
        if observation.path is None or observation.path is self._points:
            return self._frame
        frame = RoadFrame(observation.path)
        if self._frame is not None and self._memory is not None:
            shift = frame.locate(observation.ego)[1] - self._frame.locate(observation.ego)[1]
            self._memory = self._memory._replace(target=self._memory.target + shift)
        self._points, self._frame = observation.path, frame
        return frame

    def _free_speed(self, ego: VehicleState) -> float:
        """Return the ego's first speed [m/s], which is used if no road is known."""
        if self._cruising is None:
            self._cruising = max(ego.speed, 1.0)
        return self._cruising

    def _reference(
        self, frame: RoadFrame, egos: LatticeEgos, size: Size, others: Expected, road: Road, dt: float
    ) -> Floats:
        """Return the accelerations of ordinary driving ``(1, time)`` [m/s2]."""
        assert self._memory is not None
        times, v = self.settings.times, egos.speed[:, None]
        bends = frame.bend(egos.s[:, None] + size.length / 2 + np.maximum(v, 1.0) * times)[1]
        speed = np.maximum(np.minimum(road.limit, bends), MIN_DESIRED_SPEED_M_S)
        cap = eased(np.array([self._advice(road, float(egos.speed[0]), dt)]), egos.speed, self._memory.reference, dt)
        return reference(egos, size, others, speed, cap, self.settings)

    def _advice(self, road: Road, speed: float, dt: float) -> float:
        """Return the maximum acceleration [m/s2] by SUMO's driver; inf if it does not limit the ego.

        It limits the ego if it was slower than the ego asked for, or if it may not go.
        """
        if road.advised is None:
            near = bool(road.stop_lines) and road.stop_lines[0].ahead < LINE_STANDING_DISTANCE_M
            at_line = speed < LINE_STANDING_SPEED_M_S and near
            return LINE_HOLDING_M_S2 if at_line and road.must_wait else math.inf
        if road.advised > self._asked - 1e-3:
            return math.inf
        return (road.advised - self._speed) / dt
