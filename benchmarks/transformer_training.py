"""Training with JAX and optax (extra ``train``) on one thread, resumed where it stopped.

The loss is HiVT's: the negative log-likelihood of the mode that is nearest to what happened, and the cross-entropy of
the modes' probabilities against how near each mode came. On one machine the same scenes, seed and epochs give the same
weights bit for bit, also where the training was interrupted: the state is stored every ``STORED_STATE_STEPS`` steps.

``evaluate`` says how good the predictions are, on vehicles of held-out networks, beside two simple predictors.

minADE and minFDE: the mean and the last distance [m] between what happened and the nearest of up to six predictions,
each measure with its own nearest one; miss rate: the share of vehicles with a minFDE of more than ``MISS_DISTANCE_M``;
ADE and FDE: those of the likeliest prediction alone. Constant velocity has one prediction; lane following has one for
each way on from the vehicle's lane, the straightest first. A vehicle counts if it moves and its whole future is known.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from transformer_scenes import MIN_MOVING_DISTANCE_M, Scenes

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.errors import UsageError
from sumo_adv.files import write_whole
from sumo_adv.transformer.model import FUTURE_TIMES_S, Parameters, forward, make_parameters, softmax, write_weights
from sumo_adv.transformer.scene import SPEED_SCALE_M_S, Features

BATCH_SCENES = 32  # scenes a step
PEAK_LEARNING_RATE, WARM_UP_STEPS, WEIGHT_DECAY = 1e-3, 300, 1e-4  # of AdamW
STANDING_LOSS_WEIGHT = 0.3  # of a vehicle that does not move, which is easy to predict
MAX_GRADIENT_NORM = 5.0
COOL_DOWN_STEPS = 1000  # the last ones, over which the rate goes to 0 wherever the training ends
STORED_STATE_STEPS = 200  # between two stored states
ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
PARAMETER_PREFIX, MOMENT_PREFIX = "parameter/", "optimiser/"  # of names in the stored state

Progress = Callable[[int, int, float], None]
"""Told the step, the number of steps and the mean loss since it was told before, at every stored state."""
MISS_DISTANCE_M = 2.0  # as in HiVT
EVALUATED_SCENES_AT_ONCE = 64


def train(
    scenes: Scenes, folder: Path, *, seed: int, epochs: int, progress: Progress, steps: int | None = None,
    keep_every: int = STORED_STATE_STEPS,
) -> Path:  # fmt: skip
    """Train from where the folder's training stands; returns the weights' file, which is written with every state.

    steps: ends after this number of steps in all, in place of that of the ``epochs``.

    Raises:
        UsageError: JAX or optax is not installed; there are too few scenes; the folder holds another training.
    """
    jax, optax = _libraries()
    total = epochs * (len(scenes) // BATCH_SCENES)
    if not total:
        raise UsageError(f"{len(scenes)} scenes are too few: a step of the training takes {BATCH_SCENES}.")
    end = total if steps is None else min(steps, total)
    cosine = optax.warmup_cosine_decay_schedule(0.0, PEAK_LEARNING_RATE, min(WARM_UP_STEPS, total // 2), total)
    cool = min(COOL_DOWN_STEPS, end)

    def schedule(step: Any) -> Any:
        return cosine(step) * jax.numpy.clip((end - step) / cool, 0.0, 1.0)

    adamw = optax.adamw(schedule, weight_decay=WEIGHT_DECAY)
    optimiser = optax.chain(optax.clip_by_global_norm(MAX_GRADIENT_NORM), adamw)
    gradient = jax.value_and_grad(lambda parameters, f, future, known: loss(parameters, f, future, known, jax.numpy))

    @jax.jit
    def advance(parameters: Any, state: Any, *batch: Any) -> tuple[Any, Any, Any]:
        value, slope = gradient(parameters, *batch)
        updates, state = optimiser.update(slope, state, parameters)
        return optax.apply_updates(parameters, updates), state, value

    recipe = f"seed {seed}, {epochs} epochs, {end} steps, {len(scenes)} scenes, {digest(scenes)}"
    stored = folder / "state.npz"
    parameters: Any = make_parameters(seed)
    state = optimiser.init(parameters)
    step = 0
    if stored.exists():
        step, parameters, state = _restore(stored, recipe, parameters, state, jax)
    lately: list[float] = []
    for batch in _batches(scenes, seed, step, end):
        parameters, state, value = advance(parameters, state, *batch)
        lately.append(float(value))
        step += 1
        if step % keep_every == 0 or step == end:
            _keep(stored, recipe, step, parameters, jax.tree_util.tree_leaves(state))
            write_weights(parameters, folder / "weights.npz")
            progress(step, end, sum(lately) / len(lately))
            lately.clear()
    return folder / "weights.npz"


def loss(parameters: Any, f: Features, future: Any, known: Any, xp: Any = np) -> Any:
    """The mean loss over the vehicles with a known future, of many scenes; arrays as in ``Scenes``."""
    modes = forward(parameters, f, xp)
    counted = known.astype(future.dtype)
    count = counted.sum(axis=-1)
    moves = abs(future).max(axis=(-2, -1)) > MIN_MOVING_DISTANCE_M
    moves = moves * (1.0 - STANDING_LOSS_WEIGHT) + STANDING_LOSS_WEIGHT
    weight = f.there * (count > 0) * moves
    apart = modes.place - future[..., None, :, :]
    far = xp.sqrt((apart * apart).sum(axis=-1) + 1e-6)
    mean = (far * counted[..., None, :]).sum(axis=-1) / xp.maximum(count, 1.0)[..., None]  # (..., AGENTS, MODES)
    best = (mean.argmin(axis=-1)[..., None] == xp.arange(mean.shape[-1])).astype(future.dtype)
    unlikely = (xp.log(2.0 * modes.scale) + abs(apart) / modes.scale).sum(axis=-1)
    unlikely = (unlikely * counted[..., None, :]).sum(axis=-1) / xp.maximum(count, 1.0)[..., None]
    target = softmax(-_constant(mean, xp), xp)
    entropy = -(target * xp.log(softmax(modes.logit, xp) + 1e-9)).sum(axis=-1)
    return (((unlikely * best).sum(axis=-1) + entropy) * weight).sum() / xp.maximum(weight.sum(), 1.0)


def _constant(values: Any, xp: Any) -> Any:
    """The values, through which no gradient goes."""
    if xp is np:
        return values
    from jax.lax import stop_gradient

    return stop_gradient(values)


def digest(scenes: Scenes) -> str:
    """SHA-256 over what is learnt from, in short."""
    checksum = hashlib.sha256()
    for values in (*scenes.features, scenes.future, scenes.known):
        checksum.update(np.ascontiguousarray(values).tobytes())
    return checksum.hexdigest()[:16]


def _batches(scenes: Scenes, seed: int, first: int, end: int) -> Iterator[tuple[Features, Any, Any]]:
    """The batches of the steps ``first`` to ``end``: each epoch in an order of its own."""
    a_epoch = len(scenes) // BATCH_SCENES
    epoch, order = -1, np.empty(0, np.intp)
    for step in range(first, end):
        if step // a_epoch != epoch:
            epoch = step // a_epoch
            order = np.random.default_rng([seed, epoch]).permutation(len(scenes))
        rows = np.sort(order[step % a_epoch * BATCH_SCENES :][:BATCH_SCENES])
        inputs = Features(*(np.asarray(values[rows], np.float32) for values in scenes.features))
        yield inputs, np.asarray(scenes.future[rows], np.float32), scenes.known[rows]


def _keep(stored: Path, recipe: str, step: int, parameters: Any, moments: Any) -> None:
    arrays: dict[str, Any] = {PARAMETER_PREFIX + name: np.asarray(values) for name, values in parameters.items()}
    arrays |= {f"{MOMENT_PREFIX}{k:04d}": np.asarray(values) for k, values in enumerate(moments)}
    arrays |= {"what": np.array(recipe), "step": np.array(step)}
    write_whole(stored, lambda part: np.savez(part, **arrays))


def _restore(stored: Path, recipe: str, parameters: Any, state: Any, jax: Any) -> tuple[int, Any, Any]:
    try:
        with np.load(stored, allow_pickle=False) as arrays:
            entries = dict(arrays)
        before = str(entries["what"])
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"{stored} cannot be read ({error}); delete it to train from the beginning.") from error
    if before != recipe:
        raise UsageError(f"{stored} is of another training ({before}, not {recipe}); give another --out.")
    moments = [entries[name] for name in sorted(entries) if name.startswith(MOMENT_PREFIX)]
    structure = jax.tree_util.tree_structure(state)
    restored = {name: entries[PARAMETER_PREFIX + name] for name in parameters}
    return int(entries["step"]), restored, jax.tree_util.tree_unflatten(structure, moments)


def _libraries() -> tuple[Any, Any]:
    """JAX, told to use one thread, and optax."""
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {ONE_THREAD}".strip()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    try:
        import jax
        import optax
    except ImportError as error:
        raise UsageError("Training needs JAX and optax; install them with pip install 'sumo-adv[train]'.") from error
    return jax, optax


@dataclass(frozen=True, slots=True)
class Score:
    """One predictor's figures, [m] but for the miss rate; ``vehicles``: how many they are means of."""

    predictor: str
    min_ade: float
    min_fde: float
    miss_rate: float
    ade: float
    fde: float
    vehicles: int


def evaluate(parameters: Parameters, scenes: Scenes) -> list[Score]:
    """The figures of the network, of lane following (where the scenes have it) and of constant velocity."""
    rows: dict[str, list[Floats]] = {}
    for k in range(0, len(scenes), EVALUATED_SCENES_AT_ONCE):
        some = slice(k, k + EVALUATED_SCENES_AT_ONCE)
        f = Features(*(np.asarray(values[some], np.float32) for values in scenes.features))
        future = np.asarray(scenes.future[some], float)
        chosen = counted(scenes.known[some], future)
        modes = forward(parameters, f)
        likeliest = np.argmax(modes.logit, axis=-1)
        first = np.argsort(np.arange(modes.logit.shape[-1]) != likeliest[..., None], axis=-1, kind="stable")
        ordered = np.take_along_axis(modes.place, first[..., None, None], axis=2)
        rows.setdefault("transformer", []).append(_errors(ordered, future, chosen))
        if scenes.followed is not None:
            rows.setdefault("lane following", []).append(_errors(scenes.followed[some], future, chosen))
        steady = f.state[..., :1] * SPEED_SCALE_M_S * FUTURE_TIMES_S
        straight = np.stack([steady, 0.0 * steady], axis=-1)[:, :, None]
        rows.setdefault("constant velocity", []).append(_errors(straight, future, chosen))
    return [_score(name, np.concatenate(parts)) for name, parts in rows.items()]


def counted(known: Bools, future: Floats) -> Bools:
    """Which vehicles count, ``(n, AGENTS)``."""
    return np.asarray(known.all(axis=-1) & (np.hypot(*np.moveaxis(future[..., -1, :], -1, 0)) > MIN_MOVING_DISTANCE_M))


def _errors(places: Floats, future: Floats, chosen: Bools) -> Floats:
    """For each vehicle that counts: minADE, minFDE, ADE and FDE of ``places``, the likeliest first, ``(n, 4)``."""
    far = np.hypot(*np.moveaxis(places[chosen] - future[chosen][:, None], -1, 0))  # (vehicles, predictions, FUTURE)
    mean, last = far.mean(axis=-1), far[..., -1]
    return np.column_stack([np.nanmin(mean, axis=1), np.nanmin(last, axis=1), mean[:, 0], last[:, 0]])


def _score(name: str, errors: Floats) -> Score:
    min_ade, min_fde, ade, fde = errors.mean(axis=0).tolist()
    return Score(name, min_ade, min_fde, float((errors[:, 1] > MISS_DISTANCE_M).mean()), ade, fde, len(errors))
