"""Which opponent a name on the command line means."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from sumo_adv.benchmark.nouns import Opponent
from sumo_adv.benchmark.rows.bezier import Bezier
from sumo_adv.benchmark.rows.cma import Cma
from sumo_adv.benchmark.rows.fixed_intent import LABELS, FixedIntent
from sumo_adv.benchmark.rows.oracle import Oracle
from sumo_adv.benchmark.rows.random_intent import RandomIntent
from sumo_adv.benchmark.rows.random_search import RandomSearch
from sumo_adv.benchmark.rows.resampling import Resampling
from sumo_adv.benchmark.rows.transformer import Transformer
from sumo_adv.benchmark.rows.user import UserRow
from sumo_adv.errors import UsageError

ROWS: Mapping[str, Callable[[], Opponent]] = {
    "random": RandomIntent, "oracle": Oracle, "random_search": RandomSearch, "cma": Cma, "bezier": Bezier,
    "resampling": Resampling, "transformer": Transformer,
}  # fmt: skip
FIXED = "fixed:"
WEIGHTS = "transformer:"
EVERY_FIXED = tuple(FIXED + label.lower().replace(" ", "-") for label in LABELS)
"""What ``fixed`` alone means: each behaviour as a row of its own."""


def make_row(text: str) -> Opponent:
    """The opponent that ``text`` names: one of ``ROWS``, ``fixed:LABEL``, ``transformer:FILE`` or ``module:Class``.

    Case and signs of a LABEL do not matter (``fixed:aggressive-cut-in``). Raises UsageError.
    """
    if text in ROWS:
        return ROWS[text]()
    if text.startswith(FIXED):
        return FixedIntent(_label(text.removeprefix(FIXED)))
    if text.startswith(WEIGHTS):
        return Transformer(Path(text.removeprefix(WEIGHTS)))
    if ":" in text:
        return UserRow(text)
    raise UsageError(f"There is no row '{text}'; use {', '.join(ROWS)}, fixed, fixed:LABEL or module:Class.")


def _label(text: str) -> str:
    plain = _plain(text)
    behaviour = next((label for label in LABELS if _plain(label) == plain), None)
    if behaviour is None:
        raise UsageError(f"There is no behaviour '{text}' to fix; use one of {', '.join(LABELS)}.")
    return behaviour


def _plain(text: str) -> str:
    return "".join(c for c in text.lower() if c.isalnum())
