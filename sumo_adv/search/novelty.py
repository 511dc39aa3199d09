"""What makes a candidate new: it is no near-copy of an attempt, and of a kind that has not succeeded yet.

What an attempt came to is decided at the contact, or at the closest approach. Another candidate can only come to
something else if its adversary is elsewhere then, or arrives at another time.
"""

from __future__ import annotations

import math

from sumo_adv.datatypes import Prediction, Proposal

BEFORE = (0.0, -0.5, -1.0)  # s before the contact or the closest approach: when motions are compared
TRACE_STEP = 0.5  # s between the positions in ``Prediction.trace``


def kind_of(label: str, relation: str, side: str | None) -> str:
    """The kind of an attack: its intent, the adversary's relation to the ego, and the side of the ego that is hit."""
    return f"{label} / {relation} / {side or 'no contact'}"


def is_copy(p: Proposal, tried: Proposal, differs: float) -> bool:
    """Whether the collider of ``p`` is predicted to stay within ``differs`` [m] of that of an attempt in the last
    second before the latter's contact or closest approach, with the same supports."""
    new, old = p.prediction, tried.prediction
    if new is None or old is None or not new.trace or not old.trace or p.bvs != tried.bvs:
        return False
    for before in BEFORE:
        time = tried.delay + old.closest + before
        (x, y), (old_x, old_y) = _place(p.delay, new, time), _place(tried.delay, old, time)
        if math.hypot(x - old_x, y - old_y) >= differs:
            return False
    return True


def _place(delay: float, prediction: Prediction, time: float) -> tuple[float, float]:
    """Position of the adversary [m] at ``time`` [s after the trigger]; it rests before its trace and after it."""
    trace = prediction.trace
    steps = (time - delay) / TRACE_STEP
    k = int(steps)
    if steps <= 0.0 or k >= len(trace) - 1:
        return trace[0] if steps <= 0.0 else trace[-1]
    (x, y), (next_x, next_y), share = trace[k], trace[k + 1], steps - k
    return x + share * (next_x - x), y + share * (next_y - y)
