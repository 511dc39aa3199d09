"""What makes a candidate new: it is no near-copy of an attempt, and of a kind that has not succeeded yet.

What an attempt came to is decided at the contact, or at the closest approach. Another candidate can only come to
something else if its adversary is elsewhere then, or arrives at another time.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from sumo_adv.datatypes import Floats, Prediction, Proposal

BEFORE = np.array([-1.0, -0.5, 0.0])  # s before the contact or the closest approach: when motions are compared
TRACE_STEP = 0.5  # s between the positions in ``Prediction.trace``


def kind_of(label: str, relation: str, side: str | None) -> str:
    """The kind of an attack: its intent, the adversary's relation to the ego, and the side of the ego that is hit."""
    return f"{label} / {relation} / {side or 'no contact'}"


def is_copy(p: Proposal, tried: Proposal, differs: float) -> bool:
    """Whether the collider of ``p`` is predicted to stay within ``differs`` [m] of that of an attempt in the last
    second before the latter's contact or closest approach, with the same supports."""
    new, old = p.prediction, tried.prediction
    if p.bvs != tried.bvs or new is None or old is None or not new.trace or not old.trace:
        return False
    times = tried.delay + old.closest + BEFORE
    apart = _places(p.delay, new, times) - _places(tried.delay, old, times)
    return bool((np.hypot(*apart) < differs).all())


def _places(delay: float, prediction: Prediction, times: Floats) -> Floats:
    """Positions of the adversary ``(2, n)`` [m] at ``times`` [s after the trigger]; it rests after its trace ends."""
    x, y = _arrays(prediction.trace)
    known = delay + TRACE_STEP * np.arange(len(x))
    return np.stack([np.interp(times, known, x), np.interp(times, known, y)])


@lru_cache(maxsize=8192)
def _arrays(trace: tuple[tuple[float, float], ...]) -> tuple[Floats, Floats]:
    x, y = np.array(trace).T
    return x, y
