"""The network, written once against an array module ``xp``: numpy for inference, jax.numpy for training.

The structure is that of HiVT. Each vehicle first attends to its neighbours at every time step of its history
(agent-agent attention). A Transformer over time summarizes its history. Then the vehicle attends to the lanes
(agent-lane attention), and finally all vehicles of the scene attend to each other by their relative poses (global
interaction). The network decodes ``MODE_COUNT`` futures. Each has a Laplace distribution per step and coordinate, and a
logit for its probability.

There are two differences from HiVT. Two displacements make a token, and a decoded future is a smooth curve: the
position at constant velocity plus a Bernstein polynomial that is zero at the present time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import comb
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.files import write_whole
from sumo_adv.transformer.scene import (
    DISTANCE_SCALE_M,
    FUTURE_COUNT,
    POSITION_STEP_S,
    SPEED_SCALE_M_S,
    TOKEN_COUNT,
    Features,
    SceneVehicles,
    Segments,
    scene_features,
    to_world,
)

MODE_COUNT = 6
EMBEDDING_SIZE, HEAD_COUNT, INNER_SIZE = 64, 4, 256  # embeddings, attention heads, feed-forward layers
TEMPORAL_LAYER_COUNT, GLOBAL_LAYER_COUNT = 4, 3  # layers of the temporal Transformer and of the global interaction
POSITION_DEGREE, SCALE_DEGREE = 10, 3  # degrees of the polynomials of positions and of log-scales
MIN_LOG_SCALE, MAX_LOG_SCALE = -3.0, 4.0  # bounds of the log of a Laplace scale [m]
UNSEEN_LOGIT = -1e9  # attention score of absent elements
VARIANCE_EPSILON = 1e-5  # added to variances

Parameters = Mapping[str, Any]
"""The network's weights by name: arrays of numpy or JAX."""
FUTURE_TIMES_S = np.arange(1, FUTURE_COUNT + 1, dtype=np.float32) * np.float32(POSITION_STEP_S)
SHIPPED_WEIGHTS = Path(__file__).with_name("weights.npz")


class Modes(NamedTuple):
    """Predicted futures in each vehicle's frame.

    Attributes:
        place: The most likely positions [m], ``(..., AGENTS, MODES, FUTURE, 2)``.
        scale: The scales of the Laplace distributions [m], of the same shape.
        logit: The logits of the futures, ``(..., AGENTS, MODES)``.
    """

    place: Any
    scale: Any
    logit: Any


def bernstein(degree: int, first: int) -> NDArray[np.float32]:
    """Evaluate Bernstein polynomials at the steps of a future.

    Args:
        degree: The degree, which is also the index of the last polynomial.
        first: The index of the first polynomial.

    Returns:
        The values, ``(FUTURE, degree + 1 - first)``.
    """
    t = np.arange(1, FUTURE_COUNT + 1)[:, None] / FUTURE_COUNT
    k = np.arange(first, degree + 1)
    choose = np.array([comb(degree, int(j)) for j in k])
    return np.asarray(choose * t**k * (1 - t) ** (degree - k), np.float32)


POSITION_BASIS, SCALE_BASIS = bernstein(POSITION_DEGREE, 1), bernstein(SCALE_DEGREE, 0)


def make_parameters(seed: int) -> dict[str, NDArray[np.float32]]:
    """Initialize weights.

    Matrices follow Glorot's uniform distribution, shifts are 0, factors of norms are 1, and the embeddings of the class
    token and of the places in time follow a normal distribution with a standard deviation of 0.02.

    Args:
        seed: The seed of the random numbers.
    """
    rng = np.random.default_rng(seed)
    made: dict[str, NDArray[np.float32]] = {}

    def linear(name: str, into: int, out: int) -> None:
        bound = (6.0 / (into + out)) ** 0.5
        made[f"{name}.w"] = rng.uniform(-bound, bound, (into, out)).astype(np.float32)
        made[f"{name}.b"] = np.zeros(out, np.float32)

    def norm(name: str) -> None:
        made[f"{name}.w"], made[f"{name}.b"] = np.ones(EMBEDDING_SIZE, np.float32), np.zeros(EMBEDDING_SIZE, np.float32)

    def embedding(name: str, into: int) -> None:
        linear(f"{name}.1", into, EMBEDDING_SIZE)
        norm(f"{name}.norm")
        linear(f"{name}.2", EMBEDDING_SIZE, EMBEDDING_SIZE)

    def attention(name: str) -> None:
        norm(f"{name}.norm")
        for part in ("q", "k", "v", "out"):
            linear(f"{name}.{part}", EMBEDDING_SIZE, EMBEDDING_SIZE)
        norm(f"{name}.then")
        linear(f"{name}.1", EMBEDDING_SIZE, INNER_SIZE)
        linear(f"{name}.2", INNER_SIZE, EMBEDDING_SIZE)

    def gated(name: str) -> None:
        attention(name)
        for part in ("self", "new", "old"):
            linear(f"{name}.{part}", EMBEDDING_SIZE, EMBEDDING_SIZE)

    embedding("own", 5)
    embedding("state", 8)
    embedding("near", 8)
    embedding("lanes", 10)
    embedding("pairs", 4)
    gated("beside")
    made["time.class"] = rng.normal(0.0, 0.02, (1, EMBEDDING_SIZE)).astype(np.float32)
    made["time.place"] = rng.normal(0.0, 0.02, (TOKEN_COUNT + 1, EMBEDDING_SIZE)).astype(np.float32)
    for k in range(TEMPORAL_LAYER_COUNT):
        attention(f"time{k}")
    gated("road")
    for k in range(GLOBAL_LAYER_COUNT):
        gated(f"all{k}")
    norm("all.norm")
    linear("modes", EMBEDDING_SIZE, MODE_COUNT * EMBEDDING_SIZE)
    linear("decode.1", 2 * EMBEDDING_SIZE, INNER_SIZE)
    linear("decode.2", INNER_SIZE, 2 * EMBEDDING_SIZE)
    linear("place", 2 * EMBEDDING_SIZE, 2 * POSITION_DEGREE)
    linear("scale", 2 * EMBEDDING_SIZE, 2 * (SCALE_DEGREE + 1))
    linear("logit.1", 2 * EMBEDDING_SIZE, EMBEDDING_SIZE)
    linear("logit.2", EMBEDDING_SIZE, 1)
    return made


def forward(p: Parameters, f: Features, xp: Any = np) -> Modes:
    """Predict the futures of all vehicles of one scene, or of many scenes.

    Args:
        p: The weights.
        f: The features. Leading axes are scenes.
        xp: The array module, numpy or jax.numpy.
    """
    state = _embed(p, "state", f.state, xp)
    own = _embed(p, "own", f.own, xp) + state[..., None, :]
    near = _embed(p, "near", f.near, xp)
    moments = _gated(p, "beside", own, near, None, f.near_there, xp)

    shape = (*moments.shape[:-2], 1, EMBEDDING_SIZE)
    tokens = xp.concatenate([moments, xp.broadcast_to(p["time.class"], shape)], axis=-2) + p["time.place"]
    every = xp.ones((*tokens.shape[:-1], tokens.shape[-2]), tokens.dtype)
    for k in range(TEMPORAL_LAYER_COUNT):
        x = _norm(p, f"time{k}.norm", tokens, xp)
        tokens = tokens + _attend(p, f"time{k}", x, x[..., None, :, :], None, every, xp)
        tokens = tokens + _onward(p, f"time{k}", tokens, xp)
    local = tokens[..., -1, :]

    lanes = _embed(p, "lanes", f.lanes, xp)
    local = _gated(p, "road", local, lanes, None, f.lanes_there, xp)

    pairs = _embed(p, "pairs", f.pairs, xp)
    there = xp.broadcast_to(f.there[..., None, :], f.pairs.shape[:-1])
    whole = local
    for k in range(GLOBAL_LAYER_COUNT):
        whole = _gated(p, f"all{k}", whole, whole[..., None, :, :], pairs, there, xp)
    whole = _norm(p, "all.norm", whole, xp)

    modes = _linear(p, "modes", whole)
    modes = modes.reshape((*modes.shape[:-1], MODE_COUNT, EMBEDDING_SIZE))
    both = xp.concatenate([modes, xp.broadcast_to(local[..., None, :], modes.shape)], axis=-1)
    decoded = _relu(_linear(p, "decode.2", _relu(_linear(p, "decode.1", both), xp)), xp)
    logit = _linear(p, "logit.2", _relu(_linear(p, "logit.1", both), xp))[..., 0]
    curve = _linear(p, "place", decoded)
    place = DISTANCE_SCALE_M * (POSITION_BASIS @ curve.reshape((*curve.shape[:-1], POSITION_DEGREE, 2)))
    steady = SPEED_SCALE_M_S * f.state[..., :1] * FUTURE_TIMES_S  # at constant velocity, along x
    place = place + xp.stack([steady, xp.zeros_like(steady)], axis=-1)[..., None, :, :]
    spread = _linear(p, "scale", decoded)
    spread = SCALE_BASIS @ spread.reshape((*spread.shape[:-1], SCALE_DEGREE + 1, 2))
    return Modes(place, xp.exp(xp.clip(spread, MIN_LOG_SCALE, MAX_LOG_SCALE)), logit)


# -- layers -------------------------------------------------------------------------------------------------------


def _linear(p: Parameters, name: str, x: Any) -> Any:
    return x @ p[f"{name}.w"] + p[f"{name}.b"]


def _relu(x: Any, xp: Any) -> Any:
    return xp.maximum(x, 0.0)


def _norm(p: Parameters, name: str, x: Any, xp: Any) -> Any:
    centred = x - x.mean(axis=-1, keepdims=True)
    variance = (centred * centred).mean(axis=-1, keepdims=True)
    return centred / xp.sqrt(variance + VARIANCE_EPSILON) * p[f"{name}.w"] + p[f"{name}.b"]


def _embed(p: Parameters, name: str, x: Any, xp: Any) -> Any:
    return _linear(p, f"{name}.2", _relu(_norm(p, f"{name}.norm", _linear(p, f"{name}.1", x), xp), xp))


def _attend(p: Parameters, name: str, x: Any, others: Any, relative: Any, there: Any, xp: Any) -> Any:
    """Apply multi-head attention.

    Args:
        p: The weights.
        name: The name of the layer.
        x: The elements that attend, ``(..., w)``.
        others: The elements that they attend to, ``(..., n, w)``.
        relative: Embeddings of the pairs, which are added to keys and values; None if there are none.
        there: 1 if the other element is present, 0 if it is absent, ``(..., n)``.
        xp: The array module.
    """
    heads = (HEAD_COUNT, EMBEDDING_SIZE // HEAD_COUNT)
    q, k, v = _linear(p, f"{name}.q", x), _linear(p, f"{name}.k", others), _linear(p, f"{name}.v", others)
    if relative is not None:
        k, v = k + relative @ p[f"{name}.k.w"], v + relative @ p[f"{name}.v.w"]
    q, k, v = (z.reshape((*z.shape[:-1], *heads)) for z in (q, k, v))
    score = (q[..., None, :, :] * k).sum(axis=-1) / heads[1] ** 0.5  # (..., n, heads)
    score = xp.where(there[..., None] > 0.0, score, UNSEEN_LOGIT)
    weight = xp.exp(score - score.max(axis=-2, keepdims=True)) * there[..., None]
    weight = weight / xp.maximum(weight.sum(axis=-2, keepdims=True), VARIANCE_EPSILON)
    gathered = (weight[..., None] * v).sum(axis=-3)
    return _linear(p, f"{name}.out", gathered.reshape((*gathered.shape[:-2], EMBEDDING_SIZE)))


def _onward(p: Parameters, name: str, x: Any, xp: Any) -> Any:
    """Apply the feed-forward layers that follow an attention."""
    return _linear(p, f"{name}.2", _relu(_linear(p, f"{name}.1", _norm(p, f"{name}.then", x, xp)), xp))


def _gated(p: Parameters, name: str, x: Any, others: Any, relative: Any, there: Any, xp: Any) -> Any:
    """Update ``x`` as in HiVT: a gate weighs the gathered values against its own."""
    normed = _norm(p, f"{name}.norm", x, xp)
    gathered = _attend(p, name, normed, others, relative, there, xp)
    gate = _linear(p, f"{name}.new", gathered) + _linear(p, f"{name}.old", normed)
    gate = 0.5 + 0.5 * xp.tanh(0.5 * gate)  # the logistic function; its gradient is finite everywhere
    x = x + gathered + gate * (_linear(p, f"{name}.self", normed) - gathered)
    return x + _onward(p, name, x, xp)


@dataclass(frozen=True, slots=True)
class Predicted:
    """The predicted futures of ``n`` vehicles.

    Attributes:
        place: The most likely positions in the world [m], ``(n, MODES, FUTURE, 2)``.
        scale: The scales of the Laplace distributions along and across each vehicle's present heading [m], of the same
            shape.
        probability: The probabilities of the futures, ``(n, MODES)``.
    """

    place: Floats
    scale: Floats
    probability: Floats


class TransformerPredictor:
    """Predicts motion with a trained network."""

    def __init__(self, weights: Path = SHIPPED_WEIGHTS) -> None:
        """Read the weights.

        Args:
            weights: The file of the weights.

        Raises:
            UsageError: The file does not contain weights of this network.
        """
        self._parameters = read_weights(weights)

    def predict(self, agents: SceneVehicles, segments: Segments) -> Predicted:
        """Predict the futures of all vehicles of a scene.

        Args:
            agents: The vehicles, at most ``MAX_AGENTS``.
            segments: The lanes around them.
        """
        n = len(agents.heading)
        modes = forward(self._parameters, scene_features(agents, segments))
        place = to_world(np.asarray(modes.place[:n], float), agents)
        return Predicted(place, np.asarray(modes.scale[:n], float), softmax(np.asarray(modes.logit[:n], float)))


def softmax(x: Any, xp: Any = np) -> Any:
    """Compute the softmax over the last axis."""
    weight = xp.exp(x - x.max(axis=-1, keepdims=True))
    return weight / weight.sum(axis=-1, keepdims=True)


def write_weights(parameters: Mapping[str, Any], target: Path) -> None:
    """Write weights in half precision. Equal weights give equal bytes."""
    half: dict[str, Any] = {name: np.asarray(values, np.float16) for name, values in sorted(parameters.items())}
    write_whole(target, lambda part: np.savez(part, **half))


def read_weights(file: Path) -> dict[str, NDArray[np.float32]]:
    """Read weights of this network.

    Raises:
        UsageError: The file cannot be read, or does not contain weights of this network.
    """
    shapes = {name: values.shape for name, values in make_parameters(0).items()}
    try:
        with np.load(file, allow_pickle=False) as arrays:
            weights = {name: np.asarray(values, np.float32) for name, values in arrays.items()}
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} cannot be read as weights ({error}); give the weights.npz of a training.") from error
    if {name: values.shape for name, values in weights.items()} != shapes:
        raise UsageError(f"{file} holds no weights of this network; train them with benchmarks/transformer.py.")
    return weights
