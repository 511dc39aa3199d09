"""Which drivers an ego may be, judged by how it went without an attack and in the attempts so far.

A known driver has one model. For an unknown one a family of simple drivers is held against everything that was
observed. Each has a weight (Bayes' rule, with an exponential law for the distance between the predicted and the real
ego). Predictions are made for the most likely driver; the best candidates are scored by all likely ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats, Guard, ObservedMotion
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.drivers.scenes import Scenes
from sumo_adv.situation import Situation, on_path

FAR = 10.0  # m: a larger distance counts as this
SCALE = 4.0  # m: mean distance of a good model's prediction from the real ego, for each observed second
CLEARLY = 1.5  # another driver is believed once it is likelier by this factor, since all is predicted again then
KEPT = 0.7  # share of the first weights that comes from earlier encounters with the same driver
LIKELY, MOST = 0.1, 3  # a driver with a smaller weight is left out, and so are all but the most likely ones
LOOKED_AT = 6.0  # s of the unattacked run
AWAY = 1e4  # m: the station of a vehicle that is not there
WIDE = 2.5  # m to either side within which a driver takes a vehicle ahead for its leader
AUTOMATIC = Guard(ttc=1.5, reaction=0.1, deceleration=8.0)  # an automatic emergency brake
FORESIGHT = Guard(ttc=3.0, reaction=0.5, deceleration=4.0)  # a driver that brakes early and gently


class DriverIdentification:
    """``models`` and their ``names``: all that are considered, the default first."""

    def __init__(self, model: DriverModel, shown: Mapping[str, float] | None = None) -> None:
        """``shown``: weights by name that earlier encounters ended with. They count for ``KEPT`` of the first weights,
        since the next encounter may be of another kind."""
        family = family_of(model)
        self.names, self.models = [m.name for m in family], [m.model for m in family]
        first, shown = np.array([m.weight for m in family]), shown or {}
        before = np.array([shown.get(name, 0.0) for name in self.names])
        if before.sum() > 0.0:
            first = (1.0 - KEPT) * first + KEPT * before / before.sum()
        self._log = np.log(first)
        self._current = int(np.argmax(first))

    @property
    def open(self) -> bool:
        """Whether more than one model is possible."""
        return len(self.models) > 1

    @property
    def model(self) -> DriverModel:
        """The model that is believed now."""
        return self.models[self._current]

    @property
    def weights(self) -> Floats:
        """How likely each model is; the sum is 1."""
        relative = np.exp(self._log - self._log.max())
        return np.asarray(relative / relative.sum())

    @property
    def likely(self) -> list[tuple[DriverModel, float]]:
        """The models that count for the scores, the believed one first, with weights that add up to 1."""
        weights = self.weights
        order = sorted(range(len(weights)), key=lambda k: (k != self._current, -weights[k]))
        chosen = [k for k in order if k == self._current or weights[k] >= LIKELY][:MOST]
        return [(self.models[k], float(weights[k] / weights[chosen].sum())) for k in chosen]

    def observe(self, distances: Sequence[Floats]) -> bool:
        """Take note of how far from the real ego each model is in each observed second [m]; whether another model is
        believed from now on."""
        self._log = self._log - np.array([np.minimum(d, FAR).sum() for d in distances]) / SCALE
        nearest = int(np.argmax(self._log))
        if self._log[nearest] < self._log[self._current] + np.log(CLEARLY):
            return False
        self._current = nearest
        return True


@dataclass(frozen=True, slots=True)
class Possible:
    """A driver that the ego may be, and its weight before anything is observed."""

    name: str
    model: DriverModel
    weight: float


def family_of(model: DriverModel) -> list[Possible]:
    """The model of a known driver alone. For an unknown one: drivers that differ in where they look and when they
    brake, with their weights before anything is observed."""
    if model.known or model.kind == "replay":
        return [Possible(model.kind, model, 1.0)]
    return [
        Possible("car_following", model, 0.25),
        Possible("emergency_brake", replace(model, guard=AUTOMATIC), 0.2),
        Possible("foresight", replace(model, guard=FORESIGHT), 0.2),
        Possible("looks_to_the_side", replace(model, sees=WIDE), 0.15),
        Possible("swerves", replace(model, kind="lattice"), 0.1),
        Possible("never_reacts", replace(model, kind="replay"), 0.1),
    ]


def in_traffic(situation: Situation, model: DriverModel) -> Floats:
    """How far [m] the model is from the real ego in each second without an attack, while the others drive as they did:
    a driver that brakes where the real one did not is less likely."""
    real, dt = situation.baseline, situation.dt
    others = situation.traffic.others
    steps = min(len(real.s), round(LOOKED_AT / dt))
    if not others or steps < 2:
        return np.zeros(1)
    tracks = [on_path(t, situation.time, dt, steps, real.path) for t in others]
    motion = np.array([[t.s, t.d, t.heading, t.speed] for t in tracks])
    motion[:, 0] = np.where(np.isfinite(motion[:, 0]), motion[:, 0], AWAY)
    motion = np.nan_to_num(motion)
    scenes = Scenes([situation.driven_by(model)] * len(others))
    length, width = (np.array([getattr(t, size) for t in others]) for size in ("length", "width"))
    egos = PredictedEgos(scenes, [t.id for t in others], length, width)
    distance = np.zeros(steps)
    for k in range(steps - 1):
        s, d, h, v = motion[:, :, k].T
        egos.step(k * dt, (s, d, h), v)
        distance[k + 1] = np.abs(egos.s - real.s[k + 1]).max()
    return by_second(distance, dt)


def apart(real: tuple[Floats, Floats], predicted: tuple[Floats, Floats], motion: ObservedMotion, dt: float) -> Floats:
    """Mean distance [m] of a predicted ego from the real one in each observed second; x and y by step of ``dt`` [s]."""
    steps = max(1, min(motion.seen, len(real[0]), len(predicted[0])))
    distance = np.hypot(real[0][:steps] - predicted[0][:steps], real[1][:steps] - predicted[1][:steps])
    return by_second(distance, dt)


def by_second(distance: Floats, dt: float) -> Floats:
    """The means of each second of values that are ``dt`` [s] apart."""
    second = max(1, round(1.0 / dt))
    return np.array([distance[k : k + second].mean() for k in range(0, len(distance), second)])
