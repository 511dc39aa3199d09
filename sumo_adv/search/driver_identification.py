"""What kind of driver an ego of unknown model is, by how it went in the attempts so far.

Several models are held against each attempt; the one whose ego came nearest to the real one, over all attempts, is the
one that is predicted with from then on (model selection by prediction error).  Drivers that are known have one model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, ObservedMotion

FAR = 10.0  # m: farther off is as wrong
ALERT = 0.1  # s until an alert driver brakes for whoever comes its way
CLEARLY = 0.9  # of the error of the model that is believed: from there on another one is
WIDE = 2.5  # m to either side within which a wary driver has a vehicle ahead for its leader


class DriverIdentification:
    """``models``: what the driver may be, what is believed without evidence first."""

    def __init__(self, model: Mapping[str, Any]) -> None:
        self.models = models_of(model)
        self._errors = np.zeros(len(self.models))
        self._current = 0

    @property
    def open(self) -> bool:
        """Whether there is anything to find out."""
        return len(self.models) > 1

    @property
    def model(self) -> Mapping[str, Any]:
        """What is believed now."""
        return self.models[self._current]

    def hear(self, errors: Sequence[float]) -> bool:
        """Each model's error [m] in an attempt; whether another one is believed from now on. Only one that is clearly
        nearer is, since all is predicted again then."""
        self._errors += errors
        nearest = int(np.argmin(self._errors))
        if self._errors[nearest] >= CLEARLY * self._errors[self._current]:
            return False
        self._current = nearest
        return True


def models_of(model: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """A known driver's model alone; else also one that brakes at once for whoever comes its way, one that has whoever
    is ahead beside its lane for a leader, and one that takes no notice."""
    if not model.get("unknown", False) or model["kind"] == "replay":
        return [model]
    return [
        model, {**model, "kind": "careful", "reaction": ALERT}, {**model, "sees": WIDE}, {**model, "kind": "replay"}
    ]  # fmt: skip


def apart(seen: tuple[Floats, Floats], predicted: tuple[Floats, Floats], course: ObservedMotion) -> float:
    """Mean distance [m] of a predicted ego from the real one, x and y by step, as long as that was seen."""
    steps = max(1, min(course.seen, len(seen[0]), len(predicted[0])))
    distance = np.hypot(seen[0][:steps] - predicted[0][:steps], seen[1][:steps] - predicted[1][:steps])
    return float(np.minimum(distance, FAR).mean())
