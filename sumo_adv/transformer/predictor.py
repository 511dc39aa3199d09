"""Prediction with numpy alone: the shipped weights, or those of a file that ``transformer train`` wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.files import write_whole
from sumo_adv.transformer.model import forward, make_parameters
from sumo_adv.transformer.scene import Agents, Segments, features, to_world

SHIPPED = Path(__file__).with_name("weights.npz")


@dataclass(frozen=True, slots=True)
class Predicted:
    """The futures of ``n`` vehicles.

    place ``(n, MODES, FUTURE, 2)``: most likely positions in the world [m]; scale, alike: of the Laplace distributions,
    along and across each vehicle's heading now [m]; probability ``(n, MODES)``.
    """

    place: Floats
    scale: Floats
    probability: Floats


class Predictor:
    """A trained network."""

    def __init__(self, weights: Path = SHIPPED) -> None:
        """Raises UsageError if the file holds no weights of this network."""
        self._parameters = read_weights(weights)

    def predict(self, agents: Agents, segments: Segments) -> Predicted:
        """The futures of all vehicles of a scene of at most ``AGENTS``."""
        n = len(agents.heading)
        modes = forward(self._parameters, features(agents, segments))
        place = to_world(np.asarray(modes.place[:n], float), agents)
        return Predicted(place, np.asarray(modes.scale[:n], float), probabilities(np.asarray(modes.logit[:n], float)))


def probabilities(logit: Floats) -> Floats:
    """The softmax over the last axis."""
    weight = np.exp(logit - logit.max(axis=-1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


def write_weights(parameters: Mapping[str, Any], target: Path) -> None:
    """Write weights in half precision; the same weights are the same bytes."""
    half: dict[str, Any] = {name: np.asarray(values, np.float16) for name, values in sorted(parameters.items())}
    write_whole(target, lambda part: np.savez(part, **half))


def read_weights(file: Path) -> dict[str, NDArray[np.float32]]:
    """Weights of this network. Raises UsageError."""
    shapes = {name: values.shape for name, values in make_parameters(0).items()}
    try:
        with np.load(file, allow_pickle=False) as arrays:
            weights = {name: np.asarray(values, np.float32) for name, values in arrays.items()}
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} cannot be read as weights ({error}); give the weights.npz of a training.") from error
    if {name: values.shape for name, values in weights.items()} != shapes:
        raise UsageError(f"{file} holds no weights of this network; train them with sumo-adv transformer train.")
    return weights
