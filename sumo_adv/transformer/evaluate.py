"""How good the predictions are, on vehicles of held-out networks, beside two simple predictors.

minADE and minFDE: the mean and the last distance [m] between what happened and the nearest of up to six predictions,
each measure with its own nearest one; miss rate: the share of vehicles with a minFDE of more than ``MISS``; ADE and
FDE: those of the likeliest prediction alone. Constant velocity has one prediction; lane following has one for each way
on from the vehicle's lane, the straightest first. A vehicle counts if it moves and its whole future is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.transformer.dataset import MOVES, Scenes
from sumo_adv.transformer.model import TIMES, Parameters, forward
from sumo_adv.transformer.scene import SPEED, Features

MISS = 2.0  # m, as in HiVT
AT_ONCE = 64  # scenes


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
    for k in range(0, len(scenes), AT_ONCE):
        some = slice(k, k + AT_ONCE)
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
        steady = f.state[..., :1] * SPEED * TIMES
        straight = np.stack([steady, 0.0 * steady], axis=-1)[:, :, None]
        rows.setdefault("constant velocity", []).append(_errors(straight, future, chosen))
    return [_score(name, np.concatenate(parts)) for name, parts in rows.items()]


def counted(known: Bools, future: Floats) -> Bools:
    """Which vehicles count, ``(n, AGENTS)``."""
    return np.asarray(known.all(axis=-1) & (np.hypot(*np.moveaxis(future[..., -1, :], -1, 0)) > MOVES))


def _errors(places: Floats, future: Floats, chosen: Bools) -> Floats:
    """For each vehicle that counts: minADE, minFDE, ADE and FDE of ``places``, the likeliest first, ``(n, 4)``."""
    far = np.hypot(*np.moveaxis(places[chosen] - future[chosen][:, None], -1, 0))  # (vehicles, predictions, FUTURE)
    mean, last = far.mean(axis=-1), far[..., -1]
    return np.column_stack([np.nanmin(mean, axis=1), np.nanmin(last, axis=1), mean[:, 0], last[:, 0]])


def _score(name: str, errors: Floats) -> Score:
    min_ade, min_fde, ade, fde = errors.mean(axis=0).tolist()
    return Score(name, min_ade, min_fde, float((errors[:, 1] > MISS).mean()), ade, fde, len(errors))
